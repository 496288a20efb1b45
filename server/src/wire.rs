//! The JSON shapes that cross the wire, and between the server and its child processes.
//!
//! Core's types never cross the HTTP wire directly; the OpenAPI document is generated from these.

mod batch;
pub mod child;
mod defect;
mod doors;
mod job;
mod lists;
mod live;
mod measure;
mod retention;
mod run;
pub mod time;

pub use batch::{Batch, BatchFilter, BatchPage, BatchPreview, BatchResult, BatchResultPage, BatchState, BatchWish};
pub use defect::{
    Change, ChangeReport, Defect, DefectChange, DefectHistory, DefectPage, DefectSighting, DefectState, Registration,
    SameDefect,
};
pub use doors::{AuditLine, AuditPage, LogIn, Rotation, Session, Token, TokenPage, TokenWish, TokenWithSecret};
pub use job::{Job, JobEvent, JobState, LogLine, Priority, Product, Recording, RecordingSegment, Reprocess};
pub use lists::{
    Asset, AssetPage, Health, JobPage, LogPage, OptionRange, ProductPage, Recipe, RecipeOption, Rig, RigPage, RunPage,
    Worker,
};
pub use live::{LiveEnded, LiveStream, LiveStreamPage};
pub use measure::{CrossSection, Trajectory};
pub use retention::{Doomed, Pin, RetentionPreview, RetentionRules, RetentionWish, RulesOrigin};
pub use run::{Direction, Run, RunChange, RunSource};

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What went wrong, as RFC 9457 writes it; on a job, why it failed (then without `status`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Problem {
    /// A name for the kind of problem that programs can compare.
    #[serde(rename = "type")]
    pub kind: String,
    /// The kind in words.
    pub title: String,
    /// The HTTP status.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub status: Option<u16>,
    /// This case in words: what was found, with its unit.
    pub detail: String,
    /// The field at fault.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// What would have been right.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected: Option<String>,
    /// True where the same request may succeed later.
    pub retryable: bool,
}
