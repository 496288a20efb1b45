//! `manifest.json`: what was made, from what, with what, how well.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::depth_map::MapGeometry;

/// Version of the manifest's shape; grows when a field changes its meaning.
pub const SCHEMA_VERSION: u32 = 1;

/// A file with its size and hash.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FileEntry {
    /// Path inside the product folder (or the source's own name).
    pub name: String,
    /// Size, bytes.
    pub bytes: u64,
    /// SHA-256 in lower-case hex.
    pub sha256: String,
}

/// How the 16-bit gray values of `depth.png` map to mm: z = min_mm + (value − 1)·(max_mm − min_mm)/65534; 0 = none.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GrayScale {
    /// Depth of value 1, mm.
    pub min_mm: f64,
    /// Depth of value 65535, mm.
    pub max_mm: f64,
}

/// The paper's resolution formulas (15) to (18) for this run's own geometry.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Resolution {
    /// Median distance of the wall, mm.
    pub distance_mm: f64,
    /// C1 of equation (3), mm·px.
    pub c1_mm_px: f64,
    /// C2 of equation (4), px.
    pub c2_px: f64,
    /// Height of the view, mm: (15) from the diagonal angle, by its corrected form.
    pub d_vertical_mm: f64,
    /// Along the line, mm per px (16).
    pub r_vertical_mm: f64,
    /// Along the travel, mm per frame (17).
    pub r_lateral_mm: Option<f64>,
    /// In depth, mm for one px (18).
    pub r_depth_mm: f64,
}

/// How well the run was measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Frames read.
    pub frames: u64,
    /// Frames in which a line was found.
    pub frames_with_stripe: u64,
    /// Frames whose motion was found (of all but the first).
    pub frames_tracked: u64,
    /// Share of line positions with a spot, over all frames, 0 to 1.
    pub rows_found: f64,
    /// Points measured.
    pub points: u64,
    /// Share of map pixels with a depth, 0 to 1.
    pub coverage: f64,
    /// Median over frames of the motion's residual, px.
    pub residual_px: Option<f64>,
    /// Distance travelled, mm.
    pub travel_mm: f64,
    /// Duration of the run, s.
    pub duration_s: f64,
}

/// A stretch of frames without motion or without a stripe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gap {
    /// First frame.
    pub first_frame: u32,
    /// Last frame.
    pub last_frame: u32,
    /// `no_stripe` or `not_tracked`.
    pub reason: String,
}

/// `manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`SCHEMA_VERSION`].
    pub schema_version: u32,
    /// `stria` and its version.
    pub software: String,
    /// The source's files as read.
    pub source: Vec<FileEntry>,
    /// The rig as used.
    pub rig: serde_json::Value,
    /// SHA-256 of the rig's TOML form.
    pub rig_sha256: String,
    /// The recipe as used.
    pub recipe: serde_json::Value,
    /// SHA-256 of the recipe's TOML form.
    pub recipe_sha256: String,
    /// Where the maps lie; absent where nothing was measured.
    pub depth_map: Option<MapGeometry>,
    /// The gray values of `depth.png`.
    pub depth_png: Option<GrayScale>,
    /// Resolution for the run's own geometry.
    pub resolution: Option<Resolution>,
    /// Quality figures.
    pub quality: Quality,
    /// Stretches without data.
    pub gaps: Vec<Gap>,
    /// What a person should know.
    pub warnings: Vec<String>,
    /// Seconds of work per stage.
    pub timings_s: BTreeMap<String, f64>,
    /// Every product.
    pub products: Vec<FileEntry>,
}
