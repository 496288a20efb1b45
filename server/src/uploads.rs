//! Uploads that arrive in pieces (tus 1.0.0): what has come is durable, what is promised is durable, and whoever comes
//! next goes on where the last one was cut off. A finished upload becomes one run with one job, however often it is asked.
//!
//! One request at a time writes to an upload. A newer one takes it over: the older is told to stop, keeps what it has,
//! and is waited for. Between servers the row's fence does the same: an older request's next write finds it changed.

mod bytes_so_far;

use std::sync::Arc;
use std::time::Duration;

use sea_orm::sea_query::Expr;
use sea_orm::{ActiveValue::Set, ColumnTrait, Condition, EntityTrait, ExprTrait, QueryFilter, QueryOrder, QuerySelect};
use tokio_util::sync::CancellationToken;

use self::bytes_so_far::BytesSoFar;
use crate::config::UploadLimits;
use crate::db::tables::{upload, upload_part};
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::error::{Error, Result};
use crate::queue::Queue;
use crate::runs::{NewRun, Runs};
use crate::store::{Facts, Store, upload_prefix};
use crate::turns::{Turn, Turns};
use crate::wire::time::now_ms;

/// Uploads of one sweep.
const SWEPT_AT_ONCE: u64 = 100;

/// An upload to be.
pub struct NewUpload {
    /// Its size, bytes, where the sender knows it already.
    pub length_bytes: Option<u64>,
    /// The header as it came, to be said back.
    pub metadata: String,
    /// What it will be, checked.
    pub run: NewRun,
    /// The SHA-256 that its sender announced, lower-case hex.
    pub sha256: Option<String>,
}

/// An upload as its sender sees it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Upload {
    /// Its name.
    pub id: String,
    /// Its size, bytes, where known.
    pub length_bytes: Option<u64>,
    /// Bytes that are durable.
    pub offset_bytes: u64,
    /// The metadata as it came.
    pub metadata: String,
    /// When it will be forgotten, unless more comes, ms since 1970.
    pub expires_ms: i64,
    /// The run and the job that it became.
    pub became: Option<(String, String)>,
}

/// The uploads.
#[derive(Clone)]
pub struct Uploads {
    db: Db,
    store: Store,
    runs: Runs,
    limits: UploadLimits,
    turns: Arc<Turns>,
}

/// States of the row. A row that is gone was never there, or was given up by its sender.
mod state {
    pub(super) const OPEN: &str = "open";
    pub(super) const DONE: &str = "done";
    pub(super) const EXPIRED: &str = "expired";
    pub(super) const SPOILED: &str = "spoiled";
}

impl Uploads {
    /// On the records and the store, becoming runs.
    pub fn new(db: Db, store: Store, runs: Runs, limits: UploadLimits) -> Uploads {
        Uploads { db, store, runs, limits, turns: Arc::default() }
    }

    /// The limits.
    pub fn limits(&self) -> &UploadLimits {
        &self.limits
    }

    /// Begins an upload; the same key with the same content is the same upload.
    pub async fn create(&self, new: NewUpload, key: Option<&str>) -> Result<Upload> {
        if new.length_bytes == Some(0) {
            return Err(Error::field("Upload-Length", "the file is empty (0 bytes)", "a video file"));
        }
        self.check_length(new.length_bytes)?;
        let run = serde_json::to_string(&new.run).map_err(|e| Error::Internal(format!("a run is not JSON: {e}")))?;
        let fingerprint = crate::store::sha256_of(&format!("{:?} {run} {:?}", new.length_bytes, new.sha256));
        let (id, run_id) = (Queue::new_id(), Queue::new_id());
        let row = upload::Model {
            id,
            created_ms: now_ms(),
            expires_ms: self.expiry_ms(),
            state: state::OPEN.into(),
            idempotency_key: key.map(Into::into),
            fingerprint,
            length_bytes: new.length_bytes.map(to_i64),
            offset_bytes: 0,
            metadata: new.metadata,
            new_run: run,
            sha256: new.sha256,
            run_id,
            job_id: None,
            fence: 0,
            hash_state: String::new(),
            part_bytes: to_i64(self.limits.part_bytes()),
            parts_name: None,
            tail_number: 0,
            tail_bytes: 0,
        };
        retried(ANSWER_PATIENCE, || self.insert(row.clone())).await
    }

