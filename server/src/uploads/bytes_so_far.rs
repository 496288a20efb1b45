//! The bytes of an upload: in a folder a file that grows; on S3 a multipart upload, with what does not fill a part yet
//! kept as an object of its own. Only what [`BytesSoFar::make_durable`] answered may be promised.

use std::io::SeekFrom;
use std::path::PathBuf;

use bytes::Bytes;
use sha2_resumable::Sha256;
use sha2_resumable::digest::Digest;
use tokio::fs::File;
use tokio::io::{AsyncSeekExt, AsyncWriteExt};

use super::{prefix_of, to_i64, to_u64};
use crate::db::tables::upload;
use crate::error::{Error, Result};
use crate::resumed_hash;
use crate::store::{Facts, Key, Store};

/// An upload's bytes, open for more.
pub(super) struct BytesSoFar {
    offset_bytes: u64,
    hash: Sha256,
    place: Place,
}

enum Place {
    Folder { path: PathBuf, file: File },
    Bucket(Box<Parts>),
}

struct Parts {
    store: Store,
    upload: String,
    source: Key,
    name: String,
    part_bytes: usize,
    /// What does not fill a part yet.
    tail: Vec<u8>,
    next_part: i64,
    new_parts: Vec<(i64, String)>,
    tail_number: i64,
    tail_kept_bytes: i64,
    /// The tail that the row promises.
    old_tail: Option<i64>,
}

/// What is durable now.
pub(super) struct Progress {
    pub(super) offset_bytes: i64,
    pub(super) hash_state: String,
    pub(super) tail_number: i64,
    pub(super) tail_bytes: i64,
    pub(super) new_parts: Vec<(i64, String)>,
}

impl BytesSoFar {
    /// Opens them as the row promises them: what came after that and was not promised is dropped.
    pub(super) async fn open(store: &Store, row: &mut upload::Model, parts: Vec<String>) -> Result<BytesSoFar> {
        let offset_bytes = to_u64(row.offset_bytes);
        let hash = resumed_hash::read(&row.hash_state)?;
        let place = match file_of(store, row) {
            Some(path) => Place::Folder { file: open_file(&path, offset_bytes).await?, path },
            None => Place::Bucket(Box::new(Parts::open(store, row, parts).await?)),
        };
        Ok(BytesSoFar { offset_bytes, hash, place })
    }

    /// Bytes so far, durable or not.
    pub(super) fn offset_bytes(&self) -> u64 {
        self.offset_bytes
    }

    pub(super) async fn push(&mut self, chunk: &[u8]) -> Result<()> {
        match &mut self.place {
            Place::Folder { path, file } => file.write_all(chunk).await.map_err(|e| Error::io(path, e))?,
            Place::Bucket(parts) => parts.push(chunk).await?,
        }
        self.hash.update(chunk);
        self.offset_bytes += chunk.len() as u64;
        Ok(())
    }

    /// Makes all of it durable.
    pub(super) async fn make_durable(&mut self) -> Result<Progress> {
        let state = resumed_hash::write(&self.hash);
        match &mut self.place {
            Place::Folder { path, file } => {
                let failed = |e| Error::io(path.as_path(), e);
                file.flush().await.map_err(failed)?;
                file.sync_data().await.map_err(failed)?;
                Ok(Progress {
                    offset_bytes: to_i64(self.offset_bytes),
                    hash_state: state,
                    tail_number: 0,
                    tail_bytes: 0,
                    new_parts: Vec::new(),
                })
            }
            Place::Bucket(parts) => {
                parts.keep_tail().await?;
                Ok(Progress {
                    offset_bytes: to_i64(self.offset_bytes),
                    hash_state: state,
                    tail_number: parts.tail_number,
                    tail_bytes: parts.tail_kept_bytes,
                    new_parts: std::mem::take(&mut parts.new_parts),
                })
            }
        }
    }
}

impl BytesSoFar {
    /// The new tail is promised: the one before goes.
    pub(super) async fn forget_old_tail(&mut self) {
        let Place::Bucket(parts) = &mut self.place else { return };
        let Some(old) = parts.old_tail.replace(parts.tail_number).filter(|old| *old != parts.tail_number) else {
            return;
        };
        let gone = match number(old) {
            Ok(old) => parts.store.delete(&Key::upload_part(&parts.upload, old)).await,
            Err(error) => Err(error),
        };
        if let Err(error) = gone {
            // It goes with the upload.
            tracing::debug!(%error, "an old tail stays for now");
        }
    }
}

async fn open_file(path: &std::path::Path, offset_bytes: u64) -> Result<File> {
    let failed = |e| Error::io(path, e);
    if let Some(folder) = path.parent() {
        tokio::fs::create_dir_all(folder).await.map_err(failed)?;
    }
    let options = std::fs::OpenOptions::new().write(true).create(true).truncate(false).to_owned();
    let mut file = tokio::fs::OpenOptions::from(options).open(path).await.map_err(failed)?;
    let there = file.metadata().await.map_err(failed)?.len();
    if there < offset_bytes {
        return Err(Error::Internal(format!("{}: {there} bytes are left of {offset_bytes}", path.display())));
    }
    file.set_len(offset_bytes).await.map_err(failed)?;
    file.seek(SeekFrom::Start(offset_bytes)).await.map_err(failed)?;
    if offset_bytes == 0 {
        // A file that is promised must have its name, too.
        let folder = path.parent().unwrap_or(path).to_path_buf();
        let synced = tokio::task::spawn_blocking(move || std::fs::File::open(folder)?.sync_all()).await;
        synced.map_err(|e| Error::Internal(format!("file work stopped: {e}")))?.map_err(failed)?;
    }
    Ok(file)
}

