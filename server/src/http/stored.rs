//! A file of the store for code that reads and seeks: the core's readers, on a thread where waiting is allowed.

use std::io::{Error, Read, Result, Seek, SeekFrom};

use bytes::{Bytes, BytesMut};
use futures::TryStreamExt;
use tokio::runtime::Handle;

use crate::store::{Key, Store};

/// Bytes that are fetched at once: few enough that a reader far from the store loses little, many enough that it asks
/// seldom.
const BLOCK_BYTES: u64 = 256 * 1024;

/// An open file of the store. Reading blocks: use it inside `spawn_blocking` only.
pub(super) struct StoredFileReader {
    runtime: Handle,
    store: Store,
    key: Key,
    size_bytes: u64,
    position: u64,
    /// Where the held block begins, and its bytes.
    block: (u64, Bytes),
}

impl StoredFileReader {
    /// Opens a file of `size_bytes`; call it inside the runtime.
    pub(super) fn new(store: Store, key: Key, size_bytes: u64) -> StoredFileReader {
        StoredFileReader { runtime: Handle::current(), store, key, size_bytes, position: 0, block: (0, Bytes::new()) }
    }

    fn fetch(&mut self) -> Result<()> {
        let start = self.position / BLOCK_BYTES * BLOCK_BYTES;
        let range = start..(start + BLOCK_BYTES).min(self.size_bytes);
        let read = async {
            let stream = self.store.read(&self.key, range).await.map_err(Error::other)?;
            stream
                .try_fold(BytesMut::new(), |mut all, part| async move {
                    all.extend_from_slice(&part);
                    Ok(all)
                })
                .await
        };
        self.block = (start, self.runtime.block_on(read)?.freeze());
        Ok(())
    }

    fn held(&self) -> &[u8] {
        let (start, bytes) = &self.block;
        let into = self.position.checked_sub(*start).and_then(|into| usize::try_from(into).ok());
        into.and_then(|into| bytes.get(into..)).unwrap_or_default()
    }
}

impl Read for StoredFileReader {
    fn read(&mut self, into: &mut [u8]) -> Result<usize> {
        if self.position >= self.size_bytes || into.is_empty() {
            return Ok(0);
        }
        if self.held().is_empty() {
            self.fetch()?;
        }
        let held = self.held();
        if held.is_empty() {
            return Err(Error::other("the store's file is shorter than its record says"));
        }
        let count = held.len().min(into.len());
        into[..count].copy_from_slice(&held[..count]);
        self.position += count as u64;
        Ok(count)
    }
}

impl Seek for StoredFileReader {
    fn seek(&mut self, to: SeekFrom) -> Result<u64> {
        let position = match to {
            SeekFrom::Start(position) => Some(position),
            SeekFrom::End(way) => self.size_bytes.checked_add_signed(way),
            SeekFrom::Current(way) => self.position.checked_add_signed(way),
        };
        self.position = position.ok_or_else(|| Error::other("a place before the file's beginning"))?;
        Ok(self.position)
    }
}
