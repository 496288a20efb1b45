//! The queue's promises, on a real database.

use std::time::Duration;

use sea_orm::{ActiveValue::Set, ColumnTrait, EntityTrait, QueryFilter};

use super::*;
use crate::db::DatabasePlace;
use crate::db::tables::{asset, product};
use crate::store::{Facts, ProductName};
use crate::wire::child::Failure;

pub(super) struct Records {
    pub(super) queue: Queue,
    pub(super) db: Db,
    _folder: Option<tempfile::TempDir>,
}

pub(super) async fn records(limits: JobLimits) -> Records {
    let folder = tempfile::tempdir().expect("folder");
    let db = Db::open(&DatabasePlace::Sqlite(folder.path().join("stria.db"))).await.expect("opens");
    let row = asset::ActiveModel { name: Set("wall".into()), created_ms: Set(0) };
    asset::Entity::insert(row).exec_without_returning(db.read()).await.expect("inserts");
    Records { _folder: Some(folder), ..Records::on(db, limits) }
}

impl Records {
    pub(super) fn on(db: Db, limits: JobLimits) -> Records {
        Records { queue: Queue::new(db.clone(), limits), db, _folder: None }
    }

    pub(super) async fn add(&self, priority: Priority) -> String {
        let run = Queue::new_id();
        let row = run::ActiveModel {
            id: Set(run.clone()),
            created_ms: Set(0),
            asset: Set("wall".into()),
            chainage_mm: Set(0.0),
            direction: Set("forward".into()),
            recorded_ms: Set(0),
            note: Set(String::new()),
            filename: Set("a.mp4".into()),
            source_extension: Set("mp4".into()),
            source_bytes: Set(1),
            source_sha256: Set(String::new()),
            fps: Set(None),
            rig_name: Set("rig".into()),
            state: Set("queued".into()),
            latest_job: Set(String::new()),
            source_kind: Set(crate::source::FILE.into()),
            source_open: Set(0),
        };
        run::Entity::insert(row).exec_without_returning(self.db.read()).await.expect("inserts");
        let new = NewJob {
            run,
            priority,
            rig_name: "rig".into(),
            rig_toml: String::new(),
            recipe_name: "paper".into(),
            recipe_toml: String::new(),
        };
        self.queue.enqueue(self.db.read(), new).await.expect("enqueues")
    }

    async fn claim(&self) -> Option<Lease> {
        self.queue.claim(Wanted::Any, "node", "worker").await.expect("claims")
    }

    pub(super) async fn job(&self, id: &str) -> job::Model {
        find_to_change(self.db.read(), id).await.expect("exists")
    }

    async fn unpublished(&self) -> Vec<(String, i64)> {
        let rows = unpublished::Entity::find().all(self.db.read()).await.expect("lists");
        rows.into_iter().map(|r| (r.prefix, r.due_ms)).collect()
    }
}

pub(super) fn outcome() -> Outcome {
    let facts = Facts { bytes: 3, sha256: "00".into() };
    let name = ProductName::new("depth.tif").expect("plain");
    let products = vec![PublishedProduct { name, facts }];
    Outcome { products, warnings: vec!["dusty".into()], quality: serde_json::json!({}), frames: 7, defects: None }
}

fn fast() -> JobLimits {
    JobLimits { retry_base: Duration::ZERO, ..JobLimits::default() }
}

#[tokio::test]
async fn urgent_jobs_go_first_and_waiting_makes_up_for_it() {
    let r = records(fast()).await;
    let (batch, upload, live) =
        (r.add(Priority::Batch).await, r.add(Priority::Upload).await, r.add(Priority::Live).await);
    let old = r.add(Priority::Batch).await;
    let change =
        job::ActiveModel { rank_ms: Set(rank_ms(now_ms() - 2 * 3_600_000, Priority::Batch)), ..Default::default() };
    job::Entity::update_many().set(change).filter(job::Column::Id.eq(&old)).exec(r.db.read()).await.expect("ages");
    for expected in [live, old, upload, batch] {
        assert_eq!(r.claim().await.expect("a job").job, expected);
    }
    assert!(r.claim().await.is_none());
}

