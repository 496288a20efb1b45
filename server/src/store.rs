//! The files of the service, through `object_store`: a local folder. Every key is made here.
//!
//! A file becomes visible under its key whole or not at all, and what is published never changes.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use futures::stream::{BoxStream, StreamExt, TryStreamExt};
use object_store::local::LocalFileSystem;
use object_store::path::Path as ObjectPath;
use object_store::{GetOptions, GetRange, GetResultPayload, ObjectStore, ObjectStoreExt, WriteMultipart};
use sha2::{Digest, Sha256};
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio_util::io::ReaderStream;

use crate::error::{Error, Result};

/// Bytes that are read or written at once.
const CHUNK_BYTES: usize = 256 * 1024;

/// Longest name of a product, characters.
const MAX_NAME_CHARS: usize = 200;

/// Longest file name extension that a source keeps.
const MAX_EXTENSION_CHARS: usize = 8;

/// The name of one file in the store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key(ObjectPath);

impl Key {
    fn new(text: String) -> Key {
        Key(ObjectPath::from(text))
    }

    /// A run's images.
    pub fn source(run: &str, extension: &str) -> Key {
        let dot = if extension.is_empty() { "" } else { "." };
        Key::new(format!("{}source{dot}{extension}", run_prefix(run)))
    }

    /// A product of an attempt.
    pub fn product(job: &str, fence: i64, name: &ProductName) -> Key {
        Key::new(format!("{}products/{}", attempt_prefix(job, fence), name.0))
    }

    /// A recording segment of an attempt.
    pub fn segment(job: &str, fence: i64, number: u32) -> Key {
        Key::new(format!("{}recording/{number:06}.rrd", attempt_prefix(job, fence)))
    }
}

/// Everything of a run that is not its jobs'.
pub fn run_prefix(run: &str) -> String {
    format!("runs/{run}/")
}

/// Everything of a job.
pub fn job_prefix(job: &str) -> String {
    format!("jobs/{job}/")
}

/// Everything of one attempt at a job.
pub fn attempt_prefix(job: &str, fence: i64) -> String {
    format!("jobs/{job}/{fence:06}/")
}

/// The path of a product inside its folder: plain words with `/` between them, so that it can be no path elsewhere.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ProductName(String);

impl ProductName {
    /// Checks a name; `None` where it is none that a pipeline would give.
    pub fn new(name: &str) -> Option<ProductName> {
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
        let word = |w: &str| !w.is_empty() && !w.starts_with('.') && w.chars().all(plain);
        (name.len() <= MAX_NAME_CHARS && name.split('/').all(word)).then(|| ProductName(name.into()))
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// The extension of an uploaded file's name, where it is a plain one; a hint for FFmpeg, nothing more.
pub fn plain_extension(filename: &str) -> String {
    let extension = Path::new(filename).extension().and_then(|e| e.to_str()).unwrap_or_default();
    let plain = extension.len() <= MAX_EXTENSION_CHARS && extension.chars().all(|c| c.is_ascii_alphanumeric());
    if plain { extension.to_ascii_lowercase() } else { String::new() }
}

/// A file's size and hash.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Facts {
    /// Size, bytes.
    pub bytes: u64,
    /// SHA-256 in lower-case hex.
    pub sha256: String,
}

/// The files.
#[derive(Clone)]
pub struct Store {
    objects: Arc<LocalFileSystem>,
    root: Arc<PathBuf>,
}

impl Store {
    /// Opens (or makes) a local folder.
    pub fn open(root: &Path) -> Result<Store> {
        std::fs::create_dir_all(root).map_err(|e| Error::io(root, e))?;
        let objects = LocalFileSystem::new_with_prefix(root)?.with_automatic_cleanup(true);
        Ok(Store { objects: Arc::new(objects), root: Arc::new(root.to_path_buf()) })
    }

    /// Takes a file in, by renaming it where it lies on the store's own disk. Durable after [`Store::sync`].
    pub async fn take_file(&self, from: &Path, key: &Key) -> Result<()> {
        let to = self.objects.path_to_filesystem(&key.0)?;
        let source = from.to_path_buf();
        let moved = blocking(move || rename_into(&source, &to)).await?;
        match moved {
            Err(e) if e.kind() == std::io::ErrorKind::CrossesDevices => {
                self.copy_file(from, key).await?;
                tokio::fs::remove_file(from).await.map_err(|e| Error::io(from, e))
            }
            other => other.map_err(|e| Error::io(from, e)),
        }
    }

    /// Takes a copy of a file in.
    pub async fn copy_file(&self, from: &Path, key: &Key) -> Result<Facts> {
        let mut file = tokio::fs::File::open(from).await.map_err(|e| Error::io(from, e))?;
        let mut upload = WriteMultipart::new(self.objects.put_multipart(&key.0).await?);
        let (mut hash, mut bytes) = (Sha256::new(), 0);
        let mut chunk = vec![0u8; CHUNK_BYTES];
        loop {
            let n = file.read(&mut chunk).await.map_err(|e| Error::io(from, e))?;
            if n == 0 {
                break;
            }
            hash.update(&chunk[..n]);
            bytes += n as u64;
            upload.wait_for_capacity(4).await?;
            upload.write(&chunk[..n]);
        }
        upload.finish().await?;
        Ok(Facts { bytes, sha256: hex(&hash.finalize()) })
    }

    /// Makes everything taken in so far survive the loss of power: one call for the whole file system, since a
    /// pyramid of tiles has thousands of files.
    pub async fn sync(&self) -> Result<()> {
        let root = self.root.clone();
        let synced =
            blocking(move || rustix::fs::syncfs(std::fs::File::open(root.as_path())?).map_err(Into::into)).await?;
        synced.map_err(|e| Error::io(self.root.as_path(), e))
    }

