//! The commands around the service: process, send, serve, inspect, and their exit codes.

use std::io::Write;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use stria_tests::support::server::{Server, read, signal};
use stria_tests::support::{files_below, long_run, run_stria, short_run, stria};

fn plain(path: &std::path::Path) -> &str {
    path.to_str().expect("a plain path")
}

fn words(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn process_makes_products_for_people_and_lines_for_programs() {
    let folder = tempfile::tempdir().expect("folder");
    let (video, rig) = (plain(&short_run().video), plain(&short_run().rig));
    let out = folder.path().join("people");
    let done = run_stria(&["process", video, "--rig", rig, "--out", plain(&out), "--only", "depth,trajectory"]);
    assert_eq!(done.status.code(), Some(0), "{}", words(&done.stderr));
    let said = words(&done.stdout);
    assert!(said.starts_with("Done in ") && said.contains("8 frames") && said.contains("files"), "{said}");
    assert_eq!(files_below(&out), ["depth.png", "depth.tif", "manifest.json", "trajectory.csv"]);
    let inspected = run_stria(&["inspect", plain(&out)]);
    assert!(words(&inspected.stdout).contains("a product folder"), "{}", words(&inspected.stdout));

    let again = run_stria(&["process", video, "--rig", rig, "--out", plain(&out)]);
    assert_eq!(again.status.code(), Some(2));
    assert!(words(&again.stderr).contains("not empty"), "{}", words(&again.stderr));
    assert_eq!(files_below(&out).len(), 4, "what was there stays");

    let out = folder.path().join("programs");
    let done = run_stria(&["process", video, "--rig", rig, "--out", plain(&out), "--json", "--set", "stripe.k=0.8"]);
    let lines: Vec<Value> =
        words(&done.stdout).lines().map(|l| serde_json::from_str(l).expect("JSON a line")).collect();
    assert!(lines.iter().any(|l| l["type"] == "progress" && l["stage"] == "measuring"));
    let last = lines.last().expect("a last line");
    assert_eq!(last["type"], "result");
    let manifest: Value = serde_json::from_slice(&read(&out.join("manifest.json"))).expect("JSON");
    assert_eq!(last["manifest"], manifest);
    assert_eq!(manifest["recipe"]["stripe"]["k"], 0.8);
}

#[test]
fn process_says_what_is_wrong_and_leaves_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let (video, rig) = (plain(&short_run().video), plain(&short_run().rig));
    let no_video = folder.path().join("text.mp4");
    std::fs::write(&no_video, "no video").expect("writes");
    let out = folder.path().join("out");
    let out = plain(&out);
    for (arguments, expected) in [
        (vec!["process", video, "--out", out], "--rig"),
        (vec!["process", "missing.mp4", "--rig", rig, "--out", out], "missing.mp4"),
        (vec!["process", plain(&no_video), "--rig", rig, "--out", out], "text.mp4"),
        (vec!["process", video, "--rig", "missing.toml", "--out", out], "missing.toml"),
        (vec!["process", video, "--rig", rig, "--out", out, "--recipe", "fast"], "paper"),
        (vec!["process", video, "--rig", rig, "--out", out, "--set", "stripe.k=7"], "0.5 to 0.99"),
        (vec!["process", video, "--rig", rig, "--out", out, "--set", "stripe.k"], "key=value"),
        (vec!["process", video, "--rig", rig, "--out", out, "--only", "everything"], "trajectory"),
        (vec!["process", video, "--rig", rig, "--out", out, "--recorded-at", "now"], "recorded-at"),
        (vec!["inspect", "missing"], "missing"),
        (vec!["nothing"], "nothing"),
    ] {
        let failed = run_stria(&arguments);
        assert_eq!(failed.status.code(), Some(2), "{arguments:?}: {}", words(&failed.stderr));
        assert!(words(&failed.stderr).contains(expected), "{arguments:?}: {}", words(&failed.stderr));
        assert!(!std::path::Path::new(out).exists(), "{arguments:?}");
    }
    let failed = run_stria(&["process", plain(&no_video), "--rig", rig, "--out", out, "--json"]);
    let line: Value = serde_json::from_slice(&failed.stdout).expect("one JSON line");
    assert_eq!((line["type"].as_str(), line["kind"].as_str()), (Some("error"), Some("bad_input")));
    assert_eq!(line["retryable"], false);
}

#[test]
fn process_stops_when_asked_and_when_its_parent_dies() {
    let folder = tempfile::tempdir().expect("folder");
    for (i, how) in ["INT", "TERM", "stdin"].into_iter().enumerate() {
        let out = folder.path().join(i.to_string());
        let mut command = Command::new(stria());
        command.args(["process", plain(&long_run().video), "--rig", plain(&long_run().rig), "--out", plain(&out)]);
        if how == "stdin" {
            command.arg("--exit-with-stdin");
        }
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut process = command.spawn().expect("starts");
        let begun = Instant::now();
        while !out.exists() && begun.elapsed() < Duration::from_secs(20) {
            std::thread::sleep(Duration::from_millis(5));
        }
        let asked = Instant::now();
        match how {
            "stdin" => {
                let mut stdin = process.stdin.take().expect("piped");
                stdin.write_all(b"what is written is no end\n").expect("writes");
                std::thread::sleep(Duration::from_millis(50));
                assert!(process.try_wait().expect("waits").is_none(), "it goes on while stdin is open");
                drop(stdin);
            }
            name => signal(name, process.id()),
        }
        let status = process.wait().expect("ends");
        assert_eq!(status.code(), Some(130), "{how}");
        assert!(asked.elapsed() < Duration::from_secs(3), "{how}: {:?}", asked.elapsed());
        assert!(how == "stdin" || !out.exists(), "{how}: nothing half-made stays");
    }
}

