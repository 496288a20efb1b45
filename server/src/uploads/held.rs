//! An upload in the hands of one request.

use bytes::Bytes;
use sea_orm::{ActiveValue::Set, ColumnTrait, Condition, EntityTrait, QueryFilter, QueryOrder};
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::bytes_so_far::{self, BytesSoFar, Progress};
use super::{TAKEN_OVER, Upload, Uploads, said, state, to_i64, to_u64};
use crate::db::tables::{upload, upload_part};
use crate::db::{ANSWER_PATIENCE, retried};
use crate::error::{Error, Result};
use crate::resumed_hash;
use crate::runs::NewRun;
use crate::store::Facts;
use crate::turns::Turn;
use crate::wire::time::now_ms;

/// An upload that this request alone may write to.
pub struct Held {
    uploads: Uploads,
    row: upload::Model,
    turn: Turn,
}

impl Held {
    /// Of this request alone, which raised the row's fence.
    pub(super) fn new(uploads: Uploads, row: upload::Model, turn: Turn) -> Held {
        Held { uploads, row, turn }
    }

    /// The upload as it is.
    pub fn upload(&self) -> Upload {
        said(self.row.clone())
    }

    /// Somebody else wants it: stop soon, and keep what there is.
    pub fn wanted_by_another(&self) -> &CancellationToken {
        self.turn.wanted()
    }

    /// Says how large the upload is, once.
    pub async fn declare_length(&mut self, length_bytes: u64) -> Result<()> {
        self.uploads.check_length(Some(length_bytes))?;
        match self.row.length_bytes.map(to_u64) {
            Some(known) if known == length_bytes => return Ok(()),
            Some(known) => {
                let found = format!("Upload-Length is {length_bytes}");
                return Err(Error::field("Upload-Length", found, format!("{known}, as was said before")));
            }
            None => {}
        }
        let offset = to_u64(self.row.offset_bytes);
        if length_bytes < offset || length_bytes == 0 {
            let found = format!("Upload-Length is {length_bytes}");
            return Err(Error::field("Upload-Length", found, format!("at least 1, and the {offset} bytes received")));
        }
        self.row.length_bytes = Some(to_i64(length_bytes));
        let change = upload::ActiveModel { length_bytes: Set(self.row.length_bytes), ..Default::default() };
        self.write(change, &[]).await
    }