    async fn insert(&self, row: upload::Model) -> Result<Upload> {
        let t = self.db.write().await?;
        if let Some(key) = &row.idempotency_key {
            let before = upload::Entity::find().filter(upload::Column::IdempotencyKey.eq(key)).one(&*t).await?;
            if let Some(before) = before {
                return if before.fingerprint == row.fingerprint {
                    Ok(said(before))
                } else {
                    Err(Error::KeyReused(key.clone()))
                };
            }
        }
        let made = said(row.clone());
        upload::Entity::insert(upload::ActiveModel::from(row)).exec_without_returning(&*t).await?;
        t.commit().await?;
        Ok(made)
    }

    fn check_length(&self, length_bytes: Option<u64>) -> Result<()> {
        match length_bytes {
            Some(bytes) if bytes > self.limits.upload_bytes => {
                Err(Error::TooLarge { limit_bytes: self.limits.upload_bytes })
            }
            _ => Ok(()),
        }
    }

    fn expiry_ms(&self) -> i64 {
        now_ms() + i64::try_from(self.limits.kept_for.as_millis()).unwrap_or(i64::MAX / 2)
    }

    /// Takes the upload over from whoever writes to it. What that one received is kept; the answer is exact.
    ///
    /// # Errors
    /// [`Error::Locked`] where it does not let go in time, [`Error::NotFound`], [`Error::Gone`].
    pub async fn take(&self, id: &str) -> Result<Held> {
        self.row(id).await?;
        let turn = self.turns.take(id, self.limits.takeover).await?;
        let row = retried(ANSWER_PATIENCE, || self.raise_fence(id)).await?;
        Ok(Held { uploads: self.clone(), row, turn })
    }

    async fn raise_fence(&self, id: &str) -> Result<upload::Model> {
        let t = self.db.write().await?;
        upload::Entity::update_many()
            .col_expr(upload::Column::Fence, Expr::col(upload::Column::Fence).add(1))
            .filter(upload::Column::Id.eq(id))
            .exec(&*t)
            .await?;
        let row = upload::Entity::find_by_id(id).one(&*t).await?;
        t.commit().await?;
        check_state(row.ok_or_else(|| not_found(id))?)
    }

    async fn row(&self, id: &str) -> Result<upload::Model> {
        let found =
            retried(ANSWER_PATIENCE, || async { Ok(upload::Entity::find_by_id(id).one(self.db.read()).await?) });
        check_state(found.await?.ok_or_else(|| not_found(id))?)
    }

    /// Gives an upload up, with its bytes. What it became stays.
    pub async fn give_up(&self, id: &str) -> Result<()> {
        let held = self.take(id).await?;
        if held.row.state != state::DONE {
            self.drop_bytes(&held.row).await?;
        }
        let t = self.db.write().await?;
        upload::Entity::delete_by_id(id).exec(&*t).await?;
        t.commit().await
    }

    async fn drop_bytes(&self, row: &upload::Model) -> Result<()> {
        bytes_so_far::drop_all(&self.store, row).await
    }