#[test]
fn a_simulation_that_is_interrupted_leaves_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("run");
    let mut command = Command::new(stria());
    command.args(["simulate", "wall", "--seconds", "60", "--out", plain(&out)]);
    let mut process = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
    let begun = Instant::now();
    let at_work = || std::fs::read_dir(folder.path()).expect("a folder").count() > 0;
    while !at_work() && begun.elapsed() < Duration::from_secs(20) {
        std::thread::sleep(Duration::from_millis(5));
    }
    assert!(at_work(), "it never began to write");
    signal("INT", process.id());
    assert_eq!(process.wait().expect("ends").code(), Some(130));
    assert!(!at_work(), "nothing half-made stays");
}

#[test]
fn send_waits_for_the_result_and_passes_on_what_went_wrong() {
    let server = Server::start(&["--workers", "1"]);
    let (video, rig, url) = (plain(&short_run().video), plain(&short_run().rig), server.url(""));
    let send = |more: &[&str]| run_stria(&[&["send", video, "--server", &url, "--asset", "Wall"][..], more].concat());
    let done = send(&["--rig", rig, "--chainage-mm", "-250", "--direction", "backward", "--wait"]);
    assert_eq!(done.status.code(), Some(0), "{}", words(&done.stderr));
    let said = words(&done.stdout);
    let page = said.lines().last().expect("a last line");
    let run = page.strip_prefix(&format!("{url}/runs/")).unwrap_or_else(|| panic!("no address in {said}"));
    let run = server.json(&format!("/api/runs/{run}"));
    assert_eq!((run["state"].as_str(), run["chainage_mm"].as_f64()), (Some("done"), Some(-250.0)));
    assert_eq!(run["source"]["filename"], "video.mp4");

    assert_eq!(send(&["--rig", "wall"]).status.code(), Some(0), "a rig that the server has");
    for (more, code, expected) in [
        (vec!["--rig", "unknown"], 2, "no stored rig"),
        (vec!["--rig", "missing.toml"], 2, "missing.toml"),
        (vec!["--rig", rig, "--recipe", "fast"], 2, "paper"),
        (vec!["--rig", rig, "--server", "ftp://127.0.0.1:1"], 2, "https://"),
    ] {
        let failed = if more.contains(&"--server") {
            run_stria(&[&["send", video, "--asset", "Wall"][..], more.as_slice()].concat())
        } else {
            send(&more)
        };
        assert_eq!(failed.status.code(), Some(code), "{more:?}");
        assert!(words(&failed.stderr).contains(expected), "{more:?}: {}", words(&failed.stderr));
    }
    let folder = tempfile::tempdir().expect("folder");
    let no_video = folder.path().join("text.mp4");
    std::fs::write(&no_video, "no video").expect("writes");
    let failed = run_stria(&["send", plain(&no_video), "--server", &url, "--asset", "Wall", "--rig", rig, "--wait"]);
    assert_eq!(failed.status.code(), Some(1));
    assert!(words(&failed.stderr).contains("text.mp4"), "{}", words(&failed.stderr));
}

#[test]
fn serve_refuses_what_would_do_harm() {
    let server = Server::start(&["--workers", "0"]);
    let data = server.data();
    let second = run_stria(&["serve", "--listen", "127.0.0.1:0", "--data", plain(&data)]);
    assert_eq!(second.status.code(), Some(1));
    assert!(words(&second.stderr).contains("in use"), "{}", words(&second.stderr));

    let folder = tempfile::tempdir().expect("folder");
    let data = plain(folder.path());
    let url = server.url("");
    let taken = url.trim_start_matches("http://");
    for (arguments, expected) in [
        (vec!["--listen", "0.0.0.0:0", "--without-authentication"], "127.0.0.1"),
        (vec!["--listen", "[::]:0", "--without-authentication"], "127.0.0.1"),
        (vec!["--tls-cert", "missing.pem"], "--tls-key"),
        (vec!["--tls-cert", "missing.pem", "--tls-key", "missing.pem"], "missing.pem"),
        (vec!["--listen", "nowhere"], "--listen"),
        (vec!["--max-upload-gb", "0"], "max-upload-gb"),
        (vec!["--workers", "100000"], "1024"),
        (vec!["--listen", taken], "expected a free address"),
    ] {
        let refused = run_stria(&[&["serve", "--data", data][..], arguments.as_slice()].concat());
        assert_eq!(refused.status.code(), Some(2), "{arguments:?}");
        assert!(words(&refused.stderr).contains(expected), "{arguments:?}: {}", words(&refused.stderr));
    }
}
