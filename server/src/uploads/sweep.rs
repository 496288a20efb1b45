//! Uploads that nobody goes on with: those that are whole become runs all the same, the others go.

use std::time::Duration;

use sea_orm::sea_query::Expr;
use sea_orm::{ActiveValue::Set, ColumnTrait, Condition, EntityTrait, ExprTrait, QueryFilter, QuerySelect};

use super::{Uploads, bytes_so_far, state, to_i64};
use crate::db::tables::upload;
use crate::error::{Error, Result};
use crate::wire::time::now_ms;

/// Uploads of one sweep.
const AT_ONCE: u64 = 100;

/// A whole upload whose last request was cut off before its answer is left to its sender for this long.
const LEFT_TO_SENDER: Duration = Duration::from_secs(60);

impl Uploads {
    /// One look. An upload that makes trouble does not keep the others waiting.
    pub async fn sweep(&self) -> Result<()> {
        for id in self.left_whole().await? {
            self.warn_of(&id, self.finish(&id).await);
        }
        for row in self.expired().await? {
            self.warn_of(&row.id, self.expire(&row).await);
        }
        self.forget().await
    }

    fn warn_of(&self, upload: &str, result: Result<()>) {
        if let Err(error) = result {
            tracing::warn!(%error, upload, "an upload could not be ended; it will be tried again");
        }
    }

    /// Uploads whose bytes are all there but which are no run yet: the server was killed, or its store was away, in the
    /// last moment.
    async fn left_whole(&self) -> Result<Vec<String>> {
        // The last write set the expiry.
        let untouched = now_ms() + to_i64(self.limits.kept_for.saturating_sub(LEFT_TO_SENDER).as_millis() as u64);
        let whole = Condition::all()
            .add(upload::Column::State.eq(state::OPEN))
            .add(upload::Column::ExpiresMs.gte(now_ms()))
            .add(upload::Column::ExpiresMs.lt(untouched))
            .add(Expr::col(upload::Column::OffsetBytes).eq(Expr::col(upload::Column::LengthBytes)));
        let rows = upload::Entity::find().filter(whole).limit(AT_ONCE).all(self.db.read()).await?;
        Ok(rows.into_iter().map(|row| row.id).collect())
    }

    async fn finish(&self, id: &str) -> Result<()> {
        let Some(turn) = self.turns.take_if_free(id) else { return Ok(()) };
        match self.hold(id, turn).await?.finish_if_whole().await {
            // Its sender hears this when it comes back.
            Err(Error::Checksum(_) | Error::Gone(_)) => Ok(()),
            other => other.map(|_| ()),
        }
    }

    async fn expired(&self) -> Result<Vec<upload::Model>> {
        let old =
            Condition::all().add(upload::Column::State.ne(state::EXPIRED)).add(upload::Column::ExpiresMs.lt(now_ms()));
        Ok(upload::Entity::find().filter(old).limit(AT_ONCE).all(self.db.read()).await?)
    }

    async fn expire(&self, row: &upload::Model) -> Result<()> {
        let Some(_turn) = self.turns.take_if_free(&row.id) else { return Ok(()) };
        if row.state == state::DONE {
            bytes_so_far::drop_tails(&self.store, row).await?;
        } else if self.let_go(row, row.expires_ms).await? {
            bytes_so_far::drop_all(&self.store, row).await?;
        } else {
            return Ok(());
        }
        let ended = upload::ActiveModel {
            state: Set(state::EXPIRED.into()),
            idempotency_key: Set(None),
            new_run: Set(String::new()),
            metadata: Set(String::new()),
            ..Default::default()
        };
        let t = self.db.write().await?;
        upload::Entity::update_many().set(ended).filter(upload::Column::Id.eq(&row.id)).exec(&*t).await?;
        t.commit().await
    }

    /// Nobody goes on with the upload from here; false where it became a run, or somebody went on with it meanwhile.
    /// Its bytes go afterwards: until they have gone, each sweep finds it.
    pub(super) async fn let_go(&self, row: &upload::Model, expires_ms: i64) -> Result<bool> {
        let unchanged = Condition::all()
            .add(upload::Column::Id.eq(&row.id))
            .add(upload::Column::Fence.eq(row.fence))
            .add(upload::Column::State.ne(state::DONE));
        let going = upload::ActiveModel {
            state: Set(state::GOING.into()),
            expires_ms: Set(expires_ms),
            idempotency_key: Set(None),
            ..Default::default()
        };
        let t = self.db.write().await?;
        let changed = upload::Entity::update_many().set(going).filter(unchanged).exec(&*t).await?.rows_affected;
        t.commit().await?;
        Ok(changed > 0)
    }

    /// After a long time it is forgotten that an upload was there.
    async fn forget(&self) -> Result<()> {
        let before = now_ms() - to_i64(self.limits.remembered_for.as_millis() as u64);
        let old =
            Condition::all().add(upload::Column::State.eq(state::EXPIRED)).add(upload::Column::ExpiresMs.lt(before));
        if upload::Entity::find().filter(old.clone()).one(self.db.read()).await?.is_none() {
            return Ok(());
        }
        let t = self.db.write().await?;
        upload::Entity::delete_many().filter(old).exec(&*t).await?;
        t.commit().await
    }
}
