//! A server of a test's own: own data folder, own port, the real binary.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use reqwest::blocking::{Client, RequestBuilder, Response};
use serde_json::Value;
use tempfile::TempDir;

use super::{Run, form, stria};

/// How long anything may take before a test fails.
const PATIENCE: Duration = Duration::from_secs(60);

/// A running (or stopped) server and its data.
pub struct Server {
    data: TempDir,
    flags: Vec<String>,
    variables: Vec<(String, String)>,
    /// What starts the binary in its stead, with it as its last argument.
    wrapper: Vec<String>,
    process: Option<Child>,
    url: String,
    said: Arc<Mutex<Vec<String>>>,
    token: Option<String>,
    client: Client,
}

impl Server {
    /// Starts one on a new folder; it asks nobody for a token.
    ///
    /// # Panics
    /// Where it does not become ready.
    pub fn start(flags: &[&str]) -> Server {
        Server::start_with(flags, &[])
    }

    /// Starts one on a new folder, as it is without any flag: with its doors locked.
    ///
    /// # Panics
    /// Where it does not become ready.
    pub fn start_locked(flags: &[&str]) -> Server {
        Server::start_any(flags, &[])
    }

    /// Starts one on a new folder, with variables in its environment.
    ///
    /// # Panics
    /// Where it does not become ready.
    pub fn start_with(flags: &[&str], variables: &[(String, String)]) -> Server {
        let flags: Vec<&str> = flags.iter().copied().chain(["--without-authentication"]).collect();
        Server::start_any(&flags, variables)
    }

    /// One on a new folder that was not started yet.
    ///
    /// # Panics
    /// Where there is no place for it.
    pub fn stopped(flags: &[&str]) -> Server {
        let flags: Vec<&str> = flags.iter().copied().chain(["--without-authentication"]).collect();
        Server::new(tempfile::tempdir().expect("a temporary folder"), &flags, &[], &[])
    }

    /// Starts one in a folder, by a program that prepares its world and then becomes what its arguments say.
    ///
    /// # Panics
    /// Where it does not become ready.
    pub fn start_in(folder: TempDir, flags: &[&str], variables: &[(String, String)], wrapper: &[&str]) -> Server {
        let flags: Vec<&str> = flags.iter().copied().chain(["--without-authentication"]).collect();
        let mut server = Server::new(folder, &flags, variables, wrapper);
        server.start_again();
        server
    }

    fn start_any(flags: &[&str], variables: &[(String, String)]) -> Server {
        let mut server = Server::new(tempfile::tempdir().expect("a temporary folder"), flags, variables, &[]);
        server.start_again();
        server
    }

    fn new(folder: TempDir, flags: &[&str], variables: &[(String, String)], wrapper: &[&str]) -> Server {
        Server {
            data: folder,
            flags: flags.iter().map(ToString::to_string).collect(),
            variables: variables.to_vec(),
            wrapper: wrapper.iter().map(ToString::to_string).collect(),
            process: None,
            url: String::new(),
            said: Arc::default(),
            token: None,
            client: Client::builder().timeout(PATIENCE).build().expect("a client"),
        }
    }

    /// Flags for the next start.
    pub fn add_flags(&mut self, flags: &[&str]) {
        self.flags.extend(flags.iter().map(ToString::to_string));
    }

    /// Starts it (again) on its folder; its port is another each time, unless a flag says which.
    ///
    /// # Panics
    /// Where it does not become ready.
    pub fn start_again(&mut self) {
        let listens = self.flags.iter().any(|flag| flag == "--listen");
        let words: Vec<_> = self.wrapper.iter().map(Into::into).chain([stria().into_os_string()]).collect();
        let mut process = Command::new(&words[0])
            .args(&words[1..])
            .arg("serve")
            .args(if listens { &[][..] } else { &["--listen", "127.0.0.1:0"] })
            .arg("--data")
            .arg(self.data())
            .args(&self.flags)
            .env("STRIA_LOG", std::env::var("STRIA_LOG").unwrap_or_else(|_| "warn".into()))
            .envs(self.variables.iter().map(|(name, value)| (name, value)))
            .stdout(Stdio::piped())
            .spawn()
            .expect("the server starts");
        let stdout = process.stdout.take().expect("piped");
        let mut stdout = BufReader::new(stdout);
        let mut line = String::new();
        stdout.read_line(&mut line).expect("stdout is text");
        let url = line.split_whitespace().find(|word| word.starts_with("http"));
        self.url = url.unwrap_or_else(|| panic!("no address in {line:?}")).trim_end_matches('/').to_string();
        let said = Arc::new(Mutex::new(Vec::new()));
        self.said = said.clone();
        std::thread::spawn(move || {
            for line in stdout.lines().map_while(Result::ok) {
                said.lock().expect("no one panics here").push(line);
            }
        });
        self.process = Some(process);
    }

