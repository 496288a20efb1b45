//! `stria send`: a run goes to a server in one request; with `--wait` its job is followed to the end.

use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use clap::Args;
use reqwest::Url;
use reqwest::blocking::{Body, Client, Response};
use serde_json::Value;

use super::bearer::TokenArgs;
use super::progress::{JobBar, byte_bar, duration};
use super::{Failed, Outcome, Success};

/// How long a server that does not answer yet is waited for.
const STARTING: Duration = Duration::from_secs(30);
/// Pause between two tries.
const PAUSE: Duration = Duration::from_millis(500);
/// Tries of the upload itself; the idempotency key makes them safe.
const UPLOADS: u32 = 3;
/// Tries to hear of a job while the server does not answer: ten minutes.
const MISSED_ANSWERS: u32 = 1200;
/// Longest time for a small answer.
const ANSWER: Duration = Duration::from_secs(60);

/// Send a run to a server
#[derive(Args)]
#[command(
    after_help = "Example: stria send run.mp4 --server http://127.0.0.1:8420 --asset 'Pipe 7' --rig rig.toml --wait"
)]
pub(super) struct Send {
    /// The video file
    source: PathBuf,
    /// The server's address
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8420", env = "STRIA_SERVER")]
    server: Url,
    /// The pipe or wall
    #[arg(long, value_name = "NAME", env = "STRIA_ASSET")]
    asset: String,
    /// The rig it was recorded with: a rig file, or the name of a rig that the server has
    #[arg(long, value_name = "FILE|NAME", env = "STRIA_RIG")]
    rig: String,
    /// How to process: a recipe of the server, or a TOML file
    #[arg(long, value_name = "NAME|FILE", env = "STRIA_RECIPE")]
    recipe: Option<String>,
    /// Chainage of the first frame, mm
    #[arg(long, value_name = "MM", default_value_t = 0.0, allow_negative_numbers = true)]
    chainage_mm: f64,
    /// Which way the robot went along the asset
    #[arg(long, value_parser = ["forward", "backward"], default_value = "forward")]
    direction: String,
    /// When it was recorded (RFC 3339); the time of arrival when nothing is said
    #[arg(long, value_name = "TIME")]
    recorded_at: Option<jiff::Timestamp>,
    /// Frames a second, where the source does not say
    #[arg(long, value_name = "F")]
    fps: Option<f64>,
    #[command(flatten)]
    token: TokenArgs,
    /// Follow the job to its end and print where to look at the result
    #[arg(long)]
    wait: bool,
}

impl Send {
    pub(super) fn run(self) -> Outcome {
        if !matches!(self.server.scheme(), "http" | "https") {
            return Err(Failed::Input(format!("--server {}: expected http:// or https://", self.server)));
        }
        // The upload takes as long as it takes; all else has its time.
        let client =
            Client::builder().timeout(None).connect_timeout(ANSWER).default_headers(self.token.headers()?).build();
        let client = client.map_err(|e| Failed::Other(format!("the HTTP client did not start: {e}")))?;
        self.wait_for_server(&client)?;
        // Before the bytes: a server that lets nobody in says so at once.
        answer_of(
            client
                .get(self.address("/api/session")?)
                .timeout(ANSWER)
                .send()
                .map_err(|e| Failed::Other(format!("{}: {}", self.server, cause(&e))))?,
        )?;
        let run = self.upload(&client)?;
        let (run_id, job_id) = (text(&run, "/id"), text(&run, "/job/id"));
        let page = self.address(&format!("/runs/{run_id}"))?;
        if !self.wait {
            println!("sent: run {run_id}, job {job_id}\n{page}");
            return Ok(Success::Done);
        }
        let job = self.follow(&client, &job_id)?;
        self.report(&job, page.as_str())
    }

    fn address(&self, path: &str) -> Result<Url, Failed> {
        self.server.join(path).map_err(|e| Failed::Input(format!("--server {}: {e}", self.server)))
    }

