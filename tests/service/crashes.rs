//! kill -9 of the server or the child at any moment: after a restart the job completes, once.

use std::time::{Duration, Instant};

use serde_json::Value;
use stria_tests::support::server::{Server, is_alive, send, signal, text};
use stria_tests::support::{files_below, long_run};

/// The job is done, all it made is there, and nothing else is.
fn assert_done_once(server: &Server, job: &Value) {
    let base = format!("/api/jobs/{}", text(job, "/id"));
    let products = server.json(&format!("{base}/products?limit=1000"));
    let products = products["items"].as_array().expect("items");
    assert!(products.len() > 8);
    for product in products {
        let bytes = send(server.get(&text(product, "/url"))).bytes().expect("a body");
        assert_eq!(bytes.len() as u64, product["bytes"].as_u64().expect("a size"));
    }
    assert_eq!(server.json("/api/jobs")["items"].as_array().map(Vec::len), Some(1));
    let log = server.json(&format!("{base}/log"));
    let ends = log["items"].as_array().expect("items").iter().filter(|l| text(l, "/text").contains("is done")).count();
    assert_eq!(ends, 1, "{log:#}");
    // What dead attempts left is cleaned up: files of one attempt remain.
    let begun = Instant::now();
    loop {
        let files = files_below(&server.data().join("store/jobs"));
        let attempts: std::collections::BTreeSet<_> = files.iter().filter_map(|f| f.split('/').nth(1)).collect();
        if attempts.len() == 1 && files_below(&server.data().join("scratch")).is_empty() {
            return;
        }
        assert!(begun.elapsed() < Duration::from_secs(20), "left behind: {files:?}");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn a_job_survives_the_death_of_its_server_at_any_moment() {
    let mut server = Server::start(&["--workers", "1"]);
    let run = server.upload(long_run(), "Wall");
    let job = text(&run, "/job/id");
    let share =
        |at_least: f64| move |j: &Value| j["progress"].as_f64().is_some_and(|p| p >= at_least) || j["state"] == "done";
    // At the claim, in the middle, near the end, while products go into the store.
    for at_least in [0.0, 0.3, 0.8, 1.0] {
        server.wait_for(&job, "far enough", share(at_least));
        let children = server.children();
        server.kill();
        let begun = Instant::now();
        while children.iter().any(|child| is_alive(*child)) {
            assert!(begun.elapsed() < Duration::from_secs(5), "a child outlives its server");
            std::thread::sleep(Duration::from_millis(10));
        }
        server.start_again();
    }
    let done = server.wait_for_state(&job, "done");
    assert_done_once(&server, &done);
}

#[test]
fn a_job_survives_the_death_of_its_child() {
    let server = Server::start(&["--workers", "1"]);
    let job = text(&server.upload(long_run(), "Wall"), "/job/id");
    server.wait_for(&job, "at work", |j| j["progress"].as_f64().is_some_and(|p| p > 0.2));
    signal("KILL", server.children()[0]);
    let between = server.wait_for(&job, "on its second attempt", |j| j["error"].is_object() || j["attempt"] == 2);
    if between["error"].is_object() {
        assert!(text(&between, "/error/detail").contains("SIGKILL"), "{between:#}");
    }
    let done = server.wait_for_state(&job, "done");
    assert_eq!(done["attempt"], 2);
    assert_done_once(&server, &done);
}

#[test]
fn a_clean_stop_costs_no_attempt_and_leaves_no_child() {
    let mut server = Server::start(&["--workers", "1"]);
    let job = text(&server.upload(long_run(), "Wall"), "/job/id");
    for _ in 0..2 {
        server.wait_for(&job, "at work", |j| j["progress"].as_f64().is_some_and(|p| p > 0.1));
        let children = server.children();
        let asked = Instant::now();
        assert!(server.stop().success());
        assert!(asked.elapsed() < Duration::from_secs(8), "{:?}", asked.elapsed());
        assert!(children.iter().all(|child| !is_alive(*child)));
        assert!(files_below(&server.data().join("scratch")).is_empty());
        server.start_again();
    }
    let done = server.wait_for_state(&job, "done");
    assert_eq!(done["attempt"], 1);
    assert_done_once(&server, &done);
}

#[test]
fn a_job_that_takes_too_long_or_too_much_fails_with_the_reason() {
    // 0.36 s.
    let server = Server::start(&["--workers", "1", "--job-time-limit-h", "0.0001"]);
    let job = text(&server.upload(long_run(), "Wall"), "/job/id");
    let failed = server.wait_for_state(&job, "failed");
    assert_eq!(text(&failed, "/error/type"), "urn:stria:job:time_limit");
    assert!(server.children().is_empty());

    let server = Server::start(&["--workers", "1", "--job-memory-limit-gb", "0.02"]);
    let job = text(&server.upload(long_run(), "Wall"), "/job/id");
    let failed = server.wait_for_state(&job, "failed");
    assert_eq!(failed["attempt"], 3, "it may have been another's memory: {failed:#}");
    assert_eq!(text(&failed, "/error/type"), "urn:stria:job:out_of_memory");
    assert!(text(&failed, "/error/detail").contains("0.02 GB"), "the limit is named: {failed:#}");
}

#[test]
fn a_job_whose_process_always_dies_ends_with_the_reason() {
    let server = Server::start(&["--workers", "1"]);
    let job = text(&server.upload(long_run(), "Wall"), "/job/id");
    let mut killed = Vec::new();
    let failed = loop {
        let now = server.json(&format!("/api/jobs/{job}"));
        if now["state"] == "failed" {
            break now;
        }
        assert!(matches!(now["state"].as_str(), Some("queued" | "running")), "{now:#}");
        for child in server.children().into_iter().filter(|child| !killed.contains(child)).collect::<Vec<_>>() {
            signal("SEGV", child);
            killed.push(child);
        }
        std::thread::sleep(Duration::from_millis(10));
    };
    assert_eq!(failed["attempt"], 3, "{failed:#}");
    assert_eq!(text(&failed, "/error/type"), "urn:stria:job:killed");
    assert!(text(&failed, "/error/detail").contains("signal 11 (SIGSEGV)"), "{failed:#}");
    assert_eq!(failed["error"]["retryable"], false);
}

#[test]
fn a_job_that_always_takes_its_worker_along_ends_with_the_reason() {
    let mut server = Server::start(&["--workers", "1", "--max-losses", "2"]);
    let job = text(&server.upload(long_run(), "Wall"), "/job/id");
    for attempt in 1..=2 {
        server.wait_for(&job, "at work", |j| j["state"] == "running" && j["attempt"] == attempt);
        server.kill();
        server.start_again();
    }
    let failed = server.wait_for_state(&job, "failed");
    assert_eq!(text(&failed, "/error/type"), "urn:stria:job:lost");
    assert!(text(&failed, "/error/detail").contains("2 of at most 2"), "{failed:#}");
}
