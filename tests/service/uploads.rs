//! Runs come in, and come back byte for byte.

use stria_tests::support::form::{content_type, form};
use stria_tests::support::server::{Server, header, json_of, problem_of, send, text};
use stria_tests::support::short_run;

/// A server that takes runs and lets their jobs wait.
fn storing_server() -> Server {
    Server::start(&["--workers", "0"])
}

#[test]
fn a_form_and_a_raw_body_make_the_same_run() {
    let server = storing_server();
    let (video, rig) = (short_run().video_bytes(), short_run().rig_text());
    let fields = [
        ("asset", "Pipe 7"),
        ("chainage_mm", "12500.5"),
        ("direction", "backward"),
        ("recorded_at", "2026-05-17T10:30:00+02:00"),
        ("recipe", "paper-literal"),
        ("note", "after rain"),
        ("rig", rig.as_str()),
    ];
    let body = form(&fields, "Süd \"7\".mp4", &video);
    let by_form = send(server.post("/api/runs").header("Content-Type", content_type()).body(body));
    let (named_run, named_job) = (header(&by_form, "stria-run"), header(&by_form, "stria-job"));
    assert_eq!(header(&by_form, "location"), format!("/api/runs/{named_run}"));
    let by_form = json_of(by_form, 201);
    assert_eq!((text(&by_form, "/id"), text(&by_form, "/job/id")), (named_run, named_job));

    let raw = server.post("/api/runs").query(&fields).query(&[("filename", "run.mp4")]).body(video.clone());
    let by_body = json_of(send(raw), 201);
    for run in [&by_form, &by_body] {
        for (pointer, expected) in [
            ("/asset", "Pipe 7"),
            ("/direction", "backward"),
            ("/recorded_at", "2026-05-17T08:30:00.000Z"),
            ("/job/recipe", "paper-literal"),
            ("/note", "after rain"),
            ("/rig", "wall"),
            ("/state", "queued"),
        ] {
            assert_eq!(text(run, pointer), expected);
        }
        assert_eq!(run["chainage_mm"], 12500.5);
        assert_eq!(run["source"]["bytes"], video.len());
        let back = send(server.get(&text(run, "/source/url"))).bytes().expect("a body");
        assert!(back == video, "the source comes back byte for byte");
    }
    assert_eq!(text(&by_form, "/source/filename"), "Süd \"7\".mp4", "the name is kept as it was given");
    assert_eq!(server.json("/api/runs")["items"].as_array().map(Vec::len), Some(2));
    assert_eq!(server.json("/api/assets")["items"][0]["runs"], 2);

    // The rig that came with a run can be named from then on.
    let named = server.post("/api/runs").query(&[("asset", "Pipe 8"), ("rig", "wall")]).body(video);
    assert_eq!(text(&json_of(send(named), 201), "/job/rig"), "wall");
}

#[test]
fn ranges_and_conditions_are_answered_exactly() {
    let server = storing_server();
    let video = short_run().video_bytes();
    let run = server.upload(short_run(), "Wall");
    let path = text(&run, "/source/url");
    let size = video.len();
    for (range, first, last) in [
        ("bytes=0-0".to_string(), 0, 0),
        ("bytes=10-99".into(), 10, 99),
        (format!("bytes={}-", size - 5), size - 5, size - 1),
        ("bytes=-7".into(), size - 7, size - 1),
        (format!("bytes=5-{}", 10 * size), 5, size - 1),
    ] {
        let response = send(server.get(&path).header("Range", &range));
        assert_eq!(response.status(), 206, "{range}");
        assert_eq!(header(&response, "content-range"), format!("bytes {first}-{last}/{size}"));
        assert!(response.bytes().expect("a body") == video[first..=last], "{range}");
    }
    let outside = send(server.get(&path).header("Range", format!("bytes={size}-")));
    assert_eq!(header(&outside, "content-range"), format!("bytes */{size}"));
    problem_of(outside, 416);

    let head = send(server.head(&path));
    assert_eq!((head.status().as_u16(), header(&head, "content-length")), (200, size.to_string()));
    let etag = header(&head, "etag");
    assert_eq!(etag, format!("\"{}\"", text(&run, "/source/sha256")), "the ETag is the SHA-256");
    let same = send(server.get(&path).header("If-None-Match", &etag));
    assert_eq!(same.status(), 304);
    assert!(same.bytes().expect("no body").is_empty());
    let changed = send(server.get(&path).header("Range", "bytes=0-0").header("If-Range", "\"another\""));
    assert_eq!(changed.status(), 200, "a range of another version would be mixed up");
}

