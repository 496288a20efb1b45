//! Pages and filters: every list goes by a cursor and a bounded limit, on an index.

use sea_orm::sea_query::{Expr, Func};
use sea_orm::{
    ColumnTrait, Condition, EntityTrait, ExprTrait, Order, PaginatorTrait, QueryFilter, QueryOrder, QuerySelect,
    sea_query,
};

use super::{Runs, read_time, to_u64};
use crate::db::tables::{asset, job, run, worker};
use crate::error::{Error, Result};
use crate::queue::state_of;
use crate::store::sha256_of;
use crate::wire::time::to_text;
use crate::wire::{self, Direction, JobState, Priority};

/// Digits of a run's version: more than enough to tell two of its states apart.
const VERSION_CHARS: usize = 32;

/// Which part of a list.
#[derive(Clone, Debug)]
pub struct Page {
    /// Where the page before ended.
    pub cursor: Option<String>,
    /// Most items.
    pub limit: u64,
}

impl Page {
    /// Items of a page when nothing is said.
    pub const DEFAULT: u64 = 50;
    /// Most items of a page.
    pub const MAX: u64 = 1000;

    /// From a request.
    pub fn new(cursor: Option<String>, limit: Option<u64>) -> Result<Page> {
        let limit = limit.unwrap_or(Page::DEFAULT);
        if limit == 0 || limit > Page::MAX {
            return Err(Error::field("limit", format!("limit is {limit}"), format!("1 to {}", Page::MAX)));
        }
        Ok(Page { cursor: cursor.filter(|c| !c.is_empty()), limit })
    }

    /// Queries ask for one row more than the page holds: it tells whether there is a next page.
    pub(crate) fn next<T>(&self, rows: &mut Vec<T>, name: impl Fn(&T) -> String) -> Option<String> {
        if rows.len() as u64 <= self.limit {
            return None;
        }
        rows.truncate(self.limit as usize);
        rows.last().map(name)
    }
}

/// Which runs to list.
#[derive(Clone, Debug, Default, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunFilter {
    /// Of this asset.
    pub asset: Option<String>,
    /// Whose latest job has this state.
    pub state: Option<String>,
    /// With this text in the asset's name, the file's name or the note.
    pub q: Option<String>,
    /// Recorded at this time or later.
    pub from: Option<String>,
    /// Recorded before this time.
    pub to: Option<String>,
    /// Recorded with the rig of this name.
    pub rig: Option<String>,
    /// Whose latest job has the recipe of this name.
    pub recipe: Option<String>,
    /// In which order.
    #[serde(skip)]
    pub sort: RunSort,
}

/// The order of a list of runs. Each has an index, so that a page costs the same wherever it begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RunSort {
    by: RunKey,
    falling: bool,
}

