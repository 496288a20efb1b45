//! What is true of a frame: the line's place at every line position, and how the image moved.

use nalgebra::{Point3, Vector3};

use super::bands::for_bands;
use super::light::FrameView;
use super::render::Pixel;
use super::scene::LineProfile;
use super::sensor::Sensor;
use super::wall::{WallWindow, enclosed_root};
use crate::geometry::{RawPixel, WorldFromCamera};
use crate::rig::{Camera, LaserColour, LineDirection, Rig};

/// The truth of one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameTruth {
    /// Capture time since the first frame, s.
    pub time_s: f64,
    /// Where the camera is.
    pub world_from_camera: WorldFromCamera,
    /// Raw image column of the laser's centre at each row's centre (row and column changed with a
    /// horizontal line), px; NaN where the camera cannot see it.
    pub stripe_across_px: Vec<f32>,
    /// The line positions that a careful method can measure: not washed out, not drowned in noise.
    pub measurable: Vec<bool>,
    /// Median shift of the surface's image since the previous frame along the columns, raw px; 0 at the first frame.
    pub dx_px: f64,
    /// The same along the rows, px.
    pub dy_px: f64,
    /// Scale of the similarity (METHOD.md (14)) that fits the shift best; above 1 the camera came closer.
    pub scale: f64,
}

/// The line at one line position.
#[derive(Clone, Copy)]
pub(super) struct LinePoint {
    /// Raw px across the line; NaN where it is not seen.
    pub across_px: f64,
    pub measurable: bool,
}

pub(super) const UNSEEN: LinePoint = LinePoint { across_px: f64::NAN, measurable: false };

/// All that finding the line needs.
pub(super) struct LineFinder<'a> {
    pub rig: &'a Rig,
    pub profile: LineProfile,
    pub window: &'a WallWindow<'a>,
    pub view: &'a FrameView<'a>,
    pub pose: &'a WorldFromCamera,
    pub z_near_mm: f64,
    pub sensor: &'a Sensor,
}

impl LineFinder<'_> {
    /// The line at every line position. The rendered distances from the laser's plane say where to look, so
    /// what another part of the wall hides from the camera is never found.
    pub(super) fn find(&self, pixels: &[Pixel]) -> Vec<LinePoint> {
        let camera = &self.rig.camera;
        let (width, height) = (camera.width_px as usize, camera.height_px as usize);
        let (positions, count, along, across) = match self.rig.laser.line {
            LineDirection::Vertical => (height, width, width, 1),
            LineDirection::Horizontal => (width, height, 1, width),
        };
        let mut points = vec![UNSEEN; positions];
        for_bands(&mut points, 1, 32, |first, points| {
            for (i, point) in points.iter_mut().enumerate() {
                let position = first + i;
                let away = |k: usize| pixels[position * along + k * across].from_plane_mm;
                *point = (0..count - 1)
                    .filter(|k| (away(*k) < 0.0) != (away(k + 1) < 0.0) && (away(*k) + away(k + 1)).is_finite())
                    .find_map(|k| self.refine(position, k))
                    .unwrap_or(UNSEEN);
            }
        });
        points
    }

    /// The exact place between two neighbouring pixels; `None` where the surface jumps over the laser's plane
    /// or where the laser does not reach it.
    fn refine(&self, position: usize, across: usize) -> Option<LinePoint> {
        let from_plane_mm = |a: f64| self.from_plane_mm(position, a).unwrap_or(f64::NAN);
        let at = |a: f64| (a, from_plane_mm(a));
        let (mut low, mut high) = (at(across as f64), at(across as f64 + 1.0));
        // The baked surface may differ by a hair from the true one.
        if (low.1 > 0.0) == (high.1 > 0.0) {
            (low, high) = (at(across as f64 - 0.5), at(across as f64 + 1.5));
        }
        if low.1.is_nan() || high.1.is_nan() || (low.1 > 0.0) == (high.1 > 0.0) {
            return None;
        }
        let across_px = enclosed_root(from_plane_mm, low, high);
        if from_plane_mm(across_px).abs() > 0.01 {
            return None;
        }
        let ray = self.rig.camera.undistort(self.pixel(position, across_px));
        let depth_mm = self.depth_mm(&ray.direction())?;
        let hit = self.view.hit(ray.x as f32, ray.y as f32, depth_mm as f32)?;
        if !self.view.is_lit(&hit) {
            return None;
        }
        let (ambient, laser) = self.view.shade(&hit);
        Some(LinePoint { across_px, measurable: self.is_measurable(&ambient, &laser) })
    }

    /// The laser's own channel must have room left above the ambient light, well beyond the noise.
    fn is_measurable(&self, ambient: &[f32; 3], laser: &[f32; 3]) -> bool {
        if matches!(self.profile, LineProfile::Image { .. }) {
            return true;
        }
        let channel = match self.rig.laser.colour {
            LaserColour::Red => 0,
            LaserColour::Green => 1,
            LaserColour::Blue => 2,
        };
        let (dark, bright) = (ambient[channel].min(1.0), (ambient[channel] + laser[channel]).min(1.0));
        bright - dark > (6.0 * self.sensor.noise_of(bright)).max(0.04)
    }

    fn pixel(&self, position: usize, across: f64) -> RawPixel {
        match self.rig.laser.line {
            LineDirection::Vertical => RawPixel { u_px: across, v_px: position as f64 },
            LineDirection::Horizontal => RawPixel { u_px: position as f64, v_px: across },
        }
    }

    fn depth_mm(&self, direction_in_camera: &Vector3<f64>) -> Option<f64> {
        first_hit(self.window, self.pose, direction_in_camera, self.z_near_mm)
    }

    fn from_plane_mm(&self, position: usize, across: f64) -> Option<f64> {
        let direction = self.rig.camera.undistort(self.pixel(position, across)).direction();
        let plane = &self.rig.laser.plane;
        self.depth_mm(&direction).map(|depth| depth * plane.normal.dot(&direction) - plane.offset_mm)
    }
}

