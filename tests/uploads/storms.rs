//! The clients that others wrote, through a tunnel that cuts a hundred times: what is stored is what was sent, and what
//! was confirmed is not sent again.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use serde_json::Value;
use sha2::{Digest, Sha256};
use stria_tests::support::dice::Dice;
use stria_tests::support::server::{Server, text};
use tempfile::TempDir;

use super::ledger::field;
use super::pieces::{authority, fields, metadata, runs, server, source_sha256};
use super::tunnel::{Tunnel, Weather};

/// What a server may lose of what arrived and was not confirmed yet, bytes: its sync interval (`UploadLimits`).
pub(super) const SYNC_BYTES: u64 = 16 << 20;

/// A large upload, bytes.
const FILE_BYTES: usize = 200_000_000;
/// Cuts of one upload.
const CUTS: u32 = 100;

/// A file to be sent.
pub(super) struct BigFile {
    /// Where it is.
    pub(super) path: PathBuf,
    /// SHA-256, lower-case hex.
    pub(super) sha256: String,
    _folder: TempDir,
}

impl BigFile {
    /// Makes one of any bytes.
    pub(super) fn of(bytes: usize, seed: u64) -> BigFile {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("run 7.mp4");
        // A block that is another one each time: as good as any, and quick to make.
        let mut block = Dice::with_seed(seed).bytes(1 << 20);
        let mut content = Vec::with_capacity(bytes + block.len());
        while content.len() < bytes {
            let number = content.len() as u64;
            block[..8].copy_from_slice(&number.to_le_bytes());
            content.extend_from_slice(&block);
        }
        content.truncate(bytes);
        std::fs::write(&path, &content).expect("writes");
        let sha256 = Sha256::digest(&content).iter().map(|b| format!("{b:02x}")).collect();
        BigFile { path, sha256, _folder: folder }
    }
}

fn big_file() -> &'static BigFile {
    static FILE: OnceLock<BigFile> = OnceLock::new();
    FILE.get_or_init(|| BigFile::of(FILE_BYTES, 7))
}

/// What a client says that it made.
pub(super) struct Sent {
    /// The upload's path.
    pub(super) path: String,
    /// Its run.
    pub(super) run: String,
}

/// Runs a client to its end.
///
/// # Panics
/// Where it fails.
fn run_client(program: &Path, script: &str, endpoint: &str, file: &Path) -> Sent {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("uploads");
    let about: BTreeMap<_, _> = fields().into_iter().collect();
    let about = serde_json::to_string(&about).expect("JSON");
    let mut command = Command::new(program);
    command.arg(folder.join(script)).arg(endpoint).arg(file).arg(about).env("NO_PROXY", "127.0.0.1");
    let what = program.display();
    let done = command.output().unwrap_or_else(|e| panic!("{what}: {e}; run `make setup`, which installs it"));
    let words = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{script}: {words}");
    let told: Value = serde_json::from_slice(&done.stdout).unwrap_or_else(|e| panic!("{script}: {e}: {words}"));
    let url = text(&told, "/url");
    let path = url.find("/api/").map(|at| url[at..].to_string()).unwrap_or_else(|| panic!("no upload in {url}"));
    Sent { path, run: told["run"].as_str().unwrap_or_default().into() }
}

/// Sends with tus-js-client.
pub(super) fn tus_js_client(endpoint: &str, file: &Path) -> Sent {
    run_client(Path::new("node"), "tus_js.mjs", endpoint, file)
}

fn tuspy(endpoint: &str, file: &Path) -> Sent {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/python/bin/python");
    run_client(&python, "tuspy_send.py", endpoint, file)
}

