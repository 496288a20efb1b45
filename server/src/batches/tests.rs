//! Batches' promises, on a real database.

use super::*;
use crate::config::JobLimits;
use crate::db::DatabasePlace;
use crate::db::tables::asset;
use crate::queue::{Lease, Outcome};
use crate::wire::Priority;

struct Site {
    batches: Batches,
    queue: Queue,
    db: Db,
    _folder: tempfile::TempDir,
}

async fn site() -> Site {
    let folder = tempfile::tempdir().expect("folder");
    let db = Db::open(&DatabasePlace::Sqlite(folder.path().join("stria.db"))).await.expect("opens");
    for name in ["a", "b"] {
        let row = asset::ActiveModel { name: Set(name.into()), created_ms: Set(0) };
        asset::Entity::insert(row).exec_without_returning(db.read()).await.expect("inserts");
    }
    let queue = Queue::new(db.clone(), JobLimits::default());
    Site { batches: Batches::new(db.clone(), queue.clone()), queue, db, _folder: folder }
}

impl Site {
    /// A run with a job that is done, as the records have it.
    async fn done_runs(&self, asset: &str, count: usize) -> Vec<String> {
        let (mut runs, mut jobs, mut ids) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..count {
            let (id, latest) = (Queue::new_id(), Queue::new_id());
            runs.push(run::ActiveModel {
                id: Set(id.clone()),
                created_ms: Set(0),
                asset: Set(asset.into()),
                chainage_mm: Set(0.0),
                direction: Set("forward".into()),
                recorded_ms: Set(0),
                note: Set(String::new()),
                filename: Set("a.mp4".into()),
                source_extension: Set("mp4".into()),
                source_bytes: Set(1),
                source_sha256: Set(String::new()),
                fps: Set(None),
                rig_name: Set("old".into()),
                state: Set("done".into()),
                latest_job: Set(latest.clone()),
                source_kind: Set(crate::source::FILE.into()),
                source_open: Set(0),
            });
            let origin = crate::queue::Origin { batch: String::new(), base_job: String::new() };
            jobs.push(job::ActiveModel {
                id: Set(latest),
                state: Set("done".into()),
                rig_name: Set("old".into()),
                rig_toml: Set("old rig".into()),
                recipe_name: Set("paper".into()),
                recipe_toml: Set("old recipe".into()),
                quality: Set(Some("{\"coverage\":0.5,\"frames\":10,\"residual_px\":null}".into())),
                batch_id: Set(None),
                base_job: Set(None),
                ..crate::queue::new_row(&id, Priority::Upload, origin)
            });
            ids.push(id);
        }
        for (runs, jobs) in runs.chunks(500).zip(jobs.chunks(500)) {
            let t = self.db.write().await.expect("begins");
            run::Entity::insert_many(runs.to_vec()).exec_without_returning(&*t).await.expect("inserts");
            job::Entity::insert_many(jobs.to_vec()).exec_without_returning(&*t).await.expect("inserts");
            t.commit().await.expect("commits");
        }
        ids
    }

    async fn settle(&self) -> usize {
        let mut steps = 0;
        while self.batches.step().await.expect("steps") {
            steps += 1;
        }
        steps
    }

    async fn claim(&self) -> Option<Lease> {
        self.queue.claim(crate::queue::Wanted::Any, "node", "worker").await.expect("claims")
    }

    async fn finish(&self, lease: &Lease) {
        let quality = serde_json::json!({"coverage": 0.75, "frames": 10, "residual_px": 0.1});
        let outcome = Outcome { products: vec![], warnings: vec![], quality, frames: 10, defects: None };
        self.queue.finish(lease, outcome).await.expect("publishes");
    }
}

fn all(filter: RunFilter) -> NewBatch {
    NewBatch { filter, runs: None, rig: None, recipe: None, note: String::new() }
}

fn of_asset(name: &str) -> RunFilter {
    RunFilter { asset: Some(name.into()), ..RunFilter::default() }
}