/// The camera's z of the surface along a direction (x, y, 1) of the camera, mm.
fn first_hit(window: &WallWindow, pose: &WorldFromCamera, direction: &Vector3<f64>, z_near_mm: f64) -> Option<f64> {
    let from = Point3::from(pose.translation.vector);
    let direction = pose.rotation * direction;
    window.first_hit(&from, &direction, (z_near_mm - from.z) / direction.z)
}

/// The median shift (dx, dy, px) of the surface's image from one pose to the next, and the scale of the
/// similarity that fits it best, over a grid of places that the first frame shows.
pub(super) fn image_shift(
    camera: &Camera,
    window: &WallWindow,
    from: &WorldFromCamera,
    to: &WorldFromCamera,
    z_near_mm: f64,
) -> (f64, f64, f64) {
    let spacing = (camera.width_px.max(camera.height_px) / 80).max(16) as usize;
    let (columns, rows) = (camera.width_px as usize / spacing, camera.height_px as usize / spacing);
    let to_from_from = to.inverse() * from;
    let mut pairs: Vec<Option<[f64; 4]>> = vec![None; columns * rows];
    for_bands(&mut pairs, columns.max(1), 4, |first_row, pairs| {
        for (i, pair) in pairs.iter_mut().enumerate() {
            let place = |k: usize| (k * spacing) as f64 + 0.5 * spacing as f64;
            let (u, v) = (place(i % columns), place(first_row + i / columns));
            let direction = camera.undistort(RawPixel { u_px: u, v_px: v }).direction();
            *pair = first_hit(window, from, &direction, z_near_mm).map(|depth| {
                let seen = camera.project(&(to_from_from * Point3::from(direction * depth)));
                [u, v, seen.u_px, seen.v_px]
            });
        }
    });
    let pairs: Vec<[f64; 4]> = pairs.into_iter().flatten().collect();
    if pairs.is_empty() {
        return (0.0, 0.0, 1.0);
    }
    let dx = median(pairs.iter().map(|p| p[2] - p[0]).collect());
    let dy = median(pairs.iter().map(|p| p[3] - p[1]).collect());
    (dx, dy, similarity_scale(&pairs))
}

/// The scale S of the least-squares fit p' = S·p + T.
fn similarity_scale(pairs: &[[f64; 4]]) -> f64 {
    let count = pairs.len() as f64;
    let mean: [f64; 4] = std::array::from_fn(|i| pairs.iter().map(|p| p[i]).sum::<f64>() / count);
    let (mut mixed, mut square) = (0.0, 0.0);
    for p in pairs {
        let (x, y) = (p[0] - mean[0], p[1] - mean[1]);
        mixed += x * (p[2] - mean[2]) + y * (p[3] - mean[3]);
        square += x * x + y * y;
    }
    if square > 0.0 { mixed / square } else { 1.0 }
}

fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    let (_, value, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    *value
}
