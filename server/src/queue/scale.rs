//! A bench: listing, claiming and counting beside 10,000 and 1,000,000 jobs, of which 1,000 wait. Prints times and ratios:
//! cargo test --release --workspace --bin stria -- --ignored --nocapture scale

use std::time::{Duration, Instant};

use super::tests::{Records, records};
use super::*;
use crate::runs::{Page, Runs};
use crate::store::{Store, StorePlace};

const WAITING: u32 = 1000;
const ROUNDS: u32 = 20;

/// As many jobs, each with its run, as the records of a long life have.
async fn filled(jobs: u32) -> Records {
    let r = records(JobLimits::default()).await;
    let numbers = format!("WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < {jobs} - 1)");
    let state = format!("CASE WHEN i % ({jobs} / {WAITING}) = 0 THEN 'queued' ELSE 'done' END");
    let id = |kind: &str| format!("printf('{kind}%07x-0000-7000-8000-%012x', i, i)");
    let runs = format!(
        "{numbers} INSERT INTO runs (id, created_ms, asset, chainage_mm, direction, recorded_ms, note, filename, \
         source_extension, source_bytes, source_sha256, rig_name, state, latest_job) \
         SELECT {}, i, 'wall', 0, 'forward', i, '', 'a.mp4', 'mp4', 1, '', 'rig', {state}, {} FROM n",
        id("0"),
        id("1")
    );
    let jobs = format!(
        "{numbers} INSERT INTO jobs (id, run_id, created_ms, priority, rank_ms, rig_name, rig_toml, recipe_name, \
         recipe_toml, state, cancel_requested, not_before_ms, fence, attempt, failures, losses, node, worker, beat, \
         stage, fraction, frames, frames_per_s, warnings) SELECT {}, {}, i, 'upload', i, 'rig', '', 'metric', '', \
         {state}, 0, 0, 0, 0, 0, 0, '', '', 0, '', 0, 0, 0, '[]' FROM n",
        id("1"),
        id("0")
    );
    for sql in [runs, jobs, "ANALYZE".into()] {
        r.db.read().execute_unprepared(&sql).await.expect("fills");
    }
    r
}

/// The median time of each thing that a long life must not make slower.
async fn times(jobs: u32) -> Vec<(&'static str, Duration)> {
    let r = filled(jobs).await;
    let folder = tempfile::tempdir().expect("folder");
    let store = Store::open(&StorePlace::Folder(folder.path().into())).expect("opens");
    let runs = Runs::new(r.db.clone(), r.queue.clone(), store);
    let page = || Page::new(None, None).expect("a page");
    let deep = Page::new(Some(format!("1{:07x}", jobs / 2)), None).expect("a page");
    let mut all: Vec<(&'static str, Vec<Duration>)> =
        ["list", "list of a state", "list from the middle", "claim", "count"].map(|name| (name, Vec::new())).into();
    for _ in 0..ROUNDS {
        let mut note = |i: usize, begun: Instant| all[i].1.push(begun.elapsed());
        let begun = Instant::now();
        runs.jobs(None, None, &page()).await.expect("lists");
        note(0, begun);
        let begun = Instant::now();
        runs.jobs(None, Some("queued"), &page()).await.expect("lists");
        note(1, begun);
        let begun = Instant::now();
        runs.jobs(None, None, &deep).await.expect("lists");
        note(2, begun);
        let begun = Instant::now();
        r.queue.claim(Wanted::Any, "node", "worker").await.expect("claims").expect("a job waits");
        note(3, begun);
        let begun = Instant::now();
        r.queue.depths().await.expect("counts");
        note(4, begun);
    }
    let median = |mut times: Vec<Duration>| {
        times.sort();
        times[times.len() / 2]
    };
    all.into_iter().map(|(name, times)| (name, median(times))).collect()
}

#[test]
#[ignore = "a bench, and no check: it prints what it measures"]
fn scale() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    let (few, many) = runtime.block_on(async { (times(10_000).await, times(1_000_000).await) });
    println!("| what | 10,000 jobs, ms | 1,000,000 jobs, ms | ratio |\n|---|---:|---:|---:|");
    for ((name, few), (_, many)) in few.into_iter().zip(many) {
        let ms = |d: Duration| d.as_secs_f64() * 1000.0;
        println!("| {name} | {:.2} | {:.2} | {:.2} |", ms(few), ms(many), ms(many) / ms(few));
    }
}
