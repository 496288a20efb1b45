//! Leases whose worker is gone: found at the next start of its node, or by watching for signs of life.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use sea_orm::{ActiveValue::Set, ColumnTrait, Condition, EntityTrait, QueryFilter, QuerySelect};

use super::ending::{ended, problem_of, requeued};
use super::lease::add_log_line;
use super::{Queue, mark_unpublished, repeat_in_run};
use crate::db::tables::{job, segment};
use crate::db::{ANSWER_PATIENCE, retried};
use crate::error::Result;
use crate::metrics::metrics;
use crate::store;
use crate::wire::JobState;
use crate::wire::child::Failure;
use crate::wire::time::now_ms;

/// How long the files of a lost attempt are left alone: its worker may only be paused, and still be writing.
const LOST_FILES_MS: i64 = 600_000;

impl Queue {
    /// Takes back every lease of a node that has just started: whoever held them is dead.
    pub async fn recover(&self, node: &str) -> Result<usize> {
        let held =
            Condition::all().add(job::Column::State.eq(JobState::Running.as_str())).add(job::Column::Node.eq(node));
        let mut lost = 0;
        for row in job::Entity::find().filter(held).all(self.db.read()).await? {
            let lose = || self.lose(&row.id, row.fence, row.beat, now_ms());
            lost += usize::from(retried(ANSWER_PATIENCE, lose).await?);
        }
        Ok(lost)
    }

    /// Ends a lease, unless its owner has given a sign of life since `beat`. True where it did.
    async fn lose(&self, id: &str, fence: i64, beat: i64, files_due_ms: i64) -> Result<bool> {
        let t = self.db.write().await?;
        let held = Condition::all()
            .add(job::Column::Id.eq(id))
            .add(job::Column::State.eq(JobState::Running.as_str()))
            .add(job::Column::Fence.eq(fence))
            .add(job::Column::Beat.eq(beat));
        let Some(row) = job::Entity::find().filter(held).lock_exclusive().one(&*t).await? else { return Ok(false) };
        let losses = row.losses + 1;
        let state = match (row.cancel_requested, losses >= self.limits.max_losses) {
            (0, false) => JobState::Queued,
            (0, true) => JobState::Failed,
            _ => JobState::Cancelled,
        };
        let again = state == JobState::Queued;
        let words = format!(
            "the worker '{}' was lost in attempt {} (its process was killed, or its machine stopped)",
            row.worker, row.attempt
        );
        let failure =
            Failure::new("lost", format!("{words}; {losses} of at most {} losses", self.limits.max_losses), again);
        let change = job::ActiveModel {
            losses: Set(losses),
            error: Set(Some(problem_of(&failure, again)?)),
            not_before_ms: Set(0),
            ..if again { requeued() } else { ended(state) }
        };
        job::Entity::update_many().set(change).filter(job::Column::Id.eq(id)).exec(&*t).await?;
        add_log_line(&*t, id, row.attempt, &words, &self.limits).await?;
        segment::Entity::delete_many().filter(segment::Column::JobId.eq(id)).exec(&*t).await?;
        mark_unpublished(&*t, store::attempt_prefix(id, fence), files_due_ms).await?;
        repeat_in_run(&*t, id, state).await?;
        t.commit().await?;
        self.bell.ring();
        Ok(true)
    }

    /// True where an attempt still has its lease.
    pub async fn is_leased(&self, job: &str, fence: i64) -> Result<bool> {
        let row = job::Entity::find_by_id(job).one(self.db.read()).await?;
        Ok(row.is_some_and(|r| r.fence == fence && r.state == JobState::Running.as_str()))
    }
}

/// Watches the running jobs of all nodes. Time is this process's own monotonic clock: only the count of signs of life
/// is read from the records, so that no clock that someone sets can end a lease.
///
/// Who was not looking saw no sign of life either: after this process was paused, or the records were away, every
/// lease is watched for its whole time anew.
pub struct LeaseWatch {
    queue: Queue,
    last_change: HashMap<String, (i64, i64, Instant)>,
    last_look: Instant,
}

impl LeaseWatch {
    /// Begins to watch.
    pub fn new(queue: Queue) -> LeaseWatch {
        LeaseWatch { queue, last_change: HashMap::new(), last_look: Instant::now() }
    }

    /// One look; takes back the leases that were silent for too long.
    pub async fn look(&mut self) -> Result<()> {
        let rows: Vec<(String, i64, i64)> = job::Entity::find()
            .select_only()
            .columns([job::Column::Id, job::Column::Fence, job::Column::Beat])
            .filter(job::Column::State.eq(JobState::Running.as_str()))
            .into_tuple()
            .all(self.queue.db.read())
            .await?;
        let now = Instant::now();
        let looked_away = now.duration_since(self.last_look) > self.longest_gap();
        self.last_look = now;
        let mut seen = HashMap::with_capacity(rows.len());
        for (id, fence, beat) in rows {
            let since = match self.last_change.get(&id) {
                Some((f, b, since)) if (*f, *b) == (fence, beat) && !looked_away => *since,
                _ => now,
            };
            if now.duration_since(since) >= self.queue.limits.lease {
                let lose = || self.queue.lose(&id, fence, beat, now_ms() + LOST_FILES_MS);
                if retried(ANSWER_PATIENCE, lose).await? {
                    metrics().leases_lost.inc();
                    tracing::warn!(job = id, "a lease without a sign of life was ended");
                }
            }
            seen.insert(id, (fence, beat, since));
        }
        self.last_change = seen;
        Ok(())
    }
    /// The longest time between two looks after which what was seen still counts.
    fn longest_gap(&self) -> Duration {
        self.queue.limits.lease / 2
    }
}
