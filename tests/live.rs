//! Live runs from outside: senders that we did not write, and one in Python that speaks the WebSocket protocol; what they
//! sent is what is processed, bit for bit, whatever happens to the connection or the server.

#[path = "live/hostile.rs"]
mod hostile;

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;

use serde_json::Value;
use stria_tests::support::server::{Server, json_of, problem_of, send, text};
use stria_tests::support::{Run, eventually, form, long_run};
use tempfile::TempDir;

/// A robot that vanished is waited for so long in these tests, s.
const COME_BACK_S: &str = "3";

fn server() -> Server {
    Server::start(&["--workers", "1", "--live-come-back-s", COME_BACK_S])
}

fn ffmpeg(arguments: &[&str]) -> Command {
    let mut command = Command::new("ffmpeg");
    command.args(["-hide_banner", "-loglevel", "error", "-nostdin"]).args(arguments);
    command
}

fn run_ffmpeg(arguments: &[&str]) {
    let status = ffmpeg(arguments).status().expect("ffmpeg is installed: docker/set-up.sh brings it");
    assert!(status.success(), "ffmpeg {arguments:?}");
}

/// The frames of the long run as JPEG images.
fn jpegs() -> &'static Path {
    static FOLDER: OnceLock<TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let pattern = folder.path().join("%05d.jpg");
        let video = plain(&long_run().video).to_string();
        run_ffmpeg(&["-i", &video, "-q:v", "2", pattern.to_str().expect("a plain path")]);
        folder
    });
    folder.path()
}

fn jpeg_count() -> u64 {
    std::fs::read_dir(jpegs()).expect("the images were made").count() as u64
}

fn plain(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

/// The address of a stream for a sender that POSTs.
fn post_url(server: &Server, stream: &str, run: &Run) -> String {
    let rig: String = form::percent_encoded(&run.rig_text());
    server.url(&format!("/api/live/{stream}?asset=Live&rig={rig}"))
}

fn stream(server: &Server, name: &str) -> Value {
    let streams = server.json("/api/live");
    let found = streams["items"].as_array().expect("items").iter().find(|s| s["stream"] == name);
    found.unwrap_or_else(|| panic!("no stream {name} in {streams:#}")).clone()
}

fn depth_map_sha256(server: &Server, job: &str) -> String {
    server.wait_for_state(job, "done");
    let products = server.json(&format!("/api/jobs/{job}/products?limit=1000"));
    let found = products["items"].as_array().expect("items").iter().find(|p| p["name"] == "depth.tif");
    text(found.expect("a depth map"), "/sha256")
}

/// The depth map of the same images, uploaded whole.
fn batch_sha256(server: &Server, file: &Path) -> String {
    let name = file.file_name().and_then(|n| n.to_str()).expect("a name");
    let bytes = std::fs::read(file).expect("the file was made");
    let body = form::form(&[("asset", "Batch"), ("rig", &long_run().rig_text())], name, &bytes);
    let made = json_of(send(server.post("/api/runs").header("Content-Type", form::content_type()).body(body)), 201);
    depth_map_sha256(server, &text(&made, "/job/id"))
}

/// The Python sender at work.
struct Sender(Child);

impl Sender {
    fn start(server: &Server, stream: &str, fps: &str, left_out: &[&str]) -> Sender {
        let folder = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/live"));
        let python = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../target/python/bin/python"));
        assert!(python.exists(), "{} is missing: run docker/set-up.sh", python.display());
        let url = server.url(&format!("/api/live/{stream}")).replacen("http", "ws", 1);
        let child = Command::new(python)
            .arg(folder.join("sender.py"))
            .args([&url, "Live", plain(&long_run().rig), plain(jpegs()), fps])
            .args(left_out)
            .stdout(Stdio::piped())
            .spawn();
        Sender(child.expect("the sender starts"))
    }

    /// Everything that it says until its end, and whether that was a good one.
    fn finish(mut self) -> (Vec<Value>, bool) {
        let out = BufReader::new(self.0.stdout.take().expect("piped"));
        let said = out.lines().map(|line| serde_json::from_str(&line.expect("text")).expect("JSON")).collect();
        (said, self.0.wait().expect("it ends").success())
    }
}

impl Drop for Sender {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn of_type<'a>(said: &'a [Value], kind: &str) -> Vec<&'a Value> {
    said.iter().filter(|s| s["type"] == kind).collect()
}

