//! What the owner of a lease may write while it works: signs of life, progress, segments, log lines. `ending.rs` holds its
//! one end.

use sea_orm::sea_query::{Expr, OnConflict};
use sea_orm::{
    ActiveValue::Set, ColumnTrait, Condition, ConnectionTrait, EntityTrait, ExprTrait, PaginatorTrait, QueryFilter,
    QuerySelect,
};

use super::Queue;
use crate::config::JobLimits;
use crate::db::retried;
use crate::db::tables::{job, log_line, run, segment};
use crate::error::{Error, Result};
use crate::store::Facts;
use crate::wire::JobState;
use crate::wire::time::now_ms;

/// The right to work at a job, and what is needed for it.
#[derive(Clone, Debug)]
pub struct Lease {
    /// The job.
    pub job: String,
    /// The run.
    pub run: String,
    /// Grows with every claim; part of every write and of every store key of this attempt.
    pub fence: i64,
    /// Which try this is, from 1.
    pub attempt: i32,
    /// The rig.
    pub rig_toml: String,
    /// The recipe.
    pub recipe_toml: String,
    /// The source's own name.
    pub filename: String,
    /// The extension of the source's key.
    pub source_extension: String,
    /// [`crate::source::FILE`], or what its segments hold.
    pub source_kind: String,
    /// The source's size and hash, where it is one file.
    pub source: Facts,
    /// Frames a second, where the sender said so.
    pub fps: Option<f64>,
    /// When the run was recorded, ms since 1970.
    pub recorded_ms: i64,
    /// True for a job of a batch.
    pub in_batch: bool,
    /// The asset.
    pub asset: String,
    /// Chainage of the first frame, mm.
    pub chainage_mm: f64,
    /// Which way the robot went along the asset: `forward` or `backward`.
    pub direction: String,
}

impl Lease {
    pub(super) fn new(job: job::Model, run: run::Model, fence: i64, attempt: i32) -> Lease {
        Lease {
            job: job.id,
            run: run.id,
            fence,
            attempt,
            rig_toml: job.rig_toml,
            recipe_toml: job.recipe_toml,
            filename: run.filename,
            asset: run.asset,
            chainage_mm: run.chainage_mm,
            direction: run.direction,
            source_extension: run.source_extension,
            source_kind: run.source_kind,
            source: Facts { bytes: run.source_bytes.unsigned_abs(), sha256: run.source_sha256 },
            fps: run.fps,
            recorded_ms: run.recorded_ms,
            in_batch: job.batch_id.is_some(),
        }
    }

    /// The row, as long as the lease holds.
    pub(super) fn held(&self) -> Condition {
        Condition::all()
            .add(job::Column::Id.eq(&self.job))
            .add(job::Column::Fence.eq(self.fence))
            .add(job::Column::State.eq(JobState::Running.as_str()))
    }
}

/// What the records say to a worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// Go on.
    Continue,
    /// Someone asked for the job to stop.
    Cancel,
    /// The job is another's now, or gone.
    Lost,
}

/// How far an attempt is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Progress {
    /// `measuring`, or the product being written.
    pub stage: String,
    /// 0 to 1 over the whole job.
    pub fraction: f64,
    /// Frames done.
    pub frames: u64,
    /// Frames in all, where known.
    pub frames_total: Option<u64>,
    /// Frames a second.
    pub frames_per_s: f64,
    /// Time left, s, where it can be told.
    pub time_left_s: Option<f64>,
}

impl Queue {
    /// A sign of life.
    pub async fn beat(&self, lease: &Lease) -> Result<()> {
        let change = job::Entity::update_many().col_expr(job::Column::Beat, Expr::col(job::Column::Beat).add(1));
        let t = self.db.write().await?;
        must_hold(change.filter(lease.held()).exec(&*t).await?.rows_affected)?;
        t.commit().await
    }

    /// Whether to go on.
    pub async fn signal(&self, lease: &Lease) -> Result<Signal> {
        let asked: Option<i32> = job::Entity::find()
            .select_only()
            .column(job::Column::CancelRequested)
            .filter(lease.held())
            .into_tuple()
            .one(self.db.read())
            .await?;
        Ok(match asked {
            None => Signal::Lost,
            Some(0) => Signal::Continue,
            Some(_) => Signal::Cancel,
        })
    }

    /// Writes how far the attempt is; also a sign of life.
    pub async fn progress(&self, lease: &Lease, progress: &Progress) -> Result<()> {
        let change = job::ActiveModel {
            stage: Set(progress.stage.clone()),
            fraction: Set(progress.fraction.clamp(0.0, 1.0)),
            frames: Set(to_i64(progress.frames)),
            frames_total: Set(progress.frames_total.map(to_i64)),
            frames_per_s: Set(progress.frames_per_s),
            time_left_s: Set(progress.time_left_s),
            ..Default::default()
        };
        let change = job::Entity::update_many()
            .set(change)
            .col_expr(job::Column::Beat, Expr::col(job::Column::Beat).add(1))
            .filter(lease.held());
        let t = self.db.write().await?;
        must_hold(change.exec(&*t).await?.rows_affected)?;
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }

    /// A recording segment lies in the store.
    pub async fn segment(&self, lease: &Lease, number: u32, facts: &Facts) -> Result<()> {
        retried(self.limits.record_patience, || self.try_segment(lease, number, facts)).await
    }

    async fn try_segment(&self, lease: &Lease, number: u32, facts: &Facts) -> Result<()> {
        let t = self.db.write().await?;
        lease_holds(&*t, lease).await?;
        let row = segment::ActiveModel {
            job_id: Set(lease.job.clone()),
            number: Set(number.into()),
            fence: Set(lease.fence),
            bytes: Set(to_i64(facts.bytes)),
            sha256: Set(facts.sha256.clone()),
        };
        // Its commit may have been made before the connection broke.
        let there = OnConflict::columns([segment::Column::JobId, segment::Column::Number]).do_nothing().to_owned();
        segment::Entity::insert(row).on_conflict(there).try_insert().exec_without_returning(&*t).await?;
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }

    /// Adds a line to the job's log; past the log's length lines are dropped.
    pub async fn log(&self, lease: &Lease, text: &str) -> Result<()> {
        let t = self.db.write().await?;
        lease_holds(&*t, lease).await?;
        add_log_line(&*t, &lease.job, lease.attempt, text, &self.limits).await?;
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }
}

pub(super) async fn add_log_line(
    records: &impl ConnectionTrait,
    job: &str,
    attempt: i32,
    text: &str,
    limits: &JobLimits,
) -> Result<()> {
    let number = log_line::Entity::find().filter(log_line::Column::JobId.eq(job)).count(records).await?;
    let number = to_i64(number);
    if number >= limits.log_lines {
        return Ok(());
    }
    let row = log_line::ActiveModel {
        job_id: Set(job.into()),
        number: Set(number),
        at_ms: Set(now_ms()),
        attempt: Set(attempt),
        line: Set(text.chars().take(limits.log_line_chars).collect()),
    };
    log_line::Entity::insert(row).exec_without_returning(records).await?;
    Ok(())
}

pub(super) async fn lease_holds(records: &impl ConnectionTrait, lease: &Lease) -> Result<job::Model> {
    job::Entity::find().filter(lease.held()).lock_exclusive().one(records).await?.ok_or(Error::LeaseLost)
}

pub(super) fn must_hold(rows: u64) -> Result<()> {
    if rows == 0 { Err(Error::LeaseLost) } else { Ok(()) }
}

pub(super) fn to_i64(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}
