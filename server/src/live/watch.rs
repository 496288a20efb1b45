//! Closes the runs of robots that vanished.

use std::collections::HashMap;
use std::time::Duration;

use sea_orm::{ColumnTrait, Condition, EntityTrait, QueryFilter, QuerySelect};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::{Live, close_run};
use crate::db::tables::stream;
use crate::error::Result;

/// How often the open streams are looked at.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// A stream's last sign of life: its fence and beat, and when they changed on this process's own clock, which no one
/// sets.
type Seen = HashMap<String, (i64, i64, Instant)>;

/// Looks again and again until asked to stop. Every server does: the first to find a robot gone closes its run.
pub async fn watch(live: Live, stop: CancellationToken) {
    let mut seen = Seen::new();
    loop {
        if let Err(error) = look(&live, &mut seen).await {
            tracing::warn!(%error, "the live streams could not be looked at");
        }
        tokio::select! {
            () = tokio::time::sleep(LOOK_EVERY) => {}
            () = stop.cancelled() => return,
        }
    }
}

async fn look(live: &Live, seen: &mut Seen) -> Result<()> {
    let rows = stream::Entity::find().filter(stream::Column::IsOpen.eq(1)).all(live.db.read()).await?;
    let now = Instant::now();
    let mut still = Seen::with_capacity(rows.len());
    for row in rows {
        let since = match seen.get(&row.name) {
            Some((fence, beat, since)) if (*fence, *beat) == (row.fence, row.beat) => *since,
            _ => now,
        };
        if now.duration_since(since) >= live.limits.come_back {
            close_vanished(live, &row).await?;
        } else {
            still.insert(row.name.clone(), (row.fence, row.beat, since));
        }
    }
    *seen = still;
    Ok(())
}

async fn close_vanished(live: &Live, row: &stream::Model) -> Result<()> {
    let t = live.db.write().await?;
    let silent = Condition::all()
        .add(stream::Column::Name.eq(&row.name))
        .add(stream::Column::Fence.eq(row.fence))
        .add(stream::Column::Beat.eq(row.beat))
        .add(stream::Column::IsOpen.eq(1));
    let Some(row) = stream::Entity::find().filter(silent).lock_exclusive().one(&*t).await? else { return Ok(()) };
    close_run(&*t, &row).await?;
    t.commit().await?;
    tracing::info!(stream = row.name, run = row.run_id, "the robot did not come back; its run is closed");
    live.bell.ring();
    Ok(())
}
