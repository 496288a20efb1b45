//! The one end of an attempt: its result, its failure, or that another one shall try.

use std::sync::atomic::{AtomicBool, Ordering};

use sea_orm::sea_query::Expr;
use sea_orm::{ActiveValue::Set, ColumnTrait, ConnectionTrait, EntityTrait, PaginatorTrait, QueryFilter, QuerySelect};
use stria_core::defects::DefectList;
use uuid::Uuid;

use super::lease::{Lease, add_log_line, lease_holds, must_hold, to_i64};
use super::{Queue, mark_unpublished, repeat_in_run};
use crate::config::JobLimits;
use crate::db::retried;
use crate::db::tables::{job, product, run, segment, unpublished};
use crate::defects;
use crate::error::{Error, Result};
use crate::store::{self, Facts, ProductName};
use crate::wire::child::Failure;
use crate::wire::time::now_ms;
use crate::wire::{JobState, Problem};

/// Rows of one INSERT; SQLite takes 32,766 values.
const ROWS_AT_ONCE: usize = 1000;

/// A product that lies in the store.
#[derive(Clone, Debug)]
pub struct PublishedProduct {
    /// Its name.
    pub name: ProductName,
    /// Its size and hash.
    pub facts: Facts,
}

/// What an attempt made.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The files, in the order in which they shall be listed.
    pub products: Vec<PublishedProduct>,
    /// What a person should know.
    pub warnings: Vec<String>,
    /// Quality figures.
    pub quality: serde_json::Value,
    /// Frames read.
    pub frames: u64,
    /// The defects, where they were looked for.
    pub defects: Option<Box<DefectList>>,
}

impl Queue {
    /// Publishes the result: state, products and the right to keep their files, at once.
    pub async fn finish(&self, lease: &Lease, outcome: Outcome) -> Result<()> {
        // A connection that breaks in the commit leaves open whether it was made.
        let unsure = AtomicBool::new(false);
        let publish = || async {
            match self.try_finish(lease, outcome.clone()).await {
                Err(Error::LeaseLost) if unsure.load(Ordering::Relaxed) => self.is_published(lease).await,
                Err(error) => {
                    unsure.store(error.is_passing(), Ordering::Relaxed);
                    Err(error)
                }
                done => done,
            }
        };
        retried(self.limits.record_patience, publish).await
    }

    /// Whether this very attempt has published the result.
    async fn is_published(&self, lease: &Lease) -> Result<()> {
        let published = job::Entity::find_by_id(&lease.job)
            .filter(job::Column::ResultFence.eq(lease.fence))
            .filter(job::Column::State.eq(JobState::Done.as_str()))
            .count(self.db.read())
            .await?;
        must_hold(published)
    }

    async fn try_finish(&self, lease: &Lease, outcome: Outcome) -> Result<()> {
        let t = self.db.write().await?;
        let count = outcome.products.len();
        let warnings: Vec<_> = outcome.warnings.into_iter().take(self.limits.warnings).collect();
        let change = job::ActiveModel {
            stage: Set(String::new()),
            fraction: Set(1.0),
            frames: Set(to_i64(outcome.frames)),
            frames_total: Set(Some(to_i64(outcome.frames))),
            time_left_s: Set(None),
            warnings: Set(serde_json::Value::from(warnings).to_string()),
            quality: Set(Some(outcome.quality.to_string())),
            result_fence: Set(Some(lease.fence)),
            ..ended(JobState::Done)
        };
        must_hold(job::Entity::update_many().set(change).filter(lease.held()).exec(&*t).await?.rows_affected)?;
        let rows = outcome.products.into_iter().enumerate().map(|(i, p)| product::ActiveModel {
            job_id: Set(lease.job.clone()),
            name: Set(p.name.as_str().into()),
            position: Set(i as i64),
            bytes: Set(to_i64(p.facts.bytes)),
            sha256: Set(p.facts.sha256),
        });
        let rows = rows.collect::<Vec<_>>();
        for part in rows.chunks(ROWS_AT_ONCE) {
            product::Entity::insert_many(part.iter().cloned()).exec_without_returning(&*t).await?;
        }
        unpublished::Entity::delete_by_id(store::attempt_prefix(&lease.job, lease.fence)).exec(&*t).await?;
        let line = format!("attempt {} is done: {count} products", lease.attempt);
        add_log_line(&*t, &lease.job, lease.attempt, &line, &self.limits).await?;
        if lease.in_batch {
            // Only now does the run show it instead of the result before; a job asked for since then stays.
            run::Entity::update_many()
                .col_expr(run::Column::LatestJob, Expr::value(lease.job.as_str()))
                .filter(run::Column::Id.eq(&lease.run))
                .filter(run::Column::LatestJob.lt(lease.job.as_str()))
                .exec(&*t)
                .await?;
        }
        if let Some(words) = defects::publish(&*t, &lease.run, &lease.job, outcome.defects.as_deref()).await? {
            add_log_line(&*t, &lease.job, lease.attempt, &words, &self.limits).await?;
        }
        repeat_in_run(&*t, &lease.job, JobState::Done).await?;
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }

