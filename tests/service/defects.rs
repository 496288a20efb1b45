//! Defects over all runs, through the real service: listed, judged, kept through reprocessing, followed from run to run.

use std::sync::OnceLock;

use serde_json::{Value, json};
use stria_tests::support::form::{content_type, form, percent_encoded};
use stria_tests::support::readers::read;
use stria_tests::support::server::{Server, header, json_of, problem_of, send, text};
use stria_tests::support::{Run, run_stria};

/// The same wall twice: later one dent is 2 mm deeper, and one is new.
fn wall(later: bool) -> &'static Run {
    static RUNS: [OnceLock<Run>; 2] = [OnceLock::new(), OnceLock::new()];
    RUNS[usize::from(later)].get_or_init(|| {
        let seed = if later { "63" } else { "61" };
        let mut options = vec!["--seconds", "3", "--size", "640x360", "--wall-seed", "7", "--seed", seed];
        options.extend(later.then_some("--later"));
        Run::simulate_with(&options)
    })
}

/// Sends a run and waits until it is measured.
fn measured(server: &Server, run: &Run, asset: &str, chainage_mm: &str, recorded: &str) -> Value {
    let rig = run.rig_text();
    let fields = [("asset", asset), ("rig", &rig), ("chainage_mm", chainage_mm), ("recorded_at", recorded)];
    let body = form(&fields, "video.mp4", &run.video_bytes());
    let run = json_of(send(server.post("/api/runs").header("Content-Type", content_type()).body(body)), 201);
    server.wait_for_state(&text(&run, "/job/id"), "done");
    run
}

fn items(list: &Value) -> Vec<Value> {
    list["items"].as_array().expect("items").clone()
}

fn listed(server: &Server, query: &str) -> Vec<Value> {
    items(&server.json(&format!("/api/defects?{query}")))
}

fn pathed(value: usize) -> std::path::PathBuf {
    value.to_string().into()
}

fn number(value: &Value, field: &str) -> f64 {
    value[field].as_f64().unwrap_or_else(|| panic!("{field} in {value:#}"))
}

