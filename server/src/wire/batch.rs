//! Reprocessing in bulk on the wire.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::JobState;

/// What `POST /api/batches` takes: a filter or a list of runs, and what shall be other than in each run's latest job.
#[derive(Clone, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BatchWish {
    /// The runs by what is known of them; `{}` takes all.
    pub filter: Option<BatchFilter>,
    /// The runs one by one.
    pub runs: Option<Vec<String>>,
    /// The name of a stored rig, or a rig in TOML or JSON.
    pub rig: Option<String>,
    /// A built-in recipe's name, or a recipe in TOML.
    pub recipe: Option<String>,
    /// Words for people.
    #[serde(default)]
    pub note: String,
    /// Only count the runs.
    #[serde(default)]
    pub dry_run: bool,
}

/// Which runs; what is absent does not matter.
#[derive(Clone, Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BatchFilter {
    /// Of this asset.
    pub asset: Option<String>,
    /// Whose latest job has this state.
    pub state: Option<JobState>,
    /// With this text in the asset's, the file's or the rig's name, or in the note.
    pub q: Option<String>,
    /// Recorded at this time or later (RFC 3339).
    pub from: Option<String>,
    /// Recorded before this time (RFC 3339).
    pub to: Option<String>,
    /// Recorded with the rig of this name.
    pub rig: Option<String>,
    /// Whose latest job has the recipe of this name.
    pub recipe: Option<String>,
}

/// What a batch would take.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct BatchPreview {
    /// Number of runs.
    pub runs: u64,
}

/// Where a batch stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum BatchState {
    /// Its jobs are being put into the queue.
    Queueing,
    /// All its jobs were put there.
    Running,
    /// Its waiting jobs are being held back.
    Pausing,
    /// Its waiting jobs are held back.
    Paused,
    /// Its jobs are being stopped.
    Cancelling,
    /// Its jobs were stopped.
    Cancelled,
    /// All its jobs have ended.
    Done,
}

/// Reprocessing in bulk.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Batch {
    /// Its name.
    pub id: String,
    /// When it was asked for.
    pub created_at: String,
    /// Words for people.
    pub note: String,
    /// Where it stands.
    pub state: BatchState,
    /// Number of its runs.
    pub runs: u64,
    /// Number of its jobs by state.
    pub jobs: BTreeMap<String, u64>,
    /// The rig's name; absent where each run keeps its own.
    pub rig: Option<String>,
    /// The recipe's name; absent where each run keeps its own.
    pub recipe: Option<String>,
}

/// A page of batches, the newest first.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct BatchPage {
    /// The batches.
    pub items: Vec<Batch>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// What a batch made of one run, beside what was there.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct BatchResult {
    /// The run.
    pub run: String,
    /// The batch's job.
    pub job: String,
    /// Where that stands.
    pub state: JobState,
    /// The job before it.
    pub base_job: Option<String>,
    /// Quality figures of the job before it.
    pub before: Option<serde_json::Value>,
    /// Quality figures of the batch's job.
    pub after: Option<serde_json::Value>,
    /// After minus before, for each figure that both have.
    pub difference: BTreeMap<String, f64>,
}

/// A page of results, in the order of the queue.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct BatchResultPage {
    /// The results.
    pub items: Vec<BatchResult>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}
