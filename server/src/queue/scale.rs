//! A bench: listing, claiming and counting beside 10,000 and 1,000,000 jobs, of which 1,000 wait, on SQLite and on the
//! PostgreSQL that `STRIA_BENCH_DATABASE` names. `make bench-queue` runs it; it prints times and ratios.

use std::time::{Duration, Instant};

use sea_orm::DbBackend;

use super::tests::{Records, records};
use super::*;
use crate::db::DatabasePlace;
use crate::runs::{Page, Runs};
use crate::store::{Store, StorePlace};

const WAITING: u32 = 1000;
const ROUNDS: u32 = 20;

/// Puts as many jobs, each with its run, into empty records as those of a long life have.
async fn fill(r: &Records, jobs: u32) {
    let postgres = r.db.read().get_database_backend() == DbBackend::Postgres;
    let id = |kind: &str| match postgres {
        true => format!("'{kind}' || lpad(to_hex(i), 7, '0') || '-0000-7000-8000-' || lpad(to_hex(i), 12, '0')"),
        false => format!("printf('{kind}%07x-0000-7000-8000-%012x', i, i)"),
    };
    let numbers = format!("WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < {jobs} - 1)");
    let state = format!("CASE WHEN i % ({jobs} / {WAITING}) = 0 THEN 'queued' ELSE 'done' END");
    let runs = format!(
        "INSERT INTO runs (id, created_ms, asset, chainage_mm, direction, recorded_ms, note, filename, \
         source_extension, source_bytes, source_sha256, rig_name, state, latest_job) \
         {numbers} SELECT {}, i, 'wall', 0, 'forward', i, '', 'a.mp4', 'mp4', 1, '', 'rig', {state}, {} FROM n",
        id("0"),
        id("1")
    );
    let jobs = format!(
        "INSERT INTO jobs (id, run_id, created_ms, priority, rank_ms, rig_name, rig_toml, recipe_name, \
         recipe_toml, state, cancel_requested, not_before_ms, fence, attempt, failures, losses, node, worker, beat, \
         stage, fraction, frames, frames_per_s, warnings) {numbers} SELECT {}, {}, i, 'upload', i, 'rig', '', 'metric', \
         '', {state}, 0, 0, 0, 0, 0, 0, '', '', 0, '', 0, 0, 0, '[]' FROM n",
        id("1"),
        id("0")
    );
    for sql in ["DELETE FROM jobs", "DELETE FROM runs", &runs, &jobs, "ANALYZE"] {
        r.db.read().execute_unprepared(sql).await.expect("fills");
    }
}

/// The median time of each thing that a long life must not make slower.
async fn times(r: &Records, jobs: u32) -> Vec<(&'static str, Duration)> {
    fill(r, jobs).await;
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

/// What each thing takes beside few and beside many jobs, as cells of a table.
async fn scales(r: &Records) -> Vec<(&'static str, String)> {
    let (few, many) = (times(r, 10_000).await, times(r, 1_000_000).await);
    let ms = |d: Duration| d.as_secs_f64() * 1000.0;
    let cells = |few, many| format!("{:.2} | {:.2} | {:.2}", ms(few), ms(many), ms(many) / ms(few));
    few.into_iter().zip(many).map(|((what, few), (_, many))| (what, cells(few, many))).collect()
}

#[tokio::test]
#[ignore = "a bench, and no check: it prints what it measures"]
async fn scale() {
    let sqlite = scales(&records(JobLimits::default()).await).await;
    let url = std::env::var("STRIA_BENCH_DATABASE").expect("STRIA_BENCH_DATABASE names a PostgreSQL");
    let db = Db::open(&DatabasePlace::parse(&url).expect("postgres://USER:PASSWORD@HOST/NAME")).await.expect("opens");
    let r = Records::on(db, JobLimits::default());
    r.db.read().execute_unprepared("INSERT INTO assets (name, created_ms) VALUES ('wall', 0)").await.expect("inserts");
    let postgres = scales(&r).await;
    let columns = |name: &str| format!("{name}: 10,000 jobs, ms | 1,000,000 jobs, ms | ratio");
    println!("| | {} | {} |\n|---|---:|---:|---:|---:|---:|---:|", columns("SQLite"), columns("PostgreSQL"));
    for ((what, sqlite), (_, postgres)) in sqlite.into_iter().zip(postgres) {
        println!("| {what} | {sqlite} | {postgres} |");
    }
}