#[test]
fn an_unmodified_ffmpeg_sends_mjpeg_and_the_surface_is_that_of_the_batch() {
    let (server, folder) = (server(), tempfile::tempdir().expect("a folder"));
    let video = plain(&long_run().video);
    let mjpeg = folder.path().join("run.mjpeg");
    run_ffmpeg(&[
        "-re",
        "-i",
        video,
        "-q:v",
        "3",
        "-f",
        "mpjpeg",
        "-method",
        "POST",
        &post_url(&server, "cam", long_run()),
    ]);
    run_ffmpeg(&["-i", video, "-q:v", "3", "-f", "mpjpeg", plain(&mjpeg)]);
    let live = stream(&server, "cam");
    assert_eq!((&live["kind"], &live["open"], live["frames"].as_u64()), (&"frames".into(), &false.into(), Some(60)));
    assert_eq!(depth_map_sha256(&server, &text(&live, "/job")), batch_sha256(&server, &mjpeg));
    // The stored frames come back as a file that is a run as well.
    let stored = folder.path().join("stored.frames");
    let source = send(server.get(&format!("/api/runs/{}/source", text(&live, "/run"))));
    std::fs::write(&stored, source.bytes().expect("a body")).expect("writes");
    assert_eq!(depth_map_sha256(&server, &text(&live, "/job")), batch_sha256(&server, &stored));
}

#[test]
fn an_unmodified_ffmpeg_sends_mpeg_ts_and_the_surface_is_that_of_the_batch() {
    let (server, folder) = (server(), tempfile::tempdir().expect("a folder"));
    let video = plain(&long_run().video);
    for (name, codec) in [("h264", ["-c:v", "copy"]), ("h265", ["-c:v", "libx265"])] {
        let ts = folder.path().join(format!("{name}.ts"));
        let url = post_url(&server, name, long_run());
        run_ffmpeg(
            &[
                &["-re", "-i", video][..],
                &codec,
                &["-x265-params", "log-level=none"],
                &["-f", "mpegts", "-method", "POST", &url],
            ]
            .concat(),
        );
        // This sender does not wait for the answer.
        eventually("the run is closed", || stream(&server, name)["open"] == false);
        let live = stream(&server, name);
        assert_eq!(live["kind"], "ts");
        let source = send(server.get(&format!("/api/runs/{}/source", text(&live, "/run"))));
        std::fs::write(&ts, source.bytes().expect("a body")).expect("writes");
        let job = server.wait_for_state(&text(&live, "/job"), "done");
        assert_eq!(job["frames"], 60, "{name}");
        assert_eq!(depth_map_sha256(&server, &text(&live, "/job")), batch_sha256(&server, &ts), "{name}");
    }
    // Both are in the list, the latest first, page by page.
    let first = server.json("/api/live?limit=1");
    let cursor = text(&first, "/next_cursor");
    let second = server.json(&format!("/api/live?limit=1&cursor={cursor}"));
    assert_eq!((text(&first, "/items/0/stream"), text(&second, "/items/0/stream")), ("h265".into(), "h264".into()));
    assert!(second["next_cursor"].is_null(), "{second:#}");
}

#[test]
fn a_websocket_sender_sends_frames_and_the_surface_is_that_of_the_batch() {
    let server = server();
    let (said, good) = Sender::start(&server, "robot", "30", &[]).finish();
    assert!(good, "{said:#?}");
    let closed = of_type(&said, "closed");
    assert_eq!((closed[0]["frames"].as_u64(), &closed[0]["missing"]), (Some(jpeg_count()), &Value::Array(vec![])));
    let acks: Vec<u64> = of_type(&said, "ack").iter().filter_map(|a| a["durable_seq"].as_u64()).collect();
    assert!(acks.len() > 4 && acks.is_sorted(), "{acks:?}");
    let job = text(of_type(&said, "welcome")[0], "/job");
    let bare = tempfile::tempdir().expect("a folder");
    let mut all = Vec::new();
    let mut files: Vec<PathBuf> = std::fs::read_dir(jpegs()).expect("lists").flatten().map(|e| e.path()).collect();
    files.sort();
    files.iter().for_each(|file| all.extend(std::fs::read(file).expect("reads")));
    let file = bare.path().join("bare.mjpeg");
    std::fs::write(&file, all).expect("writes");
    assert_eq!(depth_map_sha256(&server, &job), batch_sha256(&server, &file));
    assert_eq!(server.json(&format!("/api/jobs/{job}"))["priority"], "live");
}

