//! The records of runs: come in, be listed, changed, processed again, deleted. `runs/rigs.rs` keeps rigs and recipes,
//! `runs/jobs.rs` reads jobs and what belongs to them, `runs/listing.rs` pages and filters.

mod jobs;
mod listing;
mod rigs;

use sea_orm::sea_query::OnConflict;
use sea_orm::{ActiveValue::Set, ColumnTrait, ConnectionTrait, EntityTrait, QueryFilter, QuerySelect};

use serde::{Deserialize, Serialize};

pub use jobs::{CONTENT_TYPES, StoredFile, content_type};
pub use listing::{Page, RunFilter, RunSort, with_words};
pub use rigs::{RecipeText, RigText, built_in_recipes, options};

use crate::db::tables::{asset, idempotency_key, job, log_line, pin, product, run, segment, unpublished};
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::defects;
use crate::error::{Error, Result};
use crate::incoming::Incoming;
use crate::queue::{self, NewJob, Queue};
use crate::retention::{self, Holding, Policy};
use crate::source;
use crate::store::{self, Facts, Key, Store};
use crate::wire::time::{from_text, now_ms, to_text};
use crate::wire::{self, Direction, JobState, Priority, RunChange};

/// Longest name of an asset, a rig or a file, and longest note, characters.
pub const MAX_NAME_CHARS: usize = 200;
/// Longest note, characters.
pub const MAX_NOTE_CHARS: usize = 4000;
/// Chainage is given within ± this, mm: 100,000 km.
const MAX_CHAINAGE_MM: f64 = 1e11;

/// How long an upload may lie in the store before its record is written.
const UNRECORDED_MS: i64 = 3_600_000;
/// How long the files of a deleted run that is being processed are left to its worker.
const STOPPING_MS: i64 = 30_000;

/// What is known about a run when it comes in.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct NewRun {
    /// The pipe or wall.
    pub asset: String,
    /// Chainage of the first frame, mm.
    pub chainage_mm: f64,
    /// Which way the robot went.
    pub direction: Direction,
    /// When it was recorded, ms since 1970; `None`: now.
    pub recorded_ms: Option<i64>,
    /// Words for people.
    pub note: String,
    /// The file's own name.
    pub filename: String,
    /// Frames a second of the source, where it does not say so itself.
    pub fps: Option<f64>,
    /// The rig.
    pub rig: RigText,
    /// The recipe.
    pub recipe: RecipeText,
}

impl NewRun {
    /// Every value within its limits, or the first that is not.
    pub fn check(&self) -> Result<()> {
        check_name("asset", &self.asset)?;
        check_chainage(self.chainage_mm)?;
        check_note(&self.note)?;
        if let Some(fps) = self.fps
            && !(fps > 0.0 && fps <= 10_000.0)
        {
            return Err(Error::field("fps", format!("fps is {fps}"), "more than 0, at most 10,000 frames a second"));
        }
        Ok(())
    }

    /// The same content gives the same text; times of arrival do not count.
    fn fingerprint(&self, source: &Facts) -> String {
        let parts = (&self.asset, self.chainage_mm.to_bits(), self.direction.as_str(), self.recorded_ms, &self.note);
        let more = (&self.filename, self.fps.map(f64::to_bits), &self.rig.toml, &self.recipe.toml, &source.sha256);
        store::sha256_of(&format!("run {parts:?} {more:?}"))
    }
}

/// An upload that lies in the store and is not recorded yet.
#[derive(Clone, Copy)]
struct Arrived<'a> {
    run: &'a str,
    extension: &'a str,
    facts: &'a Facts,
    key: Option<&'a str>,
    fingerprint: &'a str,
}

/// A run that a request made, or had made before.
pub struct Created<T> {
    /// What was made.
    pub made: T,
    /// True where the same request had made it before.
    pub repeated: bool,
}

/// Most segments of a run: weeks of a live stream.
const MAX_SEGMENTS: u64 = 10_000_000;

/// How a run's images are kept.
pub struct SourceRecord<'a> {
    /// [`source::FILE`], or what its segments hold.
    pub kind: &'a str,
    /// The extension of its files.
    pub extension: &'a str,
    /// Size so far, bytes.
    pub bytes: u64,
    /// SHA-256 of all of it in lower-case hex; empty while it is open.
    pub sha256: &'a str,
    /// The robot may still send.
    pub open: bool,
}

