//! The files of the service, through `object_store`: a local folder or a bucket on S3. Every key is made here.
//!
//! A file becomes visible under its key whole or not at all, and what is published never changes. A key holds the run,
//! or the job and its fence, so that no two writers ever share one.

mod key;
mod parts;
mod place;
mod transfer;

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use futures::stream::{BoxStream, StreamExt, TryStreamExt};
use object_store::aws::AmazonS3;
use object_store::local::LocalFileSystem;
use object_store::path::Path as ObjectPath;
use object_store::{GetOptions, GetRange, GetResultPayload, ObjectStore, ObjectStoreExt};
use sha2::{Digest, Sha256};
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio_util::io::ReaderStream;

pub use key::{Key, ProductName, attempt_prefix, job_prefix, plain_extension, run_prefix, upload_prefix};
pub use parts::{PART_MIN_BYTES, PARTS_MAX};
pub use place::StorePlace;

use crate::error::{Error, Result};

/// Bytes that are read or written at once.
const CHUNK_BYTES: usize = 256 * 1024;

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
    objects: Arc<dyn ObjectStore>,
    place: Place,
}

/// What a folder and a bucket do each in their own way.
#[derive(Clone)]
enum Place {
    Folder { files: Arc<LocalFileSystem>, root: Arc<PathBuf> },
    Bucket { s3: Arc<AmazonS3>, prefix: ObjectPath },
}

impl Store {
    /// Opens a folder (and makes it), or a bucket.
    pub fn open(place: &StorePlace) -> Result<Store> {
        match place {
            StorePlace::Folder(root) => {
                std::fs::create_dir_all(root).map_err(|e| Error::io(root, e))?;
                let files = Arc::new(LocalFileSystem::new_with_prefix(root)?.with_automatic_cleanup(true));
                Ok(Store { objects: files.clone(), place: Place::Folder { files, root: Arc::new(root.clone()) } })
            }
            StorePlace::Bucket { bucket, prefix } => {
                let s3 = Arc::new(place::s3(bucket)?);
                let prefix = ObjectPath::from(prefix.as_str());
                Ok(Store { objects: s3.clone(), place: Place::Bucket { s3, prefix } })
            }
        }
    }

    /// What stands before every key.
    fn above(&self) -> &ObjectPath {
        static NOTHING: ObjectPath = ObjectPath::ROOT;
        match &self.place {
            Place::Folder { .. } => &NOTHING,
            Place::Bucket { prefix, .. } => prefix,
        }
    }

    /// A key's place in the bucket or folder.
    fn path(&self, key: &Key) -> ObjectPath {
        self.above().parts().chain(key.0.parts()).collect()
    }

    /// A prefix's place in the bucket or folder.
    fn prefixed(&self, prefix: &str) -> ObjectPath {
        self.path(&Key(ObjectPath::from(prefix)))
    }

    /// The folder where it is one: what lies there can be opened and renamed as a file.
    pub fn folder(&self) -> Option<&Path> {
        match &self.place {
            Place::Folder { root, .. } => Some(root.as_path()),
            Place::Bucket { .. } => None,
        }
    }

    /// The files can be reached.
    pub async fn ping(&self) -> Result<()> {
        match self.objects.head(&self.prefixed("ping")).await {
            Ok(_) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(e.into()),
        }
    }

    /// Makes everything taken in so far survive the loss of power: in a folder one call for the whole file system,
    /// since a pyramid of tiles has thousands of files; S3 answers only what it keeps.
    pub async fn sync(&self) -> Result<()> {
        let Place::Folder { root, .. } = &self.place else { return Ok(()) };
        let folder = root.clone();
        let synced =
            blocking(move || rustix::fs::syncfs(std::fs::File::open(folder.as_path())?).map_err(Into::into)).await?;
        synced.map_err(|e| Error::io(root.as_path(), e))
    }