    /// Forgets uploads that nobody went on with, and ends those whose last request was cut off before its answer.
    pub async fn sweep(&self) -> Result<()> {
        let old =
            Condition::all().add(upload::Column::State.ne(state::EXPIRED)).add(upload::Column::ExpiresMs.lt(now_ms()));
        let rows = upload::Entity::find().filter(old).limit(SWEPT_AT_ONCE).all(self.db.read()).await?;
        for row in rows {
            let (done, id) = (row.state == state::DONE, row.id.clone());
            let Ok(_turn) = self.turns.take(&id, Duration::ZERO).await else { continue };
            if !done {
                self.drop_bytes(&row).await?;
            }
            let t = self.db.write().await?;
            let mine = Condition::all().add(upload::Column::Id.eq(&id)).add(upload::Column::Fence.eq(row.fence));
            // Its key is free again; who asks for it hears that it is gone.
            let change = upload::ActiveModel {
                state: Set(state::EXPIRED.into()),
                idempotency_key: Set(None),
                new_run: Set(String::new()),
                ..Default::default()
            };
            upload::Entity::update_many().set(change).filter(mine).exec(&*t).await?;
            t.commit().await?;
        }
        let forgotten = now_ms() - i64::try_from(self.limits.remembered_for.as_millis()).unwrap_or(i64::MAX / 2);
        let t = self.db.write().await?;
        let ended =
            Condition::all().add(upload::Column::State.eq(state::EXPIRED)).add(upload::Column::ExpiresMs.lt(forgotten));
        upload::Entity::delete_many().filter(ended).exec(&*t).await?;
        t.commit().await
    }
}

/// An upload that this request alone may write to.
pub struct Held {
    uploads: Uploads,
    row: upload::Model,
    turn: Turn,
}

impl Held {
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
        let parts = self.parts().await?;
        let bytes = BytesSoFar::open(&self.uploads.store, &mut self.row, parts).await?;
        Ok(Receiving { held: self, bytes, all_or_nothing, since_commit: 0, committed_at: tokio::time::Instant::now() })
    }

    async fn parts(&self) -> Result<Vec<String>> {
        let rows = upload_part::Entity::find()
            .filter(upload_part::Column::UploadId.eq(&self.row.id))
            .order_by_asc(upload_part::Column::Number)
            .all(self.uploads.db.read())
            .await?;
        Ok(rows.into_iter().map(|row| row.part).collect())
    }

    /// Writes to the row, unless another server took the upload over.
    async fn write(&self, change: upload::ActiveModel, new_parts: &[(i64, String)]) -> Result<()> {
        retried(ANSWER_PATIENCE, || self.try_write(change.clone(), new_parts)).await
    }

    async fn try_write(&self, change: upload::ActiveModel, new_parts: &[(i64, String)]) -> Result<()> {
        let t = self.uploads.db.write().await?;
        let mine = Condition::all()
            .add(upload::Column::Id.eq(&self.row.id))
            .add(upload::Column::Fence.eq(self.row.fence))
            .add(upload::Column::State.eq(state::OPEN));
        let change = upload::ActiveModel { expires_ms: Set(self.uploads.expiry_ms()), ..change };
        if upload::Entity::update_many().set(change).filter(mine).exec(&*t).await?.rows_affected == 0 {
            return Err(Error::Locked("another request has taken the upload over".into()));
        }
        for (number, part) in new_parts {
            let row = upload_part::ActiveModel {
                upload_id: Set(self.row.id.clone()),
                number: Set(*number),
                part: Set(part.clone()),
            };
            upload_part::Entity::insert(row).exec_without_returning(&*t).await?;
        }
        t.commit().await
    }

    /// Where all bytes are there: makes the run and its job, or says which it became before.
    pub async fn finish_if_whole(&mut self) -> Result<Option<(String, String)>> {
        if let Some(became) = self.upload().became {
            return Ok(Some(became));
        }
        if self.row.length_bytes != Some(self.row.offset_bytes) {
            return Ok(None);
        }
        let facts =
            Facts { bytes: to_u64(self.row.offset_bytes), sha256: crate::resumed_hash::finish(&self.row.hash_state)? };
        if let Some(expected) = self.row.sha256.clone().filter(|expected| *expected != facts.sha256) {
            let spoiled = upload::ActiveModel { state: Set(state::SPOILED.into()), ..Default::default() };
            self.write(spoiled, &[]).await?;
            self.uploads.drop_bytes(&self.row).await?;
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
        let run = self.uploads.runs.publish(&self.row.run_id, new, &facts, &key, place).await?;
        let became = (run.id, run.job.id);
        let done = upload::ActiveModel {
            state: Set(state::DONE.into()),
            run_id: Set(became.0.clone()),
            job_id: Set(Some(became.1.clone())),
            ..Default::default()
        };
        self.write(done, &[]).await?;
        bytes_so_far::drop_tails(&self.uploads.store, &self.row).await?;
        (self.row.state, self.row.job_id) = (state::DONE.into(), Some(became.1.clone()));
        self.row.run_id.clone_from(&became.0);
        Ok(Some(became))
    }
}

