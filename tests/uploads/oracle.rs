//! Where a reference answer is unclear: the same requests to Stria and to @tus/server, answers compared. What differs is
//! listed here with its reason; a difference that is not listed fails, and so does a listed one that is none.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use reqwest::Method;
use reqwest::blocking::{Client, Response};
use stria_tests::support::server::{header, send};
use tempfile::TempDir;

use super::pieces::{PIECE, fields, metadata, server};

/// Largest upload of both, bytes.
const MOST_BYTES: usize = 100_000;
/// Both forget after a week.
const KEPT_MS: u64 = 7 * 86_400_000;

/// The reference, running.
struct Oracle {
    url: String,
    process: Child,
    _folder: TempDir,
}

impl Oracle {
    fn start() -> Oracle {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("uploads/oracle.mjs");
        let mut command = Command::new("node");
        command.arg(script).arg(folder.path()).arg(MOST_BYTES.to_string()).arg(KEPT_MS.to_string());
        let started = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut process = started.expect("node starts");
        let mut url = String::new();
        BufReader::new(process.stdout.take().expect("piped")).read_line(&mut url).expect("an address");
        assert!(url.starts_with("http://"), "@tus/server does not start: run `make setup`, which installs it");
        Oracle { url: url.trim().into(), process, _folder: folder }
    }
}

impl Drop for Oracle {
    fn drop(&mut self) {
        drop((self.process.kill(), self.process.wait()));
    }
}

