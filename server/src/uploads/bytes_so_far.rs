//! The bytes of an upload: in a folder a file that grows; on S3 a multipart upload, with what does not fill a part yet
//! kept as an object of its own. Only what is durable may be promised: [`BytesSoFar::make_durable`] waits for it,
//! [`BytesSoFar::becomes_durable`] leaves that to others.

use std::path::PathBuf;

use bytes::Bytes;
use sea_orm::ActiveValue::Set;
use sha2_resumable::Sha256;
use sha2_resumable::digest::Digest;

use super::growing_file::GrowingFile;
use super::{gone, to_i64, to_u64};
use crate::db::tables::upload;
use crate::error::{Error, Result};
use crate::resumed_hash;
use crate::store::{Facts, Key, Store, upload_prefix};

/// An upload's bytes, open for more.
pub(super) struct BytesSoFar {
    offset_bytes: u64,
    hash: Sha256,
    place: Place,
}

enum Place {
    Folder { file: GrowingFile, promised_bytes: u64 },
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
    /// This request's, which goes into the names of its tails.
    fence: i64,
    /// The tail that is kept now …
    kept: Tail,
    /// … and the one that the row promises.
    promised: Tail,
}

/// Bytes after the last whole part, kept as an object; no bytes, no object.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Tail {
    pub(super) fence: i64,
    pub(super) number: i64,
    pub(super) bytes: i64,
}

impl Tail {
    fn of(row: &upload::Model) -> Tail {
        Tail { fence: row.tail_fence, number: row.tail_number, bytes: row.tail_bytes }
    }

    fn key(self, upload: &str) -> Key {
        Key::upload_tail(upload, self.fence, self.number)
    }
}

/// What is durable now.
pub(super) struct Progress {
    pub(super) offset_bytes: i64,
    pub(super) hash_state: String,
    pub(super) tail: Tail,
    pub(super) new_parts: Vec<(i64, String)>,
}

impl Progress {
    /// The row's change that promises it.
    pub(super) fn change(&self) -> upload::ActiveModel {
        upload::ActiveModel {
            offset_bytes: Set(self.offset_bytes),
            hash_state: Set(self.hash_state.clone()),
            tail_fence: Set(self.tail.fence),
            tail_number: Set(self.tail.number),
            tail_bytes: Set(self.tail.bytes),
            ..Default::default()
        }
    }
}

impl BytesSoFar {
    /// Opens them as the row promises them: what came after that and was not promised is dropped.
    pub(super) async fn open(store: &Store, row: &upload::Model, parts: Vec<String>) -> Result<BytesSoFar> {
        let offset_bytes = to_u64(row.offset_bytes);
        let hash = resumed_hash::read(&row.hash_state)?;
        let place = match file_of(store, row) {
            Some(path) => {
                let file = GrowingFile::open(store, path, offset_bytes).await?;
                Place::Folder { file, promised_bytes: offset_bytes }
            }
            None => Place::Bucket(Box::new(Parts::open(store, row, parts).await?)),
        };
        Ok(BytesSoFar { offset_bytes, hash, place })
    }

    /// Bytes so far, durable or not.
    pub(super) fn offset_bytes(&self) -> u64 {
        self.offset_bytes
    }

    pub(super) async fn push(&mut self, chunk: Bytes) -> Result<()> {
        self.hash.update(&chunk);
        self.offset_bytes += chunk.len() as u64;
        match &mut self.place {
            Place::Folder { file, .. } => file.push(chunk).await,
            Place::Bucket(parts) => parts.push(&chunk).await,
        }
    }

    fn progress(&self) -> Progress {
        Progress {
            offset_bytes: to_i64(self.offset_bytes),
            hash_state: resumed_hash::write(&self.hash),
            tail: Tail { fence: 0, number: 0, bytes: 0 },
            new_parts: Vec::new(),
        }
    }

    /// In a folder: what there is now will be durable when the future ends, while more is pushed.
    pub(super) async fn becomes_durable(
        &mut self,
    ) -> Result<Option<(Progress, impl Future<Output = Result<()>> + Send + use<>)>> {
        let progress = self.progress();
        match &mut self.place {
            Place::Folder { file, .. } => {
                file.written().await?;
                Ok(Some((progress, file.synced())))
            }
            Place::Bucket(_) => Ok(None),
        }
    }

    /// Makes all of it durable.
    pub(super) async fn make_durable(&mut self) -> Result<Progress> {
        let mut progress = self.progress();
        match &mut self.place {
            Place::Folder { file, .. } => {
                file.written().await?;
                file.synced().await?;
            }
            Place::Bucket(parts) => {
                parts.keep_tail().await?;
                (progress.tail, progress.new_parts) = (parts.kept, parts.new_parts.clone());
            }
        }
        Ok(progress)
    }

    /// So many bytes, which were made durable, are promised now: what they replace goes.
    pub(super) async fn promised(&mut self, offset_bytes: i64) {
        match &mut self.place {
            Place::Folder { promised_bytes, .. } => *promised_bytes = to_u64(offset_bytes),
            Place::Bucket(parts) => {
                parts.new_parts.clear();
                let old = std::mem::replace(&mut parts.promised, parts.kept);
                if old.bytes == 0 || old == parts.kept {
                    return;
                }
                if let Err(error) = parts.store.delete(&old.key(&parts.upload)).await {
                    // It goes with the upload.
                    tracing::debug!(%error, "an old tail stays for now");
                }
            }
        }
    }