/// Bytes on their way into an upload.
pub struct Receiving<'a> {
    held: &'a mut Held,
    bytes: BytesSoFar,
    all_or_nothing: bool,
    since_commit: u64,
    committed_at: tokio::time::Instant,
}

impl Receiving<'_> {
    /// Takes a chunk; promises what came so far from time to time.
    ///
    /// # Errors
    /// [`Error::TooLarge`] where it goes past the upload's length: nothing of the chunk is taken.
    pub async fn push(&mut self, chunk: &[u8]) -> Result<()> {
        let limit = self.held.row.length_bytes.map_or(self.held.uploads.limits.upload_bytes, to_u64);
        if self.bytes.offset_bytes() + chunk.len() as u64 > limit {
            return Err(Error::TooLarge { limit_bytes: limit });
        }
        self.bytes.push(chunk).await?;
        self.since_commit += chunk.len() as u64;
        let limits = &self.held.uploads.limits;
        let due = self.since_commit >= limits.sync_bytes || self.committed_at.elapsed() >= limits.sync_every;
        if due && !self.all_or_nothing { self.commit().await } else { Ok(()) }
    }

    /// All of it is there, or what there is shall be kept: makes it durable, then promises it.
    pub async fn finish(mut self) -> Result<()> {
        self.commit().await
    }

    async fn commit(&mut self) -> Result<()> {
        let progress = self.bytes.make_durable().await?;
        let change = upload::ActiveModel {
            offset_bytes: Set(progress.offset_bytes),
            hash_state: Set(progress.hash_state.clone()),
            tail_number: Set(progress.tail_number),
            tail_bytes: Set(progress.tail_bytes),
            parts_name: Set(self.held.row.parts_name.clone()),
            ..Default::default()
        };
        self.held.write(change, &progress.new_parts).await?;
        let row = &mut self.held.row;
        (row.offset_bytes, row.hash_state) = (progress.offset_bytes, progress.hash_state);
        (row.tail_number, row.tail_bytes) = (progress.tail_number, progress.tail_bytes);
        self.bytes.forget_old_tail().await;
        self.since_commit = 0;
        self.committed_at = tokio::time::Instant::now();
        Ok(())
    }
}

fn said(row: upload::Model) -> Upload {
    let became = if row.state == state::DONE { row.job_id.map(|job| (row.run_id, job)) } else { None };
    Upload {
        id: row.id,
        length_bytes: row.length_bytes.map(to_u64),
        offset_bytes: to_u64(row.offset_bytes),
        metadata: row.metadata,
        expires_ms: row.expires_ms,
        became,
    }
}

fn check_state(row: upload::Model) -> Result<upload::Model> {
    match row.state.as_str() {
        state::EXPIRED => Err(Error::Gone(format!("the upload '{}' has expired; begin it anew", row.id))),
        state::SPOILED => {
            let what = format!("the upload '{}' did not arrive as announced and was dropped; begin it anew", row.id);
            Err(Error::Gone(what))
        }
        _ => Ok(row),
    }
}

fn not_found(id: &str) -> Error {
    Error::NotFound { what: "upload", id: id.into() }
}

/// Everything that an upload has in the store, but for the run that it may have become.
fn prefix_of(row: &upload::Model) -> String {
    upload_prefix(&row.id)
}

fn to_i64(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

fn to_u64(value: i64) -> u64 {
    u64::try_from(value).unwrap_or(0)
}