/// Where a request goes.
#[derive(Clone, Copy)]
enum To {
    /// The collection.
    All,
    /// The upload that the step of this name made.
    Made(&'static str),
    /// One that was never there.
    Nothing,
}

struct Step {
    name: &'static str,
    method: &'static str,
    to: To,
    headers: Vec<(&'static str, String)>,
    body: Option<&'static str>,
}

fn step(name: &'static str, method: &'static str, to: To, headers: &[(&'static str, &str)]) -> Step {
    let mut all = vec![("Tus-Resumable", "1.0.0".to_string())];
    if matches!((method, to), ("POST", To::All)) {
        all.push(("Upload-Metadata", metadata(&fields())));
    }
    for (name, value) in headers {
        all.retain(|(there, _)| there != name);
        if !value.is_empty() {
            all.push((name, value.to_string()));
        }
    }
    Step { name, method, to, headers: all, body: None }
}

fn piece(name: &'static str, to: To, offset: &str, body: &'static str, more: &[(&'static str, &str)]) -> Step {
    let headers = [&[("Content-Type", PIECE), ("Upload-Offset", offset)], more].concat();
    Step { body: Some(body), ..step(name, "PATCH", to, &headers) }
}

/// One request after another; each says what it is about.
fn script() -> Vec<Step> {
    use To::{All, Made, Nothing};
    let checksum_of_hello = "sha1 qvTGHdzF6KLavt4PO0gs2a6pQ00=";
    vec![
        step("abilities", "OPTIONS", All, &[]),
        step("create", "POST", All, &[("Upload-Length", "10")]),
        step("create without version", "POST", All, &[("Upload-Length", "10"), ("Tus-Resumable", "")]),
        step("create in another version", "POST", All, &[("Upload-Length", "10"), ("Tus-Resumable", "0.2.2")]),
        step("create without length", "POST", All, &[]),
        step("create with a negative length", "POST", All, &[("Upload-Length", "-1")]),
        step("create with words as length", "POST", All, &[("Upload-Length", "ten")]),
        step("create too large", "POST", All, &[("Upload-Length", "100001")]),
        step("create with both lengths", "POST", All, &[("Upload-Length", "10"), ("Upload-Defer-Length", "1")]),
        step("create with a wrong deferral", "POST", All, &[("Upload-Defer-Length", "2")]),
        step("create with broken metadata", "POST", All, &[("Upload-Length", "10"), ("Upload-Metadata", "a b c")]),
        step("ask", "HEAD", Made("create"), &[]),
        step("ask without version", "HEAD", Made("create"), &[("Tus-Resumable", "")]),
        step("ask for nothing", "HEAD", Nothing, &[]),
        piece("send to nothing", Nothing, "0", "hello", &[]),
        step("give up nothing", "DELETE", Nothing, &[]),
        piece("send", Made("create"), "0", "hello", &[]),
        piece("send at a wrong offset", Made("create"), "0", "hello", &[]),
        piece("send ahead", Made("create"), "9", "hello", &[]),
        piece("send at a negative offset", Made("create"), "-1", "hello", &[]),
        piece("send at no offset", Made("create"), "", "hello", &[]),
        piece("send another type", Made("create"), "5", "hello", &[("Content-Type", "text/plain")]),
        piece("send too much", Made("create"), "5", "hello, wall", &[]),
        step("ask after all this", "HEAD", Made("create"), &[]),
        piece("send nothing", Made("create"), "5", "", &[]),
        piece("send the rest", Made("create"), "5", "world", &[]),
        step("ask when it is whole", "HEAD", Made("create"), &[]),
        piece("send nothing when it is whole", Made("create"), "10", "", &[]),
        piece("send more when it is whole", Made("create"), "10", "!", &[]),
        step("defer", "POST", All, &[("Upload-Defer-Length", "1")]),
        step("ask while it is deferred", "HEAD", Made("defer"), &[]),
        piece("send while it is deferred", Made("defer"), "0", "hello", &[]),
        piece("declare too small", Made("defer"), "5", "", &[("Upload-Length", "4")]),
        piece("declare too large", Made("defer"), "5", "", &[("Upload-Length", "100001")]),
        piece("declare", Made("defer"), "5", "", &[("Upload-Length", "10")]),
        step("ask when it is declared", "HEAD", Made("defer"), &[]),
        piece("declare again", Made("defer"), "5", "", &[("Upload-Length", "11")]),
        piece("send the rest of what was deferred", Made("defer"), "5", "world", &[]),
        Step {
            body: Some("hello"),
            ..step("create with upload", "POST", All, &[("Upload-Length", "10"), ("Content-Type", PIECE)])
        },
        step("ask for what came with its creation", "HEAD", Made("create with upload"), &[]),
        step("give up", "DELETE", Made("create with upload"), &[]),
        step("ask for what was given up", "HEAD", Made("create with upload"), &[]),
        step("give up again", "DELETE", Made("create with upload"), &[]),
        step("create empty", "POST", All, &[("Upload-Length", "0")]),
        step("create for a checksum", "POST", All, &[("Upload-Length", "5")]),
        piece(
            "send with a right checksum",
            Made("create for a checksum"),
            "0",
            "hello",
            &[("Upload-Checksum", checksum_of_hello)],
        ),
    ]
}

/// What clients read of an answer. Dates and names differ by nature: of them only that they are there.
fn read(answer: &Response) -> BTreeMap<&'static str, String> {
    let mut seen = BTreeMap::from([("status", answer.status().as_u16().to_string())]);
    for name in ["upload-offset", "upload-length", "upload-defer-length", "upload-metadata", "tus-resumable"] {
        seen.insert(name, header(answer, name));
    }
    for name in ["tus-version", "tus-max-size", "cache-control"] {
        seen.insert(name, header(answer, name));
    }
    for name in ["location", "upload-expires"] {
        seen.insert(name, if header(answer, name).is_empty() { "" } else { "there" }.into());
    }
    seen
}

/// The answers to the whole script.
fn answers(base: &str) -> BTreeMap<&'static str, BTreeMap<&'static str, String>> {
    let client = Client::new();
    let mut made = BTreeMap::new();
    let mut all = BTreeMap::new();
    for step in script() {
        let path = match step.to {
            To::All => "/api/uploads".to_string(),
            To::Made(name) => made.get(name).cloned().unwrap_or_else(|| panic!("'{name}' made nothing at {base}")),
            To::Nothing => "/api/uploads/00000000000000000000000000000000".into(),
        };
        let method: Method = step.method.parse().expect("a method");
        let mut request = client.request(method, format!("{base}{path}"));
        for (name, value) in &step.headers {
            request = request.header(*name, value);
        }
        let answer = send(match step.body {
            Some(body) => request.body(body),
            None => request,
        });
        let location = header(&answer, "location");
        if !location.is_empty() {
            made.insert(step.name, location);
        }
        assert!(all.insert(step.name, read(&answer)).is_none(), "two steps are called '{}'", step.name);
    }
    all
}

/// Where Stria means to differ: step (or `*`), what, Stria's answer, the reference's, and why.
const DIFFERENCES: [(&str, &str, &str, &str, &str); 10] = [
    ("*", "cache-control", "no-store", "", "no cache on the way may keep what was wrong once"),
    ("*", "tus-version", "1.0.0", "", "the protocol: a 412 says which versions there are"),
    ("*", "upload-expires", "there", "", "who asks how far it is hears how long it will be kept"),
    ("*", "upload-offset", "0", "", "a creation says where to begin"),
    ("*", "upload-offset", "5", "", "a 409 says where to go on, which saves a question"),
    ("create in another version", "status", "412", "400", "the protocol asks for 412"),
    ("send at no offset", "status", "400", "403", "a header is missing; nothing is forbidden"),
    ("send another type", "status", "415", "400", "the protocol asks for 415"),
    ("create empty", "status", "400", "201", "a run without a video is refused before it is one"),
    ("create empty", "location", "", "there", "the same"),
];

#[test]
fn answers_are_those_of_the_reference_but_for_what_is_meant() {
    let oracle = Oracle::start();
    let stria = server(&["--max-upload-gb", &format!("{}", MOST_BYTES as f64 / 1e9)]);
    let (ours, theirs) = (answers(&stria.url("")), answers(&oracle.url));
    let mut found = Vec::new();
    for (step, seen) in &ours {
        for (what, value) in seen {
            let reference = &theirs[step][what];
            if value != reference {
                found.push((*step, *what, value.as_str(), reference.as_str()));
            }
        }
    }
    let listed = |step: &str, what: &str, ours: &str, theirs: &str| {
        DIFFERENCES.iter().any(|(s, w, o, t, _)| (*s == "*" || *s == step) && *w == what && *o == ours && *t == theirs)
    };
    let new: Vec<_> = found.iter().filter(|(step, what, o, t)| !listed(step, what, o, t)).collect();
    assert!(new.is_empty(), "step, what, Stria, @tus/server: {new:#?}");
    for (step, what, o, t, why) in DIFFERENCES {
        let there = found.iter().any(|(s, w, a, b)| (step == "*" || step == *s) && (*w, *a, *b) == (what, o, t));
        assert!(there, "no such difference any more: {step}, {what}: {o:?} for {t:?} ({why})");
    }
}