#[test]
fn defects_of_all_runs_are_listed_judged_and_outlive_reprocessing() {
    let mut server = Server::start(&["--workers", "1"]);
    let asset = "Gallery 3, north";
    let run = measured(&server, wall(false), asset, "12000", "2024-03-01T10:00:00Z");
    let (run_id, job) = (text(&run, "/id"), text(&run, "/job/id"));

    // The list is the product's own, in every order, by pages.
    let product = server.json(&format!("/api/jobs/{job}/products/defects.json"));
    let own = product["defects"].as_array().expect("defects");
    let all = listed(&server, "sort=chainage");
    assert!(own.len() > 3 && all.len() == own.len(), "{product:#}");
    for (row, own) in all.iter().zip(own) {
        for name in ["chainage_mm", "height_mm", "x_mm", "depth_mm", "area_mm2", "volume_mm3", "confidence"] {
            assert!((number(row, name) - number(own, name)).abs() < 1e-9, "{name}: {row:#}");
        }
        assert_eq!((&row["kind"], &row["number"], &row["state"]), (&own["kind"], &own["id"], &json!("open")));
        assert_eq!(
            (text(row, "/asset"), text(row, "/run"), text(row, "/job")),
            (asset.into(), run_id.clone(), job.clone())
        );
    }
    for (sort, field) in [("depth", "depth_mm"), ("-depth", "depth_mm"), ("-chainage", "chainage_mm")] {
        let (mut paged, mut cursor) = (Vec::new(), String::new());
        loop {
            let page = server.json(&format!("/api/defects?sort={sort}&limit=2&cursor={}", percent_encoded(&cursor)));
            paged.extend(items(&page));
            let Some(next) = page["next_cursor"].as_str() else { break };
            cursor = next.into();
        }
        let values: Vec<f64> = paged.iter().map(|d| number(d, field).abs()).collect();
        let mut sorted: Vec<f64> = all.iter().map(|d| number(d, field).abs()).collect();
        sorted.sort_by(|a, b| if sort.starts_with('-') { b.total_cmp(a) } else { a.total_cmp(b) });
        assert_eq!(values, sorted, "{sort}");
    }

    // Filters.
    let count = |query: &str| listed(&server, query).len();
    let kinds = |kind: &str| all.iter().filter(|d| d["kind"] == kind).count();
    assert_eq!((count("kind=dent"), count("kind=bulge")), (kinds("dent"), kinds("bulge")));
    let middle = number(&all[2], "chainage_mm");
    assert_eq!((count(&format!("from_mm={middle}")), count(&format!("to_mm={middle}"))), (all.len() - 2, 2));
    let deep = all.iter().filter(|d| number(d, "depth_mm").abs() >= 7.0).count();
    assert_eq!(count("depth_min_mm=7"), deep);
    let moderate = all.iter().filter(|d| d["severity"] == "moderate").count();
    assert_eq!(count("severity=moderate"), moderate);
    assert_eq!((count(&format!("asset={}", percent_encoded(asset))), count("asset=other")), (all.len(), 0));
    assert_eq!((count("q=gallery%203"), count("q=nothing")), (all.len(), 0));
    for (query, field) in [
        ("kind=crack", "kind"),
        ("state=gone", "state"),
        ("severity=bad", "severity"),
        ("sort=size", "sort"),
        ("limit=0", "limit"),
        ("from_mm=NaN", "from_mm"),
        ("sort=depth&cursor=x", "cursor"),
        ("depht=3", "query"),
    ] {
        let problem = problem_of(send(server.get(&format!("/api/defects?{query}"))), 400);
        assert_eq!(problem["field"], field, "{query}: {problem}");
    }

    // What people say, and what two people say at the same time.
    let path = format!("/api/defects/{}", text(&all[0], "/id"));
    let change = |body: Value| server.patch(&path).json(&body);
    let seen = format!("\"{}\"", text(&all[0], "/version"));
    let judged = json!({"state": "watched", "comment": "=wet, \"again\""});
    let said = json_of(send(change(judged).header("If-Match", &seen)), 200);
    assert_eq!(text(&said, "/state"), "watched");
    assert!(said["changed_at"].is_string() && said["changed_by"].is_string());
    problem_of(send(change(json!({"state": "dismissed"})).header("If-Match", &seen)), 412);
    problem_of(send(change(json!({"state": "dismissed", "version": 0}))), 400);
    assert_eq!(server.json(&path), said);
    let problem = problem_of(send(change(json!({"comment": "x".repeat(4001)}))), 400);
    assert_eq!(problem["field"], "comment");
    problem_of(send(change(json!({"state": "fine"}))), 400);
    problem_of(send(server.patch("/api/defects/none").json(&json!({}))), 404);
    problem_of(send(server.get("/api/defects/none")), 404);
    assert_eq!((count("state=watched"), count("q=WET")), (1, 1));
    let audit = server.json("/api/audit");
    assert!(items(&audit).iter().any(|l| text(l, "/method") == "PATCH" && text(l, "/path") == path), "{audit:#}");

    // Files for other programs.
    let folder = tempfile::tempdir().expect("folder");
    let keep = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).expect("write");
    keep("list.json", server.json("/api/defects?sort=chainage").to_string().as_bytes());
    for (name, kind) in [("defects.csv", "text/csv"), ("defects.geojson", "application/geo+json")] {
        let answer = send(server.get(&format!("/api/{name}?sort=chainage")));
        assert!(
            header(&answer, "content-type").starts_with(kind) && header(&answer, "content-disposition").contains(name)
        );
        let body = answer.text().expect("text");
        // A comment that looks like a formula is none in a spreadsheet.
        keep(name, body.replace("'=wet", "=wet").as_bytes());
        assert_eq!(body.contains("'=wet"), name == "defects.csv");
    }
    assert_eq!(read("defect_tables.py", &[folder.path()]), json!(all.len()));

    // The residual map as tiles: the defect's own depth in its middle.
    let tiles = format!("/api/jobs/{job}/residual");
    let index = server.json(&format!("{tiles}/tiles.json"));
    let deepest = all.iter().max_by(|a, b| number(a, "depth_mm").total_cmp(&number(b, "depth_mm"))).expect("some");
    let grid = |name: &str| number(&index["grid"], name);
    let own = own.iter().find(|d| d["id"] == deepest["number"]).expect("the product's");
    let pixel = |field: &str, origin: &str| ((number(own, field) - grid(origin)) / grid("mm_per_px")).round() as usize;
    let (column, row) = (pixel("deepest_x_mm", "x0_mm"), pixel("deepest_y_mm", "y0_mm"));
    let answer = send(server.get(&format!("{tiles}/depth/0/{}_{}.png", column / 256, row / 256)));
    assert_eq!(header(&answer, "content-type"), "image/png");
    assert!(header(&answer, "cache-control").contains("immutable"));
    keep("tile.png", &answer.bytes().expect("a body"));
    let told = read("deviation_at.py", &[&folder.path().join("tile.png"), &pathed(column % 256), &pathed(row % 256)]);
    let told = told.as_f64().expect("a value");
    assert!((told - number(deepest, "depth_mm")).abs() < 1.0, "{told}: {deepest:#}");
    problem_of(send(server.get(&format!("{tiles}/depth/0/99_0.png"))), 404);
    problem_of(send(server.get(&format!("{tiles}/depth/0/0_0.jpg"))), 404);

    // A run that is moved and turned takes its defects along.
    let moved = json!({"chainage_mm": 5000, "direction": "backward", "asset": "Gallery 4"});
    json_of(send(server.patch(&format!("/api/runs/{run_id}")).json(&moved)), 200);
    for (before, after) in all.iter().rev().zip(listed(&server, "sort=chainage&asset=Gallery%204")) {
        assert_eq!(text(before, "/id"), text(&after, "/id"));
        assert!((number(&after, "chainage_mm") - (5000.0 - number(&after, "x_mm"))).abs() < 1e-9);
    }

    // Processed again: the list shows the new job's, with what was said.
    let wish = json!({"recipe": "[defects]\nnoise_factor = 5.0\ncodes = \"dent=BAA; bulge=BAA B\"\n"});
    let again = json_of(send(server.post(&format!("/api/runs/{run_id}/jobs")).json(&wish)), 201);
    let again = text(&again, "/id");
    server.wait_for_state(&again, "done");
    let now = listed(&server, "sort=-chainage");
    assert!(!now.is_empty() && now.iter().all(|d| text(d, "/job") == again && d["current"] == true));
    for defect in &now {
        assert_eq!(defect["code"], if defect["kind"] == "dent" { "BAA" } else { "BAA B" }, "{defect:#}");
    }
    let coded = send(server.get("/api/defects.csv?q=BAA%20B")).text().expect("text");
    assert!(coded.lines().count() > 1 && coded.lines().skip(1).all(|l| l.contains(",BAA B,")), "{coded}");
    let kept: Vec<&Value> = now.iter().filter(|d| d["state"] == "watched").collect();
    assert_eq!(kept.len(), 1, "{now:#?}");
    assert_eq!(kept[0]["carried_from"], all[0]["id"]);
    assert_eq!(text(kept[0], "/comment"), "=wet, \"again\"");
    assert!((number(kept[0], "x_mm") - number(&all[0], "x_mm")).abs() < 5.0);
    assert!(server.json(&format!("/api/jobs/{again}/log")).to_string().contains("1 carried over"));
    let before = listed(&server, &format!("job={job}"));
    assert!(before.len() == all.len() && before.iter().all(|d| d["current"] == false), "the old job's are still there");

    // A copy holds them; a run that goes takes them along.
    let copy = folder.path().join("copy");
    let (data, out) = (server.data(), copy.to_str().expect("plain").to_string());
    let backed_up = run_stria(&["backup", "--data", data.to_str().expect("plain"), "--out", &out]);
    assert!(backed_up.status.success(), "{}", String::from_utf8_lossy(&backed_up.stderr));
    let wanted = server.json("/api/defects?sort=chainage");
    assert_eq!(send(server.delete(&format!("/api/runs/{run_id}"))).status(), 204);
    assert_eq!((count(""), count(&format!("job={job}"))), (0, 0));
    server.stop();
    let mut other = Server::stopped(&["--workers", "0"]);
    let new = other.data().to_str().expect("plain").to_string();
    assert!(run_stria(&["restore", &out, "--data", &new]).status.success());
    other.start_again();
    assert_eq!(other.json("/api/defects?sort=chainage"), wanted);
}

