//! A known wall or pipe, a rig and a motion → frames and the truth.
//!
//! ```text
//! Scene ▶ Wall (exact) ──▶ ground (baked on a grid) ──▶ light ▶ Pixel ▶ sensor ▶ Image
//!            └───────────────────────────────────────▶ FrameTruth
//! ```
//!
//! The image is rendered from the baked surface, the truth is solved on the exact one. Every frame depends on
//! the seed and its own index only: frames may be rendered in any order, and twice.

mod bands;
mod board;
mod decals;
mod encode;
mod ground;
mod light;
mod motion;
mod noise;
mod render;
mod scene;
mod sensor;
mod texture;
mod truth;
mod wall;
mod write;

pub use board::{BoardScene, write_board_photos};
pub use encode::{Quality, VideoWriter};
pub use motion::Motion;
pub use scene::{Ambient, LaserLight, LineProfile, Material, SCENES, Scene, SensorNoise, TextureReach};
pub use truth::FrameTruth;
pub use wall::{Block, Bump, Bumps, Shape, StepRow, Wall};
pub use write::{Output, write_png, write_run};

use nalgebra::Vector3;

use crate::error::{Error, Result};
use crate::geometry::{RawPixel, WorldFromCamera};
use crate::rig::{Camera, LineDirection, MAX_IMAGE_SIDE_PX, Rig};
use crate::source::Image;

/// The longest run that is simulated, s.
pub const MAX_SECONDS: f64 = 3600.0;

/// The most frames a second.
pub const MAX_FPS: f64 = 240.0;

/// Where a wall that is shown some time later has aged: beyond what the laser meets first, mm.
const AGES_FROM_MM: f64 = 200.0;

/// The most pixels of an image: 8K.
const MAX_PIXELS: u64 = 8192 * 4320;

/// A run that can be rendered frame by frame.
pub struct Simulation {
    scene: Scene,
    rig: Rig,
    rays: render::Rays,
    /// Directions along the image's rim, for what a frame can see.
    rim: Vec<Vector3<f64>>,
    ground: ground::Ground,
    trajectory: motion::Trajectory,
    sensor: sensor::Sensor,
    fps: f64,
    frames: u32,
    seed: u64,
}

impl Simulation {
    /// Prepares a run of `seconds` at `fps` frames a second in images of `size_px` (width, height; a custom
    /// rig's own size goes before). The same arguments always give the same run.
    ///
    /// # Errors
    /// Sizes outside 16 to 8192 px a side or above 8192x4320 px in all, times outside (0, 3600] s, frame
    /// rates outside 0.1 to 240.
    pub fn new(scene: Scene, size_px: (u32, u32), fps: f64, seconds: f64, seed: u64) -> Result<Simulation> {
        let mut scene = scene;
        let rig = scene.rig(size_px.0, size_px.1);
        check_size(rig.camera.width_px, rig.camera.height_px)?;
        if !(seconds > 0.0 && seconds <= MAX_SECONDS) {
            return Err(Error::input(
                "seconds",
                format!("{seconds} s"),
                format!("more than 0 s, at most {MAX_SECONDS} s"),
            ));
        }
        if !(0.1..=MAX_FPS).contains(&fps) {
            return Err(Error::input("fps", format!("{fps} frames/s"), format!("0.1 to {MAX_FPS} frames/s")));
        }
        let frames = ((seconds * fps).round() as u32).max(1);
        scene.wall.seed = scene.wall_seed.unwrap_or(seed);
        if scene.later {
            scene.wall.age(AGES_FROM_MM);
        }
        let base_roll_rad = match rig.laser.line {
            LineDirection::Vertical => 0.0,
            LineDirection::Horizontal => -std::f64::consts::FRAC_PI_2,
        };
        let trajectory = motion::Trajectory::new(&scene.motion, scene.speed_mm_s, fps, base_roll_rad, seed);
        let rim = rim(&rig.camera);
        let y_range = y_range_mm(&scene, &rim, &trajectory, frames);
        let step_mm = (scene.wall.distance_mm / rig.camera.fx_px.max(rig.camera.fy_px)).max(0.1);
        let ground = ground::Ground::new(scene.wall.clone(), scene.material, step_mm, y_range.0, y_range.1);
        let sensor = sensor::Sensor::new(scene.noise);
        let rays = render::Rays::new(&rig.camera);
        Ok(Simulation { scene, rig, rays, rim, ground, trajectory, sensor, fps, frames, seed })
    }

    /// The rig that sees the run.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The scene, with the wall's seed set.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Frames of the run.
    pub fn frames_total(&self) -> u32 {
        self.frames
    }

    /// Frames a second.
    pub fn fps(&self) -> f64 {
        self.fps
    }

    /// Where the camera is at a frame.
    pub fn pose(&self, frame: u32) -> WorldFromCamera {
        self.trajectory.pose(frame)
    }

    /// The true surface's z at a place of the world, mm; `None` beyond a pipe's sides.
    pub fn surface_z_mm(&self, x_mm: f64, y_mm: f64) -> Option<f64> {
        let wall = &self.scene.wall;
        wall.exists(y_mm).then(|| wall.window(x_mm, x_mm).z_mm(x_mm, y_mm))
    }

