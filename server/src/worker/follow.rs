//! A run's source → where the child reads it: a file, or a folder that gets the run's segments as they come.

use std::path::{Path, PathBuf};
use std::time::Duration;

use stria_core::source::segments::{SegmentKind, names};

use super::Worker;
use crate::error::{Error, Result};
use crate::queue::Lease;
use crate::source::{self, FILE, StoredSegment};
use crate::store::Key;

/// How long an open source is waited for before it is looked at again: a ring of another process may be lost.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// Segments of one look.
const AT_ONCE: u64 = 500;

/// The folder of the segments inside an attempt's own.
const FOLDER: &str = "source";

/// A source as the child reads it.
pub(super) struct Source {
    /// The file, or the folder of segments.
    pub(super) path: PathBuf,
    /// When the run's first frame was captured, ms since 1970.
    pub(super) recorded_ms: i64,
    segments: Option<SegmentKind>,
}

impl Source {
    /// Fetches what the child needs to begin. A live run begins with its first segment.
    pub(super) async fn open(worker: &Worker, lease: &Lease, scratch: &Path) -> Result<Source> {
        if lease.source_kind == FILE {
            let key = Key::source(&lease.run, &lease.source_extension);
            let path = worker.store.local_copy(&key, &lease.source, scratch).await?;
            return Ok(Source { path, recorded_ms: lease.recorded_ms, segments: None });
        }
        let kind = SegmentKind::of_extension(&lease.source_kind)
            .ok_or_else(|| Error::Internal(format!("run {} is of the kind {}", lease.run, lease.source_kind)))?;
        let path = scratch.join(FOLDER);
        let write = async {
            tokio::fs::create_dir_all(&path).await?;
            tokio::fs::write(path.join(names::KIND), kind.extension()).await
        };
        write.await.map_err(|e| Error::io(&path, e))?;
        let mut changes = worker.queue.bell().listen();
        loop {
            changes.borrow_and_update();
            let state = source::state(&worker.db, &lease.run).await?;
            let first = source::segments(&worker.db, &lease.run, &lease.source_extension, 0, 1).await?;
            if !first.is_empty() || !state.open {
                return Ok(Source { path, recorded_ms: state.recorded_ms, segments: Some(kind) });
            }
            let _ = tokio::time::timeout(LOOK_EVERY, changes.changed()).await;
        }
    }

    /// Brings segments to the child as they come, then says that there are no more. Returns only where that fails.
    pub(super) async fn follow(&self, worker: &Worker, lease: &Lease) -> Error {
        let Some(kind) = self.segments else { return std::future::pending().await };
        match self.bring_all(worker, lease, kind).await {
            Ok(()) => std::future::pending().await,
            Err(error) => error,
        }
    }

    async fn bring_all(&self, worker: &Worker, lease: &Lease, kind: SegmentKind) -> Result<()> {
        let mut changes = worker.queue.bell().listen();
        let mut next = 0;
        loop {
            changes.borrow_and_update();
            // What is closed gets no further segment: looked at before the segments are.
            let open = source::state(&worker.db, &lease.run).await?.open;
            let found = source::segments(&worker.db, &lease.run, &lease.source_extension, next, AT_ONCE).await?;
            let all = (found.len() as u64) < AT_ONCE;
            for segment in found {
                self.bring(worker, &segment, kind).await?;
                next = segment.number + 1;
            }
            if !open && all {
                let closed = self.path.join(names::CLOSED);
                return tokio::fs::write(&closed, "").await.map_err(|e| Error::io(&closed, e));
            }
            if all {
                let _ = tokio::time::timeout(LOOK_EVERY, changes.changed()).await;
            }
        }
    }

    /// Each file appears under its name only when it is whole.
    async fn bring(&self, worker: &Worker, segment: &StoredSegment, kind: SegmentKind) -> Result<()> {
        if let Some(arrival_ns) = segment.part_arrival_ns {
            let part = self.path.join(names::part(segment.number));
            tokio::fs::write(&part, arrival_ns.to_string()).await.map_err(|e| Error::io(&part, e))?;
        }
        let stored = worker.store.local_copy(&segment.key, &segment.facts, &self.path).await?;
        let name = self.path.join(names::segment(segment.number, kind));
        if stored.starts_with(&self.path) {
            return tokio::fs::rename(&stored, &name).await.map_err(|e| Error::io(&name, e));
        }
        // The store's own file, under a second name where that can be.
        if tokio::fs::hard_link(&stored, &name).await.is_ok() {
            return Ok(());
        }
        let half = name.with_extension("half");
        let copy = async {
            tokio::fs::copy(&stored, &half).await?;
            tokio::fs::rename(&half, &name).await
        };
        copy.await.map_err(|e| Error::io(&name, e))
    }
}
