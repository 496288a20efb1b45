//! The rerun recording of a job: the steps of the method and the growing surface.
//!
//! One `.rrd` file, and while the job runs the same data in numbered live segments, each a complete RRD file. All
//! carry the same recording and application id, so that a viewer which gets the segments one after another in one
//! channel shows one growing recording; the first brings the layout.
//!
//! In space everything is in metres, rerun's convention; plots and images are in pixels. Two timelines: `frame`, and
//! `time` since the run's first frame. Nothing leaves the machine: the SDK is built without its analytics and its
//! server, and only its encoder is used.
//!
//! The recording keeps within `recording.budget_mb` however long the run is: images and points become sparser as
//! their shares fill; the plots keep every frame until their own share fills and are then means over 2, 4, 8 …
//! frames. Of a run that is too long for it, [`Recordings`] also writes dense recordings of stretches of
//! `recording.stretch_m`.

mod blueprint;
mod budget;
mod charts;
mod data;
mod images;
mod rows;
mod store;
mod stretches;
mod surface;

use std::path::Path;
use std::time::Duration;

use jpeg_encoder::ColorType;
use nalgebra::Point3;
use rerun::{EncodedImage, Points3D, StoreId, StoreKind, TextDocument, TextLog, ViewCoordinates};

pub use self::images::shrink;
pub use self::store::Segment;
pub use self::stretches::Recordings;

use self::budget::Budget;
use self::data::{Moment, fixed, row};
use self::images::Images;
use self::rows::Rows;
use self::store::{LiveSegments, RrdStore};
use self::surface::Surface;
use crate::error::{Error, Result};
use crate::geometry::WorldFromCamera;
use crate::motion::Shift;
use crate::recipe::RecordingOptions;
use crate::rig::Rig;
use crate::source::Image;
use crate::stripe::Stripe;
use crate::surface::SurfacePoint;

/// The application's name in every recording: viewers keep one layout per application.
pub const APPLICATION: &str = "stria";

/// Widest depth image that is recorded, px.
pub const MAP_MAX_WIDTH_PX: u32 = 2000;

/// The names under which the viewer finds things.
mod entity {
    pub(super) const WORLD: &str = "world";
    pub(super) const SURFACE: &str = "world/surface";
    pub(super) const TRAJECTORY: &str = "world/trajectory";
    pub(super) const PROFILE: &str = "world/profile";
    pub(super) const NEWEST: &str = "world/newest";
    pub(super) const CAMERA: &str = "world/camera";
    pub(super) const IMAGE: &str = "world/camera/image";
    pub(super) const SPOTS: &str = "world/camera/image/spots";
    pub(super) const CORNERS: &str = "world/camera/image/corners";
    pub(super) const AREA: &str = "steps/effective_area";
    pub(super) const ONE_ROW: &str = "steps/one_row";
    pub(super) const ALL_ROWS: &str = "steps/all_rows";
    pub(super) const SHIFT: &str = "plots/shift";
    pub(super) const SCALE: &str = "plots/scale";
    pub(super) const ROWS_FOUND: &str = "plots/rows_found";
    pub(super) const DEPTH_IMAGE: &str = "depth_image";
    pub(super) const MESSAGES: &str = "messages";
    pub(super) const GUIDE: &str = "guide";
}

/// Most points of the newest profile that are shown.
const NEWEST_POINTS: usize = 200;

/// Time between two live segments while the robot still walks, s, and how far it may grow on a long run.
const WATCHED_SEGMENT_S: f64 = 0.25;
const WATCHED_LONGEST: Duration = Duration::from_millis(500);

/// Rows of plots that wait, at most, before they become a chunk.
const ROWS_WAIT: usize = 512;

/// The run that is recorded.
#[derive(Clone, Debug)]
pub struct RecordedRun<'a> {
    /// Its name for people.
    pub name: &'a str,
    /// When its first frame was captured.
    pub recorded_at: jiff::Timestamp,
    /// How many frames it will have, where the source says so: the recording is then equally dense throughout.
    pub frames_expected: Option<u64>,
    /// How long it will be, s, where the source says so.
    pub duration_expected_s: Option<f64>,
    /// The robot is still walking: people want to see now what it sees.
    pub watched: bool,
}

