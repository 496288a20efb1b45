//! Reprocessing in bulk: a filter or a list of runs becomes jobs, in steps of one small transaction each, so that
//! uploads and live jobs never wait for a batch; pause, resume and cancel go in the same steps. Any server takes the
//! next step, and one that dies leaves nothing half-done.

mod steps;

use std::collections::{BTreeMap, HashMap};

use sea_orm::{
    ActiveValue::Set, ColumnTrait, Condition, ConnectionTrait, EntityTrait, ExprTrait, Order, PaginatorTrait,
    QueryFilter, QueryOrder, QuerySelect, sea_query,
};

use crate::db::tables::{batch, batch_run, job, run};
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::error::{Error, Result};
use crate::queue::{Queue, state_of};
use crate::runs::{Created, Page, RecipeText, RigText, RunFilter, check_note};
use crate::store::sha256_of;
use crate::wire::time::{now_ms, to_text};
use crate::wire::{self, BatchState, JobState};

/// Most runs of a batch that is given as a list.
const MOST_LISTED: usize = 10_000;
/// Rows of one INSERT.
const ROWS_AT_ONCE: usize = 1000;

/// What people want of a batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// Go on.
    Run,
    /// Hold back what waits.
    Pause,
    /// Stop everything.
    Cancel,
}

impl Wanted {
    fn as_str(self) -> &'static str {
        match self {
            Wanted::Run => "run",
            Wanted::Pause => "pause",
            Wanted::Cancel => "cancel",
        }
    }

    fn parse(text: &str) -> Result<Wanted> {
        let all = [Wanted::Run, Wanted::Pause, Wanted::Cancel];
        let found = all.into_iter().find(|w| w.as_str() == text);
        found.ok_or_else(|| Error::Internal(format!("a batch wants {text:?}")))
    }
}

/// A batch to be.
#[derive(Clone, Debug)]
pub struct NewBatch {
    /// Which runs.
    pub filter: RunFilter,
    /// Only these of them.
    pub runs: Option<Vec<String>>,
    /// The rig for all; each run's own where absent.
    pub rig: Option<RigText>,
    /// The recipe for all; each run's own where absent.
    pub recipe: Option<RecipeText>,
    /// Words for people.
    pub note: String,
}

/// The batches.
#[derive(Clone)]
pub struct Batches {
    db: Db,
    queue: Queue,
}

impl Batches {
    /// On the records, for a queue.
    pub fn new(db: Db, queue: Queue) -> Batches {
        Batches { db, queue }
    }

    /// How many runs a batch would take.
    pub async fn count(&self, new: &NewBatch) -> Result<u64> {
        let mut found = run::Entity::find().filter(new.filter.condition()?);
        if let Some(listed) = &new.runs {
            self.check_listed(listed).await?;
            found = found.filter(run::Column::Id.is_in(listed));
        }
        Ok(found.count(self.db.read()).await?)
    }

    async fn check_listed(&self, listed: &[String]) -> Result<()> {
        if listed.is_empty() || listed.len() > MOST_LISTED {
            let found = format!("the list has {} runs", listed.len());
            return Err(Error::field("runs", found, format!("1 to {MOST_LISTED}; a filter takes any number")));
        }
        let known: std::collections::HashSet<String> = run::Entity::find()
            .select_only()
            .column(run::Column::Id)
            .filter(run::Column::Id.is_in(listed))
            .into_tuple()
            .all(self.db.read())
            .await?
            .into_iter()
            .collect();
        match listed.iter().find(|id| !known.contains(*id)) {
            Some(id) => Err(Error::field("runs", format!("there is no run '{id}'"), "runs that are there")),
            None => Ok(()),
        }
    }

    /// Begins a batch; its jobs follow in steps.
    pub async fn create(&self, new: NewBatch, key: Option<&str>) -> Result<Created<wire::Batch>> {
        check_note(&new.note)?;
        let filter = serde_json::to_string(&new.filter).map_err(|e| Error::Internal(format!("a filter: {e}")))?;
        let (rig, recipe) = (new.rig.as_ref().map(|r| &r.toml), new.recipe.as_ref().map(|r| &r.toml));
        let fingerprint = sha256_of(&format!("batch {filter} {:?} {rig:?} {recipe:?} {}", new.runs, new.note));
        if let Some(before) = self.made_before(self.db.read(), key, &fingerprint).await? {
            return Ok(Created { made: self.get(&before).await?, repeated: true });
        }
        let runs = self.count(&new).await?;
        let row = batch::Model {
            id: Queue::new_id(),
            created_ms: now_ms(),
            note: new.note.clone(),
            filter,
            rig_name: new.rig.as_ref().map(|r| r.name.clone()),
            rig_toml: new.rig.as_ref().map(|r| r.toml.clone()),
            recipe_name: new.recipe.as_ref().map(|r| r.name.clone()),
            recipe_toml: new.recipe.as_ref().map(|r| r.toml.clone()),
            runs: i64::try_from(runs).unwrap_or(i64::MAX),
            queued_to: String::new(),
            wanted: Wanted::Run.as_str().into(),
            settled: 0,
            idempotency_key: key.map(Into::into),
            fingerprint,
        };
        let made = retried(ANSWER_PATIENCE, || self.insert(&row, new.runs.as_deref())).await?;
        self.queue.bell().ring();
        Ok(Created { repeated: made != row.id, made: self.get(&made).await? })
    }

