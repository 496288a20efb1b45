//! Deletes what belongs to nothing that is published: files of failed attempts, of deleted runs, of uploads that were
//! never recorded; idempotency keys past their time. It deletes only what the records name.

mod policy;

use std::time::Duration;

use sea_orm::{ColumnTrait, EntityTrait, QueryFilter, QueryOrder, QuerySelect};
use tokio_util::sync::CancellationToken;

pub use policy::{Going, Policy, set_pin};

use crate::auth::Auth;
use crate::db::Db;
use crate::db::tables::{idempotency_key, unpublished};
use crate::error::{Error, Result};
use crate::queue::Bell;
use crate::runs::Runs;
use crate::store::Store;
use crate::uploads::Uploads;
use crate::wire::time::now_ms;

/// How often to look when nobody rings.
const EVERY: Duration = Duration::from_secs(30);
/// How often sessions, login codes and lines of the audit log that are over are forgotten.
const FORGET_EVERY: Duration = Duration::from_secs(3600);
/// Least time between two looks.
const AT_MOST_EVERY: Duration = Duration::from_secs(1);
/// Prefixes of one look.
const AT_ONCE: u64 = 100;
/// How long a creating request can be repeated with its key.
const KEYS_KEPT_MS: i64 = 30 * 24 * 3_600_000;

/// Looks again and again until asked to stop.
#[allow(clippy::too_many_arguments)] // One task that keeps house for all of them.
pub async fn run(
    db: Db,
    store: Store,
    uploads: Uploads,
    runs: Runs,
    policy: Policy,
    bell: Bell,
    stop: CancellationToken,
) {
    let mut changes = bell.listen();
    let mut forgot: Option<std::time::Instant> = None;
    let mut let_go: Option<std::time::Instant> = None;
    loop {
        let swept = async {
            sweep(&db, &store).await?;
            uploads.sweep().await
        };
        if let Err(error) = swept.await {
            tracing::warn!(%error, "cleaning up failed; it will be tried again");
        }
        if forgot.is_none_or(|at| at.elapsed() >= FORGET_EVERY) {
            forgot = Some(std::time::Instant::now());
            if let Err(error) = Auth::new(db.clone()).forget().await {
                tracing::warn!(%error, "what is over could not be forgotten; it will be tried again");
            }
        }
        if let_go.is_none_or(|at| at.elapsed() >= policy::EVERY) {
            let_go = Some(std::time::Instant::now());
            if let Err(error) = apply(&db, &runs, &policy).await {
                tracing::warn!(%error, "what the policy does not keep could not be deleted; it will be tried again");
            }
        }
        let pause = async {
            tokio::time::sleep(AT_MOST_EVERY).await;
            let _ = tokio::time::timeout(EVERY, changes.changed()).await;
        };
        tokio::select! {
            () = pause => {}
            () = stop.cancelled() => return,
        }
    }
}

/// Deletes what the policy does not keep; the log says each run.
async fn apply(db: &Db, runs: &Runs, policy: &Policy) -> Result<()> {
    for going in policy.going(db).await? {
        let Going { run, asset, bytes, reason, .. } = going;
        match runs.delete(&run).await {
            // Another server was first, or someone.
            Err(Error::NotFound { .. }) => {}
            other => other?,
        }
        tracing::info!(run, asset, bytes, reason, "a run was let go");
    }
    Ok(())
}

/// One look.
pub async fn sweep(db: &Db, store: &Store) -> Result<()> {
    let due = unpublished::Entity::find()
        .filter(unpublished::Column::DueMs.lte(now_ms()))
        .order_by_asc(unpublished::Column::DueMs)
        .limit(AT_ONCE)
        .all(db.read())
        .await?;
    for row in due {
        store.delete_prefix(&row.prefix).await?;
        let t = db.write().await?;
        unpublished::Entity::delete_by_id(row.prefix).exec(&*t).await?;
        t.commit().await?;
    }
    let old = idempotency_key::Column::CreatedMs.lt(now_ms() - KEYS_KEPT_MS);
    if idempotency_key::Entity::find().filter(old.clone()).one(db.read()).await?.is_some() {
        let t = db.write().await?;
        idempotency_key::Entity::delete_many().filter(old).exec(&*t).await?;
        t.commit().await?;
    }
    Ok(())
}
