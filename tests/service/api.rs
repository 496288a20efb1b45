//! The interface itself: its document, what it refuses, the page beside it.

use std::io::{Read, Write};
use std::net::TcpStream;

use serde_json::{Value, json};
use stria_tests::support::server::{Server, header, json_of, problem_of, send, text};
use stria_tests::support::short_run;

#[test]
fn the_openapi_document_is_the_golden_one() {
    let server = Server::start(&["--workers", "0"]);
    let found = server.json("/api/openapi.json");
    let golden: Value = serde_json::from_str(include_str!("../../server/openapi.json")).expect("JSON");
    assert!(
        found == golden,
        "server/openapi.json differs from what the binary serves. If the change is meant, refresh it with\n  \
         target/release/stria openapi > server/openapi.json\nand the page's types with `npm run generate` in web/"
    );
    assert!(text(&golden, "/openapi").starts_with("3.1"));
    for (path, methods) in golden["paths"].as_object().expect("paths") {
        assert!(!path.contains('*'), "{path}");
        for (method, operation) in methods.as_object().expect("methods") {
            assert!(operation["operationId"].is_string() && operation["summary"].is_string(), "{method} {path}");
        }
    }
}

#[test]
fn every_get_of_the_document_exists() {
    let server = Server::start(&["--workers", "0"]);
    let document = server.json("/api/openapi.json");
    for (path, methods) in document["paths"].as_object().expect("paths") {
        if methods["get"].is_null() {
            continue;
        }
        let path = path
            .replace("{run}", "x")
            .replace("{job}", "x")
            .replace("{name}", "x")
            .replace("{number}", "0")
            .replace("{rig}", "x")
            .replace("{stream}", "x");
        let response = send(server.get(&path));
        match response.status().as_u16() {
            200 => {}
            // A WebSocket's address, asked by something else.
            400 => assert!(path.starts_with("/api/live/"), "{path}: 400"),
            404 => assert!(!text(&problem_of(response, 404), "/detail").contains("address"), "{path} has no route"),
            status => panic!("{path}: {status}"),
        }
    }
}

#[test]
fn what_does_not_exist_is_a_problem_document() {
    let server = Server::start(&["--workers", "0"]);
    for path in [
        "/api",
        "/api/",
        "/api/nothing",
        "/api/runs/x",
        "/api/jobs/x",
        "/api/jobs/x/log",
        "/api/runs/x/source",
        "/api/rigs/x",
        "/viewer/0.1.0/re_viewer.js",
        "/viewer/0.36.3/x",
        "/missing.js",
    ] {
        problem_of(send(server.get(path)), 404);
    }
    problem_of(send(server.post("/api/nothing")), 404);
    problem_of(send(server.delete("/api/runs")), 405);
    problem_of(send(server.patch("/api/jobs/x")), 405);
    let no_json = server.post("/api/runs/x/jobs").header("Content-Type", "text/plain").body("{}");
    problem_of(send(no_json), 415);
    let broken = server.patch("/api/runs/x").header("Content-Type", "application/json").body("{");
    problem_of(send(broken), 400);
}

