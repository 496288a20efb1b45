//! The child process of an attempt: started in its own group with limits, listened to, ended.

use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{ExitStatus, Stdio};

use rustix::process::{Pid, Resource, Rlimit, Signal, kill_process_group, prlimit, setpriority_process};
use stria_core::export::manifest::Manifest;
use stria_core::pipeline::Event;
use tokio::io::{AsyncBufRead, AsyncBufReadExt, BufReader};
use tokio::process::{ChildStderr, ChildStdin, ChildStdout};

use super::Worker;
use super::scratch::Scratch;
use crate::config::GB;
use crate::error::{Error, Result};
use crate::queue::Lease;
use crate::wire::child::{End, Failure, Line};
use crate::wire::time::to_text;

/// Processing gives way to the server that people wait for.
const NICENESS: i32 = 10;

/// Longest line of stderr that is looked at, bytes; the rest of it is dropped.
const STDERR_LINE_BYTES: usize = 4096;

/// How Rust, C++, OpenCV, FFmpeg and the loader say that they got no memory.
const OUT_OF_MEMORY: [&str; 6] = [
    "memory allocation of",
    "bad_alloc",
    "Insufficient memory",
    "Cannot allocate memory",
    "failed to map segment",
    "Out of memory",
];

/// What a child says while it works.
pub(super) enum Said {
    /// An event of the pipeline.
    Event(Event),
    /// A line for people.
    Stderr(String),
}

/// A running child. Its stdin is a thread to its parent: when this process dies, however it dies, the pipe breaks
/// and the child stops by itself.
pub(super) struct Child {
    process: tokio::process::Child,
    group: Option<Pid>,
    stdin: Option<ChildStdin>,
    stdout: Option<Lines<ChildStdout>>,
    stderr: Option<Lines<ChildStderr>>,
    end: Option<End>,
    nonsense: Option<String>,
    last_words: Vec<u8>,
    last_words_bytes: usize,
    memory_bytes: u64,
}

impl Child {
    /// Starts `stria process` on the run's source.
    pub(super) fn start(worker: &Worker, lease: &Lease, scratch: &Scratch, source: &Path) -> Result<Child> {
        let mut command = worker.confined.command(&worker.program);
        command.arg("process").arg(source);
        command.arg("--rig").arg(scratch.rig()).arg("--recipe").arg(scratch.recipe()).arg("--out").arg(scratch.out());
        command.arg("--recorded-at").arg(to_text(lease.recorded_ms));
        // One word, so that a name that begins with a dash is no flag.
        command.arg(format!("--name={}", lease.filename)).arg(format!("--asset={}", lease.asset));
        command.arg(format!("--chainage-mm={}", lease.chainage_mm)).arg(format!("--direction={}", lease.direction));
        if let Some(fps) = lease.fps {
            command.arg(format!("--fps={fps}"));
        }
        command.args(["--json", "--live-segments", "--exit-with-stdin"]);
        if worker.confined.fences_files() {
            command.arg("--keep-to").arg(scratch.folder());
        }
        command.current_dir(scratch.folder()).env("TMPDIR", scratch.folder());
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command.process_group(0).kill_on_drop(true);
        let mut process = command.spawn().map_err(|e| Error::io(&worker.program, e))?;
        let group = process.id().and_then(|id| Pid::from_raw(i32::try_from(id).ok()?));
        limit(group, worker.limits.memory_bytes);
        let limits = &worker.limits;
        Ok(Child {
            group,
            stdin: process.stdin.take(),
            stdout: process.stdout.take().map(|pipe| Lines::new(pipe, limits.line_bytes)),
            stderr: process.stderr.take().map(|pipe| Lines::new(pipe, STDERR_LINE_BYTES)),
            process,
            end: None,
            nonsense: None,
            last_words: Vec::new(),
            last_words_bytes: limits.last_words_bytes,
            memory_bytes: limits.memory_bytes,
        })
    }