/// Sends with curl, as a script would.
fn curl(endpoint: &str, file: &Path) -> Sent {
    let bytes = std::fs::metadata(file).expect("the file").len();
    let base = endpoint.strip_suffix("/api/uploads").expect("an endpoint");
    let about = format!("Upload-Metadata: {}", metadata(&fields()));
    let length = format!("Upload-Length: {bytes}");
    let created = until_told(|| run_curl(&["-X", "POST", "-H", &length, "-H", &about, endpoint], "location"));
    let url = format!("{base}{created}");
    let mut run = String::new();
    let from = file.to_str().expect("a plain path");
    let kind = format!("Content-Type: {}", super::pieces::PIECE);
    let mut offset = 0;
    while run.is_empty() {
        let (at, header) = (offset.to_string(), format!("Upload-Offset: {offset}"));
        let sent = ["-X", "PATCH", "-H", &kind, "-H", &header, "-C", &at, "-T", from, &url];
        // What was cut leaves no answer; where the last answer was lost, the next one says the same.
        run = run_curl(&sent, "stria-run").unwrap_or_default();
        if run.is_empty() {
            let head = until_told(|| run_curl_raw(&["-I", &url]).filter(|head| field(head, "upload-offset").is_some()));
            offset = field(&head, "upload-offset").expect("an offset");
            run = value(&head, "stria-run").unwrap_or_default();
        }
    }
    Sent { path: created, run }
}

fn until_told(ask: impl Fn() -> Option<String>) -> String {
    const TRIES: usize = 1000;
    (0..TRIES).find_map(|_| ask()).expect("an answer within a thousand tries")
}

fn run_curl_raw(arguments: &[&str]) -> Option<String> {
    let mut command = Command::new("curl");
    command.args(["-sS", "--noproxy", "*", "-D", "-", "-o", "/dev/null", "-H", "Tus-Resumable: 1.0.0"]);
    let done = command.args(arguments).stderr(Stdio::null()).output().expect("curl: run `make setup`");
    done.status.success().then(|| String::from_utf8_lossy(&done.stdout).into_owned())
}

fn run_curl(arguments: &[&str], header: &str) -> Option<String> {
    value(&run_curl_raw(arguments)?, header)
}

fn value(head: &str, header: &str) -> Option<String> {
    let mut lines = head.lines().filter_map(|line| line.split_once(':'));
    lines.find(|(name, _)| name.eq_ignore_ascii_case(header)).map(|(_, value)| value.trim().to_string())
}

/// One run is there, with just these bytes; nothing that was confirmed was sent again, and after one cut at most
/// `most_again` of what was not.
pub(super) fn assert_arrived(server: &Server, tunnel: &Tunnel, sent: &Sent, file: &BigFile, most_again: u64) {
    let account = tunnel.look(|ledger| ledger.of(&sent.path));
    let mut kinds: BTreeMap<_, usize> = BTreeMap::new();
    for cut in tunnel.cuts() {
        *kinds.entry(cut).or_default() += 1;
    }
    println!("{kinds:?}; {account:?}");
    assert!(account.faults.is_empty(), "{:#?}", account.faults);
    assert!(account.worst <= most_again, "{} bytes were sent again after one cut", account.worst);
    assert_eq!(runs(server), 1);
    assert_eq!(source_sha256(server, &sent.run), file.sha256, "the stored bytes are others");
}

fn storm(seed: u64, client: fn(&str, &Path) -> Sent) {
    let file = big_file();
    let server = server(&[]);
    let weather = Weather { cuts: CUTS, bytes_between_cuts: FILE_BYTES / CUTS as usize * 2 / 3, throttle_mb_s: None };
    let tunnel = Tunnel::to(&[&authority(&server)], weather, seed);
    let begun = std::time::Instant::now();
    let sent = client(&tunnel.url("/api/uploads"), &file.path);
    println!("{:.1} s", begun.elapsed().as_secs_f64());
    assert_eq!(tunnel.cuts().len(), CUTS as usize, "the tunnel became calm too late");
    assert_arrived(&server, &tunnel, &sent, file, SYNC_BYTES);
}

#[test]
fn tus_js_client_gets_through_a_hundred_cuts() {
    storm(11, tus_js_client);
}

#[test]
fn tuspy_gets_through_a_hundred_cuts() {
    storm(12, tuspy);
}

#[test]
fn curl_gets_through_a_hundred_cuts() {
    storm(13, curl);
}