    /// The attempt ended in an error: back to the queue after a wait, or the job's end.
    pub async fn fail(&self, lease: &Lease, failure: &Failure) -> Result<()> {
        retried(self.limits.record_patience, || self.try_fail(lease, failure)).await
    }

    async fn try_fail(&self, lease: &Lease, failure: &Failure) -> Result<()> {
        let t = self.db.write().await?;
        let row = lease_holds(&*t, lease).await?;
        let failures = row.failures + 1;
        let state = match failure.retryable && failures < self.limits.max_failures {
            true => back_or_cancelled(&row),
            false => JobState::Failed,
        };
        let again = state == JobState::Queued;
        let change = job::ActiveModel {
            failures: Set(failures),
            error: Set(Some(problem_of(failure, again)?)),
            not_before_ms: Set(now_ms() + wait_ms(&self.limits, failures)),
            ..if again { requeued() } else { ended(state) }
        };
        let then = if again { "it will be tried again" } else { "it will not be tried again" };
        let line = format!("attempt {} failed ({}): {}; {then}", lease.attempt, failure.kind, failure.message);
        add_log_line(&*t, &lease.job, lease.attempt, &line, &self.limits).await?;
        self.leave(&*t, lease, change, state).await?;
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }

    /// The attempt stopped because someone asked for it.
    pub async fn cancelled(&self, lease: &Lease) -> Result<()> {
        retried(self.limits.record_patience, || self.try_cancelled(lease)).await
    }

    async fn try_cancelled(&self, lease: &Lease) -> Result<()> {
        let t = self.db.write().await?;
        lease_holds(&*t, lease).await?;
        self.leave(&*t, lease, ended(JobState::Cancelled), JobState::Cancelled).await?;
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }

    /// The worker stops cleanly: back to the queue, and the attempt is not counted.
    pub async fn release(&self, lease: &Lease) -> Result<()> {
        retried(self.limits.record_patience, || self.try_release(lease)).await
    }

    async fn try_release(&self, lease: &Lease) -> Result<()> {
        let t = self.db.write().await?;
        let row = lease_holds(&*t, lease).await?;
        let state = back_or_cancelled(&row);
        let change = job::ActiveModel {
            attempt: Set(row.attempt - 1),
            not_before_ms: Set(0),
            ..if state == JobState::Queued { requeued() } else { ended(state) }
        };
        self.leave(&*t, lease, change, state).await?;
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }

    /// What the attempt needs was away: back to the queue for a while, and the attempt is not counted.
    pub async fn postpone(&self, lease: &Lease, failure: &Failure) -> Result<()> {
        retried(self.limits.record_patience, || self.try_postpone(lease, failure)).await
    }