    /// What it printed after its address, a moment after it was ready.
    ///
    /// # Panics
    /// Where its reader did.
    pub fn said(&self) -> Vec<String> {
        std::thread::sleep(Duration::from_millis(500));
        self.said.lock().expect("no one panics here").clone()
    }

    /// From now on all requests carry this token.
    pub fn use_token(&mut self, token: &str) {
        self.token = Some(token.into());
    }

    fn with_token(&self, request: RequestBuilder) -> RequestBuilder {
        match &self.token {
            Some(token) => request.bearer_auth(token),
            None => request,
        }
    }

    /// Its data folder.
    pub fn data(&self) -> PathBuf {
        self.data.path().join("data")
    }

    /// The address of a path.
    pub fn url(&self, path: &str) -> String {
        format!("{}{path}", self.url)
    }

    /// A request.
    pub fn get(&self, path: &str) -> RequestBuilder {
        self.with_token(self.client.get(self.url(path)))
    }

    /// A request.
    pub fn head(&self, path: &str) -> RequestBuilder {
        self.with_token(self.client.head(self.url(path)))
    }

    /// A request.
    pub fn post(&self, path: &str) -> RequestBuilder {
        self.with_token(self.client.post(self.url(path)))
    }

    /// A request.
    pub fn put(&self, path: &str) -> RequestBuilder {
        self.with_token(self.client.put(self.url(path)))
    }

    /// A request.
    pub fn patch(&self, path: &str) -> RequestBuilder {
        self.with_token(self.client.patch(self.url(path)))
    }

    /// A request.
    pub fn delete(&self, path: &str) -> RequestBuilder {
        self.with_token(self.client.delete(self.url(path)))
    }

    /// The JSON of a path.
    ///
    /// # Panics
    /// Where the answer is no success or no JSON.
    pub fn json(&self, path: &str) -> Value {
        json_of(send(self.get(path)), 200)
    }

    /// Sends a run; the answer's JSON.
    ///
    /// # Panics
    /// Where it is refused.
    pub fn upload(&self, run: &Run, asset: &str) -> Value {
        let rig = run.rig_text();
        let body = form::form(&[("asset", asset), ("rig", &rig)], "video.mp4", &run.video_bytes());
        json_of(send(self.post("/api/runs").header("Content-Type", form::content_type()).body(body)), 201)
    }