    /// The batch's id, or that of the one which the same request made at the same time.
    async fn insert(&self, row: &batch::Model, listed: Option<&[String]>) -> Result<String> {
        let t = self.db.write().await?;
        if let Some(id) = self.made_before(&*t, row.idempotency_key.as_deref(), &row.fingerprint).await? {
            return Ok(id);
        }
        batch::Entity::insert(batch::ActiveModel::from(row.clone())).exec_without_returning(&*t).await?;
        let mut listed = listed.unwrap_or_default().to_vec();
        listed.sort();
        listed.dedup();
        let row_of = |id: &String| batch_run::ActiveModel { batch_id: Set(row.id.clone()), run_id: Set(id.clone()) };
        for part in listed.chunks(ROWS_AT_ONCE) {
            batch_run::Entity::insert_many(part.iter().map(row_of)).exec_without_returning(&*t).await?;
        }
        t.commit().await?;
        Ok(row.id.clone())
    }

    async fn made_before(
        &self,
        records: &impl ConnectionTrait,
        key: Option<&str>,
        fingerprint: &str,
    ) -> Result<Option<String>> {
        let Some(key) = key else { return Ok(None) };
        let found = batch::Entity::find().filter(batch::Column::IdempotencyKey.eq(key)).one(records).await?;
        match found {
            Some(row) if row.fingerprint != fingerprint => Err(Error::KeyReused(key.into())),
            found => Ok(found.map(|row| row.id)),
        }
    }

    /// A batch.
    pub async fn get(&self, id: &str) -> Result<wire::Batch> {
        let row = batch::Entity::find_by_id(id).one(self.db.read()).await?;
        self.batch_of(row.ok_or_else(|| Error::NotFound { what: "batch", id: id.into() })?).await
    }