#[test]
fn the_surface_grows_while_the_robot_walks() {
    let server = server();
    // 60 frames at 5 a second: twelve seconds.
    let sender = Sender::start(&server, "slow", "5", &[]);
    eventually("the stream is there", || server.json("/api/live")["items"].as_array().is_some_and(|i| !i.is_empty()));
    let job = text(&stream(&server, "slow"), "/job");
    server.wait_for(&job, "showing something before the stream has ended", |job| {
        let shown = server.json(&format!("/api/jobs/{}/recording", text(job, "/id")))["segments"]
            .as_array()
            .map_or(0, Vec::len);
        job["state"] == "running" && job["frames"].as_u64() > Some(5) && shown > 2
    });
    assert_eq!(stream(&server, "slow")["open"], true);
    problem_of(send(server.get(&format!("/api/runs/{}/source", text(&stream(&server, "slow"), "/run")))), 409);
    let (said, good) = sender.finish();
    assert!(good, "{said:#?}");
    server.wait_for_state(&job, "done");
}

#[test]
fn frames_that_were_never_sent_are_listed() {
    let server = server();
    let (said, good) = Sender::start(&server, "gappy", "200", &["10", "14"]).finish();
    assert!(good, "{said:#?}");
    let closed = of_type(&said, "closed")[0];
    assert_eq!(closed["missing"], serde_json::json!([[10, 14]]));
    let job = server.wait_for_state(&text(of_type(&said, "welcome")[0], "/job"), "done");
    assert_eq!(job["frames"].as_u64(), Some(jpeg_count() - 5));
    let warnings = job["warnings"].to_string();
    assert!(warnings.contains("5 frames were never received"), "{warnings}");
}

#[test]
fn after_kill_9_of_the_server_the_stream_goes_on_where_it_was_durable() {
    // One address for both lives of the server, since the sender comes back to it.
    let port = std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a free port").port();
    let listen = format!("127.0.0.1:{port}");
    let mut server = Server::start(&["--workers", "1", "--listen", &listen]);
    let sender = Sender::start(&server, "robot", "20", &[]);
    eventually("some frames are durable", || {
        let streams = server.json("/api/live");
        streams["items"].as_array().is_some_and(|i| i.iter().any(|s| s["frames"].as_u64() > Some(15)))
    });
    server.kill();
    server.start_again();
    let (said, good) = sender.finish();
    assert!(good, "{said:#?}");
    let welcomes = of_type(&said, "welcome");
    assert!(welcomes.len() >= 2 && welcomes.iter().all(|w| w["run"] == welcomes[0]["run"]), "{welcomes:#?}");
    // Nothing that was promised is asked for again.
    let promised = said.iter().take_while(|s| s["lost"].is_null()).filter_map(|s| s["durable_seq"].as_u64()).max();
    let next = welcomes.last().expect("a welcome")["next_seq"].as_u64();
    assert!(next > promised && next < Some(jpeg_count()), "promised {promised:?}, asked for {next:?}");
    assert_eq!(of_type(&said, "closed")[0]["frames"].as_u64(), Some(jpeg_count()));
    let job = server.wait_for_state(&text(welcomes[0], "/job"), "done");
    assert_eq!(job["frames"].as_u64(), Some(jpeg_count()));
}

