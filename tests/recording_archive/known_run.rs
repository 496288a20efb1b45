//! A wall, a rig and a motion in closed form: what each stage would say of each frame.

use nalgebra::{Isometry3, Point3, Vector3};
use stria_core::geometry::{RawPixel, WorldFromCamera, world_from_camera};
use stria_core::motion::{Shift, TrackedCorner};
use stria_core::recording::FrameSteps;
use stria_core::rig::{LaserColour, LineDirection, Rig};
use stria_core::source::Image;
use stria_core::stripe::Stripe;
use stria_core::surface::SurfacePoint;
use stria_core::triangulation::{Profile, ProfilePoint};

const BASELINE_MM: f64 = 134.0;

/// The run as a whole.
pub(super) struct KnownRun {
    pub rig: Rig,
    pub fps: f64,
    pub mm_per_frame: f64,
    background: Vec<u8>,
}

/// One frame of it, with every stage's result.
pub(super) struct KnownFrame {
    pub index: u32,
    pub time_s: f64,
    pub image: Image,
    pub mask: Vec<u8>,
    pub thresholds: Vec<f32>,
    pub stripe: Stripe,
    pub shift: Shift,
    pub pose: WorldFromCamera,
    pub profile: Profile,
    pub points: Vec<SurfacePoint>,
}

impl KnownFrame {
    pub(super) fn steps(&self) -> FrameSteps<'_> {
        FrameSteps {
            frame_index: self.index,
            time_s: self.time_s,
            image: Some(&self.image),
            effective_area: Some(&self.mask),
            row_threshold: Some(&self.thresholds),
            stripe: &self.stripe,
            shift: &self.shift,
            world_from_camera: Some(self.pose),
            points: &self.points,
        }
    }
}

impl KnownRun {
    /// A grainy gray wall seen at the given size.
    pub(super) fn new(width_px: u32, height_px: u32, fps: f64) -> KnownRun {
        let rig = Rig::from_paper(width_px, height_px, 1.03, BASELINE_MM, 90f64.to_radians(), LaserColour::Green);
        let mut state = 12345u32;
        let background = (0..width_px * height_px)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                70 + (state >> 27) as u8
            })
            .collect();
        KnownRun { rig, fps, mm_per_frame: 2.0, background }
    }

    /// World z of the wall, mm: waves of 10 mm around 800 mm.
    pub(super) fn wall_z_mm(x_mm: f64) -> f64 {
        800.0 + 10.0 * (x_mm / 60.0).sin()
    }

    pub(super) fn pose(&self, index: u32) -> WorldFromCamera {
        world_from_camera(Vector3::new(self.mm_per_frame * f64::from(index), 0.0, 0.0), 0.0, 0.0, 0.0)
    }

    pub(super) fn frame(&self, index: u32) -> KnownFrame {
        let camera = &self.rig.camera;
        let pose = self.pose(index);
        let z_mm = Self::wall_z_mm(pose.translation.x + BASELINE_MM);
        let u = camera.fx_px * BASELINE_MM / z_mm + camera.cx_px;
        let rows = camera.height_px as usize;
        let shift_px = -camera.fx_px * self.mm_per_frame / z_mm;
        let profile = self.profile(u, z_mm);
        KnownFrame {
            index,
            time_s: f64::from(index) / self.fps,
            image: self.image(u),
            mask: self.mask(u),
            thresholds: vec![200.0; rows],
            stripe: Stripe {
                line: LineDirection::Vertical,
                across_px: vec![u as f32; rows],
                confidence: vec![0.8; rows],
                sigma_px: vec![0.1; rows],
            },
            shift: self.shift(index, shift_px),
            points: surface(&profile, &pose, index),
            pose,
            profile,
        }
    }

    fn shift(&self, index: u32, shift_px: f64) -> Shift {
        if index == 0 {
            return Shift::default();
        }
        let corner = |i: usize| {
            let from = [40.0 + 13.0 * (i % 20) as f32, 30.0 + 31.0 * (i / 20) as f32];
            TrackedCorner { from_px: from, to_px: [from[0] + shift_px as f32, from[1] + 0.25] }
        };
        Shift {
            dx_px: Some(shift_px),
            dy_px: Some(0.25),
            scale: Some(1.001),
            residual_px: Some(0.05),
            corners: (0..100).map(corner).collect(),
        }
    }

    fn profile(&self, u: f64, z_mm: f64) -> Profile {
        let camera = &self.rig.camera;
        let point = |row: u32| ProfilePoint {
            line_position: row,
            pixel: RawPixel { u_px: u, v_px: f64::from(row) },
            point_in_camera: Point3::new(BASELINE_MM, (f64::from(row) - camera.cy_px) / camera.fy_px * z_mm, z_mm),
            confidence: 0.8,
        };
        Profile { points: (0..camera.height_px).map(point).collect() }
    }

    fn image(&self, u: f64) -> Image {
        let (width, height) = (self.rig.camera.width_px, self.rig.camera.height_px);
        let line = |x: usize| (-((x as f64 - u) / 2.5).powi(2)).exp();
        let bgr = self.background.iter().enumerate().flat_map(|(i, gray)| {
            let light = line(i % width as usize);
            [*gray, (f64::from(*gray) + light * (255.0 - f64::from(*gray))) as u8, *gray]
        });
        Image::from_bgr(width, height, bgr.collect())
    }

    fn mask(&self, u: f64) -> Vec<u8> {
        let (width, height) = (self.rig.camera.width_px as usize, self.rig.camera.height_px as usize);
        let row: Vec<u8> = (0..width).map(|x| if (x as f64 - u).abs() < 12.0 { 255 } else { 0 }).collect();
        row.repeat(height)
    }
}

fn surface(profile: &Profile, pose: &Isometry3<f64>, frame: u32) -> Vec<SurfacePoint> {
    let point = |p: &ProfilePoint| SurfacePoint {
        point_in_world: pose * p.point_in_camera,
        rgb: [120, 130, 140],
        confidence: p.confidence,
        frame,
    };
    profile.points.iter().map(point).collect()
}
