//! Several servers and workers share their work and show the same.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};

use serde_json::Value;
use stria_tests::support::cluster::Cluster;
use stria_tests::support::server::{Server, header, send, text};
use stria_tests::support::{eventually, files_below, long_run, run_stria, short_run};

/// Every product of a job is there, with the hash that is told.
pub(super) fn assert_products_whole(server: &Server, job: &str) {
    let products = server.json(&format!("/api/jobs/{job}/products?limit=1000"));
    let products = products["items"].as_array().expect("items");
    assert!(products.len() > 8, "{products:#?}");
    for product in products {
        let bytes = send(server.get(&text(product, "/url"))).bytes().expect("a body");
        let name = text(product, "/name");
        assert_eq!(stria_core::export::manifest::sha256_of_bytes(&bytes), text(product, "/sha256"), "{name}");
    }
}

#[test]
fn two_servers_and_three_workers_share_one_postgresql_and_one_s3() {
    let cluster = Cluster::start();
    // All at once: one of them makes the tables, the others wait for it.
    let (a, b) = std::thread::scope(|scope| {
        let a = scope.spawn(|| cluster.server(&["--workers", "0"]));
        let b = scope.spawn(|| cluster.server(&["--workers", "0"]));
        (a.join().expect("a server"), b.join().expect("a server"))
    });
    // Each says on a port of its own how it is.
    let ports: Vec<u16> = (0..3).map(|_| free_port()).collect();
    let mut workers: Vec<_> = ports
        .iter()
        .map(|port| cluster.worker(&["--slots", "1", "--metrics-listen", &format!("127.0.0.1:{port}")]))
        .collect();
    eventually("the workers are listed by both servers", || {
        [&a, &b].iter().all(|s| s.json("/api/workers").as_array().is_some_and(|all| slots(all) == 3))
    });

    let jobs: Vec<String> = (0..6)
        .map(|i| text(&[&a, &b][i % 2].upload(if i == 0 { long_run() } else { short_run() }, "Wall"), "/job/id"))
        .collect();
    // Whoever watches through the other server sees everything.
    let events = events(&b, &jobs[0]);
    assert!(events.iter().any(|(name, _)| name == "segment"), "{events:?}");
    assert_eq!(events.last().map(|(_, job)| text(job, "/state")).as_deref(), Some("done"));
    for job in &jobs {
        let done = b.wait_for_state(job, "done");
        assert_eq!(done["attempt"], 1, "{done:#}");
        assert_products_whole(&a, job);
        assert_products_whole(&b, job);
    }
    let by: BTreeSet<_> = cluster.ask("SELECT DISTINCT worker FROM jobs").into_iter().collect();
    assert!(by.len() > 1, "one worker did everything: {by:?}");
    let done: u64 = ports.iter().map(|port| jobs_done(*port)).sum();
    assert_eq!(done, jobs.len() as u64, "the workers' own counts");

    // The source comes back byte for byte, also by range.
    let run = text(&a.json(&format!("/api/jobs/{}", jobs[0])), "/run");
    let whole = send(b.get(&format!("/api/runs/{run}/source"))).bytes().expect("a body");
    assert!(whole == long_run().video_bytes());
    let part = send(b.get(&format!("/api/runs/{run}/source")).header("Range", "bytes=10-19"));
    assert_eq!((part.status().as_u16(), header(&part, "content-length").as_str()), (206, "10"));
    assert!(part.bytes().expect("a body") == whole[10..20]);

    // Deleting takes the files out of the bucket, and nothing else lies there.
    let runs: BTreeSet<_> = jobs.iter().map(|job| text(&a.json(&format!("/api/jobs/{job}")), "/run")).collect();
    for run in &runs {
        assert_eq!(send(b.delete(&format!("/api/runs/{run}"))).status(), 204);
    }
    eventually("the bucket is empty", || files_below(&cluster.files()).is_empty());
    for worker in &mut workers {
        assert!(worker.stop().success());
        assert!(files_below(&worker.scratch()).is_empty());
    }
    eventually("stopped workers are no longer listed", || {
        a.json("/api/workers").as_array().is_some_and(|all| slots(all) == 0)
    });
}

fn free_port() -> u16 {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr());
    listener.expect("a free port").port()
}

