//! Workers: lease → child process → commit. They know the queue and the store, and nothing of HTTP.
//!
//! The pipeline runs in a child process (`stria process`, the command that a person can use as well): a hostile video,
//! an abort inside a library or a memory blow-up ends one attempt, with its reason on the job, and nothing else.

mod attempt;
mod child;
mod follow;
mod publish;
mod scratch;
mod showcase;

use std::path::PathBuf;
use std::time::Duration;

use sea_orm::{ActiveValue::Set, ColumnTrait, Condition, EntityTrait, QueryFilter};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::config::JobLimits;
use crate::confinement::Confinement;
use crate::db::tables::worker;
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::disk::DiskGuard;
use crate::error::Result;
use crate::queue::{LeaseWatch, Queue, Wanted};
use crate::store::Store;
use crate::wire::time::now_ms;

/// Longest wait of an idle worker before it looks for jobs that another process enqueued, or whose wait is over.
pub(crate) const LOOK_EVERY: Duration = Duration::from_secs(1);

/// How long a worker without room on its disk waits before it looks again.
const DISK_PAUSE: Duration = Duration::from_secs(10);

/// How often a worker process says that it is there.
const SEEN_EVERY: Duration = Duration::from_secs(10);

/// A worker process that was silent for this long is no longer listed, ms.
const FORGET_MS: i64 = 24 * 3_600_000;

/// What all workers of a process share.
#[derive(Clone)]
pub struct Worker {
    /// The jobs.
    pub queue: Queue,
    /// The records, for the list of workers.
    pub db: Db,
    /// The files.
    pub store: Store,
    /// Limits of jobs.
    pub limits: JobLimits,
    /// The binary that processes: this one.
    pub program: PathBuf,
    /// How the child is kept from the network and from other files.
    pub confined: Confinement,
    /// Where attempts write.
    pub scratch: PathBuf,
    /// The name of this machine's data folder, the same after a restart.
    pub node: String,
    /// The name of this process.
    pub name: String,
    /// Room on the disk of the scratch space.
    pub disk: DiskGuard,
    /// Stop: give the jobs back.
    pub stop: CancellationToken,
}

impl Worker {
    /// Takes back what an earlier process of this node left, then works on `slots` jobs at a time until asked to stop.
    pub async fn run(self, slots: usize) -> Result<()> {
        let lost = self.queue.recover(&self.node).await?;
        if lost > 0 {
            tracing::info!(lost, "jobs of a process that was killed went back to the queue");
        }
        scratch::remove_leftovers(&self.scratch, &self.queue).await?;
        retried(ANSWER_PATIENCE, || self.announce(slots)).await?;
        let mut tasks = JoinSet::new();
        for _ in 0..slots {
            tasks.spawn(self.clone().work(Wanted::Any));
        }
        if slots > 0 {
            // People watch a live run: it never waits for a long one to end.
            tasks.spawn(self.clone().work(Wanted::Live));
        }
        tasks.spawn(self.clone().watch_leases());
        tasks.spawn(self.clone().stay_listed());
        while let Some(ended) = tasks.join_next().await {
            if let Err(error) = ended {
                tracing::error!(%error, "a worker stopped");
            }
        }
        retried(self.limits.stop_patience, || self.sign_off()).await
    }

    async fn sign_off(&self) -> Result<()> {
        let t = self.db.write().await?;
        worker::Entity::delete_by_id(&self.name).exec(&*t).await?;
        t.commit().await
    }

    /// One job after the other.
    async fn work(self, which: Wanted) {
        let mut changes = self.queue.bell().listen();
        while !self.stop.is_cancelled() {
            changes.borrow_and_update();
            if let Some(lack) = self.disk.lack() {
                tracing::warn!(lack, "no job begins");
                pause(&self.stop, DISK_PAUSE).await;
                continue;
            }
            match self.queue.claim(which, &self.node, &self.name).await {
                Ok(Some(lease)) => {
                    attempt::run(&self, &lease).await;
                    continue;
                }
                Ok(None) => {}
                Err(error) => {
                    tracing::warn!(%error, "the queue does not answer");
                    tokio::time::sleep(LOOK_EVERY).await;
                }
            }
            tokio::select! {
                _ = tokio::time::timeout(LOOK_EVERY, changes.changed()) => {}
                () = self.stop.cancelled() => {}
            }
        }
    }

    /// Takes back the leases of workers on any node that went silent.
    async fn watch_leases(self) {
        let mut watch = LeaseWatch::new(self.queue.clone());
        while pause(&self.stop, self.limits.lease / 6).await {
            if let Err(error) = watch.look().await {
                tracing::warn!(%error, "leases could not be looked at");
            }
        }
    }

    async fn stay_listed(self) {
        while pause(&self.stop, SEEN_EVERY).await {
            let row = worker::ActiveModel { seen_ms: Set(now_ms()), ..Default::default() };
            let write = async {
                let t = self.db.write().await?;
                let mine = worker::Entity::update_many().set(row).filter(worker::Column::Name.eq(&self.name));
                mine.exec(&*t).await?;
                t.commit().await
            };
            if let Err(error) = write.await {
                tracing::warn!(%error, "the list of workers could not be written");
            }
        }
    }

    async fn announce(&self, slots: usize) -> Result<()> {
        let t = self.db.write().await?;
        let dead = Condition::any()
            .add(worker::Column::Node.eq(&self.node))
            .add(worker::Column::SeenMs.lt(now_ms() - FORGET_MS));
        worker::Entity::delete_many().filter(dead).exec(&*t).await?;
        let row = worker::ActiveModel {
            name: Set(self.name.clone()),
            node: Set(self.node.clone()),
            slots: Set(i32::try_from(slots).unwrap_or(i32::MAX)),
            started_ms: Set(now_ms()),
            seen_ms: Set(now_ms()),
        };
        worker::Entity::insert(row).exec_without_returning(&*t).await?;
        t.commit().await
    }
}

/// Waits; false where it is time to stop.
async fn pause(stop: &CancellationToken, time: Duration) -> bool {
    tokio::select! {
        () = tokio::time::sleep(time) => true,
        () = stop.cancelled() => false,
    }
}
