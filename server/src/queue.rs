//! Jobs as leased rows: enqueue, claim, cancel, retry; `queue/lease.rs` holds what the owner of a lease may write
//! while it works, `queue/ending.rs` its one end, `queue/lost.rs` finds leases whose worker is gone,
//! `queue/bell.rs` wakes whoever waits for a change.
//!
//! Invariants: a claim and everything that goes with it is one transaction. Every write of a worker carries the
//! lease's fence, so that a worker that was paused past its lease writes nothing. One transaction publishes exactly
//! one result. The state of a run's latest job is repeated in the run's row in the same transaction.

mod bell;
mod ending;
mod lease;
mod lost;
mod stats;

use sea_orm::sea_query::{Expr, LockBehavior, LockType, OnConflict};
use sea_orm::{
    ActiveValue::Set, ColumnTrait, Condition, ConnectionTrait, EntityTrait, QueryFilter, QueryOrder, QuerySelect,
};
use uuid::Uuid;

pub use bell::Bell;
pub use ending::{Outcome, PublishedProduct};
pub use lease::{Lease, Progress, Signal};
pub use lost::LeaseWatch;
pub use stats::QueueDepth;

use crate::config::JobLimits;
use crate::db::tables::{batch, job, run, segment, unpublished};
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::error::{Error, Result};
use crate::metrics::metrics;
use crate::store;
use crate::wire::time::now_ms;
use crate::wire::{JobState, Priority};

/// How much earlier (or later) than it came a job counts as having come, ms. Because it is a time, waiting makes up
/// for it: a batch job that is older than an upload by an hour goes first, so none waits for ever.
fn rank_ms(created_ms: i64, priority: Priority) -> i64 {
    const HOUR_MS: i64 = 3_600_000;
    created_ms
        + match priority {
            Priority::Live => -24 * HOUR_MS,
            Priority::Upload => 0,
            Priority::Batch => HOUR_MS,
        }
}

/// Store keys of an attempt that still runs are due for deletion at no time.
const HELD_MS: i64 = i64::MAX;

/// Which jobs a worker takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// Whichever goes next.
    Any,
    /// Of robots that walk now.
    Live,
}

impl Wanted {
    fn condition(self) -> Condition {
        match self {
            Wanted::Any => Condition::all(),
            Wanted::Live => Condition::all().add(job::Column::Priority.eq(Priority::Live.as_str())),
        }
    }
}

/// A job to be.
pub struct NewJob {
    /// The run.
    pub run: String,
    /// Who goes first.
    pub priority: Priority,
    /// The rig's name.
    pub rig_name: String,
    /// The rig.
    pub rig_toml: String,
    /// The recipe's name.
    pub recipe_name: String,
    /// The recipe.
    pub recipe_toml: String,
}

/// Where a job of a batch comes from.
pub struct Origin {
    /// The batch.
    pub batch: String,
    /// The run's latest job before it.
    pub base_job: String,
}

/// The row of a batch's new job. It gets its rig and recipe when it is claimed.
pub fn new_row(run: &str, priority: Priority, origin: Origin) -> job::ActiveModel {
    let new = NewJob {
        run: run.into(),
        priority,
        rig_name: String::new(),
        rig_toml: String::new(),
        recipe_name: String::new(),
        recipe_toml: String::new(),
    };
    row_of(Queue::new_id(), new, Some(origin))
}

fn row_of(id: String, new: NewJob, origin: Option<Origin>) -> job::ActiveModel {
    let now = now_ms();
    let (batch, base_job) = origin.map(|o| (o.batch, o.base_job)).unzip();
    job::ActiveModel {
        id: Set(id),
        run_id: Set(new.run),
        created_ms: Set(now),
        priority: Set(new.priority.as_str().into()),
        rank_ms: Set(rank_ms(now, new.priority)),
        rig_name: Set(new.rig_name),
        rig_toml: Set(new.rig_toml),
        recipe_name: Set(new.recipe_name),
        recipe_toml: Set(new.recipe_toml),
        state: Set(JobState::Queued.as_str().into()),
        cancel_requested: Set(0),
        not_before_ms: Set(0),
        fence: Set(0),
        attempt: Set(0),
        failures: Set(0),
        losses: Set(0),
        node: Set(String::new()),
        worker: Set(String::new()),
        beat: Set(0),
        stage: Set(String::new()),
        fraction: Set(0.0),
        frames: Set(0),
        frames_total: Set(None),
        frames_per_s: Set(0.0),
        time_left_s: Set(None),
        warnings: Set("[]".into()),
        error: Set(None),
        quality: Set(None),
        result_fence: Set(None),
        started_ms: Set(None),
        finished_ms: Set(None),
        batch_id: Set(batch),
        base_job: Set(base_job),
    }
}

/// The jobs.
#[derive(Clone)]
pub struct Queue {
    db: Db,
    bell: Bell,
    limits: JobLimits,
}