#[test]
fn lists_of_what_can_be_chosen() {
    let server = Server::start(&["--workers", "2"]);
    let recipes = server.json("/api/recipes");
    assert!(
        recipes
            .as_array()
            .expect("a list")
            .iter()
            .any(|r| r["name"] == "paper" && text(r, "/toml").contains("[stripe]"))
    );
    assert_eq!(recipes.as_array().expect("a list").iter().filter(|r| r["default"] == true).count(), 1);
    let options = server.json("/api/options");
    let k = options.as_array().expect("a list").iter().find(|o| o["key"] == "stripe.k").expect("stripe.k").clone();
    assert_eq!((text(&k, "/range/kind"), k["range"]["min"].as_f64()), ("number".into(), Some(0.5)));
    // A worker says that it is there a moment after the server answers.
    let slots = || server.json("/api/workers")[0]["slots"].as_u64();
    let deadline = std::time::Instant::now() + std::time::Duration::from_secs(10);
    while slots().is_none() && std::time::Instant::now() < deadline {
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    assert_eq!(slots(), Some(2));
    assert_eq!(text(&server.json("/livez"), "/status"), "ok");
    assert_eq!(text(&server.json("/readyz"), "/status"), "ok");

    let toml = short_run().rig_text();
    let stored = json_of(send(server.post("/api/rigs").body(toml.clone())), 201);
    json_of(send(server.post("/api/rigs").body(toml.clone())), 200);
    let as_json = serde_json::to_string(&stored["rig"]).expect("JSON");
    json_of(send(server.post("/api/rigs").body(as_json)), 200);
    problem_of(send(server.post("/api/rigs").body(toml.replace("offset_mm = ", "offset_mm = 1"))), 409);
    problem_of(send(server.post("/api/rigs").body("name = 1")), 400);
    problem_of(send(server.post("/api/rigs").body(vec![0xff, 0xfe])), 400);
    assert_eq!(server.json("/api/rigs")["items"][0]["name"], "wall");
    assert_eq!(server.json("/api/rigs/wall")["toml"], stored["toml"]);
}

#[test]
fn foreign_pages_can_neither_write_nor_pretend_to_be_us() {
    let server = Server::start(&["--workers", "0"]);
    let own = server.url("");
    for (name, value) in [
        ("Origin", "https://evil.example"),
        ("Origin", "null"),
        ("Sec-Fetch-Site", "cross-site"),
        ("Sec-Fetch-Site", "same-site"),
    ] {
        problem_of(send(server.post("/api/rigs").header(name, value).body(short_run().rig_text())), 403);
        problem_of(send(server.delete("/api/runs/x").header(name, value)), 403);
    }
    assert_eq!(server.json("/api/rigs")["items"].as_array().map(Vec::len), Some(0));
    for path in ["/", "/api/runs", "/viewer/0.36.3/re_viewer.js"] {
        problem_of(send(server.get(path).header("Host", "evil.example")), 403);
    }
    let from_page = server.post("/api/rigs").header("Origin", &own).header("Sec-Fetch-Site", "same-origin");
    json_of(send(from_page.body(short_run().rig_text())), 201);
    assert_eq!(
        header(&send(server.get("/api/runs").header("Origin", "https://evil.example")), "access-control-allow-origin"),
        ""
    );
}

#[test]
fn the_page_and_the_viewer_come_from_the_binary() {
    let server = Server::start(&["--workers", "0"]);
    for path in ["/", "/runs/anything", "/jobs/x"] {
        let page = send(server.get(path));
        assert_eq!(page.status(), 200);
        assert!(header(&page, "content-type").starts_with("text/html"));
        assert_eq!(header(&page, "cache-control"), "no-cache");
        let policy = header(&page, "content-security-policy");
        for part in [
            "default-src 'self'",
            "script-src 'self' 'wasm-unsafe-eval'",
            "connect-src 'self'",
            "frame-ancestors 'none'",
        ] {
            assert!(policy.contains(part), "{policy}");
        }
        assert!(!policy.contains("http") && !policy.contains('*'), "{policy}");
    }
    let wasm = send(server.get("/viewer/0.36.3/re_viewer_bg.wasm").header("Accept-Encoding", "gzip"));
    assert_eq!(
        (header(&wasm, "content-type"), header(&wasm, "content-encoding")),
        ("application/wasm".into(), "gzip".into())
    );
    assert!(header(&wasm, "cache-control").contains("immutable"));
    let etag = header(&wasm, "etag");
    let packed = wasm.bytes().expect("a body");
    assert!(packed.starts_with(&[0x1f, 0x8b]) && packed.len() < 20_000_000, "{} bytes", packed.len());
    let again =
        server.get("/viewer/0.36.3/re_viewer_bg.wasm").header("Accept-Encoding", "gzip").header("If-None-Match", etag);
    assert_eq!(send(again).status(), 304);
    let plain = send(server.get("/viewer/0.36.3/re_viewer_bg.wasm"));
    assert_eq!(header(&plain, "content-encoding"), "");
    assert!(plain.bytes().expect("a body").starts_with(b"\0asm"));
    assert!(send(server.get("/viewer/re_viewer.js")).text().expect("a body").contains("wasm"));
}

/// Asks a raw question; the answer's first line.
fn raw(address: &str, request: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("connects");
    // The server may refuse a long head before it has all of it.
    let _ = stream.write_all(request.as_bytes());
    let mut answer = [0u8; 64];
    let read = stream.read(&mut answer).unwrap_or(0);
    String::from_utf8_lossy(&answer[..read]).lines().next().unwrap_or_default().to_string()
}

#[test]
fn odd_requests_do_not_disturb_the_server() {
    let server = Server::start(&["--workers", "0"]);
    let url = server.url("");
    let address = url.trim_start_matches("http://");
    let long = "x".repeat(1_000_000);
    for (request, expected) in [
        ("GET /livez HTTP/1.0\r\n\r\n".to_string(), "403"),
        (format!("GET /{long} HTTP/1.1\r\nHost: {address}\r\n\r\n"), ""),
        (format!("GET /livez HTTP/1.1\r\nHost: {address}\r\nX: {long}\r\n\r\n"), ""),
        (format!("GET /api/runs/%ff%fe HTTP/1.1\r\nHost: {address}\r\n\r\n"), "404"),
        (format!("GET /api/runs?limit=%00 HTTP/1.1\r\nHost: {address}\r\n\r\n"), "400"),
        (format!("POST /api/runs HTTP/1.1\r\nHost: {address}\r\nContent-Length: -1\r\n\r\n"), "400"),
        (
            format!(
                "POST /api/runs HTTP/1.1\r\nHost: {address}\r\nContent-Type: multipart/form-data\r\nContent-Length: 0\r\n\r\n"
            ),
            "400",
        ),
    ] {
        let line = raw(address, &request);
        assert!(line.contains(expected), "{line} instead of {expected} to {}", &request[..request.len().min(60)]);
    }
    assert_eq!(text(&server.json("/readyz"), "/status"), "ok");
}

#[test]
fn what_is_said_about_a_run_changes_only_where_it_is_what_was_read() {
    let server = Server::start(&["--workers", "0"]);
    let run = server.upload(short_run(), "Wall");
    let (path, version) = (format!("/api/runs/{}", text(&run, "/id")), text(&run, "/version"));
    let change = |note: &str, versions: &str| {
        send(server.patch(&path).header("If-Match", versions).json(&json!({ "note": note })))
    };
    let first = json_of(change("first", &format!("\"{version}\"")), 200);
    assert_ne!(text(&first, "/version"), version);
    let refused = problem_of(change("late", &format!("\"{version}\"")), 412);
    assert_eq!(text(&refused, "/type"), "urn:stria:changed");
    assert_eq!(text(&server.json(&path), "/note"), "first");
    json_of(change("any", "*"), 200);
    let now = text(&server.json(&path), "/version");
    json_of(change("one of two", &format!("\"{version}\", \"{now}\"")), 200);
    assert_eq!(text(&server.json(&path), "/note"), "one of two");
}
