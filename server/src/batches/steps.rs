//! The steps of batches: each is one small transaction.

use std::time::Duration;

use sea_orm::sea_query::{LockBehavior, LockType};
use sea_orm::{
    ActiveValue::Set, ColumnTrait, Condition, ConnectionTrait, EntityTrait, QueryFilter, QueryOrder, QuerySelect,
};
use tokio_util::sync::CancellationToken;

use super::{Batches, Wanted, runs_of};
use crate::db::tables::{batch, job, run};
use crate::db::{ANSWER_PATIENCE, retried};
use crate::error::Result;
use crate::queue::{Origin, new_row};
use crate::wire::time::now_ms;
use crate::wire::{JobState, Priority};

/// Jobs of one step.
const STEP: u64 = 500;
/// Longest wait before somebody looks whether there is something to do.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Between two steps others write.
const BREATH: Duration = Duration::from_millis(5);

impl Batches {
    /// Takes step after step until asked to stop.
    pub async fn run(self, stop: CancellationToken) {
        let mut changes = self.queue.bell().listen();
        while !stop.is_cancelled() {
            changes.borrow_and_update();
            let pause = match self.step().await {
                Ok(true) => BREATH,
                Ok(false) => LOOK_EVERY,
                Err(error) => {
                    tracing::warn!(%error, "a step of a batch failed; it will be tried again");
                    LOOK_EVERY
                }
            };
            let wait = async {
                tokio::time::sleep(BREATH).await;
                let _ = tokio::time::timeout(pause, changes.changed()).await;
            };
            tokio::select! {
                () = wait => {}
                () = stop.cancelled() => return,
            }
        }
    }

    /// One step of the oldest batch that is not as wanted; false where all are.
    pub async fn step(&self) -> Result<bool> {
        let unsettled = batch::Entity::find().filter(batch::Column::Settled.eq(0));
        if unsettled.one(self.db.read()).await?.is_none() {
            return Ok(false);
        }
        let stepped = retried(ANSWER_PATIENCE, || self.try_step()).await?;
        if stepped {
            self.queue.bell().ring();
        }
        Ok(stepped)
    }

    async fn try_step(&self) -> Result<bool> {
        let t = self.db.write().await?;
        let next = batch::Entity::find()
            .filter(batch::Column::Settled.eq(0))
            .order_by_asc(batch::Column::Id)
            .lock_with_behavior(LockType::Update, LockBehavior::SkipLocked)
            .one(&*t)
            .await?;
        let Some(row) = next else { return Ok(false) };
        let more = match Wanted::parse(&row.wanted)? {
            Wanted::Run => {
                let freed = move_jobs(&*t, &row.id, &[JobState::Paused], JobState::Queued).await?;
                freed || enqueue(&*t, &row).await?
            }
            Wanted::Pause => move_jobs(&*t, &row.id, &[JobState::Queued], JobState::Paused).await?,
            Wanted::Cancel => {
                let stopped =
                    move_jobs(&*t, &row.id, &[JobState::Queued, JobState::Paused], JobState::Cancelled).await?;
                if !stopped {
                    stop_running(&*t, &row.id).await?;
                }
                stopped
            }
        };
        if !more {
            let change = batch::ActiveModel { settled: Set(1), ..Default::default() };
            batch::Entity::update_many().set(change).filter(batch::Column::Id.eq(&row.id)).exec(&*t).await?;
        }
        t.commit().await?;
        Ok(true)
    }
}

/// The next runs get their jobs; false where there is none any more. The results stand beside the old ones: a run goes
/// on showing its latest job until the batch's one is done.
async fn enqueue(records: &impl ConnectionTrait, row: &batch::Model) -> Result<bool> {
    let runs: Vec<(String, String)> = run::Entity::find()
        .select_only()
        .columns([run::Column::Id, run::Column::LatestJob])
        .filter(runs_of(row)?)
        .filter(run::Column::Id.gt(row.queued_to.as_str()))
        .order_by_asc(run::Column::Id)
        .limit(STEP)
        .into_tuple()
        .all(records)
        .await?;
    let Some((last, _)) = runs.last().cloned() else { return Ok(false) };
    let rows = runs.into_iter().map(|(run, base_job)| {
        let origin = Origin { batch: row.id.clone(), base_job };
        new_row(&run, Priority::Batch, origin)
    });
    job::Entity::insert_many(rows).exec_without_returning(records).await?;
    let change = batch::ActiveModel { queued_to: Set(last), ..Default::default() };
    batch::Entity::update_many().set(change).filter(batch::Column::Id.eq(&row.id)).exec(records).await?;
    Ok(true)
}

/// Some of the batch's jobs that wait go from a state to another; false where none was left.
async fn move_jobs(records: &impl ConnectionTrait, batch: &str, from: &[JobState], to: JobState) -> Result<bool> {
    let ids: Vec<String> = job::Entity::find()
        .select_only()
        .column(job::Column::Id)
        .filter(job::Column::BatchId.eq(batch))
        .filter(job::Column::State.is_in(from.iter().map(|s| s.as_str())))
        .limit(STEP)
        .lock_with_behavior(LockType::Update, LockBehavior::SkipLocked)
        .into_tuple()
        .all(records)
        .await?;
    if ids.is_empty() {
        return Ok(false);
    }
    let change = job::ActiveModel {
        state: Set(to.as_str().into()),
        finished_ms: Set(to.is_final().then(now_ms)),
        ..Default::default()
    };
    job::Entity::update_many().set(change).filter(job::Column::Id.is_in(ids)).exec(records).await?;
    Ok(true)
}

/// Workers hear of it at their next look.
async fn stop_running(records: &impl ConnectionTrait, batch: &str) -> Result<()> {
    let running =
        Condition::all().add(job::Column::BatchId.eq(batch)).add(job::Column::State.eq(JobState::Running.as_str()));
    let change = job::ActiveModel { cancel_requested: Set(1), ..Default::default() };
    job::Entity::update_many().set(change).filter(running).exec(records).await?;
    Ok(())
}