    /// Waits until a job's JSON is as wanted.
    ///
    /// # Panics
    /// Where that takes too long.
    pub fn wait_for(&self, job: &str, what: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        let begun = Instant::now();
        loop {
            let now = self.json(&format!("/api/jobs/{job}"));
            if wanted(&now) {
                return now;
            }
            assert!(begun.elapsed() < PATIENCE, "waited for the job to be {what}; it is {now:#}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits for a job's last state.
    ///
    /// # Panics
    /// Where it has another one, or takes too long.
    pub fn wait_for_state(&self, job: &str, state: &str) -> Value {
        let ended = |s: &str| matches!(s, "done" | "failed" | "cancelled");
        let job = self.wait_for(job, state, |job| job["state"] == state || job["state"].as_str().is_some_and(ended));
        assert_eq!(job["state"], state, "{job:#}");
        job
    }

    /// Ends it like the loss of power.
    ///
    /// # Panics
    /// Where it does not run.
    pub fn kill(&mut self) {
        let mut process = self.process.take().expect("it runs");
        process.kill().expect("it can be killed");
        process.wait().expect("it ends");
    }

    /// Asks it to stop, as SIGTERM does; its exit status.
    ///
    /// # Panics
    /// Where it does not stop.
    pub fn stop(&mut self) -> ExitStatus {
        let mut process = self.process.take().expect("it runs");
        signal("TERM", process.id());
        let begun = Instant::now();
        loop {
            if let Some(status) = process.try_wait().expect("it can be waited for") {
                return status;
            }
            assert!(begun.elapsed() < PATIENCE, "the server does not stop");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Its process.
    ///
    /// # Panics
    /// Where it does not run.
    pub fn id(&self) -> u32 {
        self.process.as_ref().expect("it runs").id()
    }

    /// The child processes that work on jobs.
    ///
    /// # Panics
    /// Where it does not run.
    pub fn children(&self) -> Vec<u32> {
        children_of(self.id())
    }
}

/// The living children of a process.
///
/// # Panics
/// Where there is no /proc.
pub fn children_of(parent: u32) -> Vec<u32> {
    let entries = std::fs::read_dir("/proc").expect("Linux");
    let ids = entries.flatten().filter_map(|e| e.file_name().to_str()?.parse::<u32>().ok());
    ids.filter(|id| parent_of(*id) == Some(parent)).collect()
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some(mut process) = self.process.take() {
            let _ = process.kill();
            let _ = process.wait();
        }
    }
}

/// The parent of a process; `None` where there is none any more.
fn parent_of(id: u32) -> Option<u32> {
    let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
    // The name in brackets may hold anything; the state and the parent follow it.
    let mut rest = stat.rsplit_once(')')?.1.split_whitespace();
    let state = rest.next()?;
    let parent = rest.next()?.parse().ok()?;
    (state != "Z").then_some(parent)
}

/// True while a process of this number runs.
pub fn is_alive(id: u32) -> bool {
    parent_of(id).is_some()
}

/// Sends a signal by name.
///
/// # Panics
/// Where there is no `kill` command.
pub fn signal(name: &str, id: u32) {
    // Whoever it is for may be gone by now.
    let mut kill = Command::new("kill");
    kill.args(["-s", name, &id.to_string()]).stderr(Stdio::null()).status().expect("kill is there");
}

/// Sends a request.
///
/// # Panics
/// Where no answer comes.
pub fn send(request: RequestBuilder) -> Response {
    request.send().expect("an answer")
}

/// The JSON of an answer.
///
/// # Panics
/// Where the status is another or the body is no JSON.
pub fn json_of(response: Response, status: u16) -> Value {
    let found = response.status().as_u16();
    let text = response.text().expect("a body");
    assert_eq!(found, status, "{text}");
    serde_json::from_str(&text).unwrap_or_else(|e| panic!("{e}: {text}"))
}

/// The problem document of an answer.
///
/// # Panics
/// Where the status is another or it is none.
pub fn problem_of(response: Response, status: u16) -> Value {
    let kind = response.headers().get("content-type").and_then(|v| v.to_str().ok()).unwrap_or_default().to_string();
    let problem = json_of(response, status);
    assert_eq!(kind, "application/problem+json");
    for field in ["type", "title", "detail"] {
        assert!(problem[field].as_str().is_some_and(|text| !text.is_empty()), "{field}: {problem:#}");
    }
    assert_eq!(problem["status"], status);
    assert!(problem["retryable"].is_boolean());
    problem
}

/// A header as text; empty where it is missing.
pub fn header(response: &Response, name: &str) -> String {
    response.headers().get(name).and_then(|v| v.to_str().ok()).unwrap_or_default().to_string()
}

/// The text at a JSON pointer.
///
/// # Panics
/// Where there is none.
pub fn text(value: &Value, pointer: &str) -> String {
    value.pointer(pointer).and_then(Value::as_str).unwrap_or_else(|| panic!("no text at {pointer} in {value:#}")).into()
}

/// The contents of a path, whatever its kind.
///
/// # Panics
/// Where it cannot be read.
pub fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}
