//! kill -9 and SIGSTOP at random moments, of everything: every job ends done, once, whole.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde_json::Value;
use stria_tests::support::cluster::{Cluster, WorkerProcess};
use stria_tests::support::dice::Dice;
use stria_tests::support::server::{Server, is_alive, read, send, signal, text};
use stria_tests::support::{eventually, files_below, form, short_run};

/// Jobs of one loop.
const JOBS: usize = 200;
/// Uploads on their way in one step.
const UPLOADS_A_STEP: usize = 6;
/// A worker without a sign of life for this long has lost its job.
const LEASE_S: &str = "2";
/// Longer than a lease.
const PAUSED: Duration = Duration::from_millis(3500);
/// A job whose process was killed three times counts as failed: no job's process is killed more often than this.
const KILLS_OF_ONE_CHILD: u32 = 2;
/// After this long without the last job done, something hangs.
const PATIENCE: Duration = Duration::from_secs(900);

/// What the loop strikes.
struct Site {
    server: Server,
    workers: Vec<WorkerProcess>,
    child_kills: BTreeMap<String, u32>,
    strikes: BTreeMap<&'static str, u32>,
}

impl Site {
    fn new(server: Server, workers: Vec<WorkerProcess>) -> Site {
        Site { server, workers, child_kills: BTreeMap::new(), strikes: BTreeMap::new() }
    }

    fn strike(&mut self, dice: &mut Dice) {
        // A server without workers beside it works itself.
        let worker = (!self.workers.is_empty()).then(|| dice.throw(self.workers.len()));
        let what = match dice.throw(8) {
            0 | 1 => {
                self.server.kill();
                wait(dice, 300);
                self.server.start_again();
                "server killed"
            }
            2 | 3 => match worker {
                Some(i) => {
                    self.workers[i].kill();
                    wait(dice, 300);
                    self.workers[i].start_again();
                    "worker killed"
                }
                None => return,
            },
            4 => {
                let id = worker.map_or_else(|| self.server.id(), |i| self.workers[i].id());
                pause(id);
                "worker paused"
            }
            5 => match self.children().first() {
                Some(child) => {
                    pause(*child);
                    "child paused"
                }
                None => return,
            },
            _ => match self.child_to_kill() {
                Some(child) => {
                    signal("KILL", child);
                    "child killed"
                }
                None => return,
            },
        };
        *self.strikes.entry(what).or_default() += 1;
    }

    fn children(&self) -> Vec<u32> {
        self.workers.iter().flat_map(WorkerProcess::children).chain(self.server.children()).collect()
    }

    /// A child whose job was not struck too often.
    fn child_to_kill(&mut self) -> Option<u32> {
        for child in self.children() {
            let Some(job) = job_of(child) else { continue };
            let kills = self.child_kills.entry(job).or_default();
            if *kills < KILLS_OF_ONE_CHILD {
                *kills += 1;
                return Some(child);
            }
        }
        None
    }
}

/// The job that a child works on: its folder is called by it.
fn job_of(child: u32) -> Option<String> {
    let words = std::fs::read(format!("/proc/{child}/cmdline")).ok()?;
    let words = String::from_utf8_lossy(&words).into_owned();
    let folder = words.split('\0').find(|word| word.ends_with("/rig.toml"))?.strip_suffix("/rig.toml")?.to_string();
    Some(folder.rsplit('/').next()?.split('.').next()?.to_string())
}

fn wait(dice: &mut Dice, most_ms: usize) {
    std::thread::sleep(Duration::from_millis(dice.throw(most_ms) as u64));
}

/// Stops a process for a while; the other strikes go on meanwhile.
fn pause(process: u32) {
    signal("STOP", process);
    std::thread::spawn(move || {
        std::thread::sleep(PAUSED);
        signal("CONT", process);
    });
}

/// Sends run `number`, or hears that it is there; `None` where the server went away.
fn upload(url: &str, number: usize) -> Option<String> {
    let client = reqwest::blocking::Client::builder().timeout(Duration::from_secs(20)).build().expect("a client");
    let fields = [("asset", &*format!("Wall {}", number % 10)), ("rig", &*short_run().rig_text())];
    let body = form::form(&fields, &format!("{number}.mp4"), &short_run().video_bytes());
    let request = client.post(format!("{url}/api/runs")).header("Content-Type", form::content_type());
    let answer = request.header("Idempotency-Key", format!("run {number}")).body(body).send().ok()?;
    let status = answer.status().as_u16();
    let body = answer.text().ok()?;
    assert!(status == 201 || status == 503, "{status}: {body}");
    let run: Value = serde_json::from_str(&body).ok()?;
    run.pointer("/job/id").and_then(Value::as_str).map(Into::into)
}

/// All jobs in, struck at all the time; what they are called.
fn storm(site: &mut Site, dice: &mut Dice) -> Vec<String> {
    let mut jobs: Vec<Option<String>> = vec![None; JOBS];
    let begun = Instant::now();
    loop {
        let missing: Vec<usize> = (0..JOBS).filter(|i| jobs[*i].is_none()).take(UPLOADS_A_STEP).collect();
        let url = site.server.url("");
        let arrived: Vec<(usize, Option<String>)> = std::thread::scope(|scope| {
            let sent: Vec<_> = missing
                .iter()
                .map(|i| {
                    scope.spawn({
                        let url = &url;
                        move || (*i, upload(url, *i))
                    })
                })
                .collect();
            wait(dice, 1600);
            site.strike(dice);
            sent.into_iter().map(|thread| thread.join().expect("no refusal")).collect()
        });
        for (i, job) in arrived {
            jobs[i] = job;
        }
        if missing.is_empty() && open_jobs(&site.server) == 0 {
            return jobs.into_iter().flatten().collect();
        }
        assert!(begun.elapsed() < PATIENCE, "{} jobs are open; struck: {:?}", open_jobs(&site.server), site.strikes);
    }
}