    /// Puts a small file. Durable after [`Store::sync`].
    pub async fn put_bytes(&self, key: &Key, bytes: Bytes) -> Result<Facts> {
        let facts = Facts { bytes: bytes.len() as u64, sha256: hex(&Sha256::digest(&bytes)) };
        self.objects.put(&self.path(key), bytes.into()).await?;
        Ok(facts)
    }

    /// Puts a small file and makes it survive the loss of power, without waiting for anything else that is written to
    /// the same disk.
    pub async fn put_durable(&self, key: &Key, bytes: Bytes) -> Result<Facts> {
        let facts = Facts { bytes: bytes.len() as u64, sha256: hex(&Sha256::digest(&bytes)) };
        match &self.place {
            Place::Bucket { .. } => drop(self.objects.put(&self.path(key), bytes.into()).await?),
            Place::Folder { files, .. } => {
                let path = files.path_to_filesystem(&self.path(key))?;
                let file = path.clone();
                let written = blocking(move || write_durably(&file, &bytes)).await?;
                written.map_err(|e| Error::io(path, e))?;
            }
        }
        Ok(facts)
    }

    /// A small file, of at most `most_bytes`.
    pub async fn get_bytes(&self, key: &Key, most_bytes: u64) -> Result<Bytes> {
        let got = self.objects.get(&self.path(key)).await?;
        if got.meta.size > most_bytes {
            let found = got.meta.size;
            return Err(Error::Internal(format!("{} has {found} bytes; at most {most_bytes} are read", key.as_str())));
        }
        Ok(got.bytes().await?)
    }

    /// The bytes of a file, or of a range of it.
    pub async fn read(&self, key: &Key, range: Range<u64>) -> Result<BoxStream<'static, std::io::Result<Bytes>>> {
        // An empty range is no range to the store.
        let wanted = (!range.is_empty()).then(|| GetRange::Bounded(range.clone()));
        let got = self.objects.get_opts(&self.path(key), GetOptions { range: wanted, ..GetOptions::default() }).await?;
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
        Ok(self.objects.head(&self.path(key)).await?.size)
    }

    /// A small file as it is at one moment although another may take its place; `None` where there is none.
    pub async fn find_bytes(&self, key: &Key, most_bytes: u64) -> Result<Option<Bytes>> {
        match self.get_bytes(key, most_bytes).await {
            Ok(bytes) => Ok(Some(bytes)),
            Err(Error::Store(object_store::Error::NotFound { .. })) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Deletes one file; one that is gone already is no error.
    pub async fn delete(&self, key: &Key) -> Result<()> {
        match self.objects.delete(&self.path(key)).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(e.into()),
        }
    }

    /// Deletes everything under a prefix that this module made.
    pub async fn delete_prefix(&self, prefix: &str) -> Result<()> {
        let listed: Vec<_> = self.objects.list(Some(&self.prefixed(prefix))).try_collect().await?;
        let found = futures::stream::iter(listed.into_iter().map(|o| Ok(o.location))).boxed();
        let mut deleted = self.objects.delete_stream(found);
        while let Some(one) = deleted.next().await {
            match one {
                Ok(_) | Err(object_store::Error::NotFound { .. }) => {}
                Err(e) => return Err(e.into()),
            }
        }
        // A process that was killed while it put a file leaves a piece under a name that no list shows.
        if let Some(root) = self.folder() {
            let folder = root.join(prefix);
            let removed = blocking({
                let folder = folder.clone();
                move || std::fs::remove_dir_all(folder)
            });
            match removed.await? {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(Error::io(folder, e)),
                _ => {}
            }
        }
        Ok(())
    }
}

/// Writes beside the name, syncs, renames, syncs the folder.
fn write_durably(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let folder = path.parent().unwrap_or(path);
    std::fs::create_dir_all(folder)?;
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    std::io::Write::write_all(&mut file, bytes)?;
    file.as_file().sync_data()?;
    file.persist(path)?;
    std::fs::File::open(folder)?.sync_all()
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
mod tests;
