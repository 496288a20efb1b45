//! A program that we did not write asks the running server all that its OpenAPI document allows, and more: no answer is a
//! failure of the server, none is undocumented.

use std::path::Path;
use std::process::Command;

use serde_json::json;
use stria_tests::support::readers::python_program;
use stria_tests::support::server::{Server, header, json_of, send, text};
use stria_tests::support::short_run;

use super::doors::token;

#[test]
fn schemathesis_finds_no_failure_and_no_undocumented_answer() {
    let mut server = Server::start_locked(&["--workers", "1", "--requests-per-s", "100000"]);
    let secret = token(&server, "admin");
    server.use_token(&secret);
    // A run that is done, and as a batch once more; the server keeps what is asked of it busy.
    let rig = send(server.post("/api/rigs").header("Content-Type", "application/toml").body(short_run().rig_text()));
    assert_eq!(text(&json_of(rig, 201), "/name"), "wall");
    let run = server.upload(short_run(), "Wall");
    server.wait_for_state(&text(&run, "/job/id"), "done");
    let batch = json_of(send(server.post("/api/batches").json(&json!({"filter": {}}))), 201);
    let spare = json_of(send(server.post("/api/tokens").json(&json!({"name": "spare", "scopes": ["read"]}))), 201);

    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("openapi");
    let folder = tempfile::tempdir().expect("folder");
    let asked = Command::new(python_program("schemathesis"))
        .arg("--config-file")
        .arg(own.join("schemathesis.toml"))
        .args(["run", &server.url("/api/openapi.json"), "--no-color", "--workers", "1"])
        .current_dir(folder.path())
        .env("SCHEMATHESIS_HOOKS", "hooks")
        .env("PYTHONPATH", &own)
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .envs([("STRIA_TOKEN", &secret), ("STRIA_RUN", &text(&run, "/id")), ("STRIA_JOB", &text(&run, "/job/id"))])
        .envs([("STRIA_BATCH", &text(&batch, "/id")), ("STRIA_SPARE", &text(&spare, "/id"))])
        .output()
        .expect("it starts");
    let said = String::from_utf8_lossy(&asked.stdout);
    let errors = String::from_utf8_lossy(&asked.stderr);
    assert!(asked.status.success(), "{said}\n{errors}");
    // Where its token was taken away, it asked in vain.
    assert_eq!(send(server.get("/api/runs")).status(), 200);
    assert!(!said.contains("Authentication failed"), "{said}");
    let routes = json_of(send(server.get("/api/openapi.json")), 200)["paths"]
        .as_object()
        .map_or(0, |paths| paths.values().filter_map(|item| item.as_object()).map(serde_json::Map::len).sum::<usize>());
    let tested = said.lines().find_map(|line| line.trim().strip_prefix("Tested: ")).expect("a summary");
    assert_eq!(tested.parse::<usize>().ok(), Some(routes), "{said}");
}

#[test]
fn the_interface_has_a_page_for_people() {
    let server = Server::start_locked(&["--workers", "0"]);
    let page = send(server.get("/api/docs"));
    assert_eq!(page.status(), 200);
    assert!(header(&page, "content-security-policy").contains("default-src 'none'"));
    let page = page.text().expect("text");
    assert!(page.contains("/api/runs/{run}/jobs") && page.contains("Idempotency-Key"), "{page}");
}
