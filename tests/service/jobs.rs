//! Jobs: from the queue to their products, watched, cancelled, done again.

use std::io::{BufRead, BufReader};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use stria_tests::support::server::{Server, header, json_of, problem_of, send, text};
use stria_tests::support::{eventually, files_below, long_run, short_run};

#[test]
fn a_run_becomes_products_that_are_what_their_hashes_say() {
    let server = Server::start(&["--workers", "1"]);
    let run = server.upload(short_run(), "Wall");
    let job = server.wait_for_state(&text(&run, "/job/id"), "done");
    assert_eq!((job["progress"].as_f64(), job["attempt"].as_i64()), (Some(1.0), Some(1)));
    assert_eq!(job["quality"]["frames"], 8);
    let base = format!("/api/jobs/{}", text(&job, "/id"));

    let products = server.json(&format!("{base}/products?limit=1000"));
    let products = products["items"].as_array().expect("items");
    let names: Vec<_> = products.iter().map(|p| text(p, "/name")).collect();
    for expected in [
        "manifest.json",
        "depth.tif",
        "depth.png",
        "preview.png",
        "cloud.ply",
        "trajectory.csv",
        "recording.rrd",
        "archive.mcap",
    ] {
        assert!(names.iter().any(|n| n == expected), "{expected} is missing in {names:?}");
    }
    for product in products {
        let response = send(server.get(&text(product, "/url")));
        assert_eq!(header(&response, "etag"), format!("\"{}\"", text(product, "/sha256")));
        assert!(header(&response, "cache-control").contains("immutable"));
        assert_eq!(header(&response, "content-type"), text(product, "/content_type"));
        assert_eq!(header(&response, "x-content-type-options"), "nosniff");
        assert!(header(&response, "content-security-policy").contains("sandbox"));
        let bytes = response.bytes().expect("a body");
        assert_eq!(bytes.len() as u64, product["bytes"].as_u64().expect("a size"));
        let name = text(product, "/name");
        assert_eq!(stria_core::export::manifest::sha256_of_bytes(&bytes), text(product, "/sha256"), "{name}");
    }
    let manifest = server.json(&format!("{base}/products/manifest.json"));
    assert_eq!(manifest["products"].as_array().map(Vec::len), Some(products.len() - 1), "all but itself");
    assert_eq!(text(&manifest, "/source/0/name"), "video.mp4");

    let whole = send(server.get(&format!("{base}/archive.mcap"))).bytes().expect("a body");
    let part = send(server.get(&format!("{base}/products/archive.mcap")).header("Range", "bytes=-8"));
    assert!(part.bytes().expect("a body") == whole[whole.len() - 8..]);

    let recording = server.json(&format!("{base}/recording"));
    assert_eq!(recording["complete"], true);
    let segments = recording["segments"].as_array().expect("segments");
    assert!(!segments.is_empty());
    for (i, segment) in segments.iter().enumerate() {
        assert_eq!(segment["number"], i);
        let bytes = send(server.get(&text(segment, "/url"))).bytes().expect("a body");
        assert_eq!(bytes.len() as u64, segment["bytes"].as_u64().expect("a size"));
        assert!(bytes.starts_with(b"RRF2"), "each segment is an RRD of its own");
    }
    problem_of(send(server.get(&format!("{base}/recording/{}", segments.len()))), 404);
    problem_of(send(server.get(&format!("{base}/recording/x"))), 404);
    for name in ["nothing.tif", "../manifest.json", "..%2F..%2Fsource", "products", ""] {
        assert_eq!(send(server.get(&format!("{base}/products/{name}"))).status(), 404, "{name}");
    }
    eventually("scratch is removed", || files_below(&server.data().join("scratch")).is_empty());

    // Deleting the run takes all its files along.
    assert_eq!(send(server.delete(&format!("/api/runs/{}", text(&run, "/id")))).status(), 204);
    problem_of(send(server.get(&base)), 404);
    let begun = Instant::now();
    while !files_below(&server.data().join("store")).is_empty() {
        assert!(begun.elapsed() < Duration::from_secs(20), "{:?}", files_below(&server.data().join("store")));
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// The events of a job until the stream ends: name and data.
fn events(server: &Server, job: &str) -> Vec<(String, Value)> {
    let response = send(server.get(&format!("/api/jobs/{job}/events")));
    assert_eq!(header(&response, "content-type"), "text/event-stream");
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
fn events_tell_a_job_from_its_start_to_its_end() {
    let server = Server::start(&["--workers", "1"]);
    let run = server.upload(long_run(), "Wall");
    let job = text(&run, "/job/id");
    let live = events(&server, &job);
    let (first, last) = (&live[0], &live[live.len() - 1]);
    assert_eq!(first.0, "state", "the present state comes first");
    assert_eq!((last.1["id"].as_str(), last.1["state"].as_str()), (Some(job.as_str()), Some("done")));
    let states: Vec<_> = live.iter().filter(|e| e.0 == "state").map(|e| text(&e.1, "/state")).collect();
    assert!(states.ends_with(&["running".into(), "done".into()]), "{states:?}");
    let shares: Vec<_> = live.iter().filter(|e| e.0 == "progress").filter_map(|e| e.1["progress"].as_f64()).collect();
    assert!(shares.iter().any(|p| *p > 0.0 && *p < 1.0), "progress shows while the job runs: {shares:?}");
    let numbers: Vec<_> = live.iter().filter(|e| e.0 == "segment").filter_map(|e| e.1["number"].as_u64()).collect();
    assert!(numbers.iter().enumerate().all(|(i, n)| i as u64 == *n) && !numbers.is_empty(), "{numbers:?}");
    assert!(live.iter().any(|e| e.0 == "log"));

    let late = events(&server, &job);
    assert_eq!((late[0].0.as_str(), text(&late[0].1, "/state").as_str()), ("state", "done"));
    assert_eq!(late.iter().filter(|e| e.0 == "segment").count(), numbers.len(), "whoever comes late gets all of it");
    problem_of(send(server.get("/api/jobs/nothing/events")), 404);
}

#[test]
fn segments_can_be_fetched_while_the_job_runs() {
    let server = Server::start(&["--workers", "1"]);
    let job = text(&server.upload(long_run(), "Wall"), "/job/id");
    let path = format!("/api/jobs/{job}/recording");
    let begun = Instant::now();
    let segment = loop {
        let recording = server.json(&path);
        if let Some(segment) = recording["segments"].get(0) {
            assert_eq!(recording["complete"], false, "the first segment comes before the job's end");
            break segment.clone();
        }
        assert!(begun.elapsed() < Duration::from_secs(60));
        std::thread::sleep(Duration::from_millis(10));
    };
    assert!(send(server.get(&text(&segment, "/url"))).bytes().expect("a body").starts_with(b"RRF2"));
    server.wait_for_state(&job, "done");
}

#[test]
fn cancelling_stops_a_job_within_a_second() {
    let server = Server::start(&["--workers", "1"]);
    let (running, waiting) = (server.upload(long_run(), "Wall"), server.upload(short_run(), "Wall"));
    let (running, waiting) = (text(&running, "/job/id"), text(&waiting, "/job/id"));
    server.wait_for(&running, "at work", |job| job["progress"].as_f64().is_some_and(|p| p > 0.0));
    json_of(send(server.post(&format!("/api/jobs/{waiting}/cancel"))), 202);
    server.wait_for_state(&waiting, "cancelled");

    let children = server.children();
    assert_eq!(children.len(), 1);
    let asked = Instant::now();
    json_of(send(server.post(&format!("/api/jobs/{running}/cancel"))), 202);
    server.wait_for_state(&running, "cancelled");
    let took = asked.elapsed();
    assert!(took < Duration::from_millis(1500), "it took {took:?}");
    assert!(!stria_tests::support::server::is_alive(children[0]));
    assert_eq!(server.json(&format!("/api/jobs/{running}/products"))["items"].as_array().map(Vec::len), Some(0));
    let begun = Instant::now();
    while !files_below(&server.data().join("scratch")).is_empty()
        || !files_below(&server.data().join("store/jobs")).is_empty()
    {
        assert!(begun.elapsed() < Duration::from_secs(10), "{:?}", files_below(&server.data()));
        std::thread::sleep(Duration::from_millis(50));
    }

    json_of(send(server.post(&format!("/api/jobs/{waiting}/retry"))), 202);
    server.wait_for_state(&waiting, "done");
    problem_of(send(server.post(&format!("/api/jobs/{waiting}/retry"))), 409);
    problem_of(send(server.post(&format!("/api/jobs/{waiting}/cancel"))), 409);
    problem_of(send(server.post("/api/jobs/nothing/cancel")), 404);
}

#[test]
fn a_run_that_is_deleted_takes_its_running_job_along() {
    let server = Server::start(&["--workers", "1"]);
    let run = server.upload(long_run(), "Wall");
    server.wait_for(&text(&run, "/job/id"), "at work", |job| job["progress"].as_f64().is_some_and(|p| p > 0.0));
    let child = server.children()[0];
    assert_eq!(send(server.delete(&format!("/api/runs/{}", text(&run, "/id")))).status(), 204);
    let begun = Instant::now();
    while stria_tests::support::server::is_alive(child) {
        assert!(begun.elapsed() < Duration::from_secs(5), "the child goes on");
        std::thread::sleep(Duration::from_millis(20));
    }
    let next = server.upload(short_run(), "Wall");
    server.wait_for_state(&text(&next, "/job/id"), "done");
}

#[test]
fn a_run_is_processed_again_with_another_recipe() {
    let server = Server::start(&["--workers", "1"]);
    let run = server.upload(short_run(), "Wall");
    let first = server.wait_for_state(&text(&run, "/job/id"), "done");
    let path = format!("/api/runs/{}/jobs", text(&run, "/id"));
    let again = |body: &Value, key: &str| send(server.post(&path).header("Idempotency-Key", key).json(body));
    let recipe = json!({"recipe": "[stripe]\nk = 0.8\nkeep = true\n", "priority": "batch"});
    let second = json_of(again(&recipe, "a"), 201);
    assert_eq!(json_of(again(&recipe, "a"), 201)["id"], second["id"]);
    problem_of(again(&json!({"recipe": "paper"}), "a"), 422);
    problem_of(again(&json!({"recipe": "nonsense"}), "b"), 400);
    problem_of(again(&json!({"recpe": "paper"}), "c"), 400);
    assert_eq!((text(&second, "/recipe").as_str(), text(&second, "/priority").as_str()), ("custom", "batch"));
    let second = server.wait_for_state(&text(&second, "/id"), "done");
    let manifest = server.json(&format!("/api/jobs/{}/products/manifest.json", text(&second, "/id")));
    assert_eq!(manifest["recipe"]["stripe"]["k"], 0.8);
    let now = server.json(&format!("/api/runs/{}", text(&run, "/id")));
    assert_eq!(now["job"]["id"], second["id"], "the run shows its latest job");
    let jobs = server.json(&format!("/api/jobs?run={}", text(&run, "/id")));
    assert_eq!(jobs["items"].as_array().map(Vec::len), Some(2));
    // The first result is still there, unchanged.
    assert_eq!(send(server.get(&format!("/api/jobs/{}/products/depth.tif", text(&first, "/id")))).status(), 200);
}