#[tokio::test]
async fn many_workers_never_share_a_job() {
    let r = records(fast()).await;
    for _ in 0..20 {
        r.add(Priority::Upload).await;
    }
    let mut tasks = Vec::new();
    for worker in 0..8 {
        let queue = r.queue.clone();
        tasks.push(tokio::spawn(async move {
            let mut mine = Vec::new();
            while let Some(lease) = queue.claim(Wanted::Any, "node", &worker.to_string()).await.expect("claims") {
                mine.push(lease.job);
            }
            mine
        }));
    }
    let mut all = Vec::new();
    for task in tasks {
        all.extend(task.await.expect("ends"));
    }
    all.sort();
    all.dedup();
    assert_eq!(all.len(), 20);
}

#[tokio::test]
async fn one_result_is_published_and_the_fence_keeps_a_late_worker_out() {
    let r = records(fast()).await;
    let id = r.add(Priority::Upload).await;
    let late = r.claim().await.expect("a job");
    assert_eq!(r.queue.recover("another node").await.expect("looks"), 0);
    assert_eq!(r.queue.recover("node").await.expect("takes back"), 1);
    let second = r.claim().await.expect("the job again");
    assert_eq!((second.attempt, second.fence), (2, late.fence + 1));

    assert!(matches!(r.queue.finish(&late, outcome()).await, Err(Error::LeaseLost)));
    assert!(matches!(r.queue.beat(&late).await, Err(Error::LeaseLost)));
    assert!(matches!(r.queue.progress(&late, &Progress::default()).await, Err(Error::LeaseLost)));
    assert!(matches!(r.queue.log(&late, "x").await, Err(Error::LeaseLost)));
    assert_eq!(r.queue.signal(&late).await.expect("asks"), Signal::Lost);

    r.queue.finish(&second, outcome()).await.expect("publishes");
    assert!(matches!(r.queue.finish(&second, outcome()).await, Err(Error::LeaseLost)), "only once");
    let row = r.job(&id).await;
    assert_eq!((row.state.as_str(), row.result_fence), ("done", Some(second.fence)));
    let run = run::Entity::find_by_id(&row.run_id).one(r.db.read()).await.expect("reads").expect("exists");
    assert_eq!(run.state, "done");
    let products = product::Entity::find().all(r.db.read()).await.expect("lists");
    assert_eq!(products.len(), 1);
    let left = r.unpublished().await;
    assert_eq!(left.len(), 1, "the first attempt's files are to be deleted, the second's are kept: {left:?}");
    assert_eq!(left[0].0, store::attempt_prefix(&id, late.fence));
}

#[tokio::test]
async fn failures_are_retried_by_kind_and_number() {
    let r = records(fast()).await;
    let id = r.add(Priority::Upload).await;
    for attempt in 1..=3 {
        let lease = r.claim().await.expect("a job");
        assert_eq!(lease.attempt, attempt);
        let killed = Failure::new("killed", "killed by signal 9 (SIGKILL)", true);
        r.queue.fail(&lease, &killed).await.expect("fails");
    }
    let row = r.job(&id).await;
    assert_eq!(row.state, "failed");
    assert!(row.error.as_deref().is_some_and(|e| e.contains("SIGKILL")), "{:?}", row.error);

    r.queue.retry(&id).await.expect("again");
    let lease = r.claim().await.expect("a job");
    r.queue.fail(&lease, &Failure::new("bad_input", "not a video", false)).await.expect("fails");
    assert_eq!(r.job(&id).await.state, "failed", "bad input is not tried again");
    assert!(r.claim().await.is_none());
}

#[tokio::test]
async fn a_retry_waits_and_a_clock_set_back_does_not_park_it() {
    let limits = JobLimits { retry_base: Duration::from_secs(60), ..JobLimits::default() };
    let r = records(limits).await;
    let id = r.add(Priority::Upload).await;
    let lease = r.claim().await.expect("a job");
    r.queue.fail(&lease, &Failure::new("io", "gone", true)).await.expect("fails");
    assert!(r.claim().await.is_none(), "it waits");
    let year_ahead = now_ms() + 365 * 24 * 3_600_000;
    let change = job::ActiveModel { not_before_ms: Set(year_ahead), ..Default::default() };
    job::Entity::update_many().set(change).filter(job::Column::Id.eq(&id)).exec(r.db.read()).await.expect("moves");
    assert!(r.claim().await.is_some());
}