    fn wait_for_server(&self, client: &Client) -> Result<(), Failed> {
        let begun = Instant::now();
        loop {
            let error = match client.get(self.address("/readyz")?).timeout(ANSWER).send() {
                Ok(response) if response.status().is_success() => return Ok(()),
                Ok(response) => format!("it answers {}", response.status()),
                Err(e) => cause(&e),
            };
            if begun.elapsed() > STARTING {
                return Err(Failed::Other(format!("{} is not ready: {error}", self.server)));
            }
            sleep(PAUSE);
        }
    }

    fn upload(&self, client: &Client) -> Result<Value, Failed> {
        let key = crate::queue::Queue::new_id();
        let mut tries = 0;
        loop {
            tries += 1;
            let (body, content_type, bar) = self.form(&key)?;
            let request = client.post(self.address("/api/runs")?).header("Content-Type", content_type);
            let answer = request.header("Idempotency-Key", &key).body(body).send();
            bar.finish_and_clear();
            match answer {
                Ok(response) if response.status().is_server_error() && tries < UPLOADS => sleep(4 * PAUSE),
                Ok(response) => return answer_of(response),
                Err(e) if tries >= UPLOADS => return Err(Failed::Other(format!("{}: {}", self.server, cause(&e)))),
                Err(e) => {
                    eprintln!("stria: the connection broke ({}); trying again", cause(&e));
                    sleep(4 * PAUSE);
                }
            }
        }
    }

    /// The form of the upload; the file is read while it is sent.
    fn form(&self, boundary: &str) -> Result<(Body, String, indicatif::ProgressBar), Failed> {
        let unreadable = |e: std::io::Error| Failed::Input(format!("{}: {e}", self.source.display()));
        let file = std::fs::File::open(&self.source).map_err(unreadable)?;
        let facts = file.metadata().map_err(unreadable)?;
        if facts.is_dir() {
            let hint = "a folder of images can be processed here with `stria process`";
            return Err(Failed::Input(format!(
                "{}: is a folder; expected a video file ({hint})",
                self.source.display()
            )));
        }
        let name = self.source.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let mut fields = vec![
            ("asset", self.asset.clone()),
            ("rig", file_or_name(&self.rig)?),
            ("chainage_mm", self.chainage_mm.to_string()),
            ("direction", self.direction.clone()),
            ("filename", name),
        ];
        fields.extend(self.recipe.as_deref().map(file_or_name).transpose()?.map(|text| ("recipe", text)));
        fields.extend(self.recorded_at.map(|time| ("recorded_at", time.to_string())));
        fields.extend(self.fps.map(|fps| ("fps", fps.to_string())));
        let mut head = String::new();
        for (name, value) in fields {
            head += &format!("--{boundary}\r\nContent-Disposition: form-data; name=\"{name}\"\r\n\r\n{value}\r\n");
        }
        head += &format!("--{boundary}\r\nContent-Disposition: form-data; name=\"file\"; filename=\"source\"\r\n\r\n");
        let tail = format!("\r\n--{boundary}--\r\n");
        let bytes = head.len() as u64 + facts.len() + tail.len() as u64;
        let bar = byte_bar(bytes);
        let whole = Cursor::new(head).chain(file.take(facts.len())).chain(Cursor::new(tail));
        let body = Body::sized(bar.wrap_read(whole), bytes);
        Ok((body, format!("multipart/form-data; boundary={boundary}"), bar))
    }

