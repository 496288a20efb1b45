//! A bench: how many jobs a second are claimed and ended, and how long one waits for an idle worker, on the PostgreSQL that
//! `STRIA_BENCH_DATABASE` names. `make bench-queue` runs it beside another queue; it prints one line of JSON.

use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;

use super::tests::{Records, outcome};
use super::*;
use crate::config::JobLimits;
use crate::db::DatabasePlace;
use crate::db::tables::asset;
use crate::worker::LOOK_EVERY;

/// Jobs in the queue before the first is claimed.
const JOBS: usize = 2000;
/// Jobs at the same time.
const AT_ONCE: usize = 4;
/// Jobs that find an idle worker.
const STARTS: usize = 50;

async fn opened() -> Records {
    let url = std::env::var("STRIA_BENCH_DATABASE").expect("STRIA_BENCH_DATABASE names a PostgreSQL");
    let place = DatabasePlace::parse(&url).expect("postgres://USER:PASSWORD@HOST/NAME");
    let db = Db::open(&place).await.expect("opens");
    let row = asset::ActiveModel { name: Set("wall".into()), created_ms: Set(0) };
    let there = OnConflict::column(asset::Column::Name).do_nothing().to_owned();
    asset::Entity::insert(row).on_conflict(there).exec_without_returning(db.read()).await.expect("inserts");
    Records::on(db, JobLimits::default())
}

/// Claims and ends jobs until none is left; their number.
async fn work(queue: Queue, worker: usize) -> usize {
    let name = format!("worker-{worker}");
    let mut done = 0;
    while let Some(lease) = queue.claim(Wanted::Any, "node", &name).await.expect("claims") {
        queue.finish(&lease, outcome()).await.expect("ends");
        done += 1;
    }
    done
}

/// Times from a job's enqueue to its claim by an idle worker, ms. `apart`: the worker is as in another process, with
/// a bell of its own.
async fn starts_ms(r: &Records, apart: bool) -> Vec<f64> {
    let queue = if apart { Queue::new(r.db.clone(), JobLimits::default()) } else { r.queue.clone() };
    let stop = CancellationToken::new();
    let _stopped = stop.clone().drop_guard();
    for bell in [r.queue.bell(), queue.bell()] {
        tokio::spawn(bell.clone().relay(r.db.clone(), stop.clone()));
    }
    let claimer = tokio::spawn(async move {
        let mut changes = queue.bell().listen();
        let mut claimed = Vec::new();
        while claimed.len() < STARTS {
            changes.borrow_and_update();
            match queue.claim(Wanted::Any, "node", "idle").await.expect("claims") {
                Some(lease) => {
                    claimed.push((lease.job.clone(), Instant::now()));
                    queue.finish(&lease, outcome()).await.expect("ends");
                }
                None => {
                    let _ = tokio::time::timeout(LOOK_EVERY, changes.changed()).await;
                }
            }
        }
        claimed
    });
    let mut enqueued = Vec::new();
    for i in 0..STARTS {
        // At no fixed place between two looks.
        tokio::time::sleep(Duration::from_millis(20 + (i as u64 * 37) % 100)).await;
        let begun = Instant::now();
        enqueued.push((r.add(Priority::Upload).await, begun));
        r.queue.bell().ring();
    }
    let claimed: std::collections::HashMap<String, Instant> = claimer.await.expect("claims").into_iter().collect();
    let mut waits: Vec<f64> =
        enqueued.iter().map(|(job, begun)| (claimed[job] - *begun).as_secs_f64() * 1000.0).collect();
    waits.sort_by(f64::total_cmp);
    waits
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "a bench, and no check: it prints what it measures"]
async fn rate() {
    let r = opened().await;
    let begun = Instant::now();
    for _ in 0..JOBS {
        r.add(Priority::Upload).await;
    }
    let enqueue_per_s = JOBS as f64 / begun.elapsed().as_secs_f64();
    let begun = Instant::now();
    let tasks: Vec<_> = (0..AT_ONCE).map(|i| tokio::spawn(work(r.queue.clone(), i))).collect();
    let mut done = 0;
    for task in tasks {
        done += task.await.expect("works");
    }
    let jobs_per_s = done as f64 / begun.elapsed().as_secs_f64();
    assert_eq!(done, JOBS);
    let (near, apart) = (starts_ms(&r, false).await, starts_ms(&r, true).await);
    let figures = serde_json::json!({
        "enqueue_per_s": enqueue_per_s,
        "jobs_per_s": jobs_per_s,
        "start_ms": near[STARTS / 2], "start_p95_ms": near[STARTS * 95 / 100],
        "start_apart_ms": apart[STARTS / 2], "start_apart_p95_ms": apart[STARTS * 95 / 100],
    });
    println!("FIGURES {figures}");
}