impl Default for RunSort {
    fn default() -> RunSort {
        RunSort { by: RunKey::Created, falling: true }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RunKey {
    Created,
    Recorded,
    Asset,
}

impl RunSort {
    /// Reads a request's word: `created`, `recorded` or `asset`, with a minus for the other way round.
    pub fn parse(text: Option<&str>) -> Result<RunSort> {
        let Some(text) = text else { return Ok(RunSort::default()) };
        let (falling, name) = text.strip_prefix('-').map_or((false, text), |name| (true, name));
        let by = match name {
            "created" => RunKey::Created,
            "recorded" => RunKey::Recorded,
            "asset" => RunKey::Asset,
            _ => {
                let expected = "created, -created, recorded, -recorded, asset or -asset";
                return Err(Error::field("sort", format!("sort is {text:?}"), expected));
            }
        };
        Ok(RunSort { by, falling })
    }

    fn column(self) -> Option<run::Column> {
        match self.by {
            RunKey::Created => None, // a run's name is ordered by its creation
            RunKey::Recorded => Some(run::Column::RecordedMs),
            RunKey::Asset => Some(run::Column::Asset),
        }
    }

    /// What a cursor names: the run, behind the value that sorts it.
    fn cursor(self, row: &run::Model) -> String {
        match self.by {
            RunKey::Created => row.id.clone(),
            RunKey::Recorded => format!("{}|{}", row.recorded_ms, row.id),
            RunKey::Asset => format!("{}|{}", row.asset, row.id),
        }
    }

    /// The runs behind a cursor.
    fn after(self, cursor: &str) -> Result<Condition> {
        let beyond = |column: run::Column, value: sea_orm::Value| match self.falling {
            true => column.lt(value),
            false => column.gt(value),
        };
        let bad = || Error::field("cursor", format!("cursor is {cursor:?}"), "the `next_cursor` of the page before");
        let Some(column) = self.column() else {
            return Ok(Condition::all().add(beyond(run::Column::Id, cursor.into())));
        };
        let (value, id) = cursor.rsplit_once('|').ok_or_else(bad)?;
        let value: sea_orm::Value = match self.by {
            RunKey::Recorded => value.parse::<i64>().map_err(|_| bad())?.into(),
            _ => value.into(),
        };
        let same = Condition::all().add(column.eq(value.clone())).add(beyond(run::Column::Id, id.into()));
        Ok(Condition::any().add(beyond(column, value)).add(same))
    }
}

impl RunFilter {
    pub(crate) fn condition(&self) -> Result<Condition> {
        let mut all = Condition::all();
        if let Some(asset) = &self.asset {
            all = all.add(run::Column::Asset.eq(asset.as_str()));
        }
        if let Some(state) = &self.state {
            all = all.add(run::Column::State.eq(read_state(state)?.as_str()));
        }
        if let Some(rig) = &self.rig {
            all = all.add(run::Column::RigName.eq(rig));
        }
        if let Some(recipe) = &self.recipe {
            let with_it = sea_query::Query::select()
                .column(job::Column::Id)
                .from(job::Entity)
                .and_where(job::Column::RecipeName.eq(recipe))
                .to_owned();
            all = all.add(run::Column::LatestJob.in_subquery(with_it));
        }
        if let Some(q) = self.q.as_ref().filter(|q| !q.is_empty()) {
            let columns = [run::Column::Asset, run::Column::Filename, run::Column::Note, run::Column::RigName];
            all = all.add(with_words(q, &columns));
        }
        if let Some(from) = &self.from {
            all = all.add(run::Column::RecordedMs.gte(read_time("from", from)?));
        }
        if let Some(to) = &self.to {
            all = all.add(run::Column::RecordedMs.lt(read_time("to", to)?));
        }
        Ok(all)
    }
}

/// Rows with a text in one of these columns, in capitals or small letters.
pub fn with_words<C: ColumnTrait>(q: &str, columns: &[C]) -> Condition {
    // PostgreSQL's LIKE tells capitals from small letters, SQLite's only outside ASCII, as does its `lower`.
    let mut any = Condition::any();
    for text in [q.to_lowercase(), q.to_ascii_lowercase()] {
        let like = sea_query::LikeExpr::new(format!("%{}%", escaped(&text))).escape('\\');
        for column in columns {
            any = any.add(Expr::expr(Func::lower(Expr::col(*column))).like(like.clone()));
        }
    }
    any
}

/// LIKE's wildcards mean themselves.
fn escaped(text: &str) -> String {
    text.chars().flat_map(|c| matches!(c, '%' | '_' | '\\').then_some('\\').into_iter().chain([c])).collect()
}

fn read_state(text: &str) -> Result<JobState> {
    JobState::parse(text).ok_or_else(|| {
        Error::field("state", format!("state is {text:?}"), "queued, running, done, failed, cancelled or paused")
    })
}

impl Runs {
    /// Runs in the filter's order.
    pub async fn list(&self, filter: &RunFilter, page: &Page) -> Result<wire::RunPage> {
        let (sort, mut query) = (filter.sort, run::Entity::find().filter(filter.condition()?));
        let order = if sort.falling { Order::Desc } else { Order::Asc };
        if let Some(column) = sort.column() {
            query = query.order_by(column, order.clone());
        }
        query = query.order_by(run::Column::Id, order);
        if let Some(cursor) = &page.cursor {
            query = query.filter(sort.after(cursor)?);
        }
        let mut rows = query.limit(page.limit + 1).all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| sort.cursor(r));
        let ids: Vec<_> = rows.iter().map(|r| r.latest_job.clone()).collect();
        let mut jobs: std::collections::HashMap<_, _> = job::Entity::find()
            .filter(job::Column::Id.is_in(ids))
            .all(self.db.read())
            .await?
            .into_iter()
            .map(|j| (j.id.clone(), j))
            .collect();
        let mut items = Vec::with_capacity(rows.len());
        for row in rows {
            // A run that was deleted between the two queries has no job any more.
            if let Some(latest) = jobs.remove(&row.latest_job) {
                items.push(run_of(row, Some(latest))?);
            }
        }
        Ok(wire::RunPage { items, next_cursor })
    }

    /// Jobs, the newest first.
    pub async fn jobs(&self, run: Option<&str>, state: Option<&str>, page: &Page) -> Result<wire::JobPage> {
        let mut query = job::Entity::find().order_by(job::Column::Id, Order::Desc);
        if let Some(run) = run {
            query = query.filter(job::Column::RunId.eq(run));
        }
        if let Some(state) = state {
            query = query.filter(job::Column::State.eq(read_state(state)?.as_str()));
        }
        if let Some(cursor) = &page.cursor {
            query = query.filter(job::Column::Id.lt(cursor.as_str()));
        }
        let mut rows = query.limit(page.limit + 1).all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| r.id.clone());
        Ok(wire::JobPage { items: rows.into_iter().map(job_of).collect::<Result<_>>()?, next_cursor })
    }

