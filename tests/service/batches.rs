//! Reprocessing in bulk, through the real service.

use serde_json::{Value, json};
use stria_tests::support::server::{Server, json_of, problem_of, send, text};
use stria_tests::support::{eventually, short_run};

fn batch(server: &Server, body: &Value) -> Value {
    json_of(send(server.post("/api/batches").json(body)), 201)
}

#[test]
fn a_batch_processes_what_its_filter_finds_and_tells_the_difference() {
    let server = Server::start(&["--workers", "1"]);
    let runs: Vec<Value> = ["North", "North", "South"].map(|asset| server.upload(short_run(), asset)).into();
    for run in &runs {
        server.wait_for_state(&text(run, "/job/id"), "done");
    }
    let wish = |dry: bool| json!({"filter": {"asset": "North", "state": "done"}, "recipe": "paper", "dry_run": dry});
    assert_eq!(json_of(send(server.post("/api/batches").json(&wish(true))), 200)["runs"], 2);
    assert_eq!(server.json("/api/batches")["items"].as_array().map(Vec::len), Some(0), "a dry run makes nothing");

    let made = batch(&server, &wish(false));
    let path = format!("/api/batches/{}", text(&made, "/id"));
    eventually("the batch is done", || server.json(&path)["state"] == "done");
    let done = server.json(&path);
    assert_eq!((done["jobs"]["done"].as_u64(), done["runs"].as_u64()), (Some(2), Some(2)), "{done:#}");
    let results = server.json(&format!("{path}/results"));
    for result in results["items"].as_array().expect("items") {
        let (job, base) = (text(result, "/job"), text(result, "/base_job"));
        assert_eq!(server.json(&format!("/api/jobs/{job}"))["recipe"], "paper");
        // Both results are there, side by side.
        for job in [&job, &base] {
            assert_eq!(send(server.get(&format!("/api/jobs/{job}/products/depth.tif"))).status(), 200);
        }
        let figure = |part: &str| result[part]["coverage"].as_f64().expect("a figure");
        assert_eq!(result["difference"]["coverage"].as_f64(), Some(figure("after") - figure("before")));
        let run = server.json(&format!("/api/runs/{}", text(result, "/run")));
        assert_eq!(text(&run, "/job/id"), job, "the run shows the new result");
    }
    let other = server.json(&format!("/api/jobs?run={}", text(&runs[2], "/id")));
    assert_eq!(other["items"].as_array().map(Vec::len), Some(1), "other runs are left alone");
}

#[test]
fn a_batch_can_be_paused_resumed_and_cancelled() {
    let server = Server::start(&["--workers", "0"]);
    let runs: Vec<String> = (0..3).map(|_| text(&server.upload(short_run(), "Wall"), "/id")).collect();
    let made = batch(&server, &json!({"runs": runs, "note": "a new rig"}));
    let path = format!("/api/batches/{}", text(&made, "/id"));
    let reaches = |state: &str| eventually(state, || server.json(&path)["state"] == state);
    reaches("running");
    json_of(send(server.post(&format!("{path}/pause"))), 202);
    reaches("paused");
    assert_eq!(server.json("/api/jobs?state=paused")["items"].as_array().map(Vec::len), Some(3));
    json_of(send(server.post(&format!("{path}/resume"))), 202);
    reaches("running");
    json_of(send(server.post(&format!("{path}/cancel"))), 202);
    reaches("cancelled");
    problem_of(send(server.post(&format!("{path}/resume"))), 409);
    problem_of(send(server.post("/api/batches/nothing/pause")), 404);
    assert_eq!(
        server.json("/api/jobs?state=queued")["items"].as_array().map(Vec::len),
        Some(3),
        "the runs' own jobs wait"
    );
    for (body, field) in [
        (json!({}), "filter"),
        (json!({"runs": []}), "runs"),
        (json!({"runs": ["nothing"]}), "runs"),
        (json!({"filter": {}, "recipe": "fast"}), "recipe"),
        (json!({"filter": {}, "rig": "nothing"}), "rig"),
        (json!({"filter": {"state": "gone"}}), "body"),
        (json!({"filter": {"from": "yesterday"}}), "from"),
    ] {
        let refused = problem_of(send(server.post("/api/batches").json(&body)), 400);
        assert_eq!(text(&refused, "/field"), field, "{refused:#}");
    }
}