#[test]
fn a_repeated_request_is_the_same_run() {
    let server = storing_server();
    let rig = short_run().rig_text();
    let request = |key: &str, asset: &str| {
        let query = [("asset", asset), ("rig", rig.as_str())];
        server.post("/api/runs").query(&query).header("Idempotency-Key", key).body(short_run().video_bytes())
    };
    let first = json_of(send(request("k1", "Wall")), 201);
    let again = send(request("k1", "Wall"));
    assert_eq!(header(&again, "idempotency-replayed"), "true");
    assert_eq!(json_of(again, 201)["id"], first["id"]);
    assert_ne!(json_of(send(request("k2", "Wall")), 201)["id"], first["id"], "another key, another run");
    problem_of(send(request("k1", "Another wall")), 422);
    assert_eq!(server.json("/api/runs")["items"].as_array().map(Vec::len), Some(2));

    // Both at once, as a client does that gave up waiting too early.
    let ids: Vec<_> = std::thread::scope(|scope| {
        let senders: Vec<_> = (0..4).map(|_| scope.spawn(|| json_of(send(request("k3", "Wall")), 201))).collect();
        senders.into_iter().map(|s| text(&s.join().expect("sent"), "/id")).collect()
    });
    assert!(ids.iter().all(|id| *id == ids[0]), "{ids:?}");
}

#[test]
fn names_are_words_and_never_paths() {
    let server = storing_server();
    let (video, rig) = (short_run().video_bytes(), short_run().rig_text());
    for name in [
        "../../../etc/cron.d/x.mp4",
        "/abs/olute.mp4",
        "..",
        "a\"b'c;d$(e).mp4",
        "Röhre 1 ✓.mp4",
        "C:\\x\\y.mp4",
        "-rf",
    ] {
        let query = [("asset", "Wall"), ("rig", rig.as_str()), ("filename", name)];
        let run = json_of(send(server.post("/api/runs").query(&query).body(video.clone())), 201);
        assert_eq!(text(&run, "/source/filename"), name);
        let back = send(server.get(&text(&run, "/source/url")));
        let disposition = header(&back, "content-disposition");
        assert!(disposition.starts_with("attachment; filename=\"") && !disposition.contains(".."), "{disposition}");
        assert!(back.bytes().expect("a body") == video);
    }
    let strangers: Vec<_> = std::fs::read_dir(server.data().join("store"))
        .expect("the store")
        .flatten()
        .map(|e| e.file_name().to_string_lossy().into_owned())
        .filter(|name| name != "runs")
        .collect();
    assert!(strangers.is_empty(), "{strangers:?}");
    assert!(!server.data().join("../etc").exists());
}

#[test]
fn runs_are_paged_filtered_changed_and_deleted() {
    let server = storing_server();
    let rig = short_run().rig_text();
    for i in 0..5 {
        let day = format!("2026-05-1{i}T00:00:00Z");
        let name = format!("r{i}.mp4");
        let asset = if i % 2 == 0 { "North 100%" } else { "South" };
        let query =
            [("asset", asset), ("rig", rig.as_str()), ("recorded_at", day.as_str()), ("filename", name.as_str())];
        json_of(send(server.post("/api/runs").query(&query).body("not yet a video")), 201);
    }
    let mut seen = Vec::new();
    let mut path = "/api/runs?limit=2".to_string();
    loop {
        let page = server.json(&path);
        let items = page["items"].as_array().expect("items");
        assert!(items.len() <= 2);
        seen.extend(items.iter().map(|run| text(run, "/source/filename")));
        let Some(cursor) = page["next_cursor"].as_str() else { break };
        path = format!("/api/runs?limit=2&cursor={cursor}");
    }
    assert_eq!(seen, ["r4.mp4", "r3.mp4", "r2.mp4", "r1.mp4", "r0.mp4"], "the newest first, each once");

    let count = |query: &str| server.json(&format!("/api/runs?{query}"))["items"].as_array().map(Vec::len);
    for (query, expected) in [
        ("asset=South", 2),
        ("q=north", 3),
        ("q=100%25", 3),
        ("q=r_", 0),
        ("state=queued", 5),
        ("state=done", 0),
        ("from=2026-05-12T00:00:00Z", 3),
        ("from=2026-05-11T00:00:00Z&to=2026-05-13T00:00:00Z", 2),
    ] {
        assert_eq!(count(query), Some(expected), "{query}");
    }
    for query in ["state=odd", "from=yesterday", "limit=0", "limit=9999", "colour=green"] {
        problem_of(send(server.get(&format!("/api/runs?{query}"))), 400);
    }

    let id = text(&server.json("/api/runs?asset=South"), "/items/0/id");
    let path = format!("/api/runs/{id}");
    let change = serde_json::json!({"asset": "East", "chainage_mm": -3.5, "note": "moved"});
    let changed = json_of(send(server.patch(&path).json(&change)), 200);
    assert_eq!((text(&changed, "/asset"), text(&changed, "/note")), ("East".into(), "moved".into()));
    assert_eq!(changed["chainage_mm"], -3.5);
    for bad in
        [serde_json::json!({"asset": ""}), serde_json::json!({"recorded_at": "x"}), serde_json::json!({"id": "x"})]
    {
        problem_of(send(server.patch(&path).json(&bad)), 400);
    }
    assert_eq!(send(server.delete(&path)).status(), 204);
    problem_of(send(server.get(&path)), 404);
    problem_of(send(server.delete(&path)), 404);
    let names: Vec<_> =
        server.json("/api/assets")["items"].as_array().expect("items").iter().map(|a| text(a, "/name")).collect();
    assert_eq!(names, ["North 100%", "South"], "an asset without runs is forgotten");
}
