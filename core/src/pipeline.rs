//! The order of the stages: a source in, products out. Progress leaves as events; a stop comes back.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::export::manifest::Manifest;
use crate::recipe::Recipe;
use crate::rig::Rig;

/// A group of products that `--only` can name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ProductGroup {
    /// `depth.tif`, `depth.png`.
    Depth,
    /// `texture.jpg` or `.png`.
    Texture,
    /// `preview.png`.
    Preview,
    /// `tiles/`.
    Tiles,
    /// `cloud.ply`.
    Cloud,
    /// `trajectory.csv`.
    Trajectory,
    /// `recording.rrd`.
    Recording,
    /// `archive.mcap`.
    Archive,
}

impl ProductGroup {
    /// All groups.
    pub const ALL: [ProductGroup; 8] = [
        ProductGroup::Depth,
        ProductGroup::Texture,
        ProductGroup::Preview,
        ProductGroup::Tiles,
        ProductGroup::Cloud,
        ProductGroup::Trajectory,
        ProductGroup::Recording,
        ProductGroup::Archive,
    ];
}

/// What to process, with what, into where.
pub struct Request {
    /// A video file or a folder of images.
    pub source: PathBuf,
    /// The name of the source in messages and the manifest (an uploaded file's own name).
    pub source_name: String,
    /// Frames a second of a folder of images.
    pub fps: Option<f64>,
    /// The rig it was recorded with.
    pub rig: Rig,
    /// How to process it.
    pub recipe: Recipe,
    /// The folder for the products; made where it is missing, refused where it is not empty.
    pub out_dir: PathBuf,
    /// The products to make.
    pub products: Vec<ProductGroup>,
    /// Also write numbered recording segments to `recording/` inside `out_dir` while the work goes on.
    pub live_segments: bool,
}

/// What the pipeline says while it works. The server reads these as JSON lines from its child.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Event {
    /// How far the work is.
    Progress {
        /// `measuring` (frames) or the name of the product being written.
        stage: String,
        /// 0 to 1 over the whole job.
        fraction: f64,
        /// Frames done.
        frames: u64,
        /// Frames in all, where the source says so.
        frames_total: Option<u64>,
        /// Frames a second since the start.
        frames_per_s: f64,
        /// Time left, s, where it can be told.
        time_left_s: Option<f64>,
    },
    /// Something a person should know; the work goes on.
    Warning {
        /// In words.
        message: String,
    },
    /// A recording segment is complete and may be shown.
    Segment {
        /// From 0.
        number: u32,
        /// Path inside the product folder.
        path: String,
        /// Its size.
        bytes: u64,
    },
}

/// Takes the events; answers whether to go on.
pub type Observer<'a> = dyn FnMut(Event) -> std::ops::ControlFlow<()> + 'a;

/// Processes a source into a product folder.
pub fn process(request: &Request, observer: &mut Observer<'_>) -> Result<Manifest> {
    let _ = (request, observer);
    Err(Error::internal("pipeline", "not written yet"))
}