    /// The next thing it says; `None` once both its pipes are closed. Safe to drop half-way.
    pub(super) async fn next(&mut self) -> Option<Said> {
        loop {
            let (from_stdout, line) = match (&mut self.stdout, &mut self.stderr) {
                (Some(out), Some(err)) => tokio::select! {
                    line = out.next() => (true, line),
                    line = err.next() => (false, line),
                },
                (Some(out), None) => (true, out.next().await),
                (None, Some(err)) => (false, err.next().await),
                (None, None) => return None,
            };
            match (from_stdout, line) {
                (true, None) => self.stdout = None,
                (false, None) => self.stderr = None,
                (true, Some(line)) => {
                    if let Some(event) = self.read_line(&line) {
                        return Some(Said::Event(event));
                    }
                }
                (false, Some(line)) => {
                    self.remember(&line.bytes);
                    let text = String::from_utf8_lossy(&line.bytes).trim().to_string();
                    if !text.is_empty() {
                        return Some(Said::Stderr(text));
                    }
                }
            }
        }
    }

    fn read_line(&mut self, line: &Text) -> Option<Event> {
        let read = if line.cut { None } else { serde_json::from_slice::<Line>(&line.bytes).ok() };
        match read {
            Some(Line::Event(event)) => return Some(event),
            Some(Line::End(end)) => self.end = Some(end),
            None => {
                let start = String::from_utf8_lossy(&line.bytes[..line.bytes.len().min(200)]).into_owned();
                self.nonsense.get_or_insert(start);
            }
        }
        None
    }

    fn remember(&mut self, line: &[u8]) {
        self.last_words.extend_from_slice(line);
        self.last_words.push(b'\n');
        let surplus = self.last_words.len().saturating_sub(self.last_words_bytes);
        self.last_words.drain(..surplus);
    }

    /// After its pipes are closed: what it made, or why it made nothing.
    pub(super) async fn end(&mut self) -> std::result::Result<Box<Manifest>, Failure> {
        let status = match self.process.wait().await {
            Ok(status) => status,
            Err(e) => return Err(Failure::new("internal", format!("the child process was lost: {e}"), true)),
        };
        drop(self.stdin.take());
        match (status.code(), self.end.take()) {
            (Some(0 | 3), Some(End::Result { manifest })) => Ok(manifest),
            (Some(_), Some(End::Error(failure))) if failure.kind != "cancelled" => Err(self.or_memory(failure)),
            _ => Err(self.or_memory(self.unexpected(status))),
        }
    }

    /// A failure that was the memory limit's says so, whatever part of the processing ran into it.
    fn or_memory(&self, failure: Failure) -> Failure {
        let words = String::from_utf8_lossy(&self.last_words);
        let ran_out = OUT_OF_MEMORY.iter().any(|w| failure.message.contains(w) || words.contains(w));
        if failure.kind == "bad_input" || !ran_out {
            return failure;
        }
        let limit_gb = self.memory_bytes as f64 / GB as f64;
        let message = format!(
            "the processing ran out of memory; its limit is {limit_gb} GB (--job-memory-limit-gb); {}",
            failure.message
        );
        Failure::new("out_of_memory", message, failure.retryable)
    }

    fn unexpected(&self, status: ExitStatus) -> Failure {
        let mut message = match (status.signal(), status.code()) {
            (Some(signal), _) => format!("the processing was killed by signal {signal} ({})", signal_name(signal)),
            (None, Some(code)) => format!("the processing ended with exit code {code} and without a result"),
            (None, None) => "the processing ended in an unknown way".into(),
        };
        if let Some(nonsense) = &self.nonsense {
            message += &format!("; it printed a line that is no event: {nonsense:?}");
        }
        let words = String::from_utf8_lossy(&self.last_words);
        if !words.trim().is_empty() {
            message += &format!("; its last words: {}", words.trim());
        }
        match (status.signal(), status.code()) {
            // Wrong usage of a command that we wrote: the next try would be the same.
            (None, Some(2)) => Failure::new("internal", message, false),
            (Some(_), _) | (None, Some(130)) => Failure::new("killed", message, true),
            _ => Failure::new("internal", message, true),
        }
    }

