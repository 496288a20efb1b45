//! Live streams.

use serde::Serialize;
use utoipa::ToSchema;

/// A live stream.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct LiveStream {
    /// Its name.
    pub stream: String,
    /// Its latest run.
    pub run: String,
    /// That run's first job.
    pub job: String,
    /// What it brings: `frames` (images) or `ts` (MPEG-TS).
    pub kind: String,
    /// The robot may still send.
    pub open: bool,
    /// Images received; 0 for MPEG-TS, whose frames are counted when they are decoded.
    pub frames: u64,
    /// Bytes received.
    pub bytes: u64,
    /// Frames that were never sent: first and last number of each range.
    pub missing: Vec<[u64; 2]>,
    /// When the run was opened (RFC 3339, UTC).
    pub opened_at: String,
}

/// A page of live streams, those opened last first.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct LiveStreamPage {
    /// The streams.
    pub items: Vec<LiveStream>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// What a POST brought.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct LiveEnded {
    /// The run.
    pub run: String,
    /// Its job.
    pub job: String,
    /// Images received; 0 for MPEG-TS.
    pub frames: u64,
    /// Frames that were never sent: first and last number of each range.
    pub missing: Vec<[u64; 2]>,
}