    /// Begins to receive at the offset. `all_or_nothing`: nothing counts before [`Receiving::commit`], because a checksum
    /// over all of it follows.
    pub async fn receive(&mut self, all_or_nothing: bool) -> Result<Receiving<'_>> {
        if let Some(name) = bytes_so_far::begin_parts(&self.uploads.store, &self.row).await? {
            // Kept before the first part is sent: what nobody knows the name of, nobody can go on with or delete.
            let change = upload::ActiveModel { parts_name: Set(Some(name.clone())), ..Default::default() };
            self.write(change, &[]).await?;
            self.row.parts_name = Some(name);
        }
        let parts = self.parts().await?;
        let bytes = BytesSoFar::open(&self.uploads.store, &self.row, parts).await?;
        let promise = None;
        Ok(Receiving { held: self, bytes, promise, all_or_nothing, since_commit: 0, committed_at: Instant::now() })
    }

    async fn parts(&self) -> Result<Vec<String>> {
        let rows = upload_part::Entity::find()
            .filter(upload_part::Column::UploadId.eq(&self.row.id))
            .order_by_asc(upload_part::Column::Number)
            .all(self.uploads.db.read())
            .await?;
        Ok(rows.into_iter().map(|row| row.part).collect())
    }

    /// Writes to the row, unless another server took the upload over; it expires later for that.
    async fn write(&mut self, change: upload::ActiveModel, new_parts: &[(i64, String)]) -> Result<()> {
        self.row.expires_ms = self.fenced().write(change, new_parts).await?;
        Ok(())
    }

    fn fenced(&self) -> Fenced {
        Fenced { uploads: self.uploads.clone(), id: self.row.id.clone(), fence: self.row.fence }
    }

    /// Where all bytes are there: makes the run and its job, or says which it became before.
    pub async fn finish_if_whole(&mut self) -> Result<Option<(String, String)>> {
        if let Some(became) = self.upload().became {
            return Ok(Some(became));
        }
        if self.row.length_bytes != Some(self.row.offset_bytes) {
            return Ok(None);
        }
        let facts = Facts { bytes: to_u64(self.row.offset_bytes), sha256: resumed_hash::finish(&self.row.hash_state)? };
        if let Some(expected) = self.row.sha256.clone().filter(|expected| *expected != facts.sha256) {
            self.spoil().await?;
            return Err(Error::Checksum(format!(
                "the file arrived with the SHA-256 {}, but {expected} was announced; send it again",
                facts.sha256
            )));
        }
        let new: NewRun = serde_json::from_str(&self.row.new_run)
            .map_err(|e| Error::Internal(format!("upload {} has no run: {e}", self.row.id)))?;
        let key = format!("upload:{}", self.row.id);
        let parts = self.parts().await?;
        let (store, row) = (&self.uploads.store, &self.row);
        let place = |source| bytes_so_far::become_source(store, row, parts, source, &facts);
        let run = match self.uploads.runs.publish(&self.row.run_id, new, &facts, &key, place).await {
            Ok(run) => run,
            Err(error) => {
                if matches!(error, Error::Gone(_)) {
                    self.spoil().await?;
                }
                return Err(error);
            }
        };
        let became = (run.id, run.job.id);
        let done = upload::ActiveModel {
            state: Set(state::DONE.into()),
            run_id: Set(became.0.clone()),
            job_id: Set(Some(became.1.clone())),
            ..Default::default()
        };
        self.write(done, &[]).await?;
        (self.row.state, self.row.job_id) = (state::DONE.into(), Some(became.1.clone()));
        self.row.run_id.clone_from(&became.0);
        if let Err(error) = bytes_so_far::drop_tails(&self.uploads.store, &self.row).await {
            tracing::debug!(%error, "an upload's tails stay until it expires");
        }
        Ok(Some(became))
    }

    /// Its bytes are of no use. Its key is free again: who comes with it begins anew.
    async fn spoil(&mut self) -> Result<()> {
        let spoiled =
            upload::ActiveModel { state: Set(state::SPOILED.into()), idempotency_key: Set(None), ..Default::default() };
        self.write(spoiled, &[]).await?;
        bytes_so_far::drop_all(&self.uploads.store, &self.row).await
    }

    /// Gives the upload up, with its bytes. What it became stays.
    pub async fn give_up(self) -> Result<()> {
        if self.row.state != state::DONE {
            if !self.uploads.let_go(&self.row, now_ms() - 1).await? {
                return Err(Error::Locked(TAKEN_OVER.into()));
            }
            bytes_so_far::drop_all(&self.uploads.store, &self.row).await?;
        }
        let t = self.uploads.db.write().await?;
        upload::Entity::delete_by_id(&self.row.id).exec(&*t).await?;
        t.commit().await
    }
}

/// The row under this request's fence.
struct Fenced {
    uploads: Uploads,
    id: String,
    fence: i64,
}

impl Fenced {
    /// Writes to the row, unless another server took the upload over. Answers when it expires now, ms since 1970.
    async fn write(&self, change: upload::ActiveModel, new_parts: &[(i64, String)]) -> Result<i64> {
        let expires_ms = self.uploads.expiry_ms();
        let change = upload::ActiveModel { expires_ms: Set(expires_ms), ..change };
        retried(ANSWER_PATIENCE, || self.try_write(change.clone(), new_parts)).await?;
        Ok(expires_ms)
    }

    async fn try_write(&self, change: upload::ActiveModel, new_parts: &[(i64, String)]) -> Result<()> {
        let t = self.uploads.db.write().await?;
        let mine = Condition::all()
            .add(upload::Column::Id.eq(&self.id))
            .add(upload::Column::Fence.eq(self.fence))
            .add(upload::Column::State.eq(state::OPEN));
        if upload::Entity::update_many().set(change).filter(mine).exec(&*t).await?.rows_affected == 0 {
            return Err(Error::Locked(TAKEN_OVER.into()));
        }
        for (number, part) in new_parts {
            let row = upload_part::ActiveModel {
                upload_id: Set(self.id.clone()),
                number: Set(*number),
                part: Set(part.clone()),
            };
            upload_part::Entity::insert(row).exec_without_returning(&*t).await?;
        }
        t.commit().await
    }
}

