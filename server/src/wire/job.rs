//! Jobs, their log, products and recording on the wire.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::Problem;

/// Where a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum JobState {
    /// Waits for a worker, or for its next attempt.
    Queued,
    /// A worker is at it.
    Running,
    /// The products are there; perhaps with warnings.
    Done,
    /// It ended without products; `error` says why.
    Failed,
    /// Someone stopped it.
    Cancelled,
    /// It would wait for a worker, but its batch is paused.
    Paused,
}

impl JobState {
    /// All of them.
    pub const ALL: [JobState; 6] =
        [JobState::Queued, JobState::Running, JobState::Done, JobState::Failed, JobState::Cancelled, JobState::Paused];

    /// As records and requests write it.
    pub fn as_str(self) -> &'static str {
        match self {
            JobState::Queued => "queued",
            JobState::Running => "running",
            JobState::Done => "done",
            JobState::Failed => "failed",
            JobState::Cancelled => "cancelled",
            JobState::Paused => "paused",
        }
    }

    /// Reads [`JobState::as_str`]'s words.
    pub fn parse(text: &str) -> Option<JobState> {
        JobState::ALL.into_iter().find(|s| s.as_str() == text)
    }

    /// True where nothing more happens unless someone asks for it.
    pub fn is_final(self) -> bool {
        matches!(self, JobState::Done | JobState::Failed | JobState::Cancelled)
    }
}

/// Who goes first. Waiting makes up for it: see `queue::rank_ms`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Priority {
    /// A robot is walking and someone watches.
    Live,
    /// A run that came in.
    #[default]
    Upload,
    /// Reprocessing in bulk.
    Batch,
}

impl Priority {
    /// The most urgent first.
    pub const ALL: [Priority; 3] = [Priority::Live, Priority::Upload, Priority::Batch];

    /// As records and requests write it.
    pub fn as_str(self) -> &'static str {
        match self {
            Priority::Live => "live",
            Priority::Upload => "upload",
            Priority::Batch => "batch",
        }
    }

    /// Reads [`Priority::as_str`]'s words.
    pub fn parse(text: &str) -> Option<Priority> {
        Priority::ALL.into_iter().find(|p| p.as_str() == text)
    }
}

/// One processing of one run with one rig and one recipe.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct Job {
    /// Its name.
    pub id: String,
    /// The run it processes.
    pub run: String,
    /// Where it stands.
    pub state: JobState,
    /// True from the request to stop it until it has stopped.
    pub cancelling: bool,
    /// What the worker is doing: `measuring`, or the product being written; empty while it waits.
    pub stage: String,
    /// 0 to 1 over the whole job.
    pub progress: f64,
    /// Frames done.
    pub frames: u64,
    /// Frames in all, where the source says so.
    pub frames_total: Option<u64>,
    /// Frames a second.
    pub frames_per_s: f64,
    /// Time left, s, where it can be told.
    pub time_left_s: Option<f64>,
    /// Which try this is, from 1; 0 before the first.
    pub attempt: u32,
    /// Who goes first.
    pub priority: Priority,
    /// The batch that it belongs to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub batch: Option<String>,
    /// The rig's name.
    pub rig: String,
    /// The recipe's name; `custom` for one that came as text.
    pub recipe: String,
    /// What a person should know.
    pub warnings: Vec<String>,
    /// Why it failed; while it waits for its next attempt, why the last one did.
    pub error: Option<Problem>,
    /// Quality figures of the result, as in `manifest.json`.
    pub quality: Option<serde_json::Value>,
    /// When it was asked for.
    pub created_at: String,
    /// When its present attempt began.
    pub started_at: Option<String>,
    /// When it ended.
    pub finished_at: Option<String>,
    /// Not before this time does the next attempt begin.
    pub next_attempt_at: Option<String>,
}

/// What `POST /api/runs/{run}/jobs` takes; absent fields stay as in the run's latest job.
#[derive(Clone, Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Reprocess {
    /// The name of a stored rig, or a rig in TOML or JSON.
    pub rig: Option<String>,
    /// A built-in recipe's name, or a recipe in TOML.
    pub recipe: Option<String>,
    /// Who goes first.
    pub priority: Option<Priority>,
}

/// A line of a job's log.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct LogLine {
    /// Position in the log, from 0.
    pub number: u64,
    /// When.
    pub at: String,
    /// The attempt that said it.
    pub attempt: u32,
    /// What.
    pub text: String,
}

/// A file that a job made.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct Product {
    /// Path inside the product folder.
    pub name: String,
    /// Size, bytes.
    pub bytes: u64,
    /// SHA-256 in lower-case hex; also its ETag.
    pub sha256: String,
    /// What kind of file it is.
    pub content_type: String,
    /// Where to get it.
    pub url: String,
}

/// One numbered piece of a recording: a complete small RRD.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct RecordingSegment {
    /// From 0, without gaps.
    pub number: u32,
    /// Grows when the recording starts anew, at 0, because another attempt took over.
    pub generation: u64,
    /// Size, bytes.
    pub bytes: u64,
    /// Where to get it.
    pub url: String,
}

/// The recording so far.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct Recording {
    /// The segments, in order.
    pub segments: Vec<RecordingSegment>,
    /// True where no more will come.
    pub complete: bool,
    /// The whole recording in one file, once the job is done.
    pub recording: Option<String>,
}

/// One server-sent event of a job's stream.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct JobEvent {
    /// `state`, `progress`, `log`, `segment` or `tile`.
    pub event: String,
    /// JSON: a job, a log line, a recording segment, or a tile pyramid's `revision`.
    pub data: String,
    /// How long to wait before coming back after a cut, ms.
    pub retry: Option<u64>,
}