/// A run's images, to be sent back.
pub struct SourceFile {
    /// Where they lie, in order, each with its size in bytes.
    pub parts: Vec<(Key, u64)>,
    /// Size and hash of the whole.
    pub facts: Facts,
    /// The file's own name.
    pub filename: String,
}

/// The records.
#[derive(Clone)]
pub struct Runs {
    db: Db,
    queue: Queue,
    store: Store,
}

impl Runs {
    /// On a database, with the queue and the store that belong to it.
    pub fn new(db: Db, queue: Queue, store: Store) -> Runs {
        Runs { db, queue, store }
    }

    /// The records answer.
    pub async fn ping(&self) -> Result<()> {
        self.db.ping().await
    }

    /// A whole upload becomes a run with one job. The file goes into the store first, under a key that is marked for
    /// deletion; the transaction that writes the records takes the mark away.
    pub async fn create(&self, new: NewRun, incoming: Incoming, key: Option<&str>) -> Result<Created<wire::Run>> {
        let Incoming { file, facts } = &incoming;
        let place = |source| async move {
            self.store.take_known_file(file, &source, facts).await?;
            self.store.sync().await
        };
        self.place_and_record(&Queue::new_id(), new, facts, key, place).await
    }

    /// As [`Runs::create`], for a file that `place` brings to its key, durably. The key makes it safe to repeat.
    pub async fn publish<F>(
        &self,
        run: &str,
        new: NewRun,
        facts: &Facts,
        key: &str,
        place: impl FnOnce(Key) -> F,
    ) -> Result<wire::Run>
    where
        F: Future<Output = Result<()>>,
    {
        Ok(self.place_and_record(run, new, facts, Some(key), place).await?.made)
    }

    async fn place_and_record<F>(
        &self,
        run: &str,
        new: NewRun,
        facts: &Facts,
        key: Option<&str>,
        place: impl FnOnce(Key) -> F,
    ) -> Result<Created<wire::Run>>
    where
        F: Future<Output = Result<()>>,
    {
        new.check()?;
        let fingerprint = new.fingerprint(facts);
        if let Some(job) = self.made_before(self.db.read(), key, &fingerprint).await? {
            return Ok(Created { made: self.get(&job.run_id).await?, repeated: true });
        }
        let extension = store::plain_extension(&new.filename);
        let prefix = store::run_prefix(run);
        retried(ANSWER_PATIENCE, || self.mark_unrecorded(&prefix)).await?;
        place(Key::source(run, &extension)).await?;

        let arrived = Arrived { run, extension: &extension, facts, key, fingerprint: &fingerprint };
        let repeats = retried(ANSWER_PATIENCE, || self.record(new.clone(), &arrived)).await?;
        self.queue.bell().ring();
        let repeated = repeats.is_some();
        Ok(Created { made: self.get(repeats.as_deref().unwrap_or(run)).await?, repeated })
    }

    async fn mark_unrecorded(&self, prefix: &str) -> Result<()> {
        let t = self.db.write().await?;
        queue::mark_unpublished(&*t, prefix.into(), now_ms() + UNRECORDED_MS).await?;
        t.commit().await
    }

    /// Run and job, in one transaction; or the run that the same request has made before.
    async fn record(&self, new: NewRun, arrived: &Arrived<'_>) -> Result<Option<String>> {
        let Arrived { run, extension, facts, key, fingerprint } = *arrived;
        let prefix = store::run_prefix(run);
        let t = self.db.write().await?;
        if let Some(job) = self.made_before(&*t, key, fingerprint).await? {
            // The same request came twice at the same time, and the other one was first; or this is the second try
            // of a commit that was made.
            if job.run_id != run {
                queue::mark_unpublished(&*t, prefix, now_ms()).await?;
                t.commit().await?;
            }
            return Ok(Some(job.run_id));
        }
        let source =
            SourceRecord { kind: source::FILE, extension, bytes: facts.bytes, sha256: &facts.sha256, open: false };
        let job = self.insert(&*t, run, new, &source, Priority::Upload).await?;
        remember(&*t, key, fingerprint, &job).await?;
        unpublished::Entity::delete_by_id(prefix).exec(&*t).await?;
        t.commit().await?;
        Ok(None)
    }