#[tokio::test]
async fn a_batch_stands_beside_the_old_results_and_tells_the_difference() {
    let s = site().await;
    let runs = s.done_runs("a", 2).await;
    s.done_runs("b", 3).await;
    let mut new = all(of_asset("a"));
    assert_eq!(s.batches.count(&new).await.expect("counts"), 2);
    new.rig = Some(RigText { name: "new".into(), toml: "new rig".into() });
    let made = s.batches.create(new.clone(), Some("key")).await.expect("begins").made;
    assert!(s.batches.create(new.clone(), Some("key")).await.expect("the same").repeated);
    assert!(matches!(s.batches.create(all(of_asset("b")), Some("key")).await, Err(Error::KeyReused(_))));
    assert_eq!((made.state, made.runs), (BatchState::Queueing, 2));
    // A run that comes later is not of it.
    s.done_runs("a", 1).await;
    s.settle().await;
    let now = s.batches.get(&made.id).await.expect("is there");
    assert_eq!((now.state, now.jobs["queued"]), (BatchState::Running, 2));

    let shown = |run: String| async move { run::Entity::find_by_id(run) };
    let latest = |run: String| async { shown(run).await.one(s.db.read()).await.expect("reads").expect("exists") };
    let before = latest(runs[0].clone()).await;
    let lease = s.claim().await.expect("a job");
    assert_eq!((lease.rig_toml.as_str(), lease.recipe_toml.as_str()), ("new rig", "old recipe"));
    assert_eq!(latest(lease.run.clone()).await.state, "done", "the old result is shown until the new one is there");
    s.finish(&lease).await;
    let after = latest(lease.run.clone()).await;
    assert_eq!((after.state.as_str(), after.latest_job.as_str()), ("done", lease.job.as_str()));
    assert!(lease.run != runs[0] || before.latest_job != after.latest_job);

    let lease = s.claim().await.expect("a job");
    s.finish(&lease).await;
    assert_eq!(s.batches.get(&made.id).await.expect("is there").state, BatchState::Done);
    let results = s.batches.results(&made.id, &Page::new(None, None).expect("a page")).await.expect("lists");
    assert_eq!(results.items.len(), 2);
    let difference = &results.items[0].difference;
    assert_eq!((difference["coverage"], difference["frames"]), (0.25, 0.0));
    assert!(!difference.contains_key("residual_px"), "there was no figure before");
}

#[tokio::test]
async fn a_batch_is_paused_resumed_and_cancelled() {
    let s = site().await;
    s.done_runs("a", 4).await;
    let id = s.batches.create(all(RunFilter::default()), None).await.expect("begins").made.id;
    s.settle().await;
    let running = s.claim().await.expect("a job");
    s.batches.want(&id, Wanted::Pause).await.expect("pauses");
    s.settle().await;
    let paused = s.batches.get(&id).await.expect("is there");
    assert_eq!((paused.state, paused.jobs["paused"], paused.jobs["running"]), (BatchState::Paused, 3, 1));
    assert!(s.claim().await.is_none(), "nothing begins");
    s.batches.want(&id, Wanted::Run).await.expect("goes on");
    s.settle().await;
    let second = s.claim().await.expect("goes on");
    s.finish(&second).await;
    s.batches.want(&id, Wanted::Cancel).await.expect("cancels");
    s.settle().await;
    assert_eq!(s.queue.signal(&running).await.expect("asks"), crate::queue::Signal::Cancel);
    assert_eq!(s.batches.get(&id).await.expect("is there").state, BatchState::Cancelling);
    s.queue.cancelled(&running).await.expect("stops");
    let ended = s.batches.get(&id).await.expect("is there");
    assert_eq!((ended.state, ended.jobs["cancelled"], ended.jobs["done"]), (BatchState::Cancelled, 3, 1));
    assert!(matches!(s.batches.want(&id, Wanted::Run).await, Err(Error::Conflict(_))));
    assert!(matches!(s.batches.want("x", Wanted::Run).await, Err(Error::NotFound { .. })));
}

#[tokio::test]
async fn a_list_of_runs_is_checked() {
    let s = site().await;
    let runs = s.done_runs("a", 3).await;
    let listed = |runs: Vec<String>| NewBatch { runs: Some(runs), ..all(RunFilter::default()) };
    let made = s.batches.create(listed(vec![runs[2].clone(), runs[0].clone(), runs[0].clone()]), None).await;
    let id = made.expect("begins").made.id;
    s.settle().await;
    assert_eq!(s.batches.get(&id).await.expect("is there").jobs["queued"], 2);
    for bad in [vec![], vec![runs[0].clone(), "nothing".into()]] {
        assert!(matches!(s.batches.count(&listed(bad)).await, Err(Error::Input { .. })));
    }
}

#[tokio::test]
async fn a_hundred_thousand_jobs_are_queued_in_steps_between_which_others_go_first() {
    let s = site().await;
    s.done_runs("a", 100_000).await;
    let urgent = s.done_runs("b", 1).await.remove(0);
    s.batches.create(all(of_asset("a")), None).await.expect("begins");
    let mut claimed = 0;
    let mut steps = 0;
    while s.batches.step().await.expect("steps") {
        steps += 1;
        if steps % 50 == 1 {
            let new = crate::queue::NewJob {
                run: urgent.clone(),
                priority: Priority::Live,
                rig_name: "rig".into(),
                rig_toml: "rig".into(),
                recipe_name: "paper".into(),
                recipe_toml: "recipe".into(),
            };
            let live = s.queue.enqueue(s.db.read(), new).await.expect("a live job comes in between");
            assert_eq!(s.claim().await.map(|l| l.job), Some(live), "and goes first");
            claimed += 1;
        }
    }
    assert!(claimed >= 4 && steps >= 200, "{claimed} of {steps}");
    let waiting = job::Entity::find().filter(job::Column::State.eq("queued")).count(s.db.read()).await.expect("counts");
    assert_eq!(waiting, 100_000);
}