    /// Kills it with everything it started, and waits until it is gone.
    pub(super) async fn kill(mut self) {
        if let Some(group) = self.group {
            // It may have ended by itself a moment ago; then there is nothing to kill.
            let _ = kill_process_group(group, Signal::KILL);
        }
        if let Err(error) = self.process.wait().await {
            tracing::warn!(%error, "a child process could not be waited for");
        }
    }
}

/// Memory for the child, and its place behind the server. A child that is gone already needs neither.
fn limit(child: Option<Pid>, memory_bytes: u64) {
    let Some(child) = child else { return };
    let memory = Rlimit { current: Some(memory_bytes), maximum: Some(memory_bytes) };
    if let Err(error) = prlimit(Some(child), Resource::Data, memory) {
        tracing::warn!(%error, "the memory of a child process could not be limited");
    }
    // A hostile video that crashes the decoder must not fill the disk with its memory.
    let none = Rlimit { current: Some(0), maximum: Some(0) };
    if let Err(error) = prlimit(Some(child), Resource::Core, none) {
        tracing::warn!(%error, "a child process may leave a core file behind");
    }
    if let Err(error) = setpriority_process(Some(child), NICENESS) {
        tracing::debug!(%error, "a child process kept its priority");
    }
}

fn signal_name(signal: i32) -> &'static str {
    match signal {
        4 => "SIGILL",
        6 => "SIGABRT, as after a failed allocation",
        7 => "SIGBUS",
        8 => "SIGFPE",
        9 => "SIGKILL, as when the machine's memory runs out",
        11 => "SIGSEGV",
        15 => "SIGTERM",
        _ => "see signal(7)",
    }
}

/// A line, or its beginning.
struct Text {
    bytes: Vec<u8>,
    cut: bool,
}

/// Lines of a pipe, bounded; what is half-read stays for the next call.
struct Lines<R> {
    reader: BufReader<R>,
    line: Vec<u8>,
    cut: bool,
    most_bytes: usize,
}

impl<R: tokio::io::AsyncRead + Unpin> Lines<R> {
    fn new(pipe: R, most_bytes: usize) -> Lines<R> {
        Lines { reader: BufReader::with_capacity(64 * 1024, pipe), line: Vec::new(), cut: false, most_bytes }
    }

    /// The next line; `None` at the end of the pipe, or when it breaks.
    async fn next(&mut self) -> Option<Text> {
        loop {
            let bytes = self.reader.fill_buf().await.unwrap_or_default();
            let (part, used, ends) = match bytes.iter().position(|b| *b == b'\n') {
                Some(end) => (&bytes[..end], end + 1, true),
                None => (bytes, bytes.len(), bytes.is_empty()),
            };
            let room = self.most_bytes - self.line.len();
            self.cut |= part.len() > room;
            self.line.extend_from_slice(&part[..part.len().min(room)]);
            let at_end = used == 0;
            std::pin::Pin::new(&mut self.reader).consume(used);
            if ends && at_end && self.line.is_empty() {
                return None;
            }
            if ends {
                return Some(Text { bytes: std::mem::take(&mut self.line), cut: std::mem::take(&mut self.cut) });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn lines_are_bounded_and_survive_odd_ends() {
        let mut lines = Lines::new(&b"one\n\n0123456789\nlast"[..], 6);
        let mut read = Vec::new();
        while let Some(text) = lines.next().await {
            read.push((String::from_utf8(text.bytes).expect("ASCII"), text.cut));
        }
        let expected = [("one", false), ("", false), ("012345", true), ("last", false)];
        assert_eq!(read, expected.map(|(text, cut)| (text.to_string(), cut)));
    }
}