    /// Writes a run and its first job inside the caller's transaction; the caller rings the bell after its commit.
    pub async fn insert(
        &self,
        records: &impl ConnectionTrait,
        id: &str,
        new: NewRun,
        source: &SourceRecord<'_>,
        priority: Priority,
    ) -> Result<String> {
        insert_asset(records, &new.asset).await?;
        rigs::keep_if_new(records, &new.rig).await?;
        let now = now_ms();
        let row = run::ActiveModel {
            id: Set(id.into()),
            created_ms: Set(now),
            asset: Set(new.asset),
            chainage_mm: Set(new.chainage_mm),
            direction: Set(new.direction.as_str().into()),
            recorded_ms: Set(new.recorded_ms.unwrap_or(now)),
            note: Set(new.note),
            filename: Set(new.filename),
            source_extension: Set(source.extension.into()),
            source_bytes: Set(to_i64(source.bytes)),
            source_sha256: Set(source.sha256.into()),
            fps: Set(new.fps),
            rig_name: Set(new.rig.name.clone()),
            state: Set(JobState::Queued.as_str().into()),
            latest_job: Set(String::new()),
            source_kind: Set(source.kind.into()),
            source_open: Set(i32::from(source.open)),
        };
        run::Entity::insert(row).exec_without_returning(records).await?;
        let job = NewJob {
            run: id.into(),
            priority,
            rig_name: new.rig.name,
            rig_toml: new.rig.toml,
            recipe_name: new.recipe.name,
            recipe_toml: new.recipe.toml,
        };
        self.queue.enqueue(records, job).await
    }

    /// Processes a run again: what is not said stays as in its latest job.
    pub async fn reprocess(
        &self,
        run_id: &str,
        rig: Option<RigText>,
        recipe: Option<RecipeText>,
        priority: Priority,
        key: Option<&str>,
    ) -> Result<Created<wire::Job>> {
        let again = || self.try_reprocess(run_id, rig.clone(), recipe.clone(), priority, key);
        retried(ANSWER_PATIENCE, again).await
    }

    async fn try_reprocess(
        &self,
        run_id: &str,
        rig: Option<RigText>,
        recipe: Option<RecipeText>,
        priority: Priority,
        key: Option<&str>,
    ) -> Result<Created<wire::Job>> {
        let t = self.db.write().await?;
        let row = self.row_to_change(&*t, run_id).await?;
        let Some(latest) = job::Entity::find_by_id(&row.latest_job).one(&*t).await? else {
            return Err(Error::Internal(format!("run {run_id} has no job")));
        };
        let rig = rig.unwrap_or(RigText { name: latest.rig_name, toml: latest.rig_toml });
        let recipe = recipe.unwrap_or(RecipeText { name: latest.recipe_name, toml: latest.recipe_toml });
        let what = format!("job {run_id} {:?} {:?} {}", rig.toml, recipe.toml, priority.as_str());
        let fingerprint = store::sha256_of(&what);
        if let Some(job) = self.made_before(&*t, key, &fingerprint).await? {
            return Ok(Created { made: self.job(&job.id).await?, repeated: true });
        }
        rigs::keep_if_new(&*t, &rig).await?;
        let new = NewJob {
            run: run_id.into(),
            priority,
            rig_name: rig.name,
            rig_toml: rig.toml,
            recipe_name: recipe.name,
            recipe_toml: recipe.toml,
        };
        let job = self.queue.enqueue(&*t, new).await?;
        remember(&*t, key, &fingerprint, &job).await?;
        t.commit().await?;
        self.queue.bell().ring();
        Ok(Created { made: self.job(&job).await?, repeated: false })
    }

    /// A run with its latest job.
    pub async fn get(&self, id: &str) -> Result<wire::Run> {
        let row = self.row(self.db.read(), id).await?;
        let latest = job::Entity::find_by_id(&row.latest_job).one(self.db.read()).await?;
        listing::run_of(row, latest)
    }

    /// A run's images.
    pub async fn source(&self, id: &str) -> Result<SourceFile> {
        let row = self.row(self.db.read(), id).await?;
        if row.source_open != 0 {
            return Err(Error::Conflict("the robot still sends; ask again when the run has ended".into()));
        }
        let facts = Facts { bytes: to_u64(row.source_bytes), sha256: row.source_sha256 };
        if row.source_kind == source::FILE {
            let parts = vec![(Key::source(&row.id, &row.source_extension), facts.bytes)];
            return Ok(SourceFile { parts, facts, filename: row.filename });
        }
        let segments = source::segments(&self.db, id, &row.source_extension, 0, MAX_SEGMENTS).await?;
        let parts = segments.into_iter().map(|segment| (segment.key, segment.facts.bytes)).collect();
        Ok(SourceFile { parts, facts, filename: row.filename })
    }

