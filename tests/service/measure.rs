//! What people read off a job: cross-sections, the trajectory, the map while it grows.

use std::io::{BufRead, BufReader};
use std::process::Command;

use serde_json::{Value, json};
use stria_tests::support::form::{content_type, form};
use stria_tests::support::server::{Server, header, json_of, problem_of, send, text};
use stria_tests::support::{long_run, short_run};

/// Runs a reader of `tests/readers` on a folder.
fn read_with(script: &str, folder: &std::path::Path) {
    let root = std::path::PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..");
    let python = root.join("target/python/bin/python");
    assert!(python.exists(), "{} is missing: `make setup` installs it", python.display());
    let output =
        Command::new(&python).arg(root.join("tests/readers").join(script)).arg(folder).output().expect("Python starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{script}:\n{}{}", text(&output.stdout), text(&output.stderr));
}

#[test]
fn cross_sections_are_the_depth_map_s_own_values() {
    let server = Server::start(&["--workers", "1"]);
    let run = server.upload(short_run(), "Wall");
    let (id, job) = (text(&run, "/id"), text(&run, "/job/id"));
    server.wait_for_state(&job, "done");
    let changed = server.patch(&format!("/api/runs/{id}")).json(&json!({"chainage_mm": 5000, "direction": "backward"}));
    json_of(send(changed), 200);
    let base = format!("/api/jobs/{job}");
    let map = server.json(&format!("{base}/products/manifest.json"))["depth_map"].clone();
    let number = |name: &str| map[name].as_f64().expect("a number");
    let (x0, y0, step) = (number("x0_mm"), number("y0_mm"), number("mm_per_px"));
    let (width, height) = (number("width_px"), number("height_px"));

    let across = format!("{base}/profile?chainage_mm={}", 5000.0 - (x0 + step * (width / 2.0).floor()));
    let slanting = format!(
        "{base}/profile?from={},{}&to={},{}",
        x0 - 20.0,
        y0,
        x0 + step * (width - 1.0),
        y0 + step * (height - 1.0)
    );
    let sections: Vec<Value> = [&across, &slanting].map(|path| server.json(path)).into();
    assert_eq!(sections[0]["z_mm"].as_array().map(Vec::len), Some(height as usize));
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("sections.json"), Value::from(sections).to_string()).expect("write");
    for name in ["depth.tif", "manifest.json"] {
        let bytes = send(server.get(&format!("{base}/products/{name}"))).bytes().expect("a body");
        std::fs::write(folder.path().join(name), bytes).expect("write");
    }
    let csv = send(server.get(&format!("{slanting}&format=csv"))).text().expect("text");
    std::fs::write(folder.path().join("section.csv"), csv).expect("write");
    read_with("profile.py", folder.path());

    for (query, field) in [
        ("", "query"),
        ("?chainage_mm=1&from=0,0&to=1,1", "query"),
        ("?from=0&to=1,1", "from"),
        ("?chainage_mm=1&step_mm=0", "step_mm"),
        ("?from=0,0&to=1000000,0&step_mm=0.1", "profile.step_mm"),
        ("?chainage_mm=1&format=xml", "format"),
    ] {
        let problem = problem_of(send(server.get(&format!("{base}/profile{query}"))), 400);
        assert_eq!(problem["field"], field, "{query}: {problem}");
    }
}

#[test]
fn a_trajectory_comes_as_columns() {
    let server = Server::start(&["--workers", "1"]);
    let run = server.upload(short_run(), "Wall");
    let job = text(&run, "/job/id");
    server.wait_for_state(&job, "done");
    let csv = send(server.get(&format!("/api/jobs/{job}/products/trajectory.csv"))).text().expect("text");
    let lines: Vec<Vec<&str>> = csv.lines().map(|line| line.split(',').collect()).collect();
    let whole = server.json(&format!("/api/jobs/{job}/trajectory"));
    assert_eq!((&whole["frames"], &whole["every"]), (&json!(lines.len() - 1), &json!(1)));
    for (at, name) in lines[0].iter().enumerate() {
        let expected: Vec<Value> =
            lines[1..].iter().map(|line| line[at].parse::<f64>().map_or(Value::Null, Value::from)).collect();
        assert_eq!(whole["columns"][name], Value::from(expected), "{name}");
    }
    let thin = server.json(&format!("/api/jobs/{job}/trajectory?frames=3"));
    assert_eq!(thin["columns"]["frame"], json!([0.0, 3.0, 6.0]));
    problem_of(send(server.get(&format!("/api/jobs/{job}/trajectory?frames=1"))), 400);
}