/// What a worker counted, by its own metrics.
fn jobs_done(port: u16) -> u64 {
    let ask = |path: &str| reqwest::blocking::get(format!("http://127.0.0.1:{port}{path}")).expect("it answers");
    assert_eq!((ask("/livez").status().as_u16(), ask("/readyz").status().as_u16()), (200, 200));
    assert_eq!(ask("/api/runs").status(), 404, "a worker has no other doors");
    let metrics = ask("/metrics").text().expect("text");
    assert!(metrics.ends_with("# EOF\n") && metrics.contains("stria_queue_jobs"), "{metrics}");
    let count = |name: &str| {
        let number = metrics.lines().find_map(|line| line.strip_prefix(name));
        number.map_or(0, |number| number.trim().parse().expect("a number"))
    };
    assert!(count("stria_rings_heard_total ") > 0, "the servers' changes are heard, not only found: {metrics}");
    count("stria_attempts_total{end=\"done\"} ")
}

fn slots(workers: &[Value]) -> u64 {
    workers.iter().filter_map(|w| w["slots"].as_u64()).sum()
}

/// The events of a job until the stream ends: name and data.
fn events(server: &Server, job: &str) -> Vec<(String, Value)> {
    let response = send(server.get(&format!("/api/jobs/{job}/events")));
    let (mut events, mut name) = (Vec::new(), String::new());
    for line in BufReader::new(response).lines() {
        let line = line.expect("text");
        if let Some(event) = line.strip_prefix("event: ") {
            name = event.into();
        } else if let Some(data) = line.strip_prefix("data: ") {
            events.push((name.clone(), serde_json::from_str(data).expect("JSON")));
        }
    }
    events
}

#[test]
fn work_says_what_it_needs() {
    let folder = tempfile::tempdir().expect("folder");
    let data = folder.path().to_str().expect("a plain path");
    for (arguments, expected) in [
        (vec!["work", "--data", data], "--database"),
        (vec!["work", "--data", data, "--database", "sqlite:x.db"], "SQLite serves one machine"),
        (vec!["work", "--data", data, "--database", "mysql://x"], "postgres://"),
        (vec!["work", "--data", data, "--database", "postgres://x@127.0.0.1:1/x"], "--store is missing"),
        (vec!["work", "--data", data, "--database", "postgres://x@127.0.0.1:1/x", "--store", "gs://x"], "s3://"),
        (
            vec!["work", "--data", data, "--database", "postgres://x@127.0.0.1:1/x", "--store", "missing"],
            "no such folder",
        ),
        (vec!["serve", "--data", data, "--database", "oracle"], "postgres://"),
    ] {
        let failed = run_stria(&arguments);
        let said = String::from_utf8_lossy(&failed.stderr).into_owned();
        assert_eq!(failed.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(said.contains(expected), "{arguments:?}: {said}");
    }
}

#[test]
fn an_upload_begun_on_one_server_ends_on_the_other() {
    use base64::Engine;
    let cluster = Cluster::start();
    let (a, b) = (cluster.server(&["--workers", "0"]), cluster.server(&["--workers", "0"]));
    let _worker = cluster.worker(&["--slots", "1"]);
    let video = short_run().video_bytes();
    let coded = |text: &str| base64::prelude::BASE64_STANDARD.encode(text);
    let metadata =
        format!("filename {},asset {},rig {}", coded("video.mp4"), coded("Wall"), coded(&short_run().rig_text()));
    let made = a.post("/api/uploads").header("Tus-Resumable", "1.0.0").header("Upload-Length", video.len().to_string());
    let made = send(made.header("Upload-Metadata", metadata));
    assert_eq!(made.status(), 201);
    let location = header(&made, "location");
    let path = location.strip_prefix(&a.url("")).unwrap_or(&location).to_string();
    let piece = |server: &Server, from: usize, to: usize| {
        let request = server.patch(&path).header("Tus-Resumable", "1.0.0").header("Upload-Offset", from.to_string());
        send(request.header("Content-Type", "application/offset+octet-stream").body(video[from..to].to_vec()))
    };
    let half = video.len() / 2;
    assert_eq!(header(&piece(&a, 0, half), "upload-offset"), half.to_string());
    let seen = send(b.head(&path).header("Tus-Resumable", "1.0.0"));
    assert_eq!(header(&seen, "upload-offset"), half.to_string(), "the other server knows where to go on");
    let whole = piece(&b, half, video.len());
    assert_eq!(whole.status(), 204);
    let (run, job) = (header(&whole, "stria-run"), header(&whole, "stria-job"));
    a.wait_for_state(&job, "done");
    assert_products_whole(&a, &job);
    let source = send(a.get(&format!("/api/runs/{run}/source"))).bytes().expect("a body");
    assert!(source == video, "byte for byte");
}
