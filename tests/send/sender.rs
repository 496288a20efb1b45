//! A `stria send` of a test's own: own state folder, own output.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde_json::Value;
use stria_tests::support::server::{Server, signal};
use stria_tests::support::{eventually, stria};
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(90);

/// A place with a state folder and a folder for files.
pub(super) struct Robot {
    folder: TempDir,
}

impl Robot {
    /// A new robot, which has sent nothing yet.
    pub(super) fn new() -> Robot {
        Robot { folder: tempfile::tempdir().expect("a temporary folder") }
    }

    /// A path in its own folder.
    pub(super) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Its state folder.
    pub(super) fn state(&self) -> PathBuf {
        self.path("state")
    }

    /// Writes a file that compresses badly and whose every part is different.
    pub(super) fn file(&self, name: &str, bytes: usize, seed: u64) -> PathBuf {
        let path = self.path(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        std::fs::write(&path, content(bytes, seed)).expect("writes");
        path
    }

    /// Starts a sender.
    pub(super) fn send(&self, arguments: &[&str]) -> Sender {
        self.send_with(arguments, &[])
    }

    /// Starts a sender with variables.
    pub(super) fn send_with(&self, arguments: &[&str], variables: &[(&str, &str)]) -> Sender {
        let mut process = Command::new(stria())
            .arg("send")
            .args(arguments)
            .env("XDG_STATE_HOME", self.state())
            .env_remove("STRIA_TOKEN")
            .envs(variables.iter().copied())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the sender starts");
        let stdin = process.stdin.take();
        let lines = Arc::new(Mutex::new(Vec::new()));
        let said = Arc::new(Mutex::new(String::new()));
        let (stdout, mut stderr) = (process.stdout.take().expect("piped"), process.stderr.take().expect("piped"));
        let readers = vec![
            std::thread::spawn({
                let lines = lines.clone();
                move || {
                    BufReader::new(stdout)
                        .lines()
                        .map_while(Result::ok)
                        .for_each(|l| lines.lock().expect("lock").push(l));
                }
            }),
            std::thread::spawn({
                let said = said.clone();
                move || {
                    let mut buffer = [0; 4096];
                    while let Ok(read @ 1..) = stderr.read(&mut buffer) {
                        said.lock().expect("lock").push_str(&String::from_utf8_lossy(&buffer[..read]));
                    }
                }
            }),
        ];
        Sender { process, stdin, lines, said, readers }
    }
}

/// Bytes that repeat nowhere near.
pub(super) fn content(bytes: usize, seed: u64) -> Vec<u8> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state
    };
    let mut out = Vec::with_capacity(bytes + 8);
    while out.len() < bytes {
        out.extend(next().to_le_bytes());
    }
    out.truncate(bytes);
    out
}

/// A running sender.
pub(super) struct Sender {
    process: Child,
    /// Its input, until it is taken.
    pub(super) stdin: Option<ChildStdin>,
    lines: Arc<Mutex<Vec<String>>>,
    said: Arc<Mutex<String>>,
    readers: Vec<std::thread::JoinHandle<()>>,
}

impl Sender {
    /// Its process.
    pub(super) fn id(&self) -> u32 {
        self.process.id()
    }

    /// What it printed, line by line.
    pub(super) fn lines(&self) -> Vec<String> {
        self.lines.lock().expect("lock").clone()
    }

    /// What it said to people.
    pub(super) fn said(&self) -> String {
        self.said.lock().expect("lock").clone()
    }

    /// Its lines for programs.
    pub(super) fn json(&self) -> Vec<Value> {
        let parse = |line: &String| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}"));
        self.lines().iter().map(parse).collect()
    }

    /// The last line for programs of a kind.
    pub(super) fn last(&self, kind: &str) -> Option<Value> {
        self.json().into_iter().rfind(|line| line["type"] == kind)
    }

    /// Waits until it has said something.
    pub(super) fn wait_for(&self, what: &str, condition: impl Fn(&Sender) -> bool) {
        let begun = Instant::now();
        while !condition(self) {
            assert!(begun.elapsed() < PATIENCE, "waited in vain: {what}\n{:?}\n{}", self.lines(), self.said());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Ends it like the loss of power.
    pub(super) fn kill(mut self) {
        self.process.kill().expect("it can be killed");
        self.process.wait().expect("it ends");
    }

    /// Asks it to stop.
    pub(super) fn terminate(&self) {
        signal("TERM", self.id());
    }

    /// Waits for its end; its exit code, its lines, its words.
    pub(super) fn end(mut self) -> (Option<i32>, Vec<String>, String) {
        drop(self.stdin.take());
        let status = self.wait();
        self.readers.drain(..).for_each(|reader| reader.join().expect("read"));
        (status.code(), self.lines(), self.said())
    }

    fn wait(&mut self) -> ExitStatus {
        let begun = Instant::now();
        loop {
            if let Some(status) = self.process.try_wait().expect("it can be waited for") {
                return status;
            }
            if begun.elapsed() > PATIENCE {
                let words = (self.lines(), self.said());
                let _ = self.process.kill();
                panic!("the sender does not end: {words:?}");
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Sender {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// The runs of a server, the oldest first.
pub(super) fn runs(server: &Server) -> Vec<Value> {
    let mut runs = server.json("/api/runs?limit=100")["items"].as_array().expect("a list").clone();
    runs.reverse();
    runs
}

/// The bytes of a run's source.
pub(super) fn source(server: &Server, run: &Value) -> Vec<u8> {
    let run = run["id"].as_str().expect("a name");
    let answer = server.get(&format!("/api/runs/{run}/source")).send().expect("an answer");
    assert_eq!(answer.status().as_u16(), 200, "the source of {run}");
    answer.bytes().expect("a body").to_vec()
}

/// A path as an argument.
pub(super) fn plain(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

/// Waits for a file.
pub(super) fn wait_for_file(path: &Path) {
    eventually(&path.display().to_string(), || path.exists());
}
