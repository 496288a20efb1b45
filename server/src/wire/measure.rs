//! Measurements read off a job's products, on the wire.

use std::collections::BTreeMap;

use serde::Serialize;
use utoipa::ToSchema;

/// A cross-section of a depth map: one entry a point in every list.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct CrossSection {
    /// The job whose map it is.
    pub job: String,
    /// Size of the map's pixel, mm.
    pub mm_per_px: f64,
    /// Way from one point to the next, mm.
    pub step_mm: f64,
    /// Way along the line since its beginning, mm.
    pub distance_mm: Vec<f64>,
    /// Position along the asset, mm.
    pub chainage_mm: Vec<f64>,
    /// World x, mm.
    pub x_mm: Vec<f64>,
    /// World y, mm.
    pub y_mm: Vec<f64>,
    /// World z as `depth.tif` has it at the nearest pixel, mm; null where nothing was measured.
    pub z_mm: Vec<Option<f32>>,
}

/// A job's trajectory as columns, one entry a frame in every list.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Trajectory {
    /// The job.
    pub job: String,
    /// Frames of the run.
    pub frames: u64,
    /// Every n-th frame is here.
    pub every: u64,
    /// `trajectory.csv`'s columns by their names; null where a value was not determined.
    pub columns: BTreeMap<String, Vec<Option<f64>>>,
}