    /// Changes what is said about a run.
    /// `versions`: only where what is said has one of these versions; any where nothing is said.
    pub async fn change(&self, id: &str, change: RunChange, versions: Option<&[String]>) -> Result<wire::Run> {
        retried(ANSWER_PATIENCE, || self.try_change(id, change.clone(), versions)).await
    }

    async fn try_change(&self, id: &str, change: RunChange, versions: Option<&[String]>) -> Result<wire::Run> {
        let t = self.db.write().await?;
        let row = self.row_to_change(&*t, id).await?;
        if versions.is_some_and(|versions| !versions.contains(&listing::version_of(&row))) {
            return Err(Error::Changed("what is said about the run has changed since it was read".into()));
        }
        let mut set = run::ActiveModel { id: Set(row.id.clone()), note: Set(row.note.clone()), ..Default::default() };
        if let Some(name) = change.asset {
            let name = name.trim().to_string();
            check_name("asset", &name)?;
            insert_asset(&*t, &name).await?;
            set.asset = Set(name);
        }
        if let Some(chainage_mm) = change.chainage_mm {
            check_chainage(chainage_mm)?;
            set.chainage_mm = Set(chainage_mm);
        }
        if let Some(direction) = change.direction {
            set.direction = Set(direction.as_str().into());
        }
        if let Some(text) = change.recorded_at {
            set.recorded_ms = Set(read_time("recorded_at", &text)?);
        }
        if let Some(note) = change.note {
            check_note(&note)?;
            set.note = Set(note);
        }
        run::Entity::update_many().set(set).filter(run::Column::Id.eq(id)).exec(&*t).await?;
        defects::run_changed(&*t, &row).await?;
        self.forget_asset_without_runs(&*t, &row.asset).await?;
        t.commit().await?;
        self.queue.bell().ring();
        self.get(id).await
    }

    /// Deletes a run with its jobs and all their files. A worker that is at one of them loses its lease and stops.
    pub async fn delete(&self, id: &str) -> Result<()> {
        retried(ANSWER_PATIENCE, || self.try_delete(id)).await
    }

    async fn try_delete(&self, id: &str) -> Result<()> {
        let t = self.db.write().await?;
        let row = self.row_to_change(&*t, id).await?;
        for job in job::Entity::find().filter(job::Column::RunId.eq(id)).all(&*t).await? {
            let running = queue::state_of(&job)? == JobState::Running;
            let due_ms = now_ms() + if running { STOPPING_MS } else { 0 };
            queue::mark_unpublished(&*t, store::job_prefix(&job.id), due_ms).await?;
            product::Entity::delete_many().filter(product::Column::JobId.eq(&job.id)).exec(&*t).await?;
            segment::Entity::delete_many().filter(segment::Column::JobId.eq(&job.id)).exec(&*t).await?;
            log_line::Entity::delete_many().filter(log_line::Column::JobId.eq(&job.id)).exec(&*t).await?;
            let attempts = unpublished::Column::Prefix.starts_with(store::job_prefix(&job.id));
            let parts = unpublished::Column::Prefix.ne(store::job_prefix(&job.id));
            unpublished::Entity::delete_many().filter(attempts).filter(parts).exec(&*t).await?;
        }
        queue::mark_unpublished(&*t, store::run_prefix(id), now_ms()).await?;
        run::Entity::delete_by_id(&row.id).exec(&*t).await?;
        self.forget_asset_without_runs(&*t, &row.asset).await?;
        t.commit().await?;
        self.queue.bell().ring();
        Ok(())
    }

    /// What a policy would delete now, and the rules that hold on a server with flags `own`.
    pub async fn preview(&self, policy: &Policy, own: Policy) -> Result<wire::RetentionPreview> {
        let rules = self.rules_of_keeping(own).await?.wire(own);
        policy.preview(&self.db, rules).await
    }

    /// The rules of keeping that hold on a server with flags `own`.
    pub async fn rules_of_keeping(&self, own: Policy) -> Result<Holding> {
        Holding::now(&self.db, own).await
    }

    /// Stores rules of keeping for every server; `None`: each server's own hold again. `versions` as for [`Runs::change`].
    pub async fn keep_by(&self, rules: Option<Policy>, versions: Option<&[String]>, who: &str) -> Result<()> {
        retention::store_rules(&self.db, rules, versions, who).await?;
        self.queue.bell().ring();
        Ok(())
    }

    /// Keeps a run whatever the policy says, or not.
    pub async fn pin(&self, id: &str, pinned: bool) -> Result<()> {
        retried(ANSWER_PATIENCE, || retention::set_pin(&self.db, id, pinned)).await
    }