    /// Renders a frame. Frames beyond the run's end show how it would go on.
    pub fn render(&self, frame: u32) -> (Image, FrameTruth) {
        let pose = self.pose(frame);
        let before = self.pose(frame.saturating_sub(1));
        let (x_min, x_max) = self.x_range_mm(&pose);
        let view = light::FrameView::new(&self.scene, &self.rig, &self.ground, &pose, (x_min, x_max));
        let (before_min, before_max) = self.x_range_mm(&before);
        let window = self.scene.wall.window(x_min.min(before_min), x_max.max(before_max));
        let mut pixels = render::render(&self.scene, &self.rig.camera, &self.rays, &view, self.speckle_seed(&pose));
        let line = self.line(&pixels, &window, &view, &pose);
        render::draw_line(&self.scene, &self.rig, &line, &mut pixels);
        let camera = &self.rig.camera;
        let noise_seed = noise::hash(self.seed, i64::from(frame), 0x5e);
        let bgr = self.sensor.expose(&pixels, camera.width_px as usize, noise_seed);
        let (dx_px, dy_px, scale) = match frame {
            0 => (0.0, 0.0, 1.0),
            _ => truth::image_shift(camera, &window, &before, &pose, self.scene.wall.z_range_mm().0),
        };
        let truth = FrameTruth {
            time_s: f64::from(frame) / self.fps,
            world_from_camera: pose,
            stripe_across_px: line.iter().map(|p| p.across_px as f32).collect(),
            measurable: line.iter().map(|p| p.measurable).collect(),
            dx_px,
            dy_px,
            scale,
        };
        (Image::from_bgr(camera.width_px, camera.height_px, bgr), truth)
    }

    fn line(
        &self,
        pixels: &[render::Pixel],
        window: &wall::WallWindow,
        view: &light::FrameView,
        pose: &WorldFromCamera,
    ) -> Vec<truth::LinePoint> {
        let finder = truth::LineFinder {
            rig: &self.rig,
            profile: self.scene.laser.profile,
            window,
            view,
            pose,
            z_near_mm: self.scene.wall.z_range_mm().0,
            sensor: &self.sensor,
        };
        let mut line = finder.find(pixels);
        if !self.scene.laser.on {
            line.fill(truth::UNSEEN);
        }
        line
    }

    /// Speckle belongs to the camera's place: it stays while the camera stands still.
    fn speckle_seed(&self, pose: &WorldFromCamera) -> u64 {
        let bits = |v: f64| v.to_bits() as i64;
        let t = &pose.translation.vector;
        noise::hash(noise::hash(self.seed, bits(t.x), bits(t.y)), bits(t.z), bits(pose.rotation.angle()))
    }

    /// All of the world that the run can show: (x from, to), (y from, to), mm.
    fn seen_mm(&self) -> ((f64, f64), (f64, f64)) {
        let (mut low, mut high) = (f64::MAX, f64::MIN);
        for frame in 0..self.frames {
            let range = self.x_range_mm(&self.pose(frame));
            (low, high) = (low.min(range.0), high.max(range.1));
        }
        ((low, high), y_range_mm(&self.scene, &self.rim, &self.trajectory, self.frames))
    }

    /// The stretch of world x that a frame can show, with a margin.
    fn x_range_mm(&self, pose: &WorldFromCamera) -> (f64, f64) {
        seen_range_mm(&self.scene, &self.rim, pose, 0)
    }
}

fn check_size(width_px: u32, height_px: u32) -> Result<()> {
    let fits = |side: u32| (16..=MAX_IMAGE_SIDE_PX).contains(&side);
    if fits(width_px) && fits(height_px) && u64::from(width_px) * u64::from(height_px) <= MAX_PIXELS {
        return Ok(());
    }
    Err(Error::input(
        "size",
        format!("{width_px}x{height_px} px"),
        format!("16 to {MAX_IMAGE_SIDE_PX} px a side and at most 8192x4320 px in all"),
    ))
}

fn rim(camera: &Camera) -> Vec<Vector3<f64>> {
    let (w, h) = (f64::from(camera.width_px) - 1.0, f64::from(camera.height_px) - 1.0);
    (0..=16)
        .flat_map(|i| {
            let t = f64::from(i) / 16.0;
            [(t * w, 0.0), (t * w, h), (0.0, t * h), (w, t * h)]
        })
        .map(|(u_px, v_px)| camera.undistort(RawPixel { u_px, v_px }).direction())
        .collect()
}

/// The range of world x (axis 0) or y (axis 1) that a pose can show, mm.
fn seen_range_mm(scene: &Scene, rim: &[Vector3<f64>], pose: &WorldFromCamera, axis: usize) -> (f64, f64) {
    const MARGIN_MM: f64 = 5.0;
    let (near, far) = scene.wall.z_range_mm();
    let from = pose.translation.vector;
    let (mut low, mut high) = (from[axis], from[axis]);
    for ray in rim {
        let direction = pose.rotation * ray;
        if direction.z < 0.2 {
            continue;
        }
        for z in [near, far] {
            let place = from[axis] + direction[axis] * (z - from.z) / direction.z;
            (low, high) = (low.min(place), high.max(place));
        }
    }
    (low - MARGIN_MM, high + MARGIN_MM)
}

/// The range of world y that the run can show, mm; looks at up to 256 frames.
fn y_range_mm(scene: &Scene, rim: &[Vector3<f64>], trajectory: &motion::Trajectory, frames: u32) -> (f64, f64) {
    const SWAY_MARGIN_MM: f64 = 20.0;
    let (mut low, mut high) = (f64::MAX, f64::MIN);
    for frame in (0..frames).step_by(frames.div_ceil(256) as usize) {
        let range = seen_range_mm(scene, rim, &trajectory.pose(frame), 1);
        (low, high) = (low.min(range.0), high.max(range.1));
    }
    match scene.wall.shape {
        Shape::Flat => (low - SWAY_MARGIN_MM, high + SWAY_MARGIN_MM),
        Shape::Pipe { radius_mm } => ((low - SWAY_MARGIN_MM).max(-radius_mm), (high + SWAY_MARGIN_MM).min(radius_mm)),
    }
}

#[cfg(test)]
mod tests;