/// What the method made of one frame.
#[derive(Clone, Copy)]
pub struct FrameSteps<'a> {
    /// The frame's place in the run, from 0.
    pub frame_index: u32,
    /// Capture time since the run's first frame, s.
    pub time_s: f64,
    /// The frame: whole, or as [`shrink`] says where there is neither of the two that follow.
    pub image: Option<&'a Image>,
    /// The effective area: 255 where the line may be, 0 elsewhere; a value a pixel of the whole frame.
    pub effective_area: Option<&'a [u8]>,
    /// The threshold of each line position, gray value 0 to 255; NaN where there was none.
    pub row_threshold: Option<&'a [f32]>,
    /// The line as found.
    pub stripe: &'a Stripe,
    /// How the image moved.
    pub shift: &'a Shift,
    /// Where the camera was; `None` where it is not known.
    pub world_from_camera: Option<WorldFromCamera>,
    /// The frame's part of the surface.
    pub points: &'a [SurfacePoint],
}

impl FrameSteps<'_> {
    fn moment(&self) -> Moment {
        Moment { frame: self.frame_index, time_s: self.time_s }
    }
}

/// Writes the recording of one job.
pub struct Recorder {
    store: RrdStore,
    budget: Budget,
    images: Images,
    rows: Rows,
    surface: Surface,
    rig: Rig,
    run_name: String,
    last: Moment,
    guide_complete: bool,
}

impl Recorder {
    /// Starts a recording that will be at `rrd`, with live segments in `segments_dir` (made where it is missing)
    /// where there is one.
    ///
    /// # Errors
    /// Where the files cannot be written.
    pub fn create(
        options: &RecordingOptions,
        rig: &Rig,
        run: &RecordedRun<'_>,
        rrd: &Path,
        segments_dir: Option<&Path>,
    ) -> Result<Recorder> {
        let id = StoreId::random(StoreKind::Recording, APPLICATION);
        let opening = blueprint::opening(&id, run.name, run.recorded_at)?;
        let longest_s = if run.watched { WATCHED_SEGMENT_S } else { 3600.0 };
        let period = Duration::from_secs_f64(options.segment_s.clamp(0.01, longest_s));
        let longest = if run.watched { WATCHED_LONGEST } else { Duration::MAX };
        let live = segments_dir.map(|dir| LiveSegments::new(dir, period, longest)).transpose()?;
        let mut budget = Budget::new(options.budget_mb);
        let mut recorder = Recorder {
            store: RrdStore::create(id, opening, rrd, live)?,
            images: Images::new(options, rig, run.duration_expected_s),
            rows: Rows::new(run.frames_expected, &mut budget.rows),
            surface: Surface::new(options.points_per_profile, run.frames_expected, &mut budget.surface),
            budget,
            rig: rig.clone(),
            run_name: run.name.to_string(),
            last: Moment::default(),
            guide_complete: false,
        };
        recorder.open()?;
        Ok(recorder)
    }

    fn open(&mut self) -> Result<()> {
        self.store.push(fixed(entity::WORLD, &ViewCoordinates::RDF())?)?;
        self.push_guide()?;
        let chunks = [self.images.opening(&self.rig)?, Rows::opening()?, Surface::opening()?];
        chunks.into_iter().flatten().try_for_each(|chunk| self.store.push(chunk))
    }

    fn push_guide(&mut self) -> Result<()> {
        let text = blueprint::guide(&self.rig, &self.run_name, self.surface.range());
        self.store.push(fixed(entity::GUIDE, &TextDocument::new(text).with_media_type("text/markdown"))?)
    }

    /// Whether the recording shows less of the surface than every profile that was asked for.
    fn is_sparse(&self) -> bool {
        self.budget.surface.halvings() > 0
    }

    /// Whether [`Recorder::log_frame`] would show the image of a frame at this time; if not, it needs neither the
    /// effective area nor the thresholds.
    pub fn wants_image(&self, time_s: f64) -> bool {
        self.images.due(time_s, &self.budget.images)
    }

    /// Records a frame; gives the live segments that it completed.
    ///
    /// # Errors
    /// Where a file cannot be written.
    pub fn log_frame(&mut self, steps: &FrameSteps<'_>) -> Result<Vec<Segment>> {
        self.last = steps.moment();
        self.rows.push(steps, &mut self.budget.rows);
        self.surface.push(steps, &mut self.budget.surface);
        if let Some(image) = steps.image
            && self.images.due(steps.time_s, &self.budget.images)
        {
            for chunk in self.images.show(steps, image, &mut self.budget.images)? {
                self.store.push(chunk)?;
            }
        }
        let cut = self.store.segment_due(&self.budget.segments);
        self.flush(cut, false)?;
        if cut { self.cut() } else { Ok(vec![]) }
    }