    /// The bytes of a file, or of a range of it.
    pub async fn read(&self, key: &Key, range: Range<u64>) -> Result<BoxStream<'static, std::io::Result<Bytes>>> {
        // An empty range is no range to the store.
        let wanted = (!range.is_empty()).then(|| GetRange::Bounded(range.clone()));
        let got = self.objects.get_opts(&key.0, GetOptions { range: wanted, ..GetOptions::default() }).await?;
        if range.is_empty() {
            return Ok(futures::stream::empty().boxed());
        }
        match got.payload {
            // The store's own stream reads 8 KiB a time, each on a thread of its own.
            GetResultPayload::File(file, path) => {
                let mut file = tokio::fs::File::from_std(file);
                file.seek(std::io::SeekFrom::Start(range.start)).await.map_err(|e| Error::io(path, e))?;
                let part = file.take(range.end - range.start);
                Ok(ReaderStream::with_capacity(part, CHUNK_BYTES).boxed())
            }
            GetResultPayload::Stream(stream) => Ok(stream.map_err(std::io::Error::other).boxed()),
        }
    }

    /// Size of a file, bytes.
    pub async fn size(&self, key: &Key) -> Result<u64> {
        Ok(self.objects.head(&key.0).await?.size)
    }

    /// Where a child process can read a file.
    pub fn local_file(&self, key: &Key) -> Result<PathBuf> {
        Ok(self.objects.path_to_filesystem(&key.0)?)
    }

    /// Deletes everything under a prefix that this file made.
    pub async fn delete_prefix(&self, prefix: &str) -> Result<()> {
        let listed: Vec<_> = self.objects.list(Some(&ObjectPath::from(prefix))).try_collect().await?;
        let found = futures::stream::iter(listed.into_iter().map(|o| Ok(o.location))).boxed();
        let mut deleted = self.objects.delete_stream(found);
        while let Some(one) = deleted.next().await {
            match one {
                Ok(_) | Err(object_store::Error::NotFound { .. }) => {}
                Err(e) => return Err(e.into()),
            }
        }
        Ok(())
    }
}

/// Renames, making the folders above; a clean-up of empty folders beside us may take one away in between.
fn rename_into(from: &Path, to: &Path) -> std::io::Result<()> {
    const TRIES: usize = 5;
    let mut result = Ok(());
    for _ in 0..TRIES {
        if let Some(folder) = to.parent() {
            std::fs::create_dir_all(folder)?;
        }
        result = std::fs::rename(from, to);
        match &result {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound && from.exists() => continue,
            _ => break,
        }
    }
    result
}

/// Runs file work off the async threads; the outer error is a panic in it.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T> {
    tokio::task::spawn_blocking(work).await.map_err(|e| Error::Internal(format!("file work stopped: {e}")))
}

/// Lower-case hex.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// SHA-256 of a text in lower-case hex.
pub fn sha256_of(text: &str) -> String {
    hex(&Sha256::digest(text.as_bytes()))
}

/// Size and SHA-256 of a file, read in one pass; blocks.
pub fn facts_of(path: &Path) -> std::io::Result<Facts> {
    let mut file = std::fs::File::open(path)?;
    let mut hash = Sha256::new();
    let bytes = std::io::copy(&mut file, &mut hash)?;
    Ok(Facts { bytes, sha256: hex(&hash.finalize()) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_could_be_paths_are_refused() {
        for name in ["depth.tif", "tiles/depth/3/0_1.png", "cloud-2.ply", "report_v1.html"] {
            assert!(ProductName::new(name).is_some(), "{name}");
        }
        for name in ["", "..", "../x", "a//b", "/etc/passwd", "a/../b", ".hidden", "a\\b", "a b", "é", "a%2fb", "a\0b"]
        {
            assert!(ProductName::new(name).is_none(), "{name:?}");
        }
        assert!(ProductName::new(&"a".repeat(MAX_NAME_CHARS + 1)).is_none());
    }

    #[test]
    fn only_plain_extensions_are_kept() {
        for (name, extension) in
            [("run.MP4", "mp4"), ("../../x.mkv", "mkv"), ("a.m p4", ""), ("a.abcdefghi", ""), ("a", ""), ("a.\"x", "")]
        {
            assert_eq!(plain_extension(name), extension, "{name}");
        }
    }

    #[tokio::test]
    async fn files_come_back_by_range_and_go_by_prefix() {
        let dir = tempfile::tempdir().expect("folder");
        let store = Store::open(&dir.path().join("store")).expect("opens");
        let name = ProductName::new("tiles/0.png").expect("plain");
        let (moved, copied) = (Key::product("job", 1, &name), Key::segment("job", 1, 0));
        let file = dir.path().join("made");
        std::fs::write(&file, b"0123456789").expect("writes");
        let facts = store.copy_file(&file, &copied).await.expect("copies");
        assert_eq!(facts, facts_of(&file).expect("reads"));
        store.take_file(&file, &moved).await.expect("moves");
        store.sync().await.expect("syncs");
        assert!(!file.exists());
        for key in [&moved, &copied] {
            for (range, expected) in [(0..10, "0123456789"), (3..5, "34"), (9..10, "9"), (4..4, "")] {
                let chunks: Vec<Bytes> =
                    store.read(key, range).await.expect("opens").try_collect().await.expect("reads");
                assert_eq!(chunks.concat(), expected.as_bytes());
            }
        }
        store.delete_prefix(&attempt_prefix("job", 2)).await.expect("nothing there is no error");
        store.delete_prefix(&attempt_prefix("job", 1)).await.expect("deletes");
        assert!(store.size(&moved).await.is_err() && store.size(&copied).await.is_err());
        assert!(!dir.path().join("store/jobs").exists(), "empty folders go too");
    }
}
