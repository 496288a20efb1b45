//! The reading threads: one decodes, one finds in each frame what it shows alone, a few frames ahead of the rest.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{Scope, ScopedJoinHandle};
use std::time::{Duration, Instant};

use crate::error::{Error, Result};
use crate::recipe::Recipe;
use crate::rig::Rig;
use crate::source::{Frame, Source};

/// Frames that wait between the two threads, at most: with twice as many nothing is quicker, and full HD takes 24 MB more.
const FRAMES_WAIT: usize = 4;

/// A frame with what was found in it alone.
pub(super) struct Seen<T> {
    pub frame: Frame,
    pub found: T,
}

/// What the reading thread reports when it has ended.
#[derive(Default)]
pub(super) struct ReadingReport {
    /// What the source says of itself, and what we say of it.
    pub warnings: Vec<String>,
    /// Time spent decoding.
    pub decoding: Duration,
    /// Time spent finding stripes.
    pub stripes: Duration,
}

/// Starts the threads. They end at the source's end, at an error, or when nobody listens any more.
pub(super) fn start<'scope, T: Send + 'scope>(
    scope: &'scope Scope<'scope, '_>,
    source: Box<dyn Source>,
    rig: &'scope Rig,
    recipe: &'scope Recipe,
    mut find: impl FnMut(&Frame) -> Result<T> + Send + 'scope,
) -> (Receiver<Result<Seen<T>>>, Reading<'scope>) {
    let (decoded, frames) = sync_channel(FRAMES_WAIT);
    let (sender, receiver) = sync_channel(FRAMES_WAIT);
    let decoding = scope.spawn(move || decode(source, rig, recipe, &decoded));
    let finding = scope.spawn(move || {
        let mut time = Duration::ZERO;
        for frame in frames {
            let start = Instant::now();
            let seen = frame.and_then(|frame| find(&frame).map(|found| Seen { frame, found }));
            time += start.elapsed();
            let failed = seen.is_err();
            // Nobody listens only after a cancel, which has said its own.
            if sender.send(seen).is_err() || failed {
                break;
            }
        }
        time
    });
    (receiver, Reading { decoding, finding })
}

/// The threads at work.
pub(super) struct Reading<'scope> {
    decoding: ScopedJoinHandle<'scope, ReadingReport>,
    finding: ScopedJoinHandle<'scope, Duration>,
}

impl Reading<'_> {
    /// Waits for their end.
    pub(super) fn join(self) -> Result<ReadingReport> {
        let panicked = |_| Error::internal("source", "a reading thread panicked");
        let finding = self.finding.join().map_err(panicked)?;
        let report = self.decoding.join().map_err(panicked)?;
        Ok(ReadingReport { stripes: finding, ..report })
    }
}

fn decode(mut source: Box<dyn Source>, rig: &Rig, recipe: &Recipe, out: &SyncSender<Result<Frame>>) -> ReadingReport {
    let mut report = ReadingReport::default();
    let limit = recipe.limits.max_frames;
    for count in 0.. {
        let start = Instant::now();
        let frame = match source.next_frame() {
            Ok(Some(_)) if count >= limit => {
                report.warnings.push(format!("only the first {limit} frames were processed (limits.max_frames)"));
                break;
            }
            Ok(Some(frame)) => check_size(&frame, rig).map(|()| frame),
            Ok(None) => break,
            Err(error) => Err(error),
        };
        report.decoding += start.elapsed();
        let failed = frame.is_err();
        if out.send(frame).is_err() || failed {
            break;
        }
    }
    report.warnings.extend(source.warnings());
    report
}

/// A video may change its size on the way; the rig holds for one size.
fn check_size(frame: &Frame, rig: &Rig) -> Result<()> {
    let (width_px, height_px) = (frame.image.width_px(), frame.image.height_px());
    if (width_px, height_px) == (rig.camera.width_px, rig.camera.height_px) {
        return Ok(());
    }
    Err(Error::field(
        format!("frame {}", frame.index),
        "image size",
        format!("{width_px}x{height_px} px"),
        format!("{}x{} px like the frames before", rig.camera.width_px, rig.camera.height_px),
    ))
}