    /// The promise could not be made, since another request owns the upload now, whose row is as given: a tail that it
    /// does not name belongs to nobody.
    pub(super) async fn drop_orphaned_tail(&mut self, row: Option<&upload::Model>) {
        let Place::Bucket(parts) = &mut self.place else { return };
        let orphan = std::mem::replace(&mut parts.kept, parts.promised);
        if orphan.bytes == 0 || orphan == parts.promised || row.is_some_and(|row| Tail::of(row) == orphan) {
            return;
        }
        if let Err(error) = parts.store.delete(&orphan.key(&parts.upload)).await {
            tracing::debug!(%error, "a tail that belongs to nobody stays for now");
        }
    }

    /// Gives the room back of what is not promised: the disk may be full, and the records may be on it.
    pub(super) async fn drop_unpromised(self) {
        let Place::Folder { file, promised_bytes } = self.place else { return };
        if let Err(error) = file.cut(promised_bytes).await {
            tracing::warn!(%error, "what was not promised of an upload stays for now");
        }
    }
}

impl Parts {
    async fn open(store: &Store, row: &upload::Model, parts: Vec<String>) -> Result<Parts> {
        let name = row.parts_name.clone().ok_or_else(|| Error::Internal(format!("upload {} has no parts", row.id)))?;
        let promised = Tail::of(row);
        let tail = match promised.bytes {
            0 => Vec::new(),
            bytes => store.get_bytes(&promised.key(&row.id), to_u64(bytes)).await?.to_vec(),
        };
        let (next_part, there) = (to_i64(parts.len() as u64), to_i64(tail.len() as u64));
        let expected = row.offset_bytes - row.part_bytes * next_part;
        if there != expected {
            let found = format!("upload {}: {there} bytes are left of its tail of {expected}", row.id);
            return Err(Error::Internal(found));
        }
        Ok(Parts {
            store: store.clone(),
            upload: row.id.clone(),
            source: source_key(row)?,
            name,
            part_bytes: usize::try_from(row.part_bytes).unwrap_or(usize::MAX),
            tail,
            next_part,
            new_parts: Vec::new(),
            fence: row.fence,
            kept: promised,
            promised,
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
        // A new name each time: the one before is promised until this one is.
        let number = if self.kept.fence == self.fence { self.kept.number + 1 } else { 0 };
        let next = Tail { fence: self.fence, number, bytes: to_i64(self.tail.len() as u64) };
        if next.bytes > 0 {
            self.store.put_bytes(&next.key(&self.upload), Bytes::copy_from_slice(&self.tail)).await?;
        }
        self.kept = next;
        Ok(())
    }
}

/// The name under which an upload's parts are sent, where the store wants one and there is none yet.
pub(super) async fn begin_parts(store: &Store, row: &upload::Model) -> Result<Option<String>> {
    if store.folder().is_some() || row.parts_name.is_some() {
        return Ok(None);
    }
    Ok(Some(store.begin_parts(&source_key(row)?).await?))
}

/// All bytes are there: they become the run's source. Right to do twice.
///
/// # Errors
/// [`Error::Gone`] where they are not there: the source that they became was never recorded and was deleted since.
pub(super) async fn become_source(
    store: &Store,
    row: &upload::Model,
    parts: Vec<String>,
    source: Key,
    facts: &Facts,
) -> Result<()> {
    if !store.size(&source).await.is_ok_and(|bytes| bytes == facts.bytes) {
        let moved = move_to_source(store, row, parts, &source, facts).await;
        moved.map_err(|error| if is_missing(&error) { Error::Gone(gone(&row.id)) } else { error })?;
    }
    store.sync().await
}

async fn move_to_source(
    store: &Store,
    row: &upload::Model,
    mut parts: Vec<String>,
    source: &Key,
    facts: &Facts,
) -> Result<()> {
    if let Some(path) = file_of(store, row) {
        store.take_known_file(&path, source, facts).await?;
        if let Some(folder) = path.parent() {
            // It was this file's own; whoever made something else in it keeps it.
            let _ = tokio::fs::remove_dir(folder).await;
        }
        return Ok(());
    }
    let name = row.parts_name.clone().ok_or_else(|| Error::Internal(format!("upload {} has no parts", row.id)))?;
    let tail = Tail::of(row);
    if tail.bytes > 0 {
        let bytes = store.get_bytes(&tail.key(&row.id), to_u64(tail.bytes)).await?;
        parts.push(store.put_part(source, &name, number(to_i64(parts.len() as u64))?, bytes).await?);
    }
    store.finish_parts(source, &name, parts).await
}

fn is_missing(error: &Error) -> bool {
    match error {
        Error::Io { source, .. } => source.kind() == std::io::ErrorKind::NotFound,
        Error::Store(error) => matches!(error, object_store::Error::NotFound { .. }),
        _ => false,
    }
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
    store.delete_prefix(&upload_prefix(&row.id)).await
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
