//! Runs on the wire.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Job, JobState};

/// Which way the robot went along the asset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// Chainage grows with the run's x.
    #[default]
    Forward,
    /// Chainage falls with the run's x.
    Backward,
}

impl Direction {
    /// As records and requests write it.
    pub fn as_str(self) -> &'static str {
        match self {
            Direction::Forward => "forward",
            Direction::Backward => "backward",
        }
    }

    /// Reads [`Direction::as_str`]'s words.
    pub fn parse(text: &str) -> Option<Direction> {
        [Direction::Forward, Direction::Backward].into_iter().find(|d| d.as_str() == text)
    }
}

/// The images of a run as they came in.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct RunSource {
    /// The file's own name, as its sender gave it.
    pub filename: String,
    /// The robot still sends: there will be more.
    pub open: bool,
    /// Size, bytes; so far, while it is open.
    pub bytes: u64,
    /// SHA-256 in lower-case hex; not known while it is open.
    pub sha256: Option<String>,
    /// Frames a second, where the sender said so.
    pub fps: Option<f64>,
    /// Where to get it back, byte for byte.
    pub url: String,
}

/// One pass of a robot along an asset.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Run {
    /// Its name (a UUID whose order is the order of creation).
    pub id: String,
    /// The pipe or wall.
    pub asset: String,
    /// Chainage of the run's first frame, mm.
    pub chainage_mm: f64,
    /// Which way the robot went.
    pub direction: Direction,
    /// When it was recorded (RFC 3339, UTC); where nobody said so, when it came in.
    pub recorded_at: String,
    /// When it came in.
    pub created_at: String,
    /// Words for people.
    pub note: String,
    /// The name of the rig it was recorded with.
    pub rig: String,
    /// The images.
    pub source: RunSource,
    /// Another after every change of what is said about it; a PATCH that brings it as `If-Match` changes nothing else.
    pub version: String,
    /// State of its latest job.
    pub state: JobState,
    /// Its latest job.
    pub job: Job,
}

/// What can be changed about a run; absent fields stay as they are.
#[derive(Clone, Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct RunChange {
    /// The pipe or wall.
    pub asset: Option<String>,
    /// Chainage of the run's first frame, mm.
    pub chainage_mm: Option<f64>,
    /// Which way the robot went.
    pub direction: Option<Direction>,
    /// When it was recorded (RFC 3339).
    pub recorded_at: Option<String>,
    /// Words for people.
    pub note: Option<String>,
}