/// Bytes on their way into an upload. Ends with [`Receiving::commit`] or [`Receiving::drop_the_rest`].
pub struct Receiving<'a> {
    held: &'a mut Held,
    bytes: BytesSoFar,
    /// A promise that is being made while more comes.
    promise: Option<(Progress, JoinHandle<Result<i64>>)>,
    all_or_nothing: bool,
    since_commit: u64,
    committed_at: Instant,
}

impl Receiving<'_> {
    /// Takes a chunk; promises what came so far from time to time.
    ///
    /// # Errors
    /// [`Error::TooLarge`] where it goes past the upload's length: nothing of the chunk is taken.
    pub async fn push(&mut self, chunk: Bytes) -> Result<()> {
        let limit = self.held.row.length_bytes.map_or(self.held.uploads.limits.upload_bytes, to_u64);
        if self.bytes.offset_bytes() + chunk.len() as u64 > limit {
            return Err(Error::TooLarge { limit_bytes: limit });
        }
        self.since_commit += chunk.len() as u64;
        self.bytes.push(chunk).await?;
        let limits = &self.held.uploads.limits;
        // One half is being promised while the other comes.
        let due = self.since_commit >= limits.unpromised_bytes / 2 || self.committed_at.elapsed() >= limits.sync_every;
        if due && !self.all_or_nothing { self.promise().await } else { Ok(()) }
    }

    /// Begins to promise what there is; where that cannot be done aside, does it now.
    async fn promise(&mut self) -> Result<()> {
        self.settle().await?;
        let Some((progress, durable)) = self.bytes.becomes_durable().await? else { return self.commit().await };
        let (row, change) = (self.held.fenced(), progress.change());
        let made = tokio::spawn(async move {
            durable.await?;
            row.write(change, &[]).await
        });
        self.promise = Some((progress, made));
        self.since_commit = 0;
        self.committed_at = Instant::now();
        Ok(())
    }

    /// The promise that is being made is made.
    async fn settle(&mut self) -> Result<()> {
        let Some((progress, made)) = self.promise.take() else { return Ok(()) };
        let made = made.await.map_err(|e| Error::Internal(format!("an upload's task stopped: {e}")))?;
        self.held.row.expires_ms = made?;
        self.promised(progress).await;
        Ok(())
    }

    async fn promised(&mut self, progress: Progress) {
        let (row, tail) = (&mut self.held.row, progress.tail);
        (row.offset_bytes, row.hash_state) = (progress.offset_bytes, progress.hash_state);
        (row.tail_fence, row.tail_number, row.tail_bytes) = (tail.fence, tail.number, tail.bytes);
        self.bytes.promised(progress.offset_bytes).await;
    }

    /// All of it is there, or what there is shall be kept: makes it durable, then promises it.
    pub async fn commit(&mut self) -> Result<()> {
        self.settle().await?;
        let progress = self.bytes.make_durable().await?;
        if let Err(error) = self.held.write(progress.change(), &progress.new_parts).await {
            if matches!(error, Error::Locked(_)) {
                let id = &self.held.row.id;
                let now = upload::Entity::find_by_id(id).one(self.held.uploads.db.read()).await?;
                self.bytes.drop_orphaned_tail(now.as_ref()).await;
            }
            return Err(error);
        }
        self.promised(progress).await;
        self.since_commit = 0;
        self.committed_at = Instant::now();
        Ok(())
    }

    /// What was not promised yet shall not count, or could not be kept.
    pub async fn drop_the_rest(mut self) {
        if let Err(error) = self.settle().await {
            tracing::debug!(%error, "the last promise of an upload was not made");
        }
        self.bytes.drop_unpromised().await;
    }
}
