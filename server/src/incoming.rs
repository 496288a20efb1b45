//! The bytes of a request → a synced file with its size and hash. Nothing stays behind unless it is finished.

use std::io::Write;
use std::path::Path;

use bytes::Bytes;
use sha2::{Digest, Sha256};
use tempfile::TempPath;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use crate::error::{Error, Result};
use crate::metrics::metrics;
use crate::store::{Facts, hex};

/// Chunks that may wait for the disk.
const QUEUED_CHUNKS: usize = 8;
const PREFIX: &str = "upload-";
const SUFFIX: &str = ".part";

/// A whole upload on disk; the file goes when this does, unless the store took it.
pub struct Incoming {
    /// Where it is.
    pub file: TempPath,
    /// What it is.
    pub facts: Facts,
}

/// Takes the chunks of one upload.
pub struct Receiver {
    chunks: mpsc::Sender<Bytes>,
    writer: JoinHandle<Result<Incoming>>,
    received_bytes: u64,
    limit_bytes: u64,
}

impl Receiver {
    /// Begins an upload of at most `limit_bytes` in a folder.
    pub fn start(folder: &Path, limit_bytes: u64) -> Receiver {
        let (chunks, queue) = mpsc::channel(QUEUED_CHUNKS);
        let folder = folder.to_path_buf();
        let writer = tokio::task::spawn_blocking(move || write_all(&folder, queue));
        Receiver { chunks, writer, received_bytes: 0, limit_bytes }
    }

    /// Takes a chunk; waits for the disk.
    pub async fn push(&mut self, chunk: Bytes) -> Result<()> {
        self.received_bytes += chunk.len() as u64;
        metrics().bytes_in.inc_by(chunk.len() as u64);
        if self.received_bytes > self.limit_bytes {
            return Err(Error::TooLarge { limit_bytes: self.limit_bytes });
        }
        // A closed queue means that the writer failed; `finish` says why.
        if self.chunks.send(chunk).await.is_err() {
            return match (&mut self.writer).await {
                Ok(Err(error)) => Err(error),
                _ => Err(Error::Internal("the upload's writer stopped".into())),
            };
        }
        Ok(())
    }

    /// Ends the upload: the file is whole and synced.
    pub async fn finish(self) -> Result<Incoming> {
        drop(self.chunks);
        self.writer.await.map_err(|e| Error::Internal(format!("the upload's writer stopped: {e}")))?
    }
}

fn write_all(folder: &Path, mut chunks: mpsc::Receiver<Bytes>) -> Result<Incoming> {
    let mut file =
        tempfile::Builder::new().prefix(PREFIX).suffix(SUFFIX).tempfile_in(folder).map_err(|e| Error::io(folder, e))?;
    let (mut hash, mut bytes) = (Sha256::new(), 0);
    while let Some(chunk) = chunks.blocking_recv() {
        file.write_all(&chunk).map_err(|e| Error::io(file.path(), e))?;
        hash.update(&chunk);
        bytes += chunk.len() as u64;
    }
    file.as_file().sync_all().map_err(|e| Error::io(file.path(), e))?;
    Ok(Incoming { file: file.into_temp_path(), facts: Facts { bytes, sha256: hex(&hash.finalize()) } })
}

/// Removes what a server that was killed left of its uploads; only files of this module's own making.
pub fn remove_leftovers(folder: &Path) -> Result<()> {
    for entry in std::fs::read_dir(folder).map_err(|e| Error::io(folder, e))? {
        let path = entry.map_err(|e| Error::io(folder, e))?.path();
        let ours =
            path.file_name().and_then(|n| n.to_str()).is_some_and(|n| n.starts_with(PREFIX) && n.ends_with(SUFFIX));
        if ours {
            std::fs::remove_file(&path).map_err(|e| Error::io(&path, e))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn files_in(folder: &Path) -> usize {
        std::fs::read_dir(folder).expect("lists").count()
    }

    #[tokio::test]
    async fn an_upload_is_whole_or_gone() {
        let dir = tempfile::tempdir().expect("folder");
        let mut receiver = Receiver::start(dir.path(), 6);
        receiver.push(Bytes::from_static(b"abc")).await.expect("fits");
        receiver.push(Bytes::from_static(b"def")).await.expect("fits");
        let incoming = receiver.finish().await.expect("whole");
        assert_eq!(std::fs::read(&incoming.file).expect("reads"), b"abcdef");
        assert_eq!(incoming.facts, crate::store::facts_of(&incoming.file).expect("reads"));
        drop(incoming);

        let mut receiver = Receiver::start(dir.path(), 6);
        receiver.push(Bytes::from_static(b"abcdef")).await.expect("fits");
        let error = receiver.push(Bytes::from_static(b"g")).await.expect_err("one too many");
        assert!(matches!(error, Error::TooLarge { limit_bytes: 6 }));
        let Receiver { chunks, writer, .. } = receiver;
        drop(chunks);
        drop(writer.await);
        assert_eq!(files_in(dir.path()), 0);
    }

    #[tokio::test]
    async fn leftovers_go_and_strangers_stay() {
        let dir = tempfile::tempdir().expect("folder");
        std::fs::write(dir.path().join("upload-x.part"), "half").expect("writes");
        std::fs::write(dir.path().join("notes.txt"), "not ours").expect("writes");
        remove_leftovers(dir.path()).expect("removes");
        assert_eq!(files_in(dir.path()), 1);
    }
}
