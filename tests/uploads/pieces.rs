//! Uploads by hand: creating, sending, asking; and connections that a test can leave half-way.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use reqwest::blocking::{RequestBuilder, Response};
use sha2::{Digest, Sha256};
use stria_tests::support::dice::Dice;
use stria_tests::support::server::{Server, header, send};
use stria_tests::support::{eventually, short_run};

/// The body's type of a piece.
pub(super) const PIECE: &str = "application/offset+octet-stream";

/// How long an answer may take before a test fails.
const PATIENCE: Duration = Duration::from_secs(60);

/// A server that takes uploads in and lets their jobs wait, with more flags.
pub(super) fn server(flags: &[&str]) -> Server {
    Server::start(&[&["--workers", "0"], flags].concat())
}

/// Bytes that are no two times the same in one file.
pub(super) fn content(bytes: usize, seed: u64) -> Vec<u8> {
    Dice::with_seed(seed).bytes(bytes)
}

/// What every upload here says about its run.
pub(super) fn fields() -> Vec<(&'static str, String)> {
    vec![("filename", "run 7.mp4".into()), ("asset", "Röhre 7".into()), ("rig", short_run().rig_text())]
}

/// `Upload-Metadata`.
pub(super) fn metadata(fields: &[(&str, String)]) -> String {
    let pairs = fields.iter().map(|(name, value)| format!("{name} {}", BASE64_STANDARD.encode(value)));
    pairs.collect::<Vec<_>>().join(",")
}

/// A creation, to be sent.
pub(super) fn creation(server: &Server) -> RequestBuilder {
    let request = server.post("/api/uploads").header("Tus-Resumable", "1.0.0");
    request.header("Upload-Metadata", metadata(&fields()))
}

/// Creates an upload of a known size; its path.
pub(super) fn create(server: &Server, bytes: usize) -> String {
    let made = send(creation(server).header("Upload-Length", bytes));
    assert_eq!(made.status(), 201);
    header(&made, "location")
}

/// A piece, to be sent.
pub(super) fn piece(server: &Server, path: &str, offset: usize) -> RequestBuilder {
    let request = server.patch(path).header("Tus-Resumable", "1.0.0").header("Content-Type", PIECE);
    request.header("Upload-Offset", offset)
}

/// The answer to "how far is it?".
pub(super) fn ask(server: &Server, path: &str) -> Response {
    send(server.head(path).header("Tus-Resumable", "1.0.0"))
}

/// How far an upload is.
///
/// # Panics
/// Where the server does not say.
pub(super) fn offset(server: &Server, path: &str) -> usize {
    let told = ask(server, path);
    assert_eq!(told.status(), 200, "HEAD {path}");
    number(&told, "upload-offset")
}

/// A header that is a number.
pub(super) fn number(answer: &Response, name: &str) -> usize {
    header(answer, name).parse().unwrap_or_else(|_| panic!("no {name} in {answer:?}"))
}

/// Sends the rest; the run that the upload became.
pub(super) fn send_rest(server: &Server, path: &str, content: &[u8]) -> String {
    let from = offset(server, path);
    let sent = send(piece(server, path, from).body(content[from..].to_vec()));
    let (status, run) = (sent.status().as_u16(), header(&sent, "stria-run"));
    assert_eq!(status, 204, "{}", sent.text().unwrap_or_default());
    run
}

/// The run's source is just this.
pub(super) fn assert_source(server: &Server, run: &str, content: &[u8]) {
    assert_eq!(source_sha256(server, run), sha256(content), "the stored bytes are others");
}

/// SHA-256 of what comes back of a run's source, in lower-case hex.
pub(super) fn source_sha256(server: &Server, run: &str) -> String {
    let mut source = send(server.get(&format!("/api/runs/{run}/source")));
    assert_eq!(source.status(), 200, "the source of run {run}");
    let mut hash = Sha256::new();
    source.copy_to(&mut hash).expect("the whole source");
    hex(&hash.finalize())
}

/// SHA-256 in lower-case hex.
pub(super) fn sha256(content: &[u8]) -> String {
    hex(&Sha256::digest(content))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// The runs that are there.
pub(super) fn runs(server: &Server) -> usize {
    server.json("/api/runs?limit=1000")["items"].as_array().map_or(0, Vec::len)
}

/// The growing file of an upload, in a server's own folder.
pub(super) fn growing_file(server: &Server, path: &str) -> PathBuf {
    let id = path.rsplit('/').next().unwrap_or_default();
    server.data().join("store/uploads").join(id).join("whole")
}

/// Asks a server's SQLite about an upload (`?`), through a program that we did not write; the first cell of the answer.
///
/// # Panics
/// Where it is missing or refuses.
pub(super) fn ask_records(server: &Server, sql: &str, path: &str) -> String {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/python/bin/python");
    let ask = "import sqlite3, sys\nwith sqlite3.connect(sys.argv[1], timeout=20) as records:\n\
               \x20   row = records.execute(sys.argv[2], sys.argv[3:]).fetchone()\nprint(row[0] if row else '')";
    let mut command = std::process::Command::new(python);
    command
        .args(["-c", ask])
        .arg(server.data().join("stria.db"))
        .args([sql, path.rsplit('/').next().unwrap_or_default()]);
    let told = command.output().expect("target/python starts: run `make setup`");
    assert!(told.status.success(), "{sql}: {}", String::from_utf8_lossy(&told.stderr));
    String::from_utf8_lossy(&told.stdout).trim().into()
}

/// Waits until the server has written so many bytes of an upload, promised or not.
pub(super) fn wait_until_written(server: &Server, path: &str, bytes: usize) {
    let file = growing_file(server, path);
    let written = || std::fs::metadata(&file).map_or(0, |facts| facts.len()) >= bytes as u64;
    eventually(&format!("{bytes} bytes of {path} are written"), written);
}

/// A request that is not sent to its end.
pub(super) struct Half {
    stream: TcpStream,
}

impl Half {
    /// Announces a piece of `bytes` at `offset` and sends only `now` of it.
    pub(super) fn send(authority: &str, path: &str, offset: usize, bytes: usize, now: &[u8]) -> Half {
        let mut stream = TcpStream::connect(authority).expect("connects");
        stream.set_read_timeout(Some(PATIENCE)).expect("a time-out");
        let head = format!(
            "PATCH {path} HTTP/1.1\r\nHost: {authority}\r\nTus-Resumable: 1.0.0\r\nContent-Type: {PIECE}\r\n\
             Upload-Offset: {offset}\r\nContent-Length: {bytes}\r\n\r\n"
        );
        stream.write_all(head.as_bytes()).expect("sends");
        stream.write_all(now).expect("sends");
        Half { stream }
    }

    /// The status of the answer that comes all the same.
    pub(super) fn status(mut self) -> u16 {
        let mut answer = Vec::new();
        let mut chunk = [0; 1024];
        while !answer.windows(4).any(|end| end == b"\r\n\r\n") {
            let read = self.stream.read(&mut chunk).expect("an answer");
            assert!(read > 0, "the connection ended without an answer");
            answer.extend_from_slice(&chunk[..read]);
        }
        let text = String::from_utf8_lossy(&answer).into_owned();
        text.split_whitespace().nth(1).and_then(|status| status.parse().ok()).expect("a status")
    }

    /// Sends more of it; false where the server has hung up.
    pub(super) fn more(&mut self, bytes: &[u8]) -> bool {
        self.stream.write_all(bytes).is_ok()
    }
}

/// Host and port of a server.
pub(super) fn authority(server: &Server) -> String {
    server.url("").trim_start_matches("http://").to_string()
}
