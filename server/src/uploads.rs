//! Uploads that arrive in pieces (tus 1.0.0): what has come is durable, what is promised is durable, and whoever comes
//! next goes on where the last one was cut off. A finished upload becomes one run with one job, however often it is asked.
//!
//! One request at a time writes to an upload. A newer one takes it over: the older is told to stop, keeps what it has,
//! and is waited for. Between servers the row's fence does the same: an older request's next write finds it changed.

mod bytes_so_far;
mod growing_file;
mod held;
mod sweep;

use std::sync::Arc;

use sea_orm::sea_query::Expr;
use sea_orm::{ActiveValue::Set, ColumnTrait, EntityTrait, ExprTrait, QueryFilter};
use tokio_util::task::TaskTracker;

pub use self::held::{Held, Receiving};
use crate::config::UploadLimits;
use crate::db::tables::upload;
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::error::{Error, Result};
use crate::queue::Queue;
use crate::runs::{NewRun, Runs};
use crate::store::Store;
use crate::turns::{Turn, Turns};
use crate::wire::time::now_ms;

/// What a request hears that another one took the upload from.
pub const TAKEN_OVER: &str = "another request has taken the upload over";

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
    tasks: TaskTracker,
}

/// States of the row. A row that is gone was never there, or was given up by its sender.
mod state {
    /// More may come.
    pub(super) const OPEN: &str = "open";
    /// It became a run.
    pub(super) const DONE: &str = "done";
    /// Nobody went on with it, or it was given up: its bytes are being deleted.
    pub(super) const GOING: &str = "going";
    /// Its bytes are deleted; that it was there is remembered.
    pub(super) const EXPIRED: &str = "expired";
    /// It did not arrive as announced: its bytes are deleted, or will be when it expires.
    pub(super) const SPOILED: &str = "spoiled";
}

impl Uploads {
    /// On the records and the store, becoming runs.
    pub fn new(db: Db, store: Store, runs: Runs, limits: UploadLimits) -> Uploads {
        Uploads { db, store, runs, limits, turns: Arc::default(), tasks: TaskTracker::new() }
    }

    /// Where requests about uploads work: a connection that ends does not end them, so that what arrived is kept.
    pub fn tasks(&self) -> &TaskTracker {
        &self.tasks
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
            tail_fence: 0,
            tail_number: 0,
            tail_bytes: 0,
        };
        retried(ANSWER_PATIENCE, || self.insert(row.clone())).await
    }

    async fn insert(&self, row: upload::Model) -> Result<Upload> {
        let t = self.db.write().await?;
        if let Some(key) = &row.idempotency_key {
            let before = upload::Entity::find().filter(upload::Column::IdempotencyKey.eq(key)).one(&*t).await?;
            match before {
                Some(before) if before.expires_ms < row.created_ms => {
                    let free = upload::ActiveModel { idempotency_key: Set(None), ..Default::default() };
                    let gone = upload::Column::Id.eq(before.id);
                    upload::Entity::update_many().set(free).filter(gone).exec(&*t).await?;
                }
                Some(before) if before.fingerprint == row.fingerprint => return Ok(said(before)),
                Some(_) => return Err(Error::KeyReused(key.clone())),
                None => {}
            }
        }
        let made = said(row.clone());
        upload::Entity::insert(upload::ActiveModel::from(row)).exec_without_returning(&*t).await?;
        t.commit().await?;
        Ok(made)
    }

    /// A size that this server takes, where it is known.
    pub fn check_length(&self, length_bytes: Option<u64>) -> Result<()> {
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
        check_state(self.row(id).await?)?;
        let turn = self.turns.take(id, self.limits.takeover).await?;
        self.hold(id, turn).await
    }

    async fn hold(&self, id: &str, turn: Turn) -> Result<Held> {
        let row = retried(ANSWER_PATIENCE, || self.raise_fence(id)).await?;
        Ok(Held::new(self.clone(), row, turn))
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
        found.await?.ok_or_else(|| not_found(id))
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
        state::SPOILED => {
            let what = format!("the upload '{}' did not arrive as announced and was dropped; begin it anew", row.id);
            Err(Error::Gone(what))
        }
        state::OPEN | state::DONE if row.expires_ms >= now_ms() => Ok(row),
        _ => Err(Error::Gone(gone(&row.id))),
    }
}

fn gone(id: &str) -> String {
    format!("the upload '{id}' has expired; begin it anew")
}

fn not_found(id: &str) -> Error {
    Error::NotFound { what: "upload", id: id.into() }
}

fn to_i64(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

fn to_u64(value: i64) -> u64 {
    u64::try_from(value).unwrap_or(0)
}
