//! What is said while things are sent: a bar for people on stderr, JSON lines for programs on stdout.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget};
use serde::Serialize;
use serde_json::Value;

use super::super::Failed;
use super::super::progress::{byte_bar, duration, live_bar, size};

/// Pause between two lines of progress for programs.
const PROGRESS_EVERY: Duration = Duration::from_secs(1);

/// A line for programs.
#[derive(Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
enum Line<'a> {
    Progress { file: &'a str, bytes: u64, total_bytes: u64, bytes_per_s: f64, time_left_s: f64 },
    Retry { why: &'a str, wait_s: f64 },
    Warning { message: &'a str },
    Sent { file: &'a str, bytes: u64, run: &'a str, job: &'a str, page: &'a str },
    Refused { file: &'a str, why: &'a str, moved_to: String },
    Stream { run: &'a str, job: &'a str, page: &'a str },
    Frames(&'a Frames),
    Closed { run: &'a str, job: &'a str, page: &'a str, frames: u64, missing: &'a [(u64, u64)] },
    Job { job: &'a Value },
    Result { job: &'a Value, page: &'a str },
    Error { kind: &'static str, message: &'a str },
}

/// How far a live stream is.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(super) struct Frames {
    /// Frames that came from the pipe.
    pub(super) read: u64,
    /// Of those, how many wait on disk for the server's word.
    pub(super) waiting: u64,
    /// Frames left out because the disk's share was full.
    pub(super) dropped: u64,
    /// Bytes on disk.
    pub(super) spool_bytes: u64,
}

/// Whom to tell, and how.
#[derive(Clone)]
pub(super) struct Report {
    json: bool,
    shared: Arc<Mutex<Shared>>,
}

struct Shared {
    bar: ProgressBar,
    name: String,
    said_at: Option<Instant>,
}

impl Report {
    pub(super) fn new(json: bool) -> Report {
        let shared = Shared { bar: ProgressBar::hidden(), name: String::new(), said_at: None };
        Report { json, shared: Arc::new(Mutex::new(shared)) }
    }

    /// True where programs read along.
    pub(super) fn is_json(&self) -> bool {
        self.json
    }

    fn shared(&self) -> std::sync::MutexGuard<'_, Shared> {
        // Whoever panicked over it left a bar, at worst a wrong one.
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn line(&self, line: &Line) {
        use std::io::Write;
        let Ok(text) = serde_json::to_string(line) else { return };
        // Whoever started us may have stopped listening; the files go out all the same.
        let _ = writeln!(std::io::stdout().lock(), "{text}");
    }

    /// For people, above the bar.
    fn say(&self, words: &str) {
        let bar = self.shared().bar.clone();
        bar.suspend(|| eprintln!("stria: {words}"));
    }

    /// A file begins, or goes on at an offset. `what`: reading or sending.
    pub(super) fn begin(&self, what: &'static str, name: &str, offset_bytes: u64, total_bytes: u64) {
        let mut shared = self.shared();
        shared.bar.finish_and_clear();
        shared.bar = byte_bar(what, total_bytes).with_position(offset_bytes);
        if self.json {
            shared.bar.set_draw_target(ProgressDrawTarget::hidden());
        }
        // What was there before says nothing about the speed.
        shared.bar.reset_eta();
        shared.name = name.into();
        shared.said_at = None;
    }

    /// It is so far.
    pub(super) fn at(&self, bytes: u64) {
        let mut shared = self.shared();
        shared.bar.set_position(bytes);
        if self.json && shared.said_at.is_none_or(|at| at.elapsed() >= PROGRESS_EVERY) {
            shared.said_at = Some(Instant::now());
            self.line(&Line::Progress {
                file: &shared.name,
                bytes,
                total_bytes: shared.bar.length().unwrap_or(0),
                bytes_per_s: shared.bar.per_sec(),
                time_left_s: shared.bar.eta().as_secs_f64(),
            });
        }
    }

    /// No file is on its way.
    pub(super) fn idle(&self) {
        let mut shared = self.shared();
        shared.bar.finish_and_clear();
        shared.bar = ProgressBar::hidden();
    }

    /// Something did not work and is tried again.
    pub(super) fn retry(&self, why: &str, wait: Duration) {
        let wait_s = wait.as_secs_f64();
        if self.json {
            self.line(&Line::Retry { why, wait_s });
        } else {
            self.say(&format!("{why}; trying again in {}", duration(wait_s)));
        }
    }

    /// Something that a person should know.
    pub(super) fn warning(&self, message: impl AsRef<str>) {
        if self.json {
            self.line(&Line::Warning { message: message.as_ref() });
        } else {
            self.say(&format!("warning: {}", message.as_ref()));
        }
    }

    /// A file is the server's now.
    pub(super) fn sent(&self, file: &str, bytes: u64, run: &str, job: &str, page: &str) {
        self.idle();
        if self.json {
            self.line(&Line::Sent { file, bytes, run, job, page });
        } else {
            println!("sent: {file} ({}), run {run}, job {job}\n{page}", size(bytes));
        }
    }

    /// A file is not for the server.
    pub(super) fn refused(&self, file: &str, why: &str, moved_to: &std::path::Path) {
        self.idle();
        if self.json {
            self.line(&Line::Refused { file, why, moved_to: moved_to.display().to_string() });
        } else {
            self.say(&format!("{file} was refused and moved to {}: {why}", moved_to.display()));
        }
    }

    /// A live stream has a run.
    pub(super) fn stream(&self, run: &str, job: &str, page: &str) {
        if self.json {
            self.line(&Line::Stream { run, job, page });
        } else {
            self.say(&format!("live: run {run}, job {job}, {page}"));
        }
    }

    /// A live stream is so far.
    pub(super) fn frames(&self, frames: &Frames) {
        if self.json {
            self.line(&Line::Frames(frames));
            return;
        }
        let mut shared = self.shared();
        if shared.bar.is_hidden() {
            shared.bar = live_bar();
        }
        shared.bar.set_position(frames.read);
        let mut words = format!("{} waiting ({})", frames.waiting, size(frames.spool_bytes));
        if frames.dropped > 0 {
            words += &format!(", {} dropped", frames.dropped);
        }
        shared.bar.set_message(words);
    }

    /// A live stream is complete.
    pub(super) fn closed(&self, run: &str, job: &str, page: &str, frames: u64, missing: &[(u64, u64)]) {
        self.idle();
        if self.json {
            self.line(&Line::Closed { run, job, page, frames, missing });
            return;
        }
        println!("closed: {frames} frames, run {run}, job {job}");
        if !missing.is_empty() {
            println!("missing: {}", ranges(missing));
        }
        println!("{page}");
    }

    /// A job goes on.
    pub(super) fn job(&self, job: &Value) {
        let mut shared = self.shared();
        if self.json && shared.said_at.is_none_or(|at| at.elapsed() >= PROGRESS_EVERY) {
            shared.said_at = Some(Instant::now());
            self.line(&Line::Job { job });
        }
    }

    /// A job has ended well.
    pub(super) fn result(&self, job: &Value, page: &str) {
        self.line(&Line::Result { job, page });
    }

    /// The command ends without success; in words this is said elsewhere.
    pub(super) fn failed(&self, failed: &Failed) {
        self.idle();
        if !self.json {
            return;
        }
        let (kind, message) = match failed {
            Failed::Input(message) => ("bad_input", message.as_str()),
            Failed::Other(message) => ("failed", message.as_str()),
            Failed::Cancelled => ("cancelled", "stopped by a signal"),
        };
        self.line(&Line::Error { kind, message });
    }
}

/// Ranges for people: `3, 7-9`; the first of them, where there are many.
fn ranges(missing: &[(u64, u64)]) -> String {
    const SHOWN: usize = 20;
    let shown = missing.iter().take(SHOWN);
    let words = shown.map(|(a, b)| if a == b { a.to_string() } else { format!("{a}-{b}") });
    let mut text = words.collect::<Vec<_>>().join(", ");
    if missing.len() > SHOWN {
        text += &format!(" and {} more ranges", missing.len() - SHOWN);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_short() {
        assert_eq!(ranges(&[(3, 3), (7, 9)]), "3, 7-9");
        let many: Vec<_> = (0..30).map(|i| (2 * i, 2 * i)).collect();
        assert!(ranges(&many).ends_with("38 and 10 more ranges"), "{}", ranges(&many));
    }
}
