//! Doors that lock: tokens, scopes, sessions, the log of writes, rates, TLS.

use std::process::Command;
use std::time::Duration;

use reqwest::blocking::{Client, Response};
use serde_json::{Value, json};
use stria_tests::support::server::{Server, header, json_of, problem_of, send, text};
use stria_tests::support::{run_stria, short_run, stria};

/// Routes that need nothing: whoever adds one says so here.
const OPEN: [&str; 3] = ["get /livez", "get /readyz", "post /api/session"];
const SCOPES: [&str; 4] = ["ingest", "read", "operate", "admin"];

/// A token made on the command line, in the server's folder.
pub(super) fn token(server: &Server, scopes: &str) -> String {
    let data = server.data();
    let made =
        run_stria(&["token", "create", "test", "--scopes", scopes, "--data", data.to_str().expect("a plain path")]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let secret = String::from_utf8_lossy(&made.stdout).trim().to_string();
    assert!(secret.starts_with("stria_") && !secret.contains(char::is_whitespace), "{secret:?}");
    secret
}

fn ask(client: &Client, server: &Server, method: &str, path: &str, token: Option<&str>) -> Response {
    let method = method.to_uppercase().parse().expect("a method");
    let mut request = client.request(method, server.url(path)).header("Content-Type", "application/json").body("{}");
    if let Some(token) = token {
        request = request.bearer_auth(token);
    }
    send(request)
}

/// The words of a refusal; an answer to HEAD has none.
fn refused(response: Response, method: &str, status: u16) -> String {
    if method == "head" {
        assert_eq!(response.status().as_u16(), status);
        return String::new();
    }
    text(&problem_of(response, status), "/detail")
}

#[test]
fn every_route_is_shut_without_a_token_and_with_the_wrong_scope() {
    let server = Server::start_locked(&["--workers", "0", "--requests-per-s", "100000"]);
    let client = Client::builder().redirect(reqwest::redirect::Policy::none()).build().expect("a client");
    let tokens: Vec<(&str, String, String)> = SCOPES
        .iter()
        .map(|scope| {
            let others: Vec<_> = SCOPES[..3].iter().filter(|s| *s != scope).copied().collect();
            (*scope, token(&server, scope), token(&server, &others.join(",")))
        })
        .collect();
    let document = json_of(send(server.get("/api/openapi.json")), 200);
    let (mut shut, mut open) = (0, Vec::new());
    for (pattern, methods) in document["paths"].as_object().expect("paths") {
        for (method, operation) in methods.as_object().expect("methods") {
            let path =
                pattern.split('/').map(|w| if w.starts_with('{') { "x" } else { w }).collect::<Vec<_>>().join("/");
            let what = format!("{method} {pattern}");
            let needs = operation["security"].as_array().unwrap_or_else(|| panic!("{what} says nothing of tokens"));
            if needs.is_empty() {
                open.push(what);
                continue;
            }
            let stranger = ask(&client, &server, method, &path, None);
            assert_eq!(header(&stranger, "www-authenticate"), "Bearer realm=\"stria\"", "{what}");
            refused(stranger, method, 401);
            refused(ask(&client, &server, method, &path, Some("stria_nobody")), method, 401);
            let scope = needs[0]["token"].get(0).and_then(Value::as_str);
            if let Some(scope) = scope {
                let (_, right, wrong) = tokens.iter().find(|(s, ..)| *s == scope).expect("one of ours");
                let detail = refused(ask(&client, &server, method, &path, Some(wrong)), method, 403);
                assert!(detail.contains(scope) || method == "head", "{what}: {detail}");
                // Streams and uploads may wait for more; what matters is that the door opens.
                let patient = Client::builder().timeout(Duration::from_secs(5)).build().expect("a client");
                let admitted = ask(&patient, &server, method, &path, Some(right)).status().as_u16();
                assert!(admitted != 401 && admitted != 403, "{what}: {admitted}");
                for status in ["401", "403", "429"] {
                    assert!(operation["responses"][status].is_object(), "{what} does not document {status}");
                }
            }
            shut += 1;
        }
    }
    open.sort();
    assert_eq!(open, OPEN, "routes that need no token");
    assert!(shut > 25, "{shut}");
    // What is not a route is shut as well, and the page's own files are not.
    problem_of(ask(&client, &server, "post", "/api/nothing", None), 401);
    problem_of(ask(&client, &server, "get", "/api/runs/x/..", None), 401);
    let page = send(client.get(server.url("/runs/x?y=1")));
    assert_eq!((page.status().as_u16(), header(&page, "location").as_str()), (303, "/login?next=/runs/x%3Fy%3D1"));
    assert_eq!(send(client.get(server.url("/login"))).status(), 200);
}

#[test]
fn the_first_start_prints_an_address_that_logs_in_once() {
    let mut server = Server::start_locked(&["--workers", "0"]);
    let line = server.said().into_iter().find(|l| l.contains("/login?code=")).expect("a login address");
    let path = line.split_once(&server.url("")).expect("the server's address").1.to_string();
    let client = Client::builder().redirect(reqwest::redirect::Policy::none()).build().expect("a client");
    let first = send(client.get(server.url(&format!("{path}&next=/runs"))));
    assert_eq!((first.status().as_u16(), header(&first, "location").as_str()), (303, "/runs"));
    let cookie = header(&first, "set-cookie");
    for part in ["stria_session=", "HttpOnly", "SameSite=Lax", "Path=/"] {
        assert!(cookie.contains(part), "{cookie}");
    }
    assert_eq!(send(client.get(server.url(&path))).status(), 401, "only once");

    let session = cookie.split(';').next().expect("a pair").to_string();
    let who = json_of(send(client.get(server.url("/api/session")).header("Cookie", &session)), 200);
    assert_eq!((who["scopes"][0].as_str(), who["locked"].as_bool()), (Some("admin"), Some(true)));
    assert_eq!(send(client.get(server.url("/")).header("Cookie", &session)).status(), 200);
    // A write proves that our own page makes it.
    let wish = json!({"name": "robot 3", "scopes": ["ingest"]});
    let write = || client.post(server.url("/api/tokens")).header("Cookie", &session).json(&wish);
    problem_of(send(write()), 403);
    problem_of(send(write().header("Origin", "https://evil.example")), 403);
    problem_of(send(write().header("Sec-Fetch-Site", "cross-site")), 403);
    let made = json_of(send(write().header("Origin", server.url(""))), 201);
    let secret = text(&made, "/secret");
    let robot = |token: &str| send(client.post(server.url("/api/runs?asset=x")).bearer_auth(token)).status().as_u16();
    assert_eq!(robot(&secret), 400, "it is let in, and its request is at fault");

    let path = format!("/api/tokens/{}", text(&made, "/id"));
    let own = |request: reqwest::blocking::RequestBuilder| {
        send(request.header("Cookie", &session).header("Sec-Fetch-Site", "same-origin"))
    };
    let next = json_of(own(client.post(server.url(&format!("{path}/rotate"))).json(&json!({"overlap_s": 0}))), 201);
    assert_eq!((robot(&secret), robot(&text(&next, "/secret"))), (401, 400));
    let listed = json_of(own(client.get(server.url("/api/tokens"))), 200);
    assert_eq!(listed["items"].as_array().map(Vec::len), Some(2));
    assert!(!listed.to_string().contains(&text(&next, "/secret")), "a secret is shown once");
    json_of(own(client.delete(server.url(&format!("/api/tokens/{}", text(&next, "/id"))))), 200);
    assert_eq!(robot(&text(&next, "/secret")), 401);

    // Everything that wrote is in the log, and nothing that was turned away.
    let audit = json_of(own(client.get(server.url("/api/audit"))), 200);
    let lines: Vec<_> = audit["items"]
        .as_array()
        .expect("items")
        .iter()
        .map(|l| (text(l, "/method"), text(l, "/path"), l["status"].as_u64()))
        .collect();
    assert_eq!(lines.iter().filter(|l| l.1 == "/api/tokens" && l.2 == Some(201)).count(), 1, "{lines:?}");
    assert_eq!(lines.iter().filter(|l| l.0 == "DELETE").count(), 1, "{lines:?}");
    assert_eq!(text(&audit["items"][0], "/address"), "127.0.0.1");

    assert_eq!(own(client.delete(server.url("/api/session"))).status(), 204);
    problem_of(send(client.get(server.url("/api/session")).header("Cookie", &session)), 401);
    server.stop();
    server.start_again();
    assert!(
        server.said().iter().all(|l| !l.contains("login?code=")),
        "somebody can log in already: {:?}",
        server.said()
    );
}

#[test]
fn a_token_logs_a_browser_in_through_the_page() {
    let server = Server::start_locked(&["--workers", "0"]);
    let secret = token(&server, "read");
    let client = Client::builder().redirect(reqwest::redirect::Policy::none()).build().expect("a client");
    let page = send(client.get(server.url("/login?next=/runs%22%3E%3Cscript%3E"))).text().expect("text");
    assert!(page.contains("/runs&quot;&gt;&lt;script&gt;") && !page.contains("<script>"), "{page}");
    let form =
        |secret: &str| send(client.post(server.url("/login")).form(&[("secret", secret), ("next", "/runs?a=b")]));
    assert_eq!(form("stria_wrong").status(), 401);
    let logged_in = form(&secret);
    assert_eq!((logged_in.status().as_u16(), header(&logged_in, "location").as_str()), (303, "/runs?a=b"));
    let session = header(&logged_in, "set-cookie").split(';').next().expect("a pair").to_string();
    assert_eq!(send(client.get(server.url("/api/runs")).header("Cookie", &session)).status(), 200);
    problem_of(send(client.get(server.url("/api/tokens")).header("Cookie", &session)), 403);
    let foreign = client.post(server.url("/login")).header("Origin", "https://evil.example").form(&[("secret", "x")]);
    problem_of(send(foreign), 403);
}

#[test]
fn tokens_on_the_command_line() {
    let server = Server::start_locked(&["--workers", "0"]);
    let data = server.data();
    let data = data.to_str().expect("a plain path");
    let secret = token(&server, "read");
    let says = |arguments: &[&str]| {
        let all: Vec<&str> = ["token"].iter().chain(arguments).copied().chain(["--data", data]).collect();
        let done = run_stria(&all);
        (
            done.status.code(),
            String::from_utf8_lossy(&done.stdout).into_owned(),
            String::from_utf8_lossy(&done.stderr).into_owned(),
        )
    };
    let (_, list, _) = says(&["list"]);
    let line = list.lines().nth(1).expect("a token");
    assert!(
        line.contains("valid") && line.contains("read") && line.ends_with("test") && !list.contains(&secret),
        "{list}"
    );
    let id = line.split_whitespace().next().expect("an id");
    let reads = |token: &str| send(server.get("/api/runs").bearer_auth(token)).status().as_u16();
    assert_eq!(reads(&secret), 200);
    assert_eq!(says(&["revoke", id]).0, Some(0));
    assert_eq!(reads(&secret), 401);
    assert!(says(&["list"]).1.contains("revoked"));
    assert_eq!(says(&["revoke", "nothing"]).0, Some(1));
    assert_eq!(says(&["create", "x", "--scopes", "root"]).0, Some(2));
    let (_, address, _) = says(&["login", "--server", &server.url(""), "--scopes", "read"]);
    let client = Client::builder().redirect(reqwest::redirect::Policy::none()).build().expect("a client");
    assert_eq!(send(client.get(address.trim())).status(), 303);
    let elsewhere = run_stria(&["token", "list", "--data", "missing"]);
    assert_eq!(elsewhere.status.code(), Some(2));
}

#[test]
fn send_brings_its_token() {
    let server = Server::start_locked(&["--workers", "1"]);
    let secret = token(&server, "ingest,read");
    let run = short_run();
    let (video, rig) = (run.video.to_str().expect("plain"), run.rig.to_str().expect("plain"));
    let url = server.url("");
    let send_run = |variable: Option<(&str, &str)>, more: &[&str]| {
        let mut command = Command::new(stria());
        command.env_remove("STRIA_TOKEN").env_remove("STRIA_TOKEN_FILE").env("HOME", "/nonexistent");
        command.args(["send", video, "--rig", rig, "--asset", "Wall", "--server", &url, "--wait"]).args(more);
        command.envs(variable);
        let done = command.output().expect("starts");
        (done.status.code(), String::from_utf8_lossy(&done.stderr).into_owned())
    };
    let (code, said) = send_run(None, &[]);
    assert!(code == Some(2) && said.contains("STRIA_TOKEN"), "{said}");
    let (code, said) = send_run(Some(("STRIA_TOKEN", &secret)), &[]);
    assert!(matches!(code, Some(0 | 3)), "{said}");

    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("token");
    std::fs::write(&file, format!("{secret}\n")).expect("writes");
    let mode = |mode| std::os::unix::fs::PermissionsExt::from_mode(mode);
    std::fs::set_permissions(&file, mode(0o644)).expect("changes");
    let plain = file.to_str().expect("plain");
    let (code, said) = send_run(None, &["--token-file", plain]);
    assert!(code == Some(2) && said.contains("0600"), "others can read it: {said}");
    std::fs::set_permissions(&file, mode(0o600)).expect("changes");
    let (code, said) = send_run(None, &["--token-file", plain]);
    assert!(matches!(code, Some(0 | 3)), "{said}");
}

#[test]
fn who_comes_too_often_is_asked_to_come_back() {
    let server = Server::start_locked(&["--workers", "0", "--requests-per-s", "2"]);
    let secret = token(&server, "read");
    let other = token(&server, "read");
    let refused = (0..200).map(|_| send(server.get("/api/runs").bearer_auth(&secret))).find(|r| r.status() == 429);
    let refused = refused.expect("200 requests are too many");
    assert!(header(&refused, "retry-after").parse::<u64>().is_ok_and(|s| (1..10).contains(&s)));
    problem_of(refused, 429);
    assert_eq!(send(server.get("/api/runs").bearer_auth(&other)).status(), 200, "another token is another's");
    assert_eq!(send(server.get("/livez")).status(), 200);
    let stranger = (0..300).map(|_| send(server.get("/api/runs"))).find(|r| r.status() == 429);
    assert!(stranger.is_some(), "guessing is slow");
}

#[test]
fn a_proxy_is_believed_only_where_it_is_trusted() {
    let said = |flags: &[&str]| {
        let server = Server::start_locked(flags);
        let admin = token(&server, "admin");
        let body = json!({"name": "x", "scopes": ["read"]});
        let request =
            server.post("/api/tokens").bearer_auth(&admin).header("X-Forwarded-For", "203.0.113.9, 198.51.100.7");
        json_of(send(request.json(&body)), 201);
        text(&json_of(send(server.get("/api/audit").bearer_auth(&admin)), 200), "/items/0/address")
    };
    assert_eq!(said(&["--workers", "0"]), "127.0.0.1");
    assert_eq!(said(&["--workers", "0", "--trusted-proxy", "127.0.0.1"]), "198.51.100.7");
    assert_eq!(said(&["--workers", "0", "--trusted-proxy", "127.0.0.1,198.51.100.7"]), "203.0.113.9");
}

#[test]
fn tls_with_a_certificate_of_ones_own() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("plain").to_string();
    let (certificate, key) = (path("cert.pem"), path("key.pem"));
    let made = Command::new("openssl")
        .args(["req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"])
        .args(["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"])
        .args(["-keyout", &key, "-out", &certificate])
        .output()
        .expect("openssl is missing: run docker/set-up.sh");
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let server = Server::start_locked(&["--workers", "0", "--tls-cert", &certificate, "--tls-key", &key]);
    assert!(server.url("").starts_with("https://"));
    let curl = |arguments: &[&str]| {
        let done = Command::new("curl").args(["-sS", "--cacert", &certificate]).args(arguments).output();
        let done = done.expect("curl is missing: run docker/set-up.sh");
        (done.status.success(), String::from_utf8_lossy(&done.stdout).into_owned())
    };
    let (well, body) = curl(&[&server.url("/livez")]);
    assert!(well && body.contains("ok"), "{body}");
    let said = server.said().concat();
    let (_, head) = curl(&["-i", said.split_whitespace().last().expect("an address")]);
    assert!(head.contains("Secure"), "a session's cookie never travels in the clear: {head}");
    let plain = server.url("/livez").replace("https://", "http://");
    assert!(!curl(&[&plain]).0, "no plain HTTP on this port");
}

#[test]
fn metrics_tell_the_queue_and_the_answers() {
    let mut server = Server::start_locked(&["--workers", "0"]);
    let secret = token(&server, "ingest,read");
    server.use_token(&secret);
    server.upload(short_run(), "Wall");
    let answer = send(server.get("/metrics"));
    assert!(header(&answer, "content-type").starts_with("application/openmetrics-text"));
    let metrics = answer.text().expect("text");
    for line in [
        "stria_queue_jobs{priority=\"upload\",state=\"queued\"} 1",
        "stria_queue_jobs{priority=\"live\",state=\"running\"} 0",
        "stria_http_answers_total{method=\"POST\",status=\"201\"} 1",
        "# EOF",
    ] {
        assert!(metrics.lines().any(|l| l == line), "{line} is missing in\n{metrics}");
    }
    let bytes_in = metrics.lines().find_map(|l| l.strip_prefix("stria_bytes_in_total ")).expect("bytes in");
    assert_eq!(bytes_in.parse::<usize>().ok(), Some(short_run().video_bytes().len()));
}
