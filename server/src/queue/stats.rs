//! How much waits, for metrics and for whoever scales the workers.

use sea_orm::{ColumnTrait, EntityTrait, QueryFilter, QuerySelect};

use super::Queue;
use crate::db::tables::job;
use crate::error::Result;
use crate::wire::{JobState, Priority};

/// Jobs of one priority in one state.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct QueueDepth {
    /// Who goes first.
    pub priority: Priority,
    /// `queued` or `running`.
    pub state: JobState,
    /// How many.
    pub jobs: i64,
    /// When the oldest of them was asked for, ms since 1970.
    pub oldest_ms: i64,
}

impl Queue {
    /// What waits and what runs.
    pub async fn depths(&self) -> Result<Vec<QueueDepth>> {
        let open = [JobState::Queued.as_str(), JobState::Running.as_str()];
        let rows: Vec<(String, String, i64, i64)> = job::Entity::find()
            .select_only()
            .column(job::Column::Priority)
            .column(job::Column::State)
            .column_as(job::Column::Id.count(), "jobs")
            .column_as(job::Column::CreatedMs.min(), "oldest_ms")
            .filter(job::Column::State.is_in(open))
            .group_by(job::Column::Priority)
            .group_by(job::Column::State)
            .into_tuple()
            .all(self.db.read())
            .await?;
        let of = |(priority, state, jobs, oldest_ms): (String, String, i64, i64)| {
            Some(QueueDepth { priority: Priority::parse(&priority)?, state: JobState::parse(&state)?, jobs, oldest_ms })
        };
        Ok(rows.into_iter().filter_map(of).collect())
    }
}
