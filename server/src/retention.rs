//! Deletes what belongs to nothing that is published: files of failed attempts, of deleted runs, of uploads that were
//! never recorded; idempotency keys past their time. It deletes only what the records name.

use std::time::Duration;

use sea_orm::{ColumnTrait, EntityTrait, QueryFilter, QueryOrder, QuerySelect};
use tokio_util::sync::CancellationToken;

use crate::db::Db;
use crate::db::tables::{idempotency_key, unpublished};
use crate::error::Result;
use crate::queue::Bell;
use crate::store::Store;
use crate::uploads::Uploads;
use crate::wire::time::now_ms;

/// How often to look when nobody rings.
const EVERY: Duration = Duration::from_secs(30);
/// Least time between two looks.
const AT_MOST_EVERY: Duration = Duration::from_secs(1);
/// Prefixes of one look.
const AT_ONCE: u64 = 100;
/// How long a creating request can be repeated with its key.
const KEYS_KEPT_MS: i64 = 30 * 24 * 3_600_000;

/// Looks again and again until asked to stop.
pub async fn run(db: Db, store: Store, uploads: Uploads, bell: Bell, stop: CancellationToken) {
    let mut changes = bell.listen();
    loop {
        let swept = async {
            // First: it goes on with files that may be due here.
            uploads.sweep().await?;
            sweep(&db, &store).await
        };
        if let Err(error) = swept.await {
            tracing::warn!(%error, "cleaning up failed; it will be tried again");
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
