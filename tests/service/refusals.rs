//! Bad input: a clear word at once or on the job, the server goes on, nothing is left behind half-made.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use stria_tests::support::form::{content_type, form};
use stria_tests::support::server::{Server, json_of, problem_of, send, text};
use stria_tests::support::{files_below, short_run};

/// Waits for clean-up, which follows an answer.
fn assert_nothing_kept(server: &Server) {
    let begun = Instant::now();
    loop {
        let (store, incoming) =
            (files_below(&server.data().join("store")), files_below(&server.data().join("incoming")));
        if store.is_empty() && incoming.is_empty() {
            return;
        }
        assert!(begun.elapsed() < Duration::from_secs(10), "left behind: {store:?} {incoming:?}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn what_cannot_be_used_is_refused_by_field() {
    let server = Server::start(&["--workers", "0"]);
    let good = short_run().rig_text();
    let plane_through_camera = good.replace("plane_offset_mm", "plane_offset_mm = 0.0 #");
    let no_width = good.replace("width_px", "width_px = 0 #");
    let huge = good.replace("width_px", "width_px = 20000 #");
    let typo = good.replace("[laser]", "[laser]\ncolor = \"green\"");
    let no_hash = "0".repeat(64);
    for (fields, file, field) in [
        (vec![("asset", "Wall"), ("rig", plane_through_camera.as_str())], "x", "rig.laser.plane_offset_mm"),
        (vec![("asset", "Wall"), ("rig", no_width.as_str())], "x", "rig.camera.width_px"),
        (vec![("asset", "Wall"), ("rig", huge.as_str())], "x", "rig.camera.width_px"),
        (vec![("asset", "Wall"), ("rig", typo.as_str())], "x", "rig"),
        (vec![("asset", "Wall"), ("rig", "no-such-rig")], "x", "rig"),
        (vec![("asset", "Wall"), ("rig", "= = =")], "x", "rig"),
        (vec![("asset", "Wall")], "x", "rig"),
        (vec![("rig", good.as_str())], "x", "asset"),
        (vec![("asset", "Wall"), ("rig", good.as_str())], "", "file"),
        (vec![("asset", "Wall"), ("rig", good.as_str()), ("recipe", "fast")], "x", "recipe"),
        (vec![("asset", "Wall"), ("rig", good.as_str()), ("recipe", "[stripe]\nk = 9.0")], "x", "recipe.stripe.k"),
        (vec![("asset", "Wall"), ("rig", good.as_str()), ("chainage_mm", "far")], "x", "chainage_mm"),
        (vec![("asset", "Wall"), ("rig", good.as_str()), ("chainage_mm", "inf")], "x", "chainage_mm"),
        (vec![("asset", "Wall"), ("rig", good.as_str()), ("direction", "up")], "x", "direction"),
        (vec![("asset", "Wall"), ("rig", good.as_str()), ("recorded_at", "today")], "x", "recorded_at"),
        (vec![("asset", "Wall"), ("rig", good.as_str()), ("fps", "-1")], "x", "fps"),
        (vec![("asset", "Wall"), ("rig", good.as_str()), ("sha256", no_hash.as_str())], "x", "sha256"),
        (vec![("asset", "Wall"), ("asset", "Wall"), ("rig", good.as_str())], "x", "asset"),
        (vec![("asset", "Wall"), ("rig", good.as_str()), ("speed", "1")], "x", "speed"),
    ] {
        let query = send(server.post("/api/runs").query(&fields).body(file));
        let body = form(&fields, "a.mp4", file.as_bytes());
        let by_form = send(server.post("/api/runs").header("Content-Type", content_type()).body(body));
        for response in [query, by_form] {
            let problem = problem_of(response, 400);
            assert_eq!(text(&problem, "/field"), field, "{problem:#}");
            assert!(!text(&problem, "/expected").is_empty());
        }
    }
    let no_file = format!("--{0}--\r\n", stria_tests::support::form::BOUNDARY);
    problem_of(send(server.post("/api/runs").header("Content-Type", content_type()).body(no_file)), 400);
    let mut cut = form(&[("asset", "Wall"), ("rig", good.as_str())], "a.mp4", b"half of it");
    cut.truncate(cut.len() - 20);
    problem_of(send(server.post("/api/runs").header("Content-Type", content_type()).body(cut)), 400);
    assert_eq!(server.json("/api/runs")["items"].as_array().map(Vec::len), Some(0));
    assert_nothing_kept(&server);
}

#[test]
fn too_much_is_refused_before_and_while_it_comes() {
    let server = Server::start(&["--workers", "0", "--max-upload-gb", "0.001"]);
    let rig = short_run().rig_text();
    let query = [("asset", "Wall"), ("rig", rig.as_str())];
    let body = vec![7u8; 1_500_000];
    problem_of(send(server.post("/api/runs").query(&query).body(body.clone())), 413);
    let fields = form(&query, "a.mp4", &body);
    problem_of(send(server.post("/api/runs").header("Content-Type", content_type()).body(fields)), 413);
    // Chunked: nobody knows the size before.
    let chunked = reqwest::blocking::Body::new(std::io::Cursor::new(body));
    problem_of(send(server.post("/api/runs").query(&query).body(chunked)), 413);
    let big_json = format!("{{\"note\": \"{}\"}}", "x".repeat(400_000));
    let patch = server.patch("/api/runs/x").header("Content-Type", "application/json").body(big_json);
    assert!(send(patch).status().is_client_error());
    assert_nothing_kept(&server);
    let fits = send(server.post("/api/runs").query(&query).body(vec![7u8; 900_000]));
    json_of(fits, 201);
}

#[test]
fn a_sender_who_leaves_in_the_middle_leaves_nothing() {
    let server = Server::start(&["--workers", "0"]);
    let url = server.url("");
    let address = url.trim_start_matches("http://");
    let rig = short_run().rig_text();
    let body = form(&[("asset", "Wall"), ("rig", rig.as_str())], "a.mp4", &vec![1u8; 300_000]);
    for part in [0, 100, 2000, 200_000] {
        let mut stream = TcpStream::connect(address).expect("connects");
        let head = format!(
            "POST /api/runs HTTP/1.1\r\nHost: {address}\r\nContent-Type: {}\r\nContent-Length: {}\r\n\r\n",
            content_type(),
            body.len()
        );
        stream.write_all(head.as_bytes()).expect("sends");
        stream.write_all(&body[..part]).expect("sends");
        drop(stream);
    }
    let mut garbage = TcpStream::connect(address).expect("connects");
    garbage.write_all(b"\x16\x03\x01 this is no HTTP\r\n\r\n").expect("sends");
    let mut answer = String::new();
    let _ = garbage.read_to_string(&mut answer);
    assert!(answer.starts_with("HTTP/1.1 400"), "{answer}");
    assert_nothing_kept(&server);
    assert_eq!(server.json("/api/runs")["items"].as_array().map(Vec::len), Some(0));
}

#[test]
fn files_that_are_no_videos_fail_their_job_with_a_reason() {
    let server = Server::start(&["--workers", "1"]);
    let rig = short_run().rig_text();
    let other_size = rig.replace("width_px = 320", "width_px = 322");
    assert_ne!(rig, other_size, "the simulated rig is 320 px wide");
    let video = short_run().video_bytes();
    let text_file = b"this is a text, whatever its name says\n".repeat(100);
    for (rig, file) in [(&rig, text_file), (&other_size, video)] {
        let query = [("asset", "Wall"), ("rig", rig.as_str()), ("filename", "it's \"a\" video.mp4")];
        let run = json_of(send(server.post("/api/runs").query(&query).body(file)), 201);
        let job = server.wait_for_state(&text(&run, "/job/id"), "failed");
        assert_eq!(text(&job, "/error/type"), "urn:stria:job:bad_input", "{job:#}");
        assert_eq!((job["attempt"].as_i64(), job["error"]["retryable"].as_bool()), (Some(1), Some(false)));
        let detail = text(&job, "/error/detail");
        assert!(detail.len() > 20 && !detail.contains("/store/") && !detail.contains(".rs:"), "{detail}");
        let path = format!("/api/jobs/{}", text(&job, "/id"));
        assert_eq!(server.json(&format!("{path}/products"))["items"].as_array().map(Vec::len), Some(0));
        let log = server.json(&format!("{path}/log"));
        let lines = log["items"].as_array().expect("items");
        assert!(lines.iter().any(|l| text(l, "/text").contains("bad_input")), "{log:#}");
        assert_eq!(text(&server.json(&format!("/api/runs/{}", text(&run, "/id"))), "/state"), "failed");
    }
    // Only the two sources are kept; scratch and half-made products are gone.
    let begun = Instant::now();
    while !files_below(&server.data().join("scratch")).is_empty() || files_below(&server.data().join("store")).len() > 2
    {
        assert!(begun.elapsed() < Duration::from_secs(10), "{:?}", files_below(&server.data()));
        std::thread::sleep(Duration::from_millis(50));
    }
}
