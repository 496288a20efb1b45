//! Deletes what belongs to nothing that is published: files of failed attempts, of deleted runs, of uploads that were
//! never recorded; idempotency keys past their time. It deletes only what the records name.

mod policy;
mod rules;

use std::time::Duration;

use sea_orm::{ColumnTrait, EntityTrait, QueryFilter, QueryOrder, QuerySelect};
use tokio_util::sync::CancellationToken;

pub use policy::{Going, Policy, set_pin};
pub use rules::{Holding, MOST_DAYS, MOST_GB, store as store_rules};

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

/// Looks again and again until asked to stop. `own` are this server's rules of keeping, where nobody stored others.
#[allow(clippy::too_many_arguments)] // One task that keeps house for all of them.
pub async fn run(db: Db, store: Store, uploads: Uploads, runs: Runs, own: Policy, bell: Bell, stop: CancellationToken) {
    let mut changes = bell.listen();
    let mut forgot: Option<std::time::Instant> = None;
    let mut let_go: Option<(std::time::Instant, i64)> = None;
    loop {
        let swept = async {
            // First: it goes on with files that may be due here.
            uploads.sweep().await?;
            sweep(&db, &store).await
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
        let applied = async {
            let holding = Holding::now(&db, own).await?;
            let due = let_go.is_none_or(|(at, version)| at.elapsed() >= policy::EVERY || version != holding.version);
            if due {
                let_go = Some((std::time::Instant::now(), holding.version));
                apply(&db, &runs, own, &holding).await?;
            }
            Ok::<(), Error>(())
        };
        if let Err(error) = applied.await {
            tracing::warn!(%error, "what the rules do not keep could not be deleted; it will be tried again");
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

/// Deletes what the rules do not keep; the log says each run. Stops where other rules hold by then, and leaves what was
/// pinned meanwhile.
async fn apply(db: &Db, runs: &Runs, own: Policy, holding: &Holding) -> Result<()> {
    for going in holding.policy.going(db).await? {
        let Going { run, asset, bytes, reason, .. } = going;
        if Holding::now(db, own).await?.version != holding.version {
            return Ok(());
        }
        match runs.is_pinned(&run).await {
            Ok(false) => {}
            // Another server was first, or someone.
            Ok(true) | Err(Error::NotFound { .. }) => continue,
            Err(error) => return Err(error),
        }
        match runs.delete(&run).await {
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