    /// Shows the newest profile of a robot that still walks, where it is thought to be now: its place is final only some
    /// frames later, and people shall not wait for that. Goes into the live segments alone; gives those it completed.
    ///
    /// # Errors
    /// Where a file cannot be written.
    pub fn log_newest(&mut self, frame_index: u32, time_s: f64, in_world: &[Point3<f64>]) -> Result<Vec<Segment>> {
        let step = in_world.len().div_ceil(NEWEST_POINTS).max(1);
        let points = Points3D::update_fields().with_positions(in_world.iter().step_by(step).map(metres));
        self.store.push_live(&row(entity::NEWEST, Moment { frame: frame_index, time_s }, &points)?)?;
        let cut = self.store.segment_due(&self.budget.segments);
        self.flush(cut, false)?;
        if cut { self.cut() } else { Ok(vec![]) }
    }

    /// Hands what has gathered to the store.
    fn flush(&mut self, live: bool, all: bool) -> Result<()> {
        if all || live || self.rows.len() >= ROWS_WAIT {
            for chunk in self.rows.take()? {
                self.store.push(chunk)?;
            }
        }
        if let Some(chunk) = self.surface.take(live, all)? {
            self.store.push(chunk)?;
        }
        if !self.guide_complete && self.surface.range().is_some() {
            self.guide_complete = true;
            self.push_guide()?;
        }
        Ok(())
    }

    fn cut(&mut self) -> Result<Vec<Segment>> {
        Ok(self.store.cut_segment(&mut self.budget.segments)?.into_iter().collect())
    }

    /// Records the finished depth image: `3 * width_px * height_px` bytes of red, green, blue. It is halved until it
    /// is no wider than [`MAP_MAX_WIDTH_PX`] and fits its share of the budget.
    ///
    /// # Errors
    /// Where the bytes do not fit the size, or a file cannot be written.
    pub fn log_map(&mut self, width_px: u32, height_px: u32, rgb: &[u8]) -> Result<()> {
        if rgb.len() != 3 * width_px as usize * height_px as usize || rgb.is_empty() {
            return Err(Error::internal(
                "recording",
                format!("a depth image of {} bytes for {width_px} x {height_px} px", rgb.len()),
            ));
        }
        let (mut width, mut height, mut pixels) = (width_px, height_px, rgb.to_vec());
        loop {
            if width <= MAP_MAX_WIDTH_PX && height <= MAP_MAX_WIDTH_PX {
                let jpeg = images::jpeg(&pixels, width, height, ColorType::Rgb, 88)?;
                if self.budget.map.spend(jpeg.len()) {
                    let image = EncodedImage::new(jpeg).with_media_type("image/jpeg");
                    return self.store.push(fixed(entity::DEPTH_IMAGE, &image)?);
                }
            }
            if width.min(height) < 2 {
                return Ok(());
            }
            pixels = halved(&pixels, width, height);
            (width, height) = (width / 2, height / 2);
        }
    }

    /// Records something a person should know, at the time of the latest frame. Past their small share of the
    /// budget, warnings are dropped here (they are also in the manifest).
    ///
    /// # Errors
    /// Where a file cannot be written.
    pub fn log_warning(&mut self, text: &str) -> Result<()> {
        if !self.budget.messages.spend(text.len() + 200) {
            return Ok(());
        }
        self.store.push(row(entity::MESSAGES, self.last, &TextLog::new(text).with_level("WARN"))?)
    }

    /// Completes the file and puts it in its place; gives the last live segment. Without this call, nothing is left
    /// at the recording's path.
    ///
    /// # Errors
    /// Where a file cannot be written.
    pub fn finish(mut self) -> Result<Vec<Segment>> {
        self.flush(self.store.is_live(), true)?;
        let segments = self.cut()?;
        self.store.finish()?;
        Ok(segments)
    }
}

/// A picture of half the width and height: the mean of each four pixels.
fn halved(rgb: &[u8], width_px: u32, height_px: u32) -> Vec<u8> {
    let (width, columns) = (width_px as usize, width_px as usize / 2);
    let mean = |row: usize, column: usize, c: usize| {
        let at = |r: usize, x: usize| u16::from(rgb[3 * ((2 * row + r) * width + 2 * column + x) + c]);
        ((at(0, 0) + at(0, 1) + at(1, 0) + at(1, 1) + 2) / 4) as u8
    };
    let rows = 0..height_px as usize / 2;
    rows.flat_map(|r| (0..columns).flat_map(move |x| (0..3).map(move |c| (r, x, c))))
        .map(|(r, x, c)| mean(r, x, c))
        .collect()
}

/// rerun's unit in space.
fn metres(point_mm: &Point3<f64>) -> [f32; 3] {
    [point_mm.x, point_mm.y, point_mm.z].map(|v| (v / 1000.0) as f32)
}