    /// Assets by name.
    pub async fn assets(&self, page: &Page) -> Result<wire::AssetPage> {
        let mut query = asset::Entity::find().order_by_asc(asset::Column::Name).limit(page.limit + 1);
        if let Some(cursor) = &page.cursor {
            query = query.filter(asset::Column::Name.gt(cursor.as_str()));
        }
        let mut rows = query.all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| r.name.clone());
        let mut items = Vec::with_capacity(rows.len());
        for row in rows {
            let of_it = run::Entity::find().filter(run::Column::Asset.eq(&row.name));
            let latest = of_it.clone().order_by(run::Column::Id, Order::Desc).one(self.db.read()).await?;
            let runs = of_it.count(self.db.read()).await?;
            items.push(wire::Asset { name: row.name, runs, latest_at: latest.map(|r| to_text(r.created_ms)) });
        }
        Ok(wire::AssetPage { items, next_cursor })
    }

    /// Worker processes and what they are at.
    pub async fn workers(&self) -> Result<Vec<wire::Worker>> {
        let rows = worker::Entity::find().order_by_asc(worker::Column::Name).all(self.db.read()).await?;
        let running =
            job::Entity::find().filter(job::Column::State.eq(JobState::Running.as_str())).all(self.db.read()).await?;
        let of = |w: worker::Model| wire::Worker {
            jobs: running.iter().filter(|j| j.worker == w.name).map(|j| j.id.clone()).collect(),
            name: w.name,
            started_at: to_text(w.started_ms),
            seen_at: to_text(w.seen_ms),
            slots: u32::try_from(w.slots).unwrap_or(0),
        };
        Ok(rows.into_iter().map(of).collect())
    }
}

/// The version of what can be changed about a run.
pub(super) fn version_of(row: &run::Model) -> String {
    let said = (&row.asset, row.chainage_mm, &row.direction, row.recorded_ms, &row.note);
    let mut version = sha256_of(&format!("{said:?}"));
    version.truncate(VERSION_CHARS);
    version
}

/// A run as the wire shows it.
pub(super) fn run_of(row: run::Model, latest: Option<job::Model>) -> Result<wire::Run> {
    let latest = latest.ok_or_else(|| Error::NotFound { what: "run", id: row.id.clone() })?;
    let job = job_of(latest)?;
    let open = row.source_open != 0;
    Ok(wire::Run {
        version: version_of(&row),
        source: wire::RunSource {
            filename: row.filename,
            open,
            bytes: to_u64(row.source_bytes),
            sha256: (!open).then_some(row.source_sha256),
            fps: row.fps,
            url: format!("/api/runs/{}/source", row.id),
        },
        id: row.id,
        asset: row.asset,
        chainage_mm: row.chainage_mm,
        direction: Direction::parse(&row.direction).unwrap_or_default(),
        recorded_at: to_text(row.recorded_ms),
        created_at: to_text(row.created_ms),
        note: row.note,
        rig: row.rig_name,
        state: job.state,
        job,
    })
}

/// A job as the wire shows it.
pub(super) fn job_of(row: job::Model) -> Result<wire::Job> {
    let state = state_of(&row)?;
    let broken = |e: serde_json::Error| Error::Internal(format!("job {} holds broken JSON: {e}", row.id));
    let waits = state == JobState::Queued && row.not_before_ms > 0;
    Ok(wire::Job {
        state,
        cancelling: row.cancel_requested != 0,
        progress: row.fraction,
        frames: to_u64(row.frames),
        frames_total: row.frames_total.map(to_u64),
        frames_per_s: row.frames_per_s,
        time_left_s: row.time_left_s,
        attempt: u32::try_from(row.attempt).unwrap_or(0),
        priority: Priority::parse(&row.priority).unwrap_or_default(),
        warnings: serde_json::from_str(&row.warnings).map_err(broken)?,
        error: row.error.as_deref().map(serde_json::from_str).transpose().map_err(broken)?,
        quality: row.quality.as_deref().map(serde_json::from_str).transpose().map_err(broken)?,
        created_at: to_text(row.created_ms),
        started_at: row.started_ms.map(to_text),
        finished_at: row.finished_ms.map(to_text),
        next_attempt_at: waits.then(|| to_text(row.not_before_ms)),
        batch: row.batch_id,
        id: row.id,
        run: row.run_id,
        stage: row.stage,
        rig: row.rig_name,
        recipe: row.recipe_name,
    })
}
