//! What is kept and for how long; copies of everything.

use serde_json::{Value, json};
use stria_tests::support::server::{Server, json_of, problem_of, read, send, text};
use stria_tests::support::{eventually, files_below, run_stria, short_run};

fn done_run(server: &Server, asset: &str) -> String {
    let run = server.upload(short_run(), asset);
    server.wait_for_state(&text(&run, "/job/id"), "done");
    text(&run, "/id")
}

fn runs(server: &Server) -> Vec<String> {
    let all = server.json("/api/runs");
    all["items"].as_array().expect("items").iter().map(|r| text(r, "/id")).collect()
}

#[test]
fn a_policy_tells_beforehand_what_it_deletes_and_pinned_runs_stay() {
    let mut server = Server::start(&["--workers", "1"]);
    let old: Vec<String> = (0..3).map(|_| done_run(&server, "Wall")).collect();
    json_of(send(server.put(&format!("/api/runs/{}/pin", old[0]))), 200);
    assert_eq!(server.json(&format!("/api/runs/{}/pin", old[0]))["pinned"], true);
    problem_of(send(server.put("/api/runs/nothing/pin")), 404);

    let nothing = server.json("/api/retention");
    assert_eq!((nothing["runs"].as_u64(), nothing["keep_days"].as_f64()), (Some(0), None));
    let stored = nothing["stored_bytes"].as_u64().expect("bytes");
    let on_disk: usize = files_below(&server.data().join("store"))
        .iter()
        .filter(|f| f.starts_with("runs/") || (f.contains("/products/") && !f.contains("/live/")))
        .map(|f| read(&server.data().join("store").join(f)).len())
        .sum();
    assert_eq!(stored as usize, on_disk);
    let by_age = server.json("/api/retention?keep_days=0");
    let listed: Vec<String> = by_age["items"].as_array().expect("items").iter().map(|i| text(i, "/run")).collect();
    assert_eq!(listed, [old[1].clone(), old[2].clone()], "the oldest first, the pinned one not at all");
    // Room for all but one: only the oldest that is not pinned goes.
    let quota_gb = (stored - 1) as f64 / 1e9;
    let by_size = server.json(&format!("/api/retention?quota_gb={quota_gb}"));
    assert_eq!((by_size["runs"].as_u64(), by_size["items"][0]["run"].as_str()), (Some(1), Some(old[1].as_str())));
    assert!(by_size["freed_bytes"].as_u64().expect("bytes") > 1000);
    problem_of(send(server.get("/api/retention?keep_days=-1")), 400);
    assert_eq!(runs(&server).len(), 3, "asking deletes nothing");

    server.stop();
    server.add_flags(&["--quota-gb", &format!("{quota_gb:.12}")]);
    server.start_again();
    eventually("the policy is applied", || runs(&server).len() == 2);
    assert_eq!(runs(&server), [old[2].clone(), old[0].clone()]);
    let gone = old[1].clone();
    eventually("its files go too", || !files_below(&server.data().join("store")).iter().any(|f| f.contains(&gone)));
}