/// Jobs that wait or work, in one look: in two, one that goes back to the queue in between would be in neither.
fn open_jobs(server: &Server) -> usize {
    let jobs = server.json("/api/jobs?limit=1000");
    let jobs = jobs["items"].as_array().expect("items");
    jobs.iter().filter(|job| ["queued", "running"].contains(&&*text(job, "/state"))).count()
}

/// Everything that the loop promises, from the files' own side.
fn assert_all_done_once(site: &Site, jobs: &[String], files: &Path) {
    assert_eq!(jobs.iter().collect::<BTreeSet<_>>().len(), JOBS);
    for list in ["jobs", "runs"] {
        let all = site.server.json(&format!("/api/{list}?limit=1000"));
        assert_eq!(all["items"].as_array().map(Vec::len), Some(JOBS), "an upload became two {list}");
    }
    let mut repeated = 0;
    for id in jobs {
        let job = site.server.json(&format!("/api/jobs/{id}"));
        assert_eq!(text(&job, "/state"), "done", "{job:#}");
        let attempt = job["attempt"].as_u64().expect("a number");
        assert!(attempt <= 12, "{job:#}");
        repeated += usize::from(attempt > 1);
        let log = site.server.json(&format!("/api/jobs/{id}/log?limit=1000"));
        let log = log["items"].as_array().expect("items");
        assert_eq!(log.iter().filter(|l| text(l, "/text").contains("is done")).count(), 1, "{log:#?}");
        assert_whole(&site.server, id, files);
    }
    println!("struck: {:?}; {repeated} of {JOBS} jobs needed more than one attempt", site.strikes);
    assert!(repeated > 0, "the loop struck nothing");
}

/// The published attempt's folder holds just the listed products, with their hashes.
fn assert_whole(server: &Server, job: &str, files: &Path) {
    let recording = server.json(&format!("/api/jobs/{job}/recording"));
    let fence = recording["segments"][0]["generation"].as_u64().expect("a segment");
    let folder: PathBuf = files.join(format!("jobs/{job}/{fence:06}/products"));
    let products = server.json(&format!("/api/jobs/{job}/products?limit=1000"));
    let products = products["items"].as_array().expect("items");
    let names: BTreeSet<String> = products.iter().map(|p| text(p, "/name")).collect();
    // The newest frame is shown while a job works, and is no product.
    let there = files_below(&folder).into_iter().filter(|file| !file.starts_with("live/"));
    assert_eq!(names, there.collect());
    for product in products {
        let bytes = read(&folder.join(text(product, "/name")));
        let name = text(product, "/name");
        assert_eq!(stria_core::export::manifest::sha256_of_bytes(&bytes), text(product, "/sha256"), "{job} {name}");
    }
    let manifest = send(server.get(&format!("/api/jobs/{job}/products/manifest.json")));
    assert_eq!(manifest.status(), 200);
}

#[test]
fn two_hundred_jobs_survive_kill_and_pause_on_postgresql_and_s3() {
    let mut dice = Dice::new();
    let cluster = Cluster::start();
    let flags = ["--lease-s", LEASE_S];
    let server = cluster.server(&["--workers", "0", flags[0], flags[1]]);
    let workers = (0..2).map(|_| cluster.worker(&["--slots", "2", flags[0], flags[1]])).collect();
    let mut site = Site::new(server, workers);
    let jobs = storm(&mut site, &mut dice);
    assert_all_done_once(&site, &jobs, &cluster.files());

    let over = cluster.ask("SELECT id, failures, losses FROM jobs WHERE failures >= 3 OR losses >= 10");
    assert!(over.is_empty(), "jobs over their attempts: {over:?}");
    // What is left of dead attempts is known, and will be deleted: no file lies there unseen.
    let known: BTreeSet<_> = cluster.ask("SELECT prefix FROM unpublished").into_iter().collect();
    let published: BTreeSet<_> = cluster
        .ask("SELECT 'jobs/' || id || '/' || lpad(result_fence::text, 6, '0') || '/' FROM jobs")
        .into_iter()
        .collect();
    let unseen = || -> Vec<String> {
        let files = files_below(&cluster.files());
        let attempts = files
            .iter()
            .filter(|f| f.starts_with("jobs/"))
            .map(|f| f.splitn(4, '/').take(3).collect::<Vec<_>>().join("/") + "/");
        attempts.filter(|prefix| !known.contains(prefix) && !published.contains(prefix)).collect()
    };
    eventually("every file belongs to a result or is marked for deletion", || unseen().is_empty());
    let children = site.children();
    for worker in &mut site.workers {
        assert!(worker.stop().success());
        assert!(files_below(&worker.scratch()).is_empty(), "{:?}", files_below(&worker.scratch()));
    }
    assert!(children.iter().all(|child| !is_alive(*child)));
}

#[test]
fn two_hundred_jobs_survive_kill_and_pause_on_sqlite_and_a_folder() {
    let mut dice = Dice::new();
    let mut site = Site::new(Server::start(&["--workers", "4", "--lease-s", LEASE_S]), Vec::new());
    let jobs = storm(&mut site, &mut dice);
    let files = site.server.data().join("store");
    assert_all_done_once(&site, &jobs, &files);
    eventually("scratch is removed", || files_below(&site.server.data().join("scratch")).is_empty());
}