#[test]
fn the_map_grows_on_every_level_while_the_job_runs() {
    let server = Server::start(&["--workers", "1"]);
    // The publication's way takes its time over a frame, and hands tiles out every fourth.
    let (rig, recipe) = (long_run().rig_text(), "method = \"paper\"\n[map]\ntile_frames = 4\n");
    let body = form(&[("asset", "Wall"), ("rig", &rig), ("recipe", recipe)], "video.mp4", &long_run().video_bytes());
    let run = json_of(send(server.post("/api/runs").header("Content-Type", content_type()).body(body)), 201);
    let base = format!("/api/jobs/{}", text(&run, "/job/id"));
    let (mut name, mut revisions, mut levels, mut tiles_seen) = (String::new(), Vec::new(), 0, 0);
    let events = BufReader::new(send(server.get(&format!("{base}/events"))));
    for line in events.lines() {
        let line = line.expect("a line");
        if let Some(event) = line.strip_prefix("event: ") {
            name = event.into();
        }
        let (Some(data), "tile") = (line.strip_prefix("data: "), name.as_str()) else { continue };
        revisions.push(serde_json::from_str::<Value>(data).expect("JSON")["revision"].as_u64().expect("a number"));
        let response = send(server.get(&format!("{base}/tiles/tiles.json")));
        let live = header(&response, "cache-control") == "no-cache";
        let index = json_of(response, 200);
        if live && index["complete"] == json!(false) {
            levels = levels.max(index["levels"].as_array().map_or(0, Vec::len));
            tiles_seen += tiles_of(&server, &base, &index);
        }
    }
    assert!(!revisions.is_empty() && revisions.windows(2).all(|two| two[0] < two[1]), "{revisions:?}");
    assert!(levels >= 2 && tiles_seen > 0, "{levels} levels, {tiles_seen} tiles while the job ran");

    assert_eq!(server.json(&base)["state"], "done");
    let whole = send(server.get(&format!("{base}/tiles/tiles.json")));
    assert!(header(&whole, "cache-control").contains("immutable"));
    let index = json_of(whole, 200);
    assert_eq!((&index["complete"], &index["changed"]), (&json!(true), &json!([])));
    for missing in ["tiles/..%2f..%2fmanifest.json", "tiles/depth/0/999_0.png", "live/frame.jpg"] {
        problem_of(send(server.get(&format!("{base}/{missing}"))), 404);
    }
}

/// Gets every tile that is named as changed; how many there are.
fn tiles_of(server: &Server, base: &str, index: &Value) -> usize {
    let changed = index["changed"].as_array().expect("changes");
    for change in changed {
        let [_, level, column, row] = [0, 1, 2, 3].map(|at| change[at].as_i64().expect("a number"));
        for (kind, end, magic) in [("depth", "png", b"\x89PN"), ("texture", "jpg", b"\xff\xd8\xff")] {
            let path = format!("{base}/tiles/{kind}/{level}/{column}_{row}.{end}");
            let tile = send(server.get(&path));
            assert_eq!(tile.status(), 200, "{path}");
            let etag = header(&tile, "etag");
            assert!(tile.bytes().expect("a body").starts_with(magic), "{path}");
            let again = send(server.get(&path).header("If-None-Match", etag)).status().as_u16();
            assert!([200, 304].contains(&again), "{path}: {again}");
        }
    }
    changed.len()
}