#[test]
fn rules_stored_by_people_hold_over_the_flags_until_they_are_given_up() {
    let mut server = Server::start(&["--workers", "1", "--keep-days", "3000"]);
    let old: Vec<String> = (0..3).map(|_| done_run(&server, "Wall")).collect();
    json_of(send(server.put(&format!("/api/runs/{}/pin", old[2]))), 200);
    let first = server.json("/api/retention")["rules"].clone();
    assert_eq!((text(&first, "/origin"), first["keep_days"].as_f64()), ("server".into(), Some(3000.0)));
    assert!(first["changed_at"].is_null() && first["changed_by"].is_null(), "{first}");

    // Beforehand: what other rules alone would delete, not those beside the ones that hold.
    let stored = server.json("/api/retention")["stored_bytes"].as_u64().expect("bytes");
    let quota_gb = (stored - 1) as f64 / 1e9;
    let path = format!("/api/retention?exactly=true&quota_gb={quota_gb}");
    let preview = server.json(&path);
    assert_eq!((preview["runs"].as_u64(), preview["keep_days"].as_f64()), (Some(1), None));
    assert_eq!(text(&preview, "/items/0/run"), old[0]);
    assert_eq!(preview["rules"], first, "asking stores nothing");

    let version = |rules: &Value| format!("\"{}\"", text(rules, "/version"));
    let put = |body: Value, seen: &str| send(server.put("/api/retention").header("If-Match", seen).json(&body));
    for (body, field) in [
        (json!({"keep_days": 0}), "keep_days"),
        (json!({"keep_days": 1e7}), "keep_days"),
        (json!({"quota_gb": -3}), "quota_gb"),
        (json!({"quota_gb": "much"}), "body"),
        (json!({"keep_weeks": 3}), "body"),
    ] {
        let problem = problem_of(put(body.clone(), &version(&first)), 400);
        assert!(problem["field"] == field && problem["expected"].is_string(), "{body}: {problem}");
    }
    problem_of(put(json!({"keep_days": 1}), "\"another\""), 412);
    assert_eq!(runs(&server).len(), 3);

    let answer = json_of(put(json!({"keep_days": null, "quota_gb": quota_gb}), &version(&first)), 200);
    let second = answer["rules"].clone();
    assert_eq!((text(&second, "/origin"), second["keep_days"].as_f64()), ("stored".into(), None));
    assert_eq!((second["own_keep_days"].as_f64(), second["own_quota_gb"].as_f64()), (Some(3000.0), None));
    assert!(second["changed_at"].is_string() && second["changed_by"].is_string(), "{second}");
    problem_of(put(json!({"keep_days": 1}), &version(&first)), 412);
    eventually("the new rules are applied without a new start", || runs(&server).len() == 2);
    assert_eq!(runs(&server), [old[2].clone(), old[1].clone()], "the oldest that is not pinned");

    // They outlast the process, whatever its flags say.
    server.stop();
    server.start_again();
    assert_eq!(server.json("/api/retention")["rules"], second);
    let forget = |seen: &str| send(server.delete("/api/retention").header("If-Match", seen));
    problem_of(forget(&version(&first)), 412);
    let third = json_of(forget(&version(&second)), 200)["rules"].clone();
    assert_eq!((text(&third, "/origin"), third["keep_days"].as_f64()), ("server".into(), Some(3000.0)));
    assert_ne!(third["version"], second["version"]);
    assert!(third["changed_at"].is_string(), "since when they hold again: {third}");

    let log = server.json("/api/audit");
    let deeds = log["items"].as_array().expect("items").iter().filter(|l| text(l, "/path") == "/api/retention");
    let told: Vec<(String, u64)> = deeds.map(|l| (text(l, "/method"), l["status"].as_u64().expect("status"))).collect();
    assert!(told.contains(&("PUT".into(), 200)) && told.contains(&("DELETE".into(), 200)), "{told:?}");
}

/// What people see of a run and its job.
fn seen(server: &Server, run: &str) -> (Value, Value) {
    let run = server.json(&format!("/api/runs/{run}"));
    let products = server.json(&format!("/api/jobs/{}/products?limit=1000", text(&run, "/job/id")));
    (run, products)
}

#[test]
fn a_backup_taken_while_the_server_runs_comes_back_whole() {
    let mut server = Server::start(&["--workers", "1"]);
    let run = done_run(&server, "Wall");
    let before = seen(&server, &run);
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("plain").to_string();
    let data = server.data().to_str().expect("plain").to_string();
    let says = |arguments: &[&str]| {
        let done = run_stria(arguments);
        let said = String::from_utf8_lossy(&[done.stdout, done.stderr].concat()).into_owned();
        (done.status.code(), said)
    };
    let (code, said) = says(&["backup", "--data", &data, "--out", &path("copy")]);
    assert!(code == Some(0) && said.contains("1 runs, 1 jobs"), "{said}");
    assert_eq!(
        says(&["backup", "--data", &data, "--out", &path("copy")]).0,
        Some(2),
        "a copy is never mixed with another"
    );
    assert_eq!(says(&["restore", &path("copy"), "--check"]).0, Some(0));
    server.kill();

    let mut other = Server::stopped(&["--workers", "0"]);
    let new = other.data().to_str().expect("plain").to_string();
    let (code, said) = says(&["restore", &path("copy"), "--data", &new]);
    assert_eq!(code, Some(0), "{said}");
    assert_eq!(says(&["restore", &path("copy"), "--data", &new]).0, Some(1), "not over what is there");
    other.start_again();
    assert_eq!(seen(&other, &run), before);
    let source = send(other.get(&format!("/api/runs/{run}/source"))).bytes().expect("a body");
    assert!(source == short_run().video_bytes());

    // A copy that lost a byte is no copy.
    let files = folder.path().join("copy/files");
    let product = files_below(&files).into_iter().find(|f| f.ends_with("depth.tif")).expect("a product");
    let mut bytes = read(&files.join(&product));
    *bytes.last_mut().expect("bytes") ^= 1;
    std::fs::write(files.join(&product), bytes).expect("writes");
    let (code, said) = says(&["restore", &path("copy"), "--check"]);
    assert!(code == Some(1) && said.contains("depth.tif"), "{said}");
    assert_eq!(says(&["restore", &path("nothing"), "--check"]).0, Some(1));
}
