//! A run's images as they are kept: one file, or the segments of a live run, which may still grow.

use sea_orm::{ColumnTrait, EntityTrait, QueryFilter, QueryOrder, QuerySelect};

use crate::db::Db;
use crate::db::tables::{run, source_segment};
use crate::error::{Error, Result};
use crate::store::{Facts, Key};

/// A source that is one file, in `runs.source_kind`; any other word there is what its segments hold.
pub const FILE: &str = "file";

/// One segment in the store.
#[derive(Clone, Debug)]
pub struct StoredSegment {
    /// From 0.
    pub number: u32,
    /// Where it lies.
    pub key: Key,
    /// Size and hash.
    pub facts: Facts,
    /// Where it begins a new stream: when that arrived, ns since 1970.
    pub part_arrival_ns: Option<i64>,
}

/// What changes about a live run's source.
#[derive(Clone, Copy, Debug)]
pub struct SourceState {
    /// The robot may still send.
    pub open: bool,
    /// When its first frame was captured, ms since 1970.
    pub recorded_ms: i64,
}

/// The segments of a run from a number on, in order, at most `limit`.
pub async fn segments(db: &Db, run: &str, extension: &str, from: u32, limit: u64) -> Result<Vec<StoredSegment>> {
    let rows = source_segment::Entity::find()
        .filter(source_segment::Column::RunId.eq(run))
        .filter(source_segment::Column::Number.gte(i64::from(from)))
        .order_by_asc(source_segment::Column::Number)
        .limit(limit)
        .all(db.read())
        .await?;
    let stored = rows.into_iter().map(|row| {
        let number = u32::try_from(row.number)
            .map_err(|_| Error::Internal(format!("run {run} has a segment of the number {}", row.number)))?;
        Ok(StoredSegment {
            number,
            key: Key::source_segment(run, number, row.fence, extension),
            facts: Facts { bytes: row.bytes.unsigned_abs(), sha256: row.sha256 },
            part_arrival_ns: row.part_arrival_ns,
        })
    });
    stored.collect()
}

/// Whether more may come.
///
/// # Errors
/// [`Error::NotFound`] where the run was deleted.
pub async fn state(db: &Db, run: &str) -> Result<SourceState> {
    let row = run::Entity::find_by_id(run).one(db.read()).await?;
    let row = row.ok_or_else(|| Error::NotFound { what: "run", id: run.into() })?;
    Ok(SourceState { open: row.source_open != 0, recorded_ms: row.recorded_ms })
}
