//! Defects on the wire, and what changed between two jobs.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What people decided about a defect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DefectState {
    /// Nobody has decided anything yet.
    Open,
    /// Somebody has seen it.
    Acknowledged,
    /// It shall be watched.
    Watched,
    /// It has been repaired.
    Repaired,
    /// It is none.
    Dismissed,
}

impl DefectState {
    /// All states.
    pub const ALL: [DefectState; 5] = [
        DefectState::Open,
        DefectState::Acknowledged,
        DefectState::Watched,
        DefectState::Repaired,
        DefectState::Dismissed,
    ];

    /// As records and requests write it.
    pub fn as_str(self) -> &'static str {
        match self {
            DefectState::Open => "open",
            DefectState::Acknowledged => "acknowledged",
            DefectState::Watched => "watched",
            DefectState::Repaired => "repaired",
            DefectState::Dismissed => "dismissed",
        }
    }

    /// Reads [`DefectState::as_str`]'s words.
    pub fn parse(text: &str) -> Option<DefectState> {
        DefectState::ALL.into_iter().find(|state| state.as_str() == text)
    }
}

/// A defect that a job found, and what people say about it.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Defect {
    /// Its name.
    pub id: String,
    /// The pipe or wall.
    pub asset: String,
    /// The run.
    pub run: String,
    /// The job that found it.
    pub job: String,
    /// The job is the run's latest that is done.
    pub current: bool,
    /// Its number in the job's `defects.json`, from 1.
    pub number: i64,
    /// `dent`, `bulge`, `step`, `hole` or `missing_material`.
    pub kind: String,
    /// `minor`, `moderate` or `severe`.
    pub severity: String,
    /// The operator's own code, where the recipe gives one.
    pub code: Option<String>,
    /// Chainage of its middle, mm, by what the run says now.
    pub chainage_mm: f64,
    /// Clock position on a pipe, seen along the rising chainage, h.
    pub clock_h: Option<f64>,
    /// Height on a wall above the camera's start, mm.
    pub height_mm: Option<f64>,
    /// World x of its middle, mm.
    pub x_mm: f64,
    /// World y of its middle, mm; downwards.
    pub y_mm: f64,
    /// World z of its deepest or highest place, mm.
    pub z_mm: f64,
    /// Deepest (above 0: away from the camera) or highest (below 0: towards it) value, mm.
    pub depth_mm: f64,
    /// Extent along the travel, mm.
    pub length_mm: f64,
    /// Extent across the travel, mm.
    pub width_mm: f64,
    /// Area, mm².
    pub area_mm2: f64,
    /// Volume, mm³.
    pub volume_mm3: f64,
    /// Steepest slope, degrees.
    pub steepest_slope_deg: f64,
    /// How sure it is, 0 to 1.
    pub confidence: f64,
    /// It reaches the edge of what was seen, and may be larger.
    pub at_edge: bool,
    /// What people decided.
    pub state: DefectState,
    /// What people wrote.
    pub comment: String,
    /// Another after every change of state or comment; a PATCH that brings it as `If-Match` changes nothing else.
    pub version: String,
    /// When people last changed state or comment (RFC 3339).
    pub changed_at: Option<String>,
    /// Who did: the name of a token or a session.
    pub changed_by: Option<String>,
    /// The defect of an earlier job of this run that people said it of: one of the same kind at the same place.
    pub carried_from: Option<String>,
}

/// A page of defects.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct DefectPage {
    /// The defects.
    pub items: Vec<Defect>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// What can be changed about a defect; absent fields stay as they are.
#[derive(Clone, Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct DefectChange {
    /// What was decided.
    pub state: Option<DefectState>,
    /// Words for people, at most 4,000 characters.
    pub comment: Option<String>,
}

/// One defect over the runs that passed its place.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct DefectHistory {
    /// The defect that was asked for.
    pub defect: Defect,
    /// The runs of its asset that passed its place, either way, the one recorded last first.
    pub items: Vec<DefectSighting>,
}

/// What one run says of a place.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct DefectSighting {
    /// The run.
    pub run: String,
    /// Its latest job that is done, or the defect's own.
    pub job: String,
    /// When it was recorded.
    pub recorded_at: String,
    /// How deep a round dent of 20 mm radius had to be to be listed by that job, mm.
    pub detection_limit_mm: f64,
    /// The same defect there; absent where nothing of its direction (away from the camera or towards it) was found.
    pub defect: Option<Defect>,
}

/// What changed from one job to a later one of the same asset.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct ChangeReport {
    /// The earlier job.
    pub before: String,
    /// The later job.
    pub after: String,
    /// How the two were laid on each other.
    pub registration: Registration,
    /// 95 % of an unchanged, even surface differs by less, mm.
    pub level_of_detection_mm: f64,
    /// Changes are claimed from this difference on, on an even surface, mm.
    pub claimed_from_mm: f64,
    /// Area that both measured, mm².
    pub compared_area_mm2: f64,
    /// What changed, in the order of the earlier run's chainage.
    pub changes: Vec<Change>,
    /// Defects of both that did not change.
    pub unchanged: Vec<SameDefect>,
    /// Numbers of the earlier job's defects without a partner, of which no change can be told.
    pub unsure_before: Vec<u32>,
    /// The same of the later job's.
    pub unsure_after: Vec<u32>,
}

/// How two runs were laid on each other.
#[derive(Clone, Copy, Debug, Serialize, ToSchema)]
pub struct Registration {
    /// Later run's x less the earlier one's at the same place, beyond what the chainages say, mm.
    pub offset_x_mm: f64,
    /// The same for y, mm.
    pub offset_y_mm: f64,
    /// Standard deviation of what is left along x, mm.
    pub sd_x_mm: f64,
    /// The same along y, mm.
    pub sd_y_mm: f64,
    /// Windows that were tried.
    pub windows: usize,
    /// Windows whose relief agreed.
    pub windows_agreeing: usize,
}

/// One place that changed.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Change {
    /// From 1.
    pub id: u32,
    /// `new`, `grown`, `shrunk`, `vanished`, or `changed` where neither job lists a defect.
    pub state: String,
    /// Chainage of its middle by the earlier run, mm.
    pub chainage_mm: f64,
    /// World x of its middle in the earlier run, mm.
    pub x_mm: f64,
    /// World y of it, mm.
    pub y_mm: f64,
    /// Clock position on a pipe, h.
    pub clock_h: Option<f64>,
    /// Height on a wall, mm.
    pub height_mm: Option<f64>,
    /// Greatest change, mm; above 0 away from the camera.
    pub delta_depth_mm: f64,
    /// Area, mm².
    pub area_mm2: f64,
    /// Volume, mm³.
    pub volume_mm3: f64,
    /// How sure it is, 0 to 1.
    pub confidence: f64,
    /// The defect's number in the earlier job.
    pub before_number: Option<u32>,
    /// Its depth there, mm.
    pub before_depth_mm: Option<f64>,
    /// The defect's number in the later job.
    pub after_number: Option<u32>,
    /// Its depth there, mm.
    pub after_depth_mm: Option<f64>,
}

/// The same defect in both jobs, without a change that could be told.
#[derive(Clone, Copy, Debug, Serialize, ToSchema)]
pub struct SameDefect {
    /// Its number in the earlier job.
    pub before_number: u32,
    /// Its number in the later job.
    pub after_number: u32,
    /// Difference of the depths, mm; below what could be told.
    pub delta_depth_mm: f64,
}