impl Queue {
    /// A queue on a database.
    pub fn new(db: Db, limits: JobLimits) -> Queue {
        Queue { db, bell: Bell::new(), limits }
    }

    /// Rings when a job changes.
    pub fn bell(&self) -> &Bell {
        &self.bell
    }

    /// A name for a new run or job: UUID version 7, so that names sort by creation.
    pub fn new_id() -> String {
        Uuid::now_v7().to_string()
    }

    /// Adds a job inside the caller's transaction; the caller rings the bell after its commit.
    pub async fn enqueue(&self, records: &impl ConnectionTrait, new: NewJob) -> Result<String> {
        let (id, run) = (Queue::new_id(), new.run.clone());
        let row = row_of(id.clone(), new, None);
        job::Entity::insert(row).exec_without_returning(records).await?;
        run::Entity::update_many()
            .col_expr(run::Column::LatestJob, Expr::value(id.as_str()))
            .col_expr(run::Column::State, Expr::value(JobState::Queued.as_str()))
            .filter(run::Column::Id.eq(run))
            .exec(records)
            .await?;
        Ok(id)
    }

    /// Takes the next job of a kind, if there is one: counts the attempt, raises the fence, clears what an earlier attempt left.
    pub async fn claim(&self, which: Wanted, node: &str, worker: &str) -> Result<Option<Lease>> {
        // Looking first keeps idle workers from taking the write lock again and again.
        if self.next_ready(which, self.db.read(), false).await?.is_none() {
            return Ok(None);
        }
        retried(ANSWER_PATIENCE, || self.try_claim(which, node, worker)).await
    }

    async fn try_claim(&self, which: Wanted, node: &str, worker: &str) -> Result<Option<Lease>> {
        let t = self.db.write().await?;
        let Some(next) = self.next_ready(which, &*t, true).await? else { return Ok(None) };
        let Some(run) = run::Entity::find_by_id(&next.run_id).one(&*t).await? else {
            return Err(Error::Internal(format!("job {} has no run", next.id)));
        };
        let next = with_rig_and_recipe(&*t, next).await?;
        let (fence, attempt) = (next.fence + 1, next.attempt + 1);
        job::Entity::update_many()
            .set(job::ActiveModel {
                state: Set(JobState::Running.as_str().into()),
                rig_name: Set(next.rig_name.clone()),
                rig_toml: Set(next.rig_toml.clone()),
                recipe_name: Set(next.recipe_name.clone()),
                recipe_toml: Set(next.recipe_toml.clone()),
                fence: Set(fence),
                attempt: Set(attempt),
                node: Set(node.into()),
                worker: Set(worker.into()),
                beat: Set(next.beat + 1),
                cancel_requested: Set(0),
                stage: Set(String::new()),
                fraction: Set(0.0),
                frames: Set(0),
                frames_total: Set(None),
                frames_per_s: Set(0.0),
                time_left_s: Set(None),
                warnings: Set("[]".into()),
                error: Set(None),
                started_ms: Set(Some(now_ms())),
                finished_ms: Set(None),
                ..Default::default()
            })
            .filter(job::Column::Id.eq(&next.id))
            .exec(&*t)
            .await?;
        segment::Entity::delete_many().filter(segment::Column::JobId.eq(&next.id)).exec(&*t).await?;
        mark_unpublished(&*t, store::attempt_prefix(&next.id, fence), HELD_MS).await?;
        repeat_in_run(&*t, &next.id, JobState::Running).await?;
        t.commit().await?;
        self.bell.ring();
        if next.attempt == 0 {
            metrics().wait_s.observe((now_ms() - next.created_ms).max(0) as f64 / 1000.0);
        }
        Ok(Some(Lease::new(next, run, fence, attempt)))
    }

    /// The queued job that goes next.
    async fn next_ready(
        &self,
        which: Wanted,
        records: &impl ConnectionTrait,
        to_take: bool,
    ) -> Result<Option<job::Model>> {
        let now = now_ms();
        // A wait further off than any that we set means that the clock was set back: it must not park a job.
        let horizon = now + 2 * self.limits.retry_max.as_millis() as i64;
        let ready = Condition::any().add(job::Column::NotBeforeMs.lte(now)).add(job::Column::NotBeforeMs.gt(horizon));
        let mut query = job::Entity::find()
            .filter(job::Column::State.eq(JobState::Queued.as_str()))
            .filter(ready)
            .filter(which.condition())
            .order_by_asc(job::Column::RankMs)
            .order_by_asc(job::Column::Id);
        if to_take {
            // PostgreSQL: each worker another row. SQLite has no such words; its transaction is alone anyway.
            query = query.lock_with_behavior(LockType::Update, LockBehavior::SkipLocked);
        }
        Ok(query.one(records).await?)
    }

    /// Asks a job to stop. A waiting one is cancelled at once, a running one when its worker hears of it.
    pub async fn cancel(&self, id: &str) -> Result<()> {
        retried(ANSWER_PATIENCE, || self.try_cancel(id)).await
    }