    /// Batches, the newest first.
    pub async fn list(&self, page: &Page) -> Result<wire::BatchPage> {
        let mut query = batch::Entity::find().order_by(batch::Column::Id, Order::Desc).limit(page.limit + 1);
        if let Some(cursor) = &page.cursor {
            query = query.filter(batch::Column::Id.lt(cursor.as_str()));
        }
        let mut rows = query.all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| r.id.clone());
        let mut items = Vec::with_capacity(rows.len());
        for row in rows {
            items.push(self.batch_of(row).await?);
        }
        Ok(wire::BatchPage { items, next_cursor })
    }

    async fn batch_of(&self, row: batch::Model) -> Result<wire::Batch> {
        let counted: Vec<(String, i64)> = job::Entity::find()
            .select_only()
            .column(job::Column::State)
            .column_as(job::Column::Id.count(), "jobs")
            .filter(job::Column::BatchId.eq(&row.id))
            .group_by(job::Column::State)
            .into_tuple()
            .all(self.db.read())
            .await?;
        let mut jobs: BTreeMap<String, u64> = JobState::ALL.map(|s| (s.as_str().to_string(), 0)).into();
        jobs.extend(counted.into_iter().map(|(state, n)| (state, n.unsigned_abs())));
        let open = |state: JobState| jobs.get(state.as_str()).copied().unwrap_or(0) > 0;
        let works = open(JobState::Queued) || open(JobState::Running);
        let state = match (Wanted::parse(&row.wanted)?, row.settled != 0) {
            (Wanted::Run, false) => BatchState::Queueing,
            (Wanted::Run, true) if works => BatchState::Running,
            (Wanted::Run, true) => BatchState::Done,
            (Wanted::Pause, false) => BatchState::Pausing,
            (Wanted::Pause, true) => BatchState::Paused,
            (Wanted::Cancel, true) if !works => BatchState::Cancelled,
            (Wanted::Cancel, _) => BatchState::Cancelling,
        };
        Ok(wire::Batch {
            id: row.id,
            created_at: to_text(row.created_ms),
            note: row.note,
            state,
            runs: row.runs.unsigned_abs(),
            jobs,
            rig: row.rig_name,
            recipe: row.recipe_name,
        })
    }

    /// Asks a batch to go on, to pause or to stop; a stopped one stays so.
    pub async fn want(&self, id: &str, wanted: Wanted) -> Result<wire::Batch> {
        retried(ANSWER_PATIENCE, || self.try_want(id, wanted)).await?;
        self.queue.bell().ring();
        self.get(id).await
    }

    async fn try_want(&self, id: &str, wanted: Wanted) -> Result<()> {
        let t = self.db.write().await?;
        let found = batch::Entity::find_by_id(id).lock_exclusive().one(&*t).await?;
        let row = found.ok_or_else(|| Error::NotFound { what: "batch", id: id.into() })?;
        let before = Wanted::parse(&row.wanted)?;
        if before == Wanted::Cancel && wanted != Wanted::Cancel {
            return Err(Error::Conflict("the batch was cancelled; begin a new one".into()));
        }
        if before != wanted {
            let change =
                batch::ActiveModel { wanted: Set(wanted.as_str().into()), settled: Set(0), ..Default::default() };
            batch::Entity::update_many().set(change).filter(batch::Column::Id.eq(id)).exec(&*t).await?;
        }
        t.commit().await
    }

    /// What a batch made, beside what was there.
    pub async fn results(&self, id: &str, page: &Page) -> Result<wire::BatchResultPage> {
        self.get(id).await?;
        let mut query =
            job::Entity::find().filter(job::Column::BatchId.eq(id)).order_by_asc(job::Column::Id).limit(page.limit + 1);
        if let Some(cursor) = &page.cursor {
            query = query.filter(job::Column::Id.gt(cursor.as_str()));
        }
        let mut rows = query.all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| r.id.clone());
        let bases: Vec<_> = rows.iter().filter_map(|r| r.base_job.clone()).collect();
        let bases: HashMap<String, Option<String>> = job::Entity::find()
            .select_only()
            .columns([job::Column::Id, job::Column::Quality])
            .filter(job::Column::Id.is_in(bases))
            .into_tuple::<(String, Option<String>)>()
            .all(self.db.read())
            .await?
            .into_iter()
            .collect();
        let items = rows.into_iter().map(|row| {
            let base = row.base_job.as_ref().and_then(|id| bases.get(id)).cloned().flatten();
            let (before, after) = (figures(base.as_deref())?, figures(row.quality.as_deref())?);
            Ok(wire::BatchResult {
                state: state_of(&row)?,
                difference: difference(before.as_ref(), after.as_ref()),
                run: row.run_id,
                job: row.id,
                base_job: row.base_job,
                before,
                after,
            })
        });
        Ok(wire::BatchResultPage { items: items.collect::<Result<_>>()?, next_cursor })
    }
}

/// The runs of a batch: those that its filter finds now, and that were there when it was made.
fn runs_of(row: &batch::Model) -> Result<Condition> {
    let filter: RunFilter =
        serde_json::from_str(&row.filter).map_err(|e| Error::Internal(format!("batch {}: {e}", row.id)))?;
    let listed = sea_query::Query::select()
        .column(batch_run::Column::RunId)
        .from(batch_run::Entity)
        .and_where(batch_run::Column::BatchId.eq(&row.id))
        .to_owned();
    let any = sea_query::Query::select()
        .expr(sea_query::Expr::value(1))
        .from(batch_run::Entity)
        .and_where(batch_run::Column::BatchId.eq(&row.id))
        .to_owned();
    let in_list = Condition::any().add(run::Column::Id.in_subquery(listed)).add(sea_query::Expr::exists(any).not());
    Ok(filter.condition()?.add(run::Column::Id.lt(row.id.as_str())).add(in_list))
}

fn figures(text: Option<&str>) -> Result<Option<serde_json::Value>> {
    text.map(serde_json::from_str).transpose().map_err(|e| Error::Internal(format!("quality figures: {e}")))
}

/// After minus before, for each number that both have.
fn difference(before: Option<&serde_json::Value>, after: Option<&serde_json::Value>) -> BTreeMap<String, f64> {
    let (Some(before), Some(after)) = (before.and_then(|b| b.as_object()), after.and_then(|a| a.as_object())) else {
        return BTreeMap::new();
    };
    let of = |(name, value): (&String, &serde_json::Value)| {
        Some((name.clone(), value.as_f64()? - before.get(name)?.as_f64()?))
    };
    after.iter().filter_map(of).collect()
}

#[cfg(test)]
mod tests;
