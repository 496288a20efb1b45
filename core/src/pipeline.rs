//! The order of the stages: a source in, products out. Progress leaves as events; a stop comes back.

mod archiving;
mod colours;
mod folder;
mod growing_map;
mod late;
mod laz;
mod maps;
mod metric;
mod paper;
mod poses;
mod products;
mod progress;
mod quality;
mod reading;
mod recent;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::defects::Chainage;
use crate::depth_map::sheet::WallColours;
use crate::depth_map::strips::TextureStrip;
use crate::error::{Error, Result};
use crate::export::manifest::Manifest;
use crate::motion::track::TrackUse;
use crate::recipe::{Method, Recipe};
use crate::rig::Rig;
use crate::source::{self, Beside, Image, Source, SourceInfo};
use crate::stripe::Stripe;
use crate::surface::Placed;
use folder::ProductFolder;
use products::Products;
use progress::Progress;
use quality::QualityCounter;

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
    /// `cloud.ply`, `cloud.laz`.
    Cloud,
    /// `trajectory.csv`.
    Trajectory,
    /// `recording.rrd`.
    Recording,
    /// `defects.json`, `defects.csv`, `sections.csv`, `residual.tif`.
    Defects,
    /// `archive.mcap`.
    Archive,
    /// `report.html`, and what it rests on: the files of [`ProductGroup::Defects`].
    Report,
}

impl ProductGroup {
    /// All groups.
    pub const ALL: [ProductGroup; 10] = [
        ProductGroup::Depth,
        ProductGroup::Texture,
        ProductGroup::Preview,
        ProductGroup::Tiles,
        ProductGroup::Cloud,
        ProductGroup::Trajectory,
        ProductGroup::Defects,
        ProductGroup::Recording,
        ProductGroup::Archive,
        ProductGroup::Report,
    ];
}

/// What to process, with what, into where.
pub struct Request {
    /// A video file, a folder of images or an MCAP file.
    pub source: PathBuf,
    /// The topics of an MCAP file to read; of those that are not named a guess is made.
    pub topics: Vec<String>,
    /// The name of the source in messages and the manifest (an uploaded file's own name).
    pub source_name: String,
    /// Frames a second of a folder of images.
    pub fps: Option<f64>,
    /// When the run's first frame was captured: the archive's and the recording's times count from it.
    pub recorded_at: jiff::Timestamp,
    /// The name of the asset, for the report; empty where nobody said.
    pub asset: String,
    /// Where the run lies on its asset.
    pub chainage: Chainage,
    /// The rig it was recorded with.
    pub rig: Rig,
    /// How to process it.
    pub recipe: Recipe,
    /// A CSV of the camera's poses, such as a robot's odometry ([`track`](crate::motion::track) says its form); only
    /// with method `metric`. `pose.track` in the recipe says what they are for.
    pub poses: Option<PathBuf>,
    /// The folder for the products; made where it is missing, refused where it is not empty.
    pub out_dir: PathBuf,
    /// The products to make.
    pub products: Vec<ProductGroup>,
    /// Also write what people watch while the work goes on: numbered recording segments to `recording/` inside
    /// `out_dir`, the newest frame to `live/`.
    pub live_segments: bool,
}

impl Request {
    /// What the given poses are for; `None` where there are none.
    fn track_use(&self, beside: &Beside) -> Option<TrackUse> {
        match &self.poses {
            Some(_) => Some(self.recipe.pose.track),
            // A robot's odometry drifts and slips: it says where to look, never where the camera was.
            None => (self.recipe.method == Method::Metric && !beside.poses.is_empty()).then_some(TrackUse::Prior),
        }
    }

    /// The publication's way measures in pixels: it has no place for a pose.
    fn check_poses(&self) -> Result<()> {
        match &self.poses {
            Some(path) if self.recipe.method == Method::Paper => Err(Error::input(
                path.display().to_string(),
                "poses for method `paper`, which places profiles by the image's motion alone",
                "a recipe with method `metric`, or no poses",
            )),
            _ => Ok(()),
        }
    }
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
    /// Files for those who watch are new or have changed: tiles, the newest frame.
    Files {
        /// Paths inside the product folder; those that describe others come last.
        names: Vec<String>,
    },
}

/// Takes the events; answers whether to go on.
pub type Observer<'a> = dyn FnMut(Event) -> std::ops::ControlFlow<()> + 'a;