    /// Looks at the job until it ends; a server that restarts meanwhile is waited for.
    fn follow(&self, client: &Client, job: &str) -> Result<Value, Failed> {
        let (bar, mut missed) = (JobBar::new(), 0);
        let address = self.address(&format!("/api/jobs/{job}"))?;
        loop {
            match client.get(address.clone()).timeout(ANSWER).send() {
                Ok(response) if !response.status().is_server_error() => {
                    missed = 0;
                    let job = answer_of(response)?;
                    let number = |name: &str| job.pointer(name).and_then(Value::as_f64);
                    let state = text(&job, "/state");
                    let stage = if state == "running" { text(&job, "/stage") } else { state.clone() };
                    let total = job.pointer("/frames_total").and_then(Value::as_u64);
                    let frames = job.pointer("/frames").and_then(Value::as_u64).unwrap_or(0);
                    let (fraction, rate) = (number("/progress").unwrap_or(0.0), number("/frames_per_s").unwrap_or(0.0));
                    bar.show(&stage, fraction, frames, total, rate, number("/time_left_s"));
                    if matches!(state.as_str(), "done" | "failed" | "cancelled") {
                        bar.clear();
                        return Ok(job);
                    }
                }
                other => {
                    missed += 1;
                    if missed > MISSED_ANSWERS {
                        let why = other.map_or_else(|e| cause(&e), |r| format!("it answers {}", r.status()));
                        return Err(Failed::Other(format!("{} is gone: {why}", self.server)));
                    }
                }
            }
            sleep(PAUSE);
        }
    }

    fn report(&self, job: &Value, page: &str) -> Outcome {
        match text(job, "/state").as_str() {
            "done" => {}
            "cancelled" => return Err(Failed::Cancelled),
            _ => return Err(Failed::Other(format!("the job failed: {}\n{page}", text(job, "/error/detail")))),
        }
        let time = |name: &str| text(job, name).parse::<jiff::Timestamp>().ok();
        let took = time("/finished_at").zip(time("/started_at")).map(|(b, a)| b.duration_since(a).as_secs_f64());
        let frames = job.pointer("/frames").and_then(Value::as_u64).unwrap_or(0);
        println!("Done: {frames} frames in {}", duration(took.unwrap_or(0.0)));
        let warnings = job.pointer("/warnings").and_then(Value::as_array).cloned().unwrap_or_default();
        for warning in warnings.iter().filter_map(Value::as_str) {
            println!("warning: {warning}");
        }
        println!("{page}");
        Ok(if warnings.is_empty() { Success::Done } else { Success::DoneWithWarnings })
    }
}

/// The text of a file where there is one of that name, else the name.
fn file_or_name(text: &str) -> Result<String, Failed> {
    let path = Path::new(text);
    if path.is_file() {
        return std::fs::read_to_string(path).map_err(|e| Failed::Input(format!("{text}: {e}; expected a text file")));
    }
    if path.extension().is_some() || text.contains('/') {
        return Err(Failed::Input(format!("{text}: there is no such file")));
    }
    Ok(text.into())
}

/// JSON, or the problem in words.
fn answer_of(response: Response) -> Result<Value, Failed> {
    let (status, url) = (response.status(), response.url().clone());
    let body: Value = response.json().map_err(|e| Failed::Other(format!("{url}: {}", cause(&e))))?;
    if status.is_success() {
        return Ok(body);
    }
    let expected = body.get("expected").and_then(Value::as_str).map(|e| format!("; expected {e}")).unwrap_or_default();
    if status == reqwest::StatusCode::UNAUTHORIZED {
        let hint = "expected a token in STRIA_TOKEN or --token-file; the server's `stria token create` makes one";
        return Err(Failed::Input(format!("{url}: {}; {hint}", text(&body, "/detail"))));
    }
    let detail = text(&body, "/detail");
    // The core's messages say what they expected themselves.
    let words = if detail.contains(&expected) { detail } else { detail + &expected };
    let message = format!("the server refuses the run ({status}): {words}");
    Err(if status.is_client_error() { Failed::Input(message) } else { Failed::Other(message) })
}

fn text(value: &Value, pointer: &str) -> String {
    value.pointer(pointer).and_then(Value::as_str).unwrap_or_default().into()
}

/// The innermost cause says most: "connection refused" instead of "error sending request".
fn cause(error: &reqwest::Error) -> String {
    let mut inner: &dyn std::error::Error = error;
    while let Some(next) = inner.source() {
        inner = next;
    }
    inner.to_string()
}