#[tokio::test]
async fn a_job_that_always_takes_its_worker_along_ends() {
    let r = records(JobLimits { max_losses: 3, ..fast() }).await;
    let id = r.add(Priority::Upload).await;
    for _ in 0..3 {
        r.claim().await.expect("a job");
        r.queue.recover("node").await.expect("takes back");
    }
    assert_eq!(r.job(&id).await.state, "failed");
}

/// Looks at the leases so often that it has never looked away.
async fn look_for(watch: &mut LeaseWatch, time: Duration) {
    let begun = std::time::Instant::now();
    while begun.elapsed() < time {
        watch.look().await.expect("looks");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

#[tokio::test]
async fn silence_ends_a_lease_and_a_sign_of_life_keeps_it() {
    let lease_time = Duration::from_millis(400);
    let r = records(JobLimits { lease: lease_time, ..fast() }).await;
    let id = r.add(Priority::Upload).await;
    let lease = r.claim().await.expect("a job");
    let mut watch = LeaseWatch::new(r.queue.clone());
    for _ in 0..4 {
        look_for(&mut watch, lease_time / 3).await;
        r.queue.beat(&lease).await.expect("still mine");
    }
    assert_eq!(r.job(&id).await.state, "running");
    look_for(&mut watch, lease_time * 2).await;
    assert_eq!(r.job(&id).await.state, "queued");
    assert_eq!(r.queue.signal(&lease).await.expect("asks"), Signal::Lost);
}

#[tokio::test]
async fn who_looked_away_ends_no_lease() {
    let r = records(JobLimits { lease: Duration::from_millis(100), ..fast() }).await;
    let id = r.add(Priority::Upload).await;
    r.claim().await.expect("a job");
    let mut watch = LeaseWatch::new(r.queue.clone());
    for _ in 0..3 {
        watch.look().await.expect("looks");
        tokio::time::sleep(Duration::from_millis(150)).await;
    }
    assert_eq!(r.job(&id).await.state, "running", "its worker may have been there all the time");
}

#[tokio::test]
async fn a_clean_stop_costs_no_attempt() {
    let r = records(fast()).await;
    let id = r.add(Priority::Upload).await;
    for _ in 0..5 {
        let lease = r.claim().await.expect("a job");
        assert_eq!(lease.attempt, 1);
        r.queue.release(&lease).await.expect("releases");
    }
    let row = r.job(&id).await;
    assert_eq!((row.state.as_str(), row.attempt, row.fence), ("queued", 0, 5));
}

#[tokio::test]
async fn cancelling_works_at_every_stage() {
    let r = records(fast()).await;
    let waiting = r.add(Priority::Upload).await;
    r.queue.cancel(&waiting).await.expect("cancels");
    assert_eq!(r.job(&waiting).await.state, "cancelled");
    r.queue.cancel(&waiting).await.expect("twice is the same");

    let running = r.add(Priority::Upload).await;
    let lease = r.claim().await.expect("a job");
    assert_eq!(r.queue.signal(&lease).await.expect("asks"), Signal::Continue);
    r.queue.cancel(&running).await.expect("asks to stop");
    assert_eq!(r.queue.signal(&lease).await.expect("asks"), Signal::Cancel);
    r.queue.cancelled(&lease).await.expect("stops");
    assert_eq!(r.job(&running).await.state, "cancelled");
    assert!(matches!(r.queue.cancel("nothing").await, Err(Error::NotFound { .. })));

    r.queue.retry(&running).await.expect("again");
    let lease = r.claim().await.expect("a job");
    r.queue.finish(&lease, outcome()).await.expect("publishes");
    assert!(matches!(r.queue.cancel(&running).await, Err(Error::Conflict(_))));
    assert!(matches!(r.queue.retry(&running).await, Err(Error::Conflict(_))));
}