    async fn try_postpone(&self, lease: &Lease, failure: &Failure) -> Result<()> {
        let t = self.db.write().await?;
        let row = lease_holds(&*t, lease).await?;
        let wait_ms = self.limits.postpone.as_millis() as i64;
        let state = back_or_cancelled(&row);
        let change = job::ActiveModel {
            attempt: Set(row.attempt - 1),
            error: Set(Some(problem_of(failure, true)?)),
            not_before_ms: Set(now_ms() + wait_ms),
            ..if state == JobState::Queued { requeued() } else { ended(state) }
        };
        let line = format!("attempt {} is put off: {}", lease.attempt, failure.message);
        add_log_line(&*t, &lease.job, lease.attempt, &line, &self.limits).await?;
        self.leave(&*t, lease, change, state).await?;
        t.commit().await?;
        self.bell.ring();
        Ok(())
    }

    /// The lease was lost: what its attempt has put into the store since belongs to nothing.
    pub async fn abandon(&self, lease: &Lease) -> Result<()> {
        let t = self.db.write().await?;
        let published = job::Entity::find_by_id(&lease.job).filter(job::Column::ResultFence.eq(lease.fence));
        if published.lock_exclusive().one(&*t).await?.is_none() {
            mark_unpublished(&*t, store::attempt_prefix(&lease.job, lease.fence), now_ms()).await?;
        }
        t.commit().await
    }

    /// What all ends without a result have in common.
    async fn leave(
        &self,
        records: &impl ConnectionTrait,
        lease: &Lease,
        change: job::ActiveModel,
        state: JobState,
    ) -> Result<()> {
        must_hold(job::Entity::update_many().set(change).filter(lease.held()).exec(records).await?.rows_affected)?;
        segment::Entity::delete_many().filter(segment::Column::JobId.eq(&lease.job)).exec(records).await?;
        mark_unpublished(records, store::attempt_prefix(&lease.job, lease.fence), now_ms()).await?;
        repeat_in_run(records, &lease.job, state).await
    }
}

/// Where a job goes that would be tried again: whoever asked it to stop meanwhile is heard.
fn back_or_cancelled(row: &job::Model) -> JobState {
    if row.cancel_requested == 0 { JobState::Queued } else { JobState::Cancelled }
}

/// Columns of a job that goes back to the queue.
pub(super) fn requeued() -> job::ActiveModel {
    job::ActiveModel {
        state: Set(JobState::Queued.as_str().into()),
        stage: Set(String::new()),
        fraction: Set(0.0),
        frames: Set(0),
        frames_per_s: Set(0.0),
        time_left_s: Set(None),
        cancel_requested: Set(0),
        ..Default::default()
    }
}

/// Columns of a job that ends.
pub(super) fn ended(state: JobState) -> job::ActiveModel {
    job::ActiveModel {
        state: Set(state.as_str().into()),
        cancel_requested: Set(0),
        time_left_s: Set(None),
        finished_ms: Set(Some(now_ms())),
        ..Default::default()
    }
}

/// The failure as the job's record keeps it.
pub(super) fn problem_of(failure: &Failure, again: bool) -> Result<String> {
    let title = match failure.kind.as_str() {
        "bad_input" => "The run cannot be processed as it is",
        "killed" => "The processing was killed",
        "out_of_memory" => "The processing ran out of memory",
        "time_limit" => "The processing took too long",
        "lost" => "The worker was lost",
        "away" => "The records or the files could not be reached",
        "io" => "A file could not be read or written",
        _ => "The processing failed",
    };
    let problem = Problem {
        kind: format!("urn:stria:job:{}", failure.kind),
        title: title.into(),
        status: None,
        detail: failure.message.clone(),
        field: failure.field.clone(),
        expected: failure.expected.clone(),
        retryable: again,
    };
    serde_json::to_string(&problem).map_err(|e| Error::Internal(format!("a problem is not JSON: {e}")))
}

/// The wait before the next attempt: longer each time, and never the same for many jobs at once.
pub(super) fn wait_ms(limits: &JobLimits, failures: i32) -> i64 {
    let exponent = u32::try_from(failures - 1).unwrap_or(0);
    let factor = JobLimits::RETRY_FACTOR.saturating_pow(exponent);
    let wait = limits.retry_base.saturating_mul(factor).min(limits.retry_max).as_millis() as i64;
    // Up to a quarter more; the last bits of a UUID are random.
    let random = (Uuid::now_v7().as_u128() & 0xffff) as i64;
    wait + wait * random / (4 * 0x10000)
}