#[test]
fn the_newest_frame_shows_the_stripe_that_was_found() {
    let folder = tempfile::tempdir().expect("folder");
    let out = folder.path().join("out");
    let run = long_run();
    let child = Command::new(stria_tests::support::stria())
        .arg("process")
        .arg(&run.video)
        .args([std::ffi::OsStr::new("--rig"), run.rig.as_os_str(), std::ffi::OsStr::new("--out"), out.as_os_str()])
        .args(["--json", "--live-segments"])
        .stdout(std::process::Stdio::piped())
        .spawn();
    let mut child = child.expect("stria process starts");
    let (mut frames, mut last) = (0, 0);
    for line in BufReader::new(child.stdout.take().expect("a pipe")).lines() {
        let said: Value = serde_json::from_str(&line.expect("a line")).expect("JSON");
        let names: Vec<_> = said["names"].as_array().into_iter().flatten().filter_map(Value::as_str).collect();
        if !names.contains(&"live/frame.json") {
            continue;
        }
        // A later frame may have taken its place meanwhile; at the end the folder goes.
        let Ok(text) = std::fs::read_to_string(out.join("live/frame.json")) else { continue };
        let frame: Value = serde_json::from_str(&text).expect("JSON");
        let spots = frame["spots_px"].as_array().expect("spots");
        assert!(spots.len() > 100, "{} spots", spots.len());
        assert!(spots.iter().all(|spot| (0.0..640.0).contains(&spot[0].as_f64().expect("a number"))));
        assert!(frame["frame"].as_u64().expect("a number") >= last);
        last = frame["frame"].as_u64().expect("a number");
        frames += 1;
    }
    assert!(child.wait().expect("it ends").code().is_some_and(|code| code == 0 || code == 3));
    assert!(frames >= 2, "{frames} frames");
    assert!(!out.join("live").exists(), "no product");
}

#[test]
fn runs_come_in_the_order_that_was_asked_for() {
    let server = Server::start(&["--workers", "0"]);
    for (asset, recorded) in [("b", "2026-01-03"), ("a", "2026-01-01"), ("c|d", "2026-01-02"), ("a", "2026-01-04")] {
        let run = server.upload(short_run(), asset);
        let change = json!({"recorded_at": format!("{recorded}T00:00:00Z")});
        json_of(send(server.patch(&format!("/api/runs/{}", text(&run, "/id"))).json(&change)), 200);
    }
    let listed = |sort: &str| {
        let (mut days, mut cursor) = (Vec::new(), String::new());
        loop {
            let page = server.json(&format!("/api/runs?limit=1&sort={sort}{cursor}"));
            days.extend(
                page["items"].as_array().expect("items").iter().map(|run| text(run, "/recorded_at")[8..10].to_string()),
            );
            match page["next_cursor"].as_str() {
                Some(next) => cursor = format!("&cursor={}", next.replace('|', "%7C")),
                None => return days.join(" "),
            }
        }
    };
    for (sort, expected) in [
        ("-created", "04 02 01 03"),
        ("created", "03 01 02 04"),
        ("recorded", "01 02 03 04"),
        ("-recorded", "04 03 02 01"),
        ("asset", "01 04 03 02"),
        ("-asset", "02 03 04 01"),
    ] {
        assert_eq!(listed(sort), expected, "{sort}");
    }
    problem_of(send(server.get("/api/runs?sort=colour")), 400);
    problem_of(send(server.get("/api/runs?sort=recorded&cursor=x")), 400);
}

#[test]
fn lists_are_squeezed_for_those_who_take_it() {
    let server = Server::start(&["--workers", "0"]);
    for _ in 0..3 {
        server.upload(short_run(), "Wall");
    }
    let plain = send(server.get("/api/runs"));
    assert!(!plain.headers().contains_key("content-encoding"));
    let plain = plain.bytes().expect("a body");
    let squeezed = send(server.get("/api/runs").header("Accept-Encoding", "gzip"));
    assert_eq!(
        (header(&squeezed, "content-encoding"), header(&squeezed, "vary")),
        ("gzip".into(), "accept-encoding".into())
    );
    let squeezed = squeezed.bytes().expect("a body");
    assert!(
        squeezed.starts_with(&[0x1f, 0x8b]) && squeezed.len() * 2 < plain.len(),
        "{} of {}",
        squeezed.len(),
        plain.len()
    );
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("list.gz"), &squeezed).expect("write");
    let gunzip = Command::new("gzip").arg("-dc").arg(folder.path().join("list.gz")).output().expect("gzip starts");
    assert!(gunzip.stdout == plain, "the same list");
}
