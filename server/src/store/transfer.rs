//! Files of this machine into the store and out of it, whole and with their hashes checked.

use std::path::{Path, PathBuf};

use futures::stream::TryStreamExt;
use object_store::{ObjectStoreExt, WriteMultipart};
use sha2::{Digest, Sha256};
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::{CHUNK_BYTES, Facts, Key, Place, Store, blocking, facts_of, hex};
use crate::error::{Error, Result};

/// Files up to this size go to S3 in one request, larger ones in parts of at least this size, bytes.
const PART_BYTES: u64 = 8 * 1024 * 1024;
/// Parts that a file is cut into at most; S3 takes 10,000.
const MOST_PARTS: u64 = 9_000;
/// Parts on their way at the same time.
const PARTS_AT_ONCE: usize = 4;

impl Store {
    /// Takes a file in that is as `facts` say: in a folder by renaming it where it lies on the same disk. Durable
    /// after [`Store::sync`].
    pub async fn take_file(&self, from: &Path, key: &Key, facts: &Facts) -> Result<()> {
        if let Place::Folder { files, .. } = &self.place {
            check_file(from, facts).await?;
            let to = files.path_to_filesystem(&self.path(key))?;
            let source = from.to_path_buf();
            match blocking(move || rename_into(&source, &to)).await? {
                Err(e) if e.kind() == std::io::ErrorKind::CrossesDevices => {}
                other => return other.map_err(|e| Error::io(from, e)),
            }
        }
        self.upload(from, key, Some(facts)).await?;
        tokio::fs::remove_file(from).await.map_err(|e| Error::io(from, e))
    }

    /// Takes a copy of a file in.
    pub async fn copy_file(&self, from: &Path, key: &Key) -> Result<Facts> {
        self.upload(from, key, None).await
    }

    /// A file becomes visible only after its hash was compared.
    async fn upload(&self, from: &Path, key: &Key, expected: Option<&Facts>) -> Result<Facts> {
        let unreadable = |e| Error::io(from, e);
        let mut file = tokio::fs::File::open(from).await.map_err(unreadable)?;
        let size = file.metadata().await.map_err(unreadable)?.len();
        if size <= PART_BYTES {
            let mut bytes = Vec::new();
            file.read_to_end(&mut bytes).await.map_err(unreadable)?;
            let facts = Facts { bytes: bytes.len() as u64, sha256: hex(&Sha256::digest(&bytes)) };
            check(from, &facts, expected)?;
            self.objects.put(&self.path(key), bytes.into()).await?;
            return Ok(facts);
        }
        let part_bytes = usize::try_from(PART_BYTES.max(size / MOST_PARTS)).unwrap_or(usize::MAX);
        let begun = self.objects.put_multipart(&self.path(key)).await?;
        let mut parts = WriteMultipart::new_with_chunk_size(begun, part_bytes);
        let result = send_parts(&mut file, &mut parts, from).await.and_then(|facts| {
            check(from, &facts, expected)?;
            Ok(facts)
        });
        match result {
            Ok(facts) => {
                parts.finish().await?;
                Ok(facts)
            }
            Err(error) => {
                if let Err(left) = parts.abort().await {
                    tracing::warn!(%left, key = key.as_str(), "parts of a file stay behind");
                }
                Err(error)
            }
        }
    }

    /// Where a child process can read a file: the store's own copy in a folder, else a checked one in `folder`.
    pub async fn local_copy(&self, key: &Key, facts: &Facts, folder: &Path) -> Result<PathBuf> {
        if let Place::Folder { files, .. } = &self.place {
            return Ok(files.path_to_filesystem(&self.path(key))?);
        }
        let to = folder.join(key.filename());
        self.copy_out(key, facts, &to).await?;
        Ok(to)
    }

    /// Copies a file to a path outside the store, and checks it.
    pub async fn copy_out(&self, key: &Key, facts: &Facts, to: &Path) -> Result<()> {
        let unwritable = |e| Error::io(to, e);
        let mut bytes = self.objects.get(&self.path(key)).await?.into_stream();
        let mut file = tokio::fs::File::create(to).await.map_err(unwritable)?;
        let mut hash = Sha256::new();
        let mut count = 0;
        while let Some(chunk) = bytes.try_next().await? {
            hash.update(&chunk);
            count += chunk.len() as u64;
            file.write_all(&chunk).await.map_err(unwritable)?;
        }
        file.flush().await.map_err(unwritable)?;
        let found = Facts { bytes: count, sha256: hex(&hash.finalize()) };
        check(Path::new(key.as_str()), &found, Some(facts))
    }
}

async fn send_parts(file: &mut tokio::fs::File, parts: &mut WriteMultipart, from: &Path) -> Result<Facts> {
    let (mut hash, mut bytes) = (Sha256::new(), 0);
    let mut chunk = vec![0u8; CHUNK_BYTES];
    loop {
        let n = file.read(&mut chunk).await.map_err(|e| Error::io(from, e))?;
        if n == 0 {
            return Ok(Facts { bytes, sha256: hex(&hash.finalize()) });
        }
        hash.update(&chunk[..n]);
        bytes += n as u64;
        parts.wait_for_capacity(PARTS_AT_ONCE).await?;
        parts.write(&chunk[..n]);
    }
}

async fn check_file(file: &Path, expected: &Facts) -> Result<()> {
    let path = file.to_path_buf();
    let found = blocking(move || facts_of(&path)).await?.map_err(|e| Error::io(file, e))?;
    check(file, &found, Some(expected))
}

fn check(what: &Path, found: &Facts, expected: Option<&Facts>) -> Result<()> {
    match expected {
        Some(expected) if expected != found => Err(Error::Internal(format!(
            "{} has {} bytes with the SHA-256 {}; expected {} bytes with {}",
            what.display(),
            found.bytes,
            found.sha256,
            expected.bytes,
            expected.sha256
        ))),
        _ => Ok(()),
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