#[test]
fn a_robot_that_vanishes_leaves_a_processed_run_and_one_that_comes_back_goes_on() {
    let server = server();
    let begin = |fps: &str| {
        let mut sender = Sender::start(&server, "robot", fps, &[]);
        let before =
            server.json("/api/live")["items"].as_array().and_then(|i| i.first()?["frames"].as_u64()).unwrap_or(0);
        eventually("more frames are there", || {
            server.json("/api/live")["items"]
                .as_array()
                .is_some_and(|i| i.first().is_some_and(|s| s["frames"].as_u64() > Some(before + 5)))
        });
        sender.0.kill().expect("it runs");
        stream(&server, "robot")
    };
    let first = begin("10");
    // It comes back in time: the same run.
    let second = begin("10");
    assert_eq!(first["run"], second["run"]);
    assert!(second["frames"].as_u64() > first["frames"].as_u64());
    // It does not: the run is closed and processed as it is.
    eventually("the run is closed", || stream(&server, "robot")["open"] == false);
    let job = server.wait_for_state(&text(&second, "/job"), "done");
    assert!(job["frames"].as_u64() >= second["frames"].as_u64(), "{job:#}");
    // And the next one is another run, with the numbers going on.
    let third = begin("1000");
    assert_ne!(third["run"], second["run"]);
}

#[test]
fn a_transport_stream_that_was_cut_goes_on_as_a_new_part_of_the_same_run() {
    let server = Server::start(&["--workers", "1", "--live-come-back-s", "20"]);
    let (video, url) = (plain(&long_run().video), post_url(&server, "cut", long_run()));
    let mut first = ffmpeg(&["-re", "-i", video, "-c:v", "libx264", "-g", "10", "-tune", "zerolatency"])
        .args(["-f", "mpegts", "-method", "POST", &url])
        .spawn()
        .expect("ffmpeg is installed: docker/set-up.sh brings it");
    eventually("some of it is there", || {
        server.json("/api/live")["items"]
            .as_array()
            .is_some_and(|i| i.iter().any(|s| s["bytes"].as_u64() > Some(50_000)))
    });
    first.kill().and_then(|()| first.wait()).expect("it ends");
    let before = stream(&server, "cut");
    assert_eq!(before["open"], true);
    run_ffmpeg(&["-re", "-i", video, "-c", "copy", "-f", "mpegts", "-method", "POST", &url]);
    eventually("the run is closed", || stream(&server, "cut")["open"] == false);
    let after = stream(&server, "cut");
    assert_eq!(before["run"], after["run"]);
    let job = server.wait_for_state(&text(&after, "/job"), "done");
    // All of the second part, and what could be decoded of the first.
    assert!(job["frames"].as_u64() > Some(65), "{job:#}");
    // Again from the same segments: the same surface.
    let again = json_of(
        send(server.post(&format!("/api/runs/{}/jobs", text(&after, "/run"))).json(&serde_json::json!({}))),
        201,
    );
    let (one, two) = (text(&after, "/job"), text(&again, "/id"));
    assert_eq!(depth_map_sha256(&server, &one), depth_map_sha256(&server, &two));
}

#[test]
fn what_cannot_be_used_is_refused_with_a_reason() {
    let server = server();
    let rig = form::percent_encoded(&long_run().rig_text());
    for (path, body, field) in [
        ("/api/live/a?rig=none".to_string(), &b"--x\r\n"[..], "rig"),
        (format!("/api/live/a?rig={rig}"), b"--x\r\n", "asset"),
        (format!("/api/live/a?asset=A&rig={rig}&resume=perhaps"), b"--x\r\n", "resume"),
        (format!("/api/live/a?asset=A&rig={rig}"), b"this is no video", "body"),
        (format!("/api/live/a?asset=A&rig={rig}"), b"", "body"),
        (format!("/api/live/a%20b?asset=A&rig={rig}"), b"--x\r\n", "stream"),
        (format!("/api/live/a?asset=A&rig={rig}"), &[0xff, 0xd8, 0xff, 0xe0, 0, 0, 0, 0], "body"),
    ] {
        let problem = problem_of(send(server.post(&path).body(body.to_vec())), 400);
        assert_eq!(problem["field"], field, "{path}: {problem:#}");
    }
    let problem = problem_of(send(server.get("/api/live/a")), 400);
    assert!(text(&problem, "/expected").contains("WebSocket"), "{problem:#}");
}
