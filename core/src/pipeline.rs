//! The order of the stages: a source in, products out. Progress leaves as events; a stop comes back.

mod folder;
mod products;
mod progress;
mod quality;
mod reading;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::depth_map::strips::TextureStrip;
use crate::error::{Error, Result};
use crate::export::manifest::Manifest;
use crate::motion::{ImageTracker, Shift};
use crate::recipe::Recipe;
use crate::rig::{LineDirection, Rig};
use crate::source::{self, Frame, Image, Source, SourceInfo};
use crate::stripe::{Stripe, StripeSteps};
use crate::surface::{Measured, Placed, Placement};
use crate::triangulation::{Profile, triangulate};
use folder::ProductFolder;
use products::Products;
use progress::Progress;
use quality::QualityCounter;
use reading::Seen;

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
    /// When the run's first frame was captured: the archive's and the recording's times count from it.
    pub recorded_at: jiff::Timestamp,
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
///
/// # Errors
/// [`Error::Input`] for a source, rig or folder that cannot be used, [`Error::Cancelled`] when the observer
/// says stop. Whatever was written is then removed again.
pub fn process(request: &Request, observer: &mut Observer<'_>) -> Result<Manifest> {
    let source = source::open(&request.source, &request.source_name, request.fps)?;
    let info = source.info().clone();
    request.rig.check_image_size(&request.source_name, info.width_px, info.height_px)?;
    let folder = ProductFolder::claim(&request.out_dir)?;
    let mut progress = Progress::new(observer, info.frames_announced, request.products.len() + 1);
    let manifest = measure_and_write(request, source, &info, &mut progress);
    folder.settle(manifest)
}

fn measure_and_write(
    request: &Request,
    source: Box<dyn Source>,
    info: &SourceInfo,
    progress: &mut Progress<'_, '_>,
) -> Result<Manifest> {
    let mut products = Products::create(request, info)?;
    let mut quality = QualityCounter::new();
    let timings = measure(request, source, &mut products, &mut quality, progress)?;
    products.finish(info, quality, timings, progress)
}

/// The order of the stages, frame by frame.
fn measure(
    request: &Request,
    source: Box<dyn Source>,
    products: &mut Products<'_>,
    quality: &mut QualityCounter,
    progress: &mut Progress<'_, '_>,
) -> Result<Timings> {
    let (rig, recipe) = (&request.rig, &request.recipe);
    let mut timings = Timings::default();
    let mut tracker = ImageTracker::new(&recipe.motion);
    let mut placement = Placement::new(rig, &recipe.motion);
    std::thread::scope(|scope| {
        // Source ▶ Frame ▶ Stripe, in a thread of their own.
        let (frames, reading) = reading::start(scope, source, rig, recipe);
        let mut held: Option<HeldFrame> = None;
        let mut clear = ClearOfLine::new(recipe.motion.band_half_width_px);
        for seen in frames {
            let Seen { frame, steps } = seen?;
            // Stripe ▶ Profile.
            let profile = timings.time("triangulation", || triangulate(&steps.stripe, rig));
            // Frames ▶ motion.
            let shift = timings.time("motion", || tracker.track(&frame, &steps.stripe))?;
            products.stripe(&steps.stripe)?;
            // Profile + motion ▶ surface. A frame's strip ends where the next one begins: it waits for that.
            let step_px = shift.travel_px(rig.laser.line);
            if let Some(before) = held.take() {
                let measured = before.cut(rig.laser.line, step_px, &mut clear, products);
                add(placement.push(measured), products, quality, &mut timings, progress)?;
            }
            held = Some(HeldFrame { frame, steps, profile, shift });
            progress.frame()?;
        }
        if let Some(last) = held.take() {
            let step_px = last.shift.travel_px(rig.laser.line);
            let measured = last.cut(rig.laser.line, step_px, &mut clear, products);
            add(placement.push(measured), products, quality, &mut timings, progress)?;
        }
        add(placement.finish(), products, quality, &mut timings, progress)?;
        let report = reading.join().map_err(|_| Error::internal("source", "the reading thread panicked"))?;
        timings.add("decoding", report.decoding);
        timings.add("stripe", report.stripes);
        report.warnings.into_iter().try_for_each(|warning| progress.warn(warning))
    })?;
    Ok(timings)
}

/// Surface ▶ maps, cloud, recording, archive.
fn add(
    placed: Vec<Placed<Cargo>>,
    products: &mut Products<'_>,
    quality: &mut QualityCounter,
    timings: &mut Timings,
    progress: &mut Progress<'_, '_>,
) -> Result<()> {
    for frame in placed {
        quality.add(&frame.measured, &frame.measured.cargo.stripe, frame.world_from_camera.translation.x);
        timings.time("products", || products.add(&frame, progress))?;
    }
    Ok(())
}

/// A frame that waits for the next one's shift.
struct HeldFrame {
    frame: Frame,
    steps: StripeSteps,
    profile: Profile,
    shift: Shift,
}

impl HeldFrame {
    /// Keeps what later stages need of the image and lets the rest go.
    fn cut(
        self,
        line: LineDirection,
        step_px: f64,
        clear: &mut ClearOfLine,
        products: &Products<'_>,
    ) -> Measured<Cargo> {
        let HeldFrame { frame, steps, profile, shift } = self;
        let middle_px = steps.stripe.median_px();
        let texture =
            middle_px.map(|px| TextureStrip::cut(&frame.image, line, px, step_px, clear.offsets_px(&steps.stripe, px)));
        let picture = products.wants_picture(frame.time_s).then_some(Picture {
            image: frame.image,
            effective_area: steps.effective_area,
            row_threshold: steps.row_threshold,
        });
        let cargo = Cargo { stripe: steps.stripe, texture, picture };
        Measured { frame: frame.index, time_s: frame.time_s, profile, shift, cargo }
    }
}

/// How far ahead of the line's middle and behind it no laser light was seen so far: on a pipe the line is bent.
struct ClearOfLine {
    margin_px: f64,
    reach_px: [f64; 2],
}

impl ClearOfLine {
    fn new(margin_px: f64) -> ClearOfLine {
        ClearOfLine { margin_px, reach_px: [0.0; 2] }
    }

    /// Never shrinks, so that the strips of the texture join.
    fn offsets_px(&mut self, stripe: &Stripe, middle_px: f64) -> [f64; 2] {
        if let Some((low, high)) = stripe.extent_px() {
            let reach_px = [f64::from(high) - middle_px, middle_px - f64::from(low)];
            self.reach_px = [self.reach_px[0].max(reach_px[0]), self.reach_px[1].max(reach_px[1])];
        }
        self.reach_px.map(|reach| reach + self.margin_px)
    }
}

/// What travels with a frame through the placement.
struct Cargo {
    stripe: Stripe,
    texture: Option<TextureStrip>,
    /// Only for the frames whose picture the recording shows.
    picture: Option<Picture>,
}

/// A frame as the recording shows it.
struct Picture {
    image: Image,
    effective_area: Vec<u8>,
    row_threshold: Vec<f32>,
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

    fn add(&mut self, stage: &str, time: Duration) {
        *self.stages.entry(stage.to_string()).or_default() += time.as_secs_f64();
    }
}