    async fn try_cancel(&self, id: &str) -> Result<()> {
        let t = self.db.write().await?;
        let found = find_to_change(&*t, id).await?;
        match state_of(&found)? {
            JobState::Queued | JobState::Paused => {
                let change = job::ActiveModel {
                    state: Set(JobState::Cancelled.as_str().into()),
                    finished_ms: Set(Some(now_ms())),
                    ..Default::default()
                };
                job::Entity::update_many().set(change).filter(job::Column::Id.eq(id)).exec(&*t).await?;
                repeat_in_run(&*t, id, JobState::Cancelled).await?;
            }
            JobState::Running => {
                let change = job::ActiveModel { cancel_requested: Set(1), ..Default::default() };
                job::Entity::update_many().set(change).filter(job::Column::Id.eq(id)).exec(&*t).await?;
            }
            JobState::Cancelled => {}
            ended => return Err(Error::Conflict(format!("the job is {} and cannot be cancelled", ended.as_str()))),
        }
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }

    /// Puts a failed or cancelled job back to the queue, with all its attempts before it.
    pub async fn retry(&self, id: &str) -> Result<()> {
        retried(ANSWER_PATIENCE, || self.try_retry(id)).await
    }

    async fn try_retry(&self, id: &str) -> Result<()> {
        let t = self.db.write().await?;
        let found = find_to_change(&*t, id).await?;
        match state_of(&found)? {
            JobState::Failed | JobState::Cancelled => {}
            other => {
                let what = format!("the job is {}; only a failed or cancelled one can be tried again", other.as_str());
                return Err(Error::Conflict(what));
            }
        }
        let change = job::ActiveModel {
            state: Set(JobState::Queued.as_str().into()),
            failures: Set(0),
            losses: Set(0),
            not_before_ms: Set(0),
            cancel_requested: Set(0),
            stage: Set(String::new()),
            fraction: Set(0.0),
            error: Set(None),
            finished_ms: Set(None),
            ..Default::default()
        };
        job::Entity::update_many().set(change).filter(job::Column::Id.eq(id)).exec(&*t).await?;
        repeat_in_run(&*t, id, JobState::Queued).await?;
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }
}

/// The state in a row.
pub fn state_of(row: &job::Model) -> Result<JobState> {
    JobState::parse(&row.state).ok_or_else(|| Error::Internal(format!("job {} has the state '{}'", row.id, row.state)))
}

/// Store keys under the prefix will be deleted at `due_ms`, unless they are published before.
pub async fn mark_unpublished(records: &impl ConnectionTrait, prefix: String, due_ms: i64) -> Result<()> {
    let row = unpublished::ActiveModel { prefix: Set(prefix), due_ms: Set(due_ms) };
    let replace = OnConflict::column(unpublished::Column::Prefix).update_column(unpublished::Column::DueMs).to_owned();
    unpublished::Entity::insert(row).on_conflict(replace).exec_without_returning(records).await?;
    Ok(())
}

/// A batch's job gets what its batch says, or else what its run's job before it had.
async fn with_rig_and_recipe(records: &impl ConnectionTrait, mut job: job::Model) -> Result<job::Model> {
    let Some(batch) = &job.batch_id else { return Ok(job) };
    if !job.rig_toml.is_empty() && !job.recipe_toml.is_empty() {
        return Ok(job);
    }
    let missing = |what: &str| Error::Internal(format!("job {} of batch {batch} has no {what}", job.id));
    let batch = batch::Entity::find_by_id(batch).one(records).await?.ok_or_else(|| missing("batch"))?;
    let base = match &job.base_job {
        Some(id) => job::Entity::find_by_id(id).one(records).await?,
        None => None,
    };
    let base = base.ok_or_else(|| missing("job before it"))?;
    job.rig_name = batch.rig_name.unwrap_or(base.rig_name);
    job.rig_toml = batch.rig_toml.unwrap_or(base.rig_toml);
    job.recipe_name = batch.recipe_name.unwrap_or(base.recipe_name);
    job.recipe_toml = batch.recipe_toml.unwrap_or(base.recipe_toml);
    Ok(job)
}

/// A job, held until the end of the transaction.
async fn find_to_change(records: &impl ConnectionTrait, id: &str) -> Result<job::Model> {
    let found = job::Entity::find_by_id(id).lock_exclusive().one(records).await?;
    found.ok_or_else(|| Error::NotFound { what: "job", id: id.into() })
}

async fn repeat_in_run(records: &impl ConnectionTrait, job: &str, state: JobState) -> Result<()> {
    run::Entity::update_many()
        .col_expr(run::Column::State, Expr::value(state.as_str()))
        .filter(run::Column::LatestJob.eq(job))
        .exec(records)
        .await?;
    Ok(())
}

#[cfg(test)]
mod model;
#[cfg(test)]
mod rate;
#[cfg(test)]
mod scale;
#[cfg(test)]
mod tests;
