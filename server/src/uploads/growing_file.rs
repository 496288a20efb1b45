//! An upload's bytes in a folder: a file that grows. A thread apart writes, while the next chunks are received
//! and hashed.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use tokio::task::{JoinHandle, spawn_blocking};

use crate::error::{Error, Result};
use crate::store::Store;

/// So many received bytes wait at most for being written.
const WAITING_BYTES: usize = 8 << 20;

/// The file, open at its end.
pub(super) struct GrowingFile {
    path: PathBuf,
    file: Arc<std::fs::File>,
    waiting: Arc<Mutex<Waiting>>,
    writing: Option<JoinHandle<std::io::Result<()>>>,
}

/// Chunks that were received while others were written.
#[derive(Default)]
struct Waiting {
    chunks: Vec<Bytes>,
    bytes: usize,
    /// Somebody writes and will look here again.
    is_served: bool,
}

impl GrowingFile {
    /// Opens it, or makes it, with so many bytes: what is longer is cut.
    pub(super) async fn open(store: &Store, path: PathBuf, bytes: u64) -> Result<GrowingFile> {
        let inside = store.folder().map(Path::to_path_buf);
        let place = path.clone();
        let opened = spawn_blocking(move || open_at(&place, inside.as_deref(), bytes)).await;
        let file = Arc::new(opened.map_err(stopped)??);
        Ok(GrowingFile { path, file, waiting: Arc::default(), writing: None })
    }

    /// Takes a chunk. A write that failed is told by one of the next calls, by [`GrowingFile::written`] at the latest.
    pub(super) async fn push(&mut self, chunk: Bytes) -> Result<()> {
        let (is_served, is_full) = {
            let mut waiting = locked(&self.waiting);
            waiting.bytes += chunk.len();
            waiting.chunks.push(chunk);
            (std::mem::replace(&mut waiting.is_served, true), waiting.bytes >= WAITING_BYTES)
        };
        if !is_served {
            // Whoever served before has ended.
            self.written().await?;
            let (file, waiting) = (self.file.clone(), self.waiting.clone());
            self.writing = Some(spawn_blocking(move || write(&file, &waiting)));
        }
        if is_full { self.written().await } else { Ok(()) }
    }

    /// All that was pushed is in the file, though perhaps not on the disk yet.
    pub(super) async fn written(&mut self) -> Result<()> {
        match self.writing.take() {
            Some(writing) => writing.await.map_err(stopped)?.map_err(|e| Error::io(&self.path, e)),
            None => Ok(()),
        }
    }

    /// Brings what is in the file onto the disk; more may be pushed meanwhile.
    pub(super) fn synced(&self) -> impl Future<Output = Result<()>> + Send + use<> {
        let (file, path) = (self.file.clone(), self.path.clone());
        async move {
            let synced = spawn_blocking(move || file.sync_data()).await;
            synced.map_err(stopped)?.map_err(|e| Error::io(path, e))
        }
    }

    /// Cuts the file to so many bytes; what waits is dropped.
    pub(super) async fn cut(mut self, bytes: u64) -> Result<()> {
        // A write that still runs would make the file longer again; how it ends does not matter.
        let _ = self.written().await;
        let cut = spawn_blocking(move || self.file.set_len(bytes).map_err(|e| Error::io(&self.path, e))).await;
        cut.map_err(stopped)?
    }
}

/// Writes what waits until nothing does. After an error nobody serves any more: the upload ends with it.
fn write(mut file: &std::fs::File, waiting: &Mutex<Waiting>) -> std::io::Result<()> {
    loop {
        let chunks = {
            let mut waiting = locked(waiting);
            waiting.bytes = 0;
            waiting.is_served = !waiting.chunks.is_empty();
            std::mem::take(&mut waiting.chunks)
        };
        if chunks.is_empty() {
            return Ok(());
        }
        for chunk in &chunks {
            file.write_all(chunk)?;
        }
    }
}

fn locked(waiting: &Mutex<Waiting>) -> MutexGuard<'_, Waiting> {
    // A panic while it was held leaves the list as it was.
    waiting.lock().unwrap_or_else(PoisonError::into_inner)
}

fn open_at(path: &Path, inside: Option<&Path>, bytes: u64) -> Result<std::fs::File> {
    use std::io::{Seek, SeekFrom};
    let failed = |e| Error::io(path, e);
    let mut file = open_or_make(path).map_err(failed)?;
    let there = file.metadata().map_err(failed)?.len();
    if there < bytes {
        return Err(Error::Internal(format!("{}: {there} bytes are left of {bytes}", path.display())));
    }
    file.set_len(bytes).map_err(failed)?;
    file.seek(SeekFrom::Start(bytes)).map_err(failed)?;
    if bytes == 0 {
        // A file that is promised must have its name, too, and so must the folders above it.
        let folders = path.ancestors().skip(1).take_while(|folder| inside.is_some_and(|top| folder.starts_with(top)));
        for folder in folders {
            std::fs::File::open(folder).and_then(|folder| folder.sync_all()).map_err(failed)?;
        }
    }
    Ok(file)
}

/// Opens a file, or makes it with the folders above; a clean-up of empty folders beside us may take one away in between.
fn open_or_make(path: &Path) -> std::io::Result<std::fs::File> {
    const TRIES: usize = 5;
    let mut tried = 0;
    loop {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let opened = std::fs::File::options().write(true).create(true).truncate(false).open(path);
        tried += 1;
        match opened {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound && tried < TRIES => {}
            other => return other,
        }
    }
}

fn stopped(error: tokio::task::JoinError) -> Error {
    Error::Internal(format!("file work stopped: {error}"))
}