#[test]
fn two_runs_of_an_asset_show_what_changed_and_one_defect_over_time() {
    let server = Server::start(&["--workers", "1"]);
    // The second robot's chainage is 60 mm off.
    let first = measured(&server, wall(false), "Gallery 3", "12000", "2024-03-01T10:00:00Z");
    let second = measured(&server, wall(true), "Gallery 3", "12060", "2025-03-01T10:00:00Z");
    let elsewhere = measured(&server, wall(false), "Gallery 4", "12000", "2025-04-01T10:00:00Z");
    let job = |run: &Value| text(run, "/job/id");
    let ask = |after: &str, before: &str| server.get(&format!("/api/jobs/{after}/change?before={before}"));

    // As it is by chainage, the two lie 60 mm apart and are told to lie on each other by their relief, or refused.
    let moved = server.patch(&format!("/api/runs/{}", text(&second, "/id"))).json(&json!({"chainage_mm": 12000}));
    json_of(send(moved), 200);
    let report = json_of(send(ask(&job(&second), &job(&first))), 200);
    let changes = report["changes"].as_array().expect("changes");
    let states: Vec<&str> = changes.iter().filter_map(|c| c["state"].as_str()).collect();
    assert_eq!(states.len(), 2, "{report:#}");
    assert!(states.contains(&"new") && states.contains(&"grown"), "{report:#}");
    let of = |state: &str| changes.iter().find(|c| c["state"] == state).expect("of that state");
    assert!((number(of("grown"), "delta_depth_mm") - 2.0).abs() < 0.8 && of("new")["before_number"].is_null());
    assert!(report["unchanged"].as_array().is_some_and(|u| u.len() > 3));
    assert_eq!(json_of(send(ask(&job(&second), &job(&first))), 200), report, "the same again");

    // The difference as a map, read by a program that we did not write.
    let map = |before: &str| server.get(&format!("/api/jobs/{}/change/difference.tif?before={before}", job(&second)));
    let answer = send(map(&job(&first)));
    assert_eq!((answer.status().as_u16(), header(&answer, "content-type")), (200, "image/tiff".to_string()));
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (tif, places) = (folder.path().join("difference.tif"), folder.path().join("places.json"));
    std::fs::write(&tif, answer.bytes().expect("the file")).expect("written");
    let at = |change: &Value| json!([number(change, "x_mm"), number(change, "y_mm")]);
    std::fs::write(&places, json!([at(of("grown")), at(of("new"))]).to_string()).expect("written");
    let told = read("depth_at.py", &[&tif, &places]);
    for (told, change) in told.as_array().expect("values").iter().zip([of("grown"), of("new")]) {
        let told = told.as_f64().expect("measured there");
        assert!((told - number(change, "delta_depth_mm")).abs() < 1.2, "{told} mm: {change}");
    }
    problem_of(send(map("none")), 404);

    let problem = problem_of(send(ask(&job(&elsewhere), &job(&first))), 400);
    assert_eq!(problem["field"], "before", "{problem}");
    problem_of(send(ask(&job(&second), "none")), 404);
    let problem = problem_of(send(server.get(&format!("/api/jobs/{}/change", job(&second)))), 400);
    assert_eq!(problem["field"], "before", "{problem}");
    let turned = server.patch(&format!("/api/runs/{}", text(&second, "/id"))).json(&json!({"direction": "backward"}));
    json_of(send(turned), 200);
    let problem = problem_of(send(ask(&job(&second), &job(&first))), 400);
    assert!(text(&problem, "/expected").contains("same stretch"), "turned, it lies elsewhere: {problem}");
    let back = json!({"direction": "forward", "chainage_mm": 12060});
    json_of(send(server.patch(&format!("/api/runs/{}", text(&second, "/id"))).json(&back)), 200);

    // The dent that grew, over both runs: the neighbours tell that the second list lies 60 mm farther.
    let numbered = |run: &Value, number: &Value| {
        let mine = listed(&server, &format!("run={}", text(run, "/id")));
        mine.into_iter().find(|d| d["number"] == *number).expect("that number")
    };
    let grown = numbered(&second, &of("grown")["after_number"]);
    let history = |id: &str| server.json(&format!("/api/defects/{id}/history"));
    let seen = history(&text(&grown, "/id"));
    assert_eq!(seen["defect"], grown);
    let seen = items(&seen);
    let runs: Vec<String> = seen.iter().map(|s| text(s, "/run")).collect();
    assert_eq!(runs, [text(&second, "/id"), text(&first, "/id")], "the later one first, other assets not at all");
    assert_eq!(seen[0]["defect"], grown);
    assert_eq!(seen[1]["defect"]["number"], of("grown")["before_number"], "{seen:#?}");
    assert!(number(&seen[0]["defect"], "depth_mm") > number(&seen[1]["defect"], "depth_mm") + 1.0);
    let fresh = numbered(&second, &of("new")["after_number"]);
    let seen = items(&history(&text(&fresh, "/id")));
    assert!(seen.len() == 2 && seen[1]["defect"].is_null(), "{seen:#?}");
    assert!(number(&seen[1], "detection_limit_mm") > 0.1);
    let path = format!("/api/defects/{}/history", text(&fresh, "/id"));
    problem_of(send(server.get(&format!("{path}?slack_mm=-1"))), 400);
    problem_of(send(server.get("/api/defects/none/history")), 404);
}