impl Parts {
    async fn open(store: &Store, row: &mut upload::Model, parts: Vec<String>) -> Result<Parts> {
        let source = source_key(row)?;
        let name = match &row.parts_name {
            Some(name) => name.clone(),
            None => store.begin_parts(&source).await?,
        };
        row.parts_name = Some(name.clone());
        let tail = match row.tail_bytes {
            0 => Vec::new(),
            bytes => {
                store.get_bytes(&Key::upload_part(&row.id, number(row.tail_number)?), to_u64(bytes)).await?.to_vec()
            }
        };
        let expected = row.offset_bytes - row.part_bytes * parts.len() as i64;
        if tail.len() as i64 != expected {
            return Err(Error::Internal(format!(
                "upload {}: {} bytes are left of its tail of {expected}",
                row.id,
                tail.len()
            )));
        }
        Ok(Parts {
            store: store.clone(),
            upload: row.id.clone(),
            source,
            name,
            part_bytes: usize::try_from(row.part_bytes).unwrap_or(usize::MAX),
            tail,
            next_part: parts.len() as i64,
            new_parts: Vec::new(),
            tail_number: row.tail_number,
            tail_kept_bytes: row.tail_bytes,
            old_tail: Some(row.tail_number),
        })
    }

    /// Parts lie at fixed places of the file, so that two servers that both believe the upload theirs write the same.
    async fn push(&mut self, mut chunk: &[u8]) -> Result<()> {
        while !chunk.is_empty() {
            let room = self.part_bytes - self.tail.len();
            let (now, later) = chunk.split_at(room.min(chunk.len()));
            self.tail.extend_from_slice(now);
            chunk = later;
            if self.tail.len() == self.part_bytes {
                let part = Bytes::from(std::mem::take(&mut self.tail));
                let kept = self.store.put_part(&self.source, &self.name, number(self.next_part)?, part).await?;
                self.new_parts.push((self.next_part, kept));
                self.next_part += 1;
            }
        }
        Ok(())
    }

    async fn keep_tail(&mut self) -> Result<()> {
        if self.tail.is_empty() {
            self.tail_kept_bytes = 0;
            return Ok(());
        }
        // A new name each time: the one before is promised until this one is.
        self.tail_number += 1;
        let key = Key::upload_part(&self.upload, number(self.tail_number)?);
        self.store.put_bytes(&key, Bytes::copy_from_slice(&self.tail)).await?;
        self.tail_kept_bytes = self.tail.len() as i64;
        Ok(())
    }
}

/// All bytes are there: they become the run's source. Right to do twice.
pub(super) async fn become_source(
    store: &Store,
    row: &upload::Model,
    mut parts: Vec<String>,
    source: Key,
    facts: &Facts,
) -> Result<()> {
    if store.size(&source).await.is_ok_and(|bytes| bytes == facts.bytes) {
        return Ok(());
    }
    if let Some(path) = file_of(store, row) {
        store.take_file(&path, &source, facts).await?;
        return store.sync().await;
    }
    let name = row.parts_name.clone().ok_or_else(|| Error::Internal(format!("upload {} has no parts", row.id)))?;
    if row.tail_bytes > 0 {
        let key = Key::upload_part(&row.id, number(row.tail_number)?);
        let tail = store.get_bytes(&key, to_u64(row.tail_bytes)).await?;
        parts.push(store.put_part(&source, &name, number(parts.len() as i64)?, tail).await?);
    }
    store.finish_parts(&source, &name, parts).await
}

/// Deletes what an upload has in the store.
pub(super) async fn drop_all(store: &Store, row: &upload::Model) -> Result<()> {
    if let Some(name) = &row.parts_name {
        store.drop_parts(&source_key(row)?, name).await?;
    }
    drop_tails(store, row).await
}

/// Deletes what is not part of the run that an upload became.
pub(super) async fn drop_tails(store: &Store, row: &upload::Model) -> Result<()> {
    store.delete_prefix(&prefix_of(row)).await
}

/// The growing file, where the store is a folder: on the store's own disk, so that a rename is all it takes in the end.
fn file_of(store: &Store, row: &upload::Model) -> Option<PathBuf> {
    Some(store.folder()?.join(Key::upload(&row.id).as_str()))
}

/// Where the bytes will be: the run's name was made with the upload.
fn source_key(row: &upload::Model) -> Result<Key> {
    let run: crate::runs::NewRun = serde_json::from_str(&row.new_run)
        .map_err(|e| Error::Internal(format!("upload {} has no run: {e}", row.id)))?;
    Ok(Key::source(&row.run_id, &crate::store::plain_extension(&run.filename)))
}

fn number(value: i64) -> Result<u32> {
    u32::try_from(value).map_err(|_| Error::Internal(format!("{value} is no number of a part")))
}
