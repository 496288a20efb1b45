//! `cloud.laz` beside the work: its compression has a thread of its own, so that frames do not wait for it.

use std::path::Path;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;

use crate::error::{Error, Result};
use crate::export::cloud_laz::CloudLazWriter;
use crate::surface::SurfacePoint;

/// Profiles that wait for their compression, at most.
const PROFILES_WAIT: usize = 64;

/// The thread at work. Dropped without [`LazThread::finish`], it leaves nothing.
pub(super) struct LazThread {
    profiles: Option<SyncSender<Vec<SurfacePoint>>>,
    /// Answers with the writer, which only the caller may complete.
    thread: Option<JoinHandle<Result<CloudLazWriter>>>,
}

impl LazThread {
    /// Starts the file and the thread.
    pub(super) fn start(path: &Path) -> Result<LazThread> {
        let mut writer = CloudLazWriter::create(path)?;
        let (profiles, received) = sync_channel::<Vec<SurfacePoint>>(PROFILES_WAIT);
        let work = move || {
            for points in received {
                points.iter().try_for_each(|point| writer.push(point))?;
            }
            Ok(writer)
        };
        let thread = std::thread::Builder::new().name("laz".into()).spawn(work).map_err(|e| Error::io(path, e))?;
        Ok(LazThread { profiles: Some(profiles), thread: Some(thread) })
    }

    /// Hands a profile over.
    ///
    /// # Errors
    /// Why the thread ended, where it has.
    pub(super) fn push(&mut self, points: Vec<SurfacePoint>) -> Result<()> {
        let Some(profiles) = &self.profiles else { return Ok(()) };
        match profiles.send(points) {
            Ok(()) => Ok(()),
            Err(_) => self.join().map(drop),
        }
    }

    /// Waits for the last profile and completes the file.
    pub(super) fn finish(mut self) -> Result<()> {
        self.join()?.finish()
    }

    fn join(&mut self) -> Result<CloudLazWriter> {
        self.profiles = None;
        let ended = self.thread.take().map(JoinHandle::join);
        ended.and_then(std::result::Result::ok).ok_or_else(|| Error::internal("cloud.laz", "its thread panicked"))?
    }
}

impl Drop for LazThread {
    fn drop(&mut self) {
        self.profiles = None;
        if let Some(thread) = self.thread.take() {
            // Given up: the writer takes its temporary file along.
            let _ = thread.join();
        }
    }
}