    /// Whether a run is pinned.
    pub async fn is_pinned(&self, id: &str) -> Result<bool> {
        self.row(self.db.read(), id).await?;
        Ok(pin::Entity::find_by_id(id).one(self.db.read()).await?.is_some())
    }

    async fn forget_asset_without_runs(&self, records: &impl ConnectionTrait, name: &str) -> Result<()> {
        let left = run::Entity::find().filter(run::Column::Asset.eq(name)).one(records).await?;
        if left.is_none() {
            asset::Entity::delete_by_id(name).exec(records).await?;
        }
        Ok(())
    }

    async fn row(&self, records: &impl ConnectionTrait, id: &str) -> Result<run::Model> {
        let found = run::Entity::find_by_id(id).one(records).await?;
        found.ok_or_else(|| Error::NotFound { what: "run", id: id.into() })
    }

    /// A run, held until the end of the transaction.
    async fn row_to_change(&self, records: &impl ConnectionTrait, id: &str) -> Result<run::Model> {
        let found = run::Entity::find_by_id(id).lock_exclusive().one(records).await?;
        found.ok_or_else(|| Error::NotFound { what: "run", id: id.into() })
    }

    /// The job that an earlier request with the same key and content made.
    async fn made_before(
        &self,
        records: &impl ConnectionTrait,
        key: Option<&str>,
        fingerprint: &str,
    ) -> Result<Option<job::Model>> {
        let Some(key) = key else { return Ok(None) };
        let Some(row) = idempotency_key::Entity::find_by_id(key).one(records).await? else { return Ok(None) };
        if row.fingerprint != fingerprint {
            return Err(Error::KeyReused(key.into()));
        }
        Ok(job::Entity::find_by_id(row.job_id).one(records).await?)
    }
}

async fn remember(records: &impl ConnectionTrait, key: Option<&str>, fingerprint: &str, job: &str) -> Result<()> {
    let Some(key) = key else { return Ok(()) };
    let row = idempotency_key::ActiveModel {
        key: Set(key.into()),
        created_ms: Set(now_ms()),
        fingerprint: Set(fingerprint.into()),
        job_id: Set(job.into()),
    };
    idempotency_key::Entity::insert(row).exec_without_returning(records).await?;
    Ok(())
}

async fn insert_asset(records: &impl ConnectionTrait, name: &str) -> Result<()> {
    let row = asset::ActiveModel { name: Set(name.into()), created_ms: Set(now_ms()) };
    let keep = OnConflict::column(asset::Column::Name).do_nothing().to_owned();
    asset::Entity::insert(row).on_conflict(keep).try_insert().exec_without_returning(records).await?;
    Ok(())
}

fn check_name(field: &str, name: &str) -> Result<()> {
    let plain =
        !name.trim().is_empty() && name.chars().count() <= MAX_NAME_CHARS && !name.chars().any(char::is_control);
    if plain {
        return Ok(());
    }
    let expected = format!("1 to {MAX_NAME_CHARS} characters without control characters");
    Err(Error::field(field, format!("{field} is {:?}", shorten(name)), expected))
}

fn check_chainage(chainage_mm: f64) -> Result<()> {
    if chainage_mm.abs() <= MAX_CHAINAGE_MM {
        return Ok(());
    }
    Err(Error::field(
        "chainage_mm",
        format!("chainage_mm is {chainage_mm} mm"),
        format!("within ±{MAX_CHAINAGE_MM:e} mm"),
    ))
}

pub(crate) fn check_note(note: &str) -> Result<()> {
    if note.chars().count() <= MAX_NOTE_CHARS {
        return Ok(());
    }
    let found = format!("the note has {} characters", note.chars().count());
    Err(Error::field("note", found, format!("at most {MAX_NOTE_CHARS} characters")))
}

/// Reads a time of a request.
pub fn read_time(field: &str, text: &str) -> Result<i64> {
    from_text(text).ok_or_else(|| {
        let found = format!("{field} is {:?}", shorten(text));
        Error::field(field, found, format!("a time as RFC 3339 writes it, such as {}", to_text(1_778_000_000_000)))
    })
}

/// What somebody sent, short enough to be said back.
fn shorten(text: &str) -> String {
    const MOST: usize = 60;
    if text.chars().count() <= MOST { text.into() } else { text.chars().take(MOST).chain(['…']).collect() }
}

fn to_i64(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

fn to_u64(value: i64) -> u64 {
    u64::try_from(value).unwrap_or(0)
}
