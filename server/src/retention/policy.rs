//! How long runs are kept: by age, by the room they take, unless someone pinned them. What would go is told before.

use std::time::Duration;

use sea_orm::sea_query::{Expr, Func, Query};
use sea_orm::{
    ActiveValue::Set, ColumnTrait, ConnectionTrait, EntityTrait, ExprTrait, FromQueryResult, QueryFilter, QueryOrder,
    QuerySelect,
};

use crate::db::Db;
use crate::db::tables::{job, pin, product, run};
use crate::error::{Error, Result};
use crate::wire::time::{now_ms, to_text};
use crate::wire::{Doomed, JobState, RetentionPreview, RetentionRules};

/// Runs that are looked at in one query.
const AT_ONCE: u64 = 500;
/// Runs that a preview lists; its sums count all.
const LISTED: usize = 1000;
const DAY_MS: f64 = 86_400_000.0;
const GB: f64 = 1e9;

/// What is kept.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Policy {
    /// Runs that came in longer ago than this go, days.
    pub keep_days: Option<f64>,
    /// While sources and products take more than this, the oldest runs go, GB.
    pub quota_gb: Option<f64>,
}

/// A run that the policy lets go.
#[derive(Clone, Debug, PartialEq)]
pub struct Going {
    /// The run.
    pub run: String,
    /// Its asset.
    pub asset: String,
    /// When it came in, ms since 1970.
    pub created_ms: i64,
    /// What goes with it, bytes.
    pub bytes: u64,
    /// `age` or `quota`.
    pub reason: &'static str,
}

#[derive(FromQueryResult)]
struct Sum {
    name: String,
    bytes: i64,
}

impl Policy {
    /// True where nothing ever goes.
    pub fn keeps_all(&self) -> bool {
        self.keep_days.is_none() && self.quota_gb.is_none()
    }

    /// The runs that go now, the oldest first. Pinned runs stay, and those with a job that waits or runs.
    pub async fn going(&self, db: &Db) -> Result<Vec<Going>> {
        let mut going = Vec::new();
        if self.keeps_all() {
            return Ok(going);
        }
        let oldest_ms = self.keep_days.map(|days| now_ms() - (days * DAY_MS) as i64);
        let quota_bytes = self.quota_gb.map(|gb| (gb * GB) as u64);
        let mut left_bytes = stored_bytes(db).await?;
        let mut after = String::new();
        loop {
            let rows = candidates(db, &after).await?;
            let Some(last) = rows.last() else { return Ok(going) };
            after.clone_from(&last.id);
            let ids: Vec<String> = rows.iter().map(|r| r.id.clone()).collect();
            let products = product_bytes(db, &ids).await?;
            for row in rows {
                let bytes = row.source_bytes.unsigned_abs()
                    + products.iter().find(|s| s.name == row.id).map_or(0, |s| s.bytes.unsigned_abs());
                let reason = match () {
                    () if oldest_ms.is_some_and(|ms| row.created_ms < ms) => "age",
                    () if quota_bytes.is_some_and(|most| left_bytes > most) => "quota",
                    // Ids sort by time: all that follow are younger, and there is room enough.
                    () => return Ok(going),
                };
                left_bytes = left_bytes.saturating_sub(bytes);
                going.push(Going { run: row.id, asset: row.asset, created_ms: row.created_ms, bytes, reason });
            }
        }
    }

    /// What would go now, in words that people read before it goes; beside the rules that hold.
    pub async fn preview(&self, db: &Db, rules: RetentionRules) -> Result<RetentionPreview> {
        let going = self.going(db).await?;
        let of = |g: &Going| Doomed {
            run: g.run.clone(),
            asset: g.asset.clone(),
            created_at: to_text(g.created_ms),
            bytes: g.bytes,
            reason: g.reason.into(),
        };
        Ok(RetentionPreview {
            keep_days: self.keep_days,
            quota_gb: self.quota_gb,
            stored_bytes: stored_bytes(db).await?,
            runs: going.len() as u64,
            freed_bytes: going.iter().map(|g| g.bytes).sum(),
            items: going.iter().take(LISTED).map(of).collect(),
            rules,
        })
    }
}

/// Runs that may go, from an id on.
async fn candidates(db: &Db, after: &str) -> Result<Vec<run::Model>> {
    let open = [JobState::Queued, JobState::Running, JobState::Paused].map(JobState::as_str);
    let pinned = Query::select().column(pin::Column::RunId).from(pin::Entity).to_owned();
    let busy = Query::select()
        .column(job::Column::RunId)
        .from(job::Entity)
        .and_where(job::Column::State.is_in(open))
        .to_owned();
    let rows = run::Entity::find()
        .filter(run::Column::Id.gt(after))
        .filter(run::Column::Id.not_in_subquery(pinned))
        .filter(run::Column::Id.not_in_subquery(busy))
        .order_by_asc(run::Column::Id)
        .limit(AT_ONCE)
        .all(db.read())
        .await?;
    Ok(rows)
}

/// Bytes of the products of each of these runs.
async fn product_bytes(db: &Db, runs: &[String]) -> Result<Vec<Sum>> {
    let bytes = Func::sum(Expr::col((product::Entity, product::Column::Bytes)));
    let query = Query::select()
        .expr_as(Expr::col((job::Entity, job::Column::RunId)), "name")
        .expr_as(Expr::expr(bytes).cast_as("BIGINT"), "bytes")
        .from(product::Entity)
        .inner_join(
            job::Entity,
            Expr::col((product::Entity, product::Column::JobId)).equals((job::Entity, job::Column::Id)),
        )
        .and_where(Expr::col((job::Entity, job::Column::RunId)).is_in(runs.iter().map(String::as_str)))
        .group_by_col((job::Entity, job::Column::RunId))
        .to_owned();
    let rows = db.read().query_all(&query).await?;
    rows.iter().map(|row| Sum::from_query_result(row, "").map_err(Error::from)).collect()
}

/// Bytes of all sources and products.
async fn stored_bytes(db: &Db) -> Result<u64> {
    let sum = |column: Expr| Expr::expr(Func::coalesce([Func::sum(column).into(), Expr::value(0)])).cast_as("BIGINT");
    let sources: Option<i64> = run::Entity::find()
        .select_only()
        .column_as(sum(Expr::col(run::Column::SourceBytes)), "bytes")
        .into_tuple()
        .one(db.read())
        .await?;
    let products: Option<i64> = product::Entity::find()
        .select_only()
        .column_as(sum(Expr::col(product::Column::Bytes)), "bytes")
        .into_tuple()
        .one(db.read())
        .await?;
    Ok(sources.unwrap_or(0).unsigned_abs() + products.unwrap_or(0).unsigned_abs())
}

/// Pins a run, or lets it loose.
pub async fn set_pin(db: &Db, run: &str, pinned: bool) -> Result<()> {
    let t = db.write().await?;
    if run::Entity::find_by_id(run).one(&*t).await?.is_none() {
        return Err(Error::NotFound { what: "run", id: run.into() });
    }
    pin::Entity::delete_by_id(run).exec(&*t).await?;
    if pinned {
        let row = pin::ActiveModel { run_id: Set(run.into()), at_ms: Set(now_ms()) };
        pin::Entity::insert(row).exec_without_returning(&*t).await?;
    }
    t.commit().await
}

/// How often a server lets go what the policy does not keep.
pub(super) const EVERY: Duration = Duration::from_secs(600);