/// Processes a source into a product folder.
///
/// # Errors
/// [`Error::Input`] for a source, rig or folder that cannot be used, [`Error::Cancelled`] when the observer
/// says stop. Whatever was written is then removed again.
pub fn process(request: &Request, observer: &mut Observer<'_>) -> Result<Manifest> {
    request.check_poses()?;
    let source = source::open_topics(&request.source, &request.source_name, request.fps, &request.topics)?;
    let info = source.info().clone();
    let beside = source.beside();
    request.rig.check_image_size(&request.source_name, info.width_px, info.height_px)?;
    let folder = ProductFolder::claim(&request.out_dir)?;
    let mut progress = Progress::new(observer, info.frames_announced, request.products.len() + 1);
    let manifest = warn_of_camera(request, &beside, &mut progress)
        .and_then(|()| measure_and_write(request, source, &info, &beside, &mut progress));
    folder.settle(manifest)
}

/// How far a focal length that the source gives may be from the rig's, as a share.
const FOCAL_TOLERANCE: f64 = 0.02;

/// A camera that says of itself what the rig does not: perhaps the rig is another run's.
fn warn_of_camera(request: &Request, beside: &Beside, progress: &mut Progress<'_, '_>) -> Result<()> {
    let Some(given) = &beside.camera else { return Ok(()) };
    let camera = &request.rig.camera;
    let off = [(given.focal_px[0], camera.fx_px), (given.focal_px[1], camera.fy_px)]
        .into_iter()
        .any(|(given_px, rig_px)| given_px > 0.0 && (given_px / rig_px - 1.0).abs() > FOCAL_TOLERANCE);
    if !off {
        return Ok(());
    }
    progress.warn(format!(
        "{} gives focal lengths of {:.1} and {:.1} px, the rig {:.1} and {:.1} px: check that the rig is this run's",
        given.topic, given.focal_px[0], given.focal_px[1], camera.fx_px, camera.fy_px
    ))
}

fn measure_and_write(
    request: &Request,
    source: Box<dyn Source>,
    info: &SourceInfo,
    beside: &Beside,
    progress: &mut Progress<'_, '_>,
) -> Result<Manifest> {
    let mut products = Products::create(request, info, beside)?;
    let mut quality = QualityCounter::new(request.track_use(beside));
    let timings = Timings::default();
    let mut run = Run { request, beside, products: &mut products, quality: &mut quality, progress, timings };
    match request.recipe.method {
        Method::Metric => metric::measure(&mut run, source)?,
        Method::Paper => paper::measure(&mut run, source)?,
    }
    let timings = run.timings;
    products.finish(info, quality, timings, progress)
}

/// A job at work: what every stage's results go to.
struct Run<'a, 'r, 'o, 'p> {
    request: &'r Request,
    beside: &'a Beside,
    products: &'a mut Products<'r>,
    quality: &'a mut QualityCounter,
    progress: &'a mut Progress<'o, 'p>,
    timings: Timings,
}

impl Run<'_, '_, '_, '_> {
    /// Surface ▶ maps, cloud, recording, archive.
    fn add(&mut self, placed: impl IntoIterator<Item = Placed<Cargo>>) -> Result<()> {
        for frame in placed {
            self.quality.add(&frame, &frame.measured.cargo.stripe);
            let events = self.timings.time("products", || self.products.add(&frame))?;
            events.into_iter().try_for_each(|event| self.progress.send(event))?;
        }
        Ok(())
    }
}

/// What travels with a frame through the placement.
struct Cargo {
    stripe: Stripe,
    colours: Colours,
    /// Only for the frames whose picture the recording shows.
    picture: Option<Picture>,
}

/// The newest profile, where it is thought to be before its place is final.
struct Newest {
    frame: u32,
    time_s: f64,
    points_in_world: Vec<Point3<f64>>,
}

/// A frame as the recording shows it.
struct Picture {
    /// Whole, or small where nothing else is shown of it.
    image: Image,
    effective_area: Option<Vec<u8>>,
    row_threshold: Option<Vec<f32>>,
}

/// The wall's colours at a frame's profile.
enum Colours {
    /// Not known.
    Unknown,
    /// The publication's strips.
    Strip(TextureStrip),
    /// Between this profile and the one before.
    Wall(WallColours),
}

impl Colours {
    /// The colour at a line position; mid gray where it is not known.
    fn at(&self, line_position: u32) -> [u8; 3] {
        match self {
            Colours::Unknown => [128; 3],
            Colours::Strip(strip) => strip.beside(line_position),
            Colours::Wall(wall) => wall.at(line_position, 1.0).unwrap_or([128; 3]),
        }
    }
}

/// Seconds of work per stage.
#[derive(Default)]
struct Timings {
    stages: BTreeMap<String, f64>,
}

impl Timings {
    fn time<T>(&mut self, stage: &str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        self.add(stage, start.elapsed());
        result
    }

    /// Adds what another thread took.
    fn merge(&mut self, other: Timings) {
        for (stage, time_s) in other.stages {
            *self.stages.entry(stage).or_default() += time_s;
        }
    }

    fn add(&mut self, stage: &str, time: Duration) {
        *self.stages.entry(stage.to_string()).or_default() += time.as_secs_f64();
    }
}
