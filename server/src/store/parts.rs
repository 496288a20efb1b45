//! A file that comes in parts, perhaps through several processes: each part is durable on its own, and a part that
//! comes again replaces the one of its number. S3 has this as multipart uploads; in a folder the parts are files
//! beside the one they will become.

use bytes::Bytes;
use futures::stream::{StreamExt, TryStreamExt};
use object_store::multipart::{MultipartStore, PartId};
use object_store::{ObjectStore, ObjectStoreExt, WriteMultipart};
use uuid::Uuid;

use super::{Key, Place, Store};
use crate::error::{Error, Result};

/// The least size of a part on S3, bytes; only the last part of a file may be smaller.
pub const PART_MIN_BYTES: u64 = 5 * 1024 * 1024;

/// Most parts of a file on S3.
pub const PARTS_MAX: u32 = 10_000;

impl Store {
    /// Begins a file of parts; its name is kept by whoever wants to go on with it.
    pub async fn begin_parts(&self, key: &Key) -> Result<String> {
        match &self.place {
            Place::Bucket { s3, .. } => Ok(s3.create_multipart(&self.path(key)).await?),
            Place::Folder { .. } => Ok(Uuid::now_v7().to_string()),
        }
    }

    /// Puts part `number`, counted from 0; what comes back is kept for [`Store::finish_parts`].
    pub async fn put_part(&self, key: &Key, name: &str, number: u32, bytes: Bytes) -> Result<String> {
        match &self.place {
            Place::Bucket { s3, .. } => {
                let part = s3.put_part(&self.path(key), &name.to_string(), number as usize, bytes.into()).await?;
                Ok(part.content_id)
            }
            Place::Folder { .. } => {
                let part = part_key(key, name, number);
                self.objects.put(&self.path(&part), bytes.into()).await?;
                self.sync().await?;
                Ok(part.filename().into())
            }
        }
    }

    /// The parts become the file, in the order given, which is that of their numbers without a gap.
    pub async fn finish_parts(&self, key: &Key, name: &str, parts: Vec<String>) -> Result<()> {
        match &self.place {
            Place::Bucket { s3, .. } => {
                let parts = parts.into_iter().map(|content_id| PartId { content_id }).collect();
                s3.complete_multipart(&self.path(key), &name.to_string(), parts).await?;
            }
            Place::Folder { .. } => {
                let count = u32::try_from(parts.len()).map_err(|_| Error::Internal("too many parts".into()))?;
                let mut whole = WriteMultipart::new(self.objects.put_multipart(&self.path(key)).await?);
                for number in 0..count {
                    let mut part = self.objects.get(&self.path(&part_key(key, name, number))).await?.into_stream();
                    while let Some(chunk) = part.try_next().await? {
                        whole.wait_for_capacity(4).await?;
                        whole.put(chunk);
                    }
                }
                whole.finish().await?;
                self.sync().await?;
                self.drop_parts(key, name).await?;
            }
        }
        Ok(())
    }

    /// Gives a file of parts up.
    pub async fn drop_parts(&self, key: &Key, name: &str) -> Result<()> {
        match &self.place {
            Place::Bucket { s3, .. } => match s3.abort_multipart(&self.path(key), &name.to_string()).await {
                Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
                Err(e) => Err(e.into()),
            },
            Place::Folder { .. } => self.delete_prefix(&parts_prefix(key, name)).await,
        }
    }

    /// The files below a prefix that this module made, with their sizes in bytes.
    pub fn list(&self, prefix: &str) -> futures::stream::BoxStream<'static, Result<(Key, u64)>> {
        let above = self.above().clone();
        let listed = self.objects.list(Some(&self.prefixed(prefix)));
        let keyed = listed.map(move |found| {
            let meta = found?;
            let parts: Vec<_> = match meta.location.prefix_match(&above) {
                Some(parts) => parts.collect(),
                None => return Err(Error::Internal(format!("{} lies outside the store", meta.location))),
            };
            Ok((Key(parts.into_iter().collect()), meta.size))
        });
        keyed.boxed()
    }
}

fn parts_prefix(key: &Key, name: &str) -> String {
    format!("{}.parts/{name}/", key.as_str())
}

fn part_key(key: &Key, name: &str, number: u32) -> Key {
    Key::new(format!("{}{number:06}", parts_prefix(key, name)))
}
