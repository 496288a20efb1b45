//! How far the work is, and the way out for a stop.

use std::time::{Duration, Instant};

use super::{Event, Observer};
use crate::error::{Error, Result};

/// Least time between two progress events.
const PERIOD: Duration = Duration::from_millis(200);
/// Share of the whole job that measuring the frames takes; the rest writes the products.
const MEASURING_SHARE: f64 = 0.85;

/// Sends events and counts.
pub(super) struct Progress<'a, 'o> {
    observer: &'a mut Observer<'o>,
    started: Instant,
    last: Option<Instant>,
    frames: u64,
    frames_total: Option<u64>,
    steps_total: usize,
    steps_done: usize,
    warnings: Vec<String>,
}

impl<'a, 'o> Progress<'a, 'o> {
    /// `steps_total` products are written after the frames.
    pub(super) fn new(observer: &'a mut Observer<'o>, frames_total: Option<u64>, steps_total: usize) -> Self {
        Progress {
            observer,
            started: Instant::now(),
            last: None,
            frames: 0,
            frames_total,
            steps_total: steps_total.max(1),
            steps_done: 0,
            warnings: Vec::new(),
        }
    }

    /// One more frame is measured.
    pub(super) fn frame(&mut self) -> Result<()> {
        self.frames += 1;
        if self.last.is_some_and(|last| last.elapsed() < PERIOD) {
            return Ok(());
        }
        let share = self.frames_total.map_or(0.0, |total| (self.frames as f64 / total.max(1) as f64).min(1.0));
        self.send_progress("measuring", MEASURING_SHARE * share)
    }

    /// The next product is being written.
    pub(super) fn step(&mut self, stage: &str) -> Result<()> {
        let share = self.steps_done as f64 / self.steps_total as f64;
        self.steps_done += 1;
        self.send_progress(stage, MEASURING_SHARE + (1.0 - MEASURING_SHARE) * share.min(1.0))
    }

    /// Something a person should know; said once.
    pub(super) fn warn(&mut self, message: String) -> Result<()> {
        if self.warnings.contains(&message) {
            return Ok(());
        }
        self.warnings.push(message.clone());
        self.send(Event::Warning { message })
    }

    /// Everything that was warned of.
    pub(super) fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Hands an event out; an answer to stop becomes [`Error::Cancelled`].
    pub(super) fn send(&mut self, event: Event) -> Result<()> {
        if (self.observer)(event).is_break() { Err(Error::Cancelled) } else { Ok(()) }
    }

    fn send_progress(&mut self, stage: &str, fraction: f64) -> Result<()> {
        self.last = Some(Instant::now());
        let elapsed_s = self.started.elapsed().as_secs_f64();
        // The first moments tell nothing about the rest.
        let time_left_s = (fraction > 0.02 && elapsed_s > 0.5).then(|| elapsed_s * (1.0 - fraction) / fraction);
        self.send(Event::Progress {
            stage: stage.to_string(),
            fraction,
            frames: self.frames,
            frames_total: self.frames_total,
            frames_per_s: self.frames as f64 / elapsed_s.max(1e-3),
            time_left_s,
        })
    }
}
