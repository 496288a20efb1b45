//! What a ray of the camera sees: the board, the wall behind it, the laser's fan on both.

use nalgebra::{Isometry3, Point3, Vector3};

use super::{BoardScene, RIM_SQUARES};
use crate::geometry::{Plane, RawPixel};
use crate::rig::Rig;
use crate::synthetic::bands::for_bands;
use crate::synthetic::light::laser_rgb;
use crate::synthetic::noise::value_noise;
use crate::synthetic::render::Pixel;

/// The wall behind the boards, mm from the camera.
const WALL_MM: f64 = 1400.0;
/// Places on each side of the board that its outline is drawn through.
const OUTLINE_STEPS: u32 = 20;

/// A box of pixels, with a margin for the bow of the sides between the places.
pub(super) struct Outline {
    low: (f64, f64),
    high: (f64, f64),
}

impl Outline {
    /// The pixels around the board with its rim.
    pub(super) fn around(scene: &BoardScene, pose: &Isometry3<f64>) -> Outline {
        let out = 1.0 + RIM_SQUARES;
        let (width, height) = (f64::from(scene.columns - 1) + 2.0 * out, f64::from(scene.rows - 1) + 2.0 * out);
        let mut outline = Outline { low: (f64::MAX, f64::MAX), high: (f64::MIN, f64::MIN) };
        for i in 0..=OUTLINE_STEPS {
            let t = f64::from(i) / f64::from(OUTLINE_STEPS);
            for (x, y) in [(t, 0.0), (t, 1.0), (0.0, t), (1.0, t)] {
                let place = Point3::new(x * width - out, y * height - out, 0.0) * scene.square_mm;
                outline.include(scene.rig.camera.project(&(pose * place)));
            }
        }
        outline
    }

    fn include(&mut self, pixel: RawPixel) {
        const MARGIN_PX: f64 = 3.0;
        self.low = (self.low.0.min(pixel.u_px - MARGIN_PX), self.low.1.min(pixel.v_px - MARGIN_PX));
        self.high = (self.high.0.max(pixel.u_px + MARGIN_PX), self.high.1.max(pixel.v_px + MARGIN_PX));
    }

    pub(super) fn holds(&self, column: usize, row: usize) -> bool {
        let (x, y) = (column as f64, row as f64);
        x >= self.low.0 && x <= self.high.0 && y >= self.low.1 && y <= self.high.1
    }
}

/// Directions at the pixels' corners; inside a pixel they are interpolated.
#[derive(Debug)]
pub(super) struct CornerRays {
    table: Vec<[f64; 2]>,
    columns: usize,
}

impl CornerRays {
    pub(super) fn new(rig: &Rig) -> CornerRays {
        let camera = &rig.camera;
        let columns = camera.width_px as usize + 1;
        let mut table = vec![[0.0; 2]; columns * (camera.height_px as usize + 1)];
        for_bands(&mut table, columns, 16, |first_row, rows| {
            for (i, ray) in rows.iter_mut().enumerate() {
                let (column, row) = ((i % columns) as f64, (first_row + i / columns) as f64);
                let found = camera.undistort(RawPixel { u_px: column - 0.5, v_px: row - 0.5 });
                *ray = [found.x, found.y];
            }
        });
        CornerRays { table, columns }
    }

    pub(super) fn at(&self, column: usize, row: usize, x: f64, y: f64) -> Vector3<f64> {
        let corner = |c: usize, r: usize| self.table[(row + r) * self.columns + column + c];
        let mix = |k: usize| {
            let top = corner(0, 0)[k] * (1.0 - x) + corner(1, 0)[k] * x;
            let bottom = corner(0, 1)[k] * (1.0 - x) + corner(1, 1)[k] * x;
            top * (1.0 - y) + bottom * y
        };
        Vector3::new(mix(0), mix(1), 1.0)
    }
}

/// What a photo's light needs.
pub(super) struct Shade<'a> {
    scene: &'a BoardScene,
    board: Plane,
    board_from_camera: Isometry3<f64>,
    laser: Option<[f32; 3]>,
}

impl<'a> Shade<'a> {
    pub(super) fn new(scene: &'a BoardScene, camera_from_board: &Isometry3<f64>, laser_on: bool) -> Shade<'a> {
        let normal = camera_from_board.rotation * Vector3::z();
        Shade {
            scene,
            board: Plane { normal, offset_mm: normal.dot(&camera_from_board.translation.vector) },
            board_from_camera: camera_from_board.inverse(),
            laser: laser_on.then(|| laser_rgb(scene.rig.laser.colour)),
        }
    }

    /// Linear red, green, blue along a ray.
    pub(super) fn light(&self, ray: Vector3<f64>) -> [f64; 3] {
        let (point, albedo) = self.surface(ray);
        // The room is a bit brighter on one side.
        let room = self.scene.ambient * (1.0 + 0.15 * ray.x + 0.1 * ray.y);
        let mut light = [room * 1.02, room, room * 0.95];
        if let Some(colour) = self.laser {
            let plane = &self.scene.rig.laser.plane;
            let across = (plane.normal.dot(&point) - plane.offset_mm) / self.scene.line_sigma_mm;
            let signal = self.scene.laser_power * (600.0 / point.z) * (-0.5 * across * across).exp();
            (0..3).for_each(|c| light[c] += signal * f64::from(colour[c]));
        }
        light.map(|l| l * albedo)
    }

    /// The place that a ray meets and the share of light that it gives back: the board, or the wall behind.
    pub(super) fn surface(&self, ray: Vector3<f64>) -> (Vector3<f64>, f64) {
        let (white, black) = self.scene.albedo;
        let depth = self.board.offset_mm / self.board.normal.dot(&ray);
        if depth > 0.0 {
            let point = ray * depth;
            let place = self.board_from_camera * Point3::from(point);
            let (u, v) = (place.x / self.scene.square_mm, place.y / self.scene.square_mm);
            let (columns, rows) = (f64::from(self.scene.columns), f64::from(self.scene.rows));
            let within = |rim: f64| u > -1.0 - rim && u < columns + rim && v > -1.0 - rim && v < rows + rim;
            if within(0.0) {
                let even = (u.floor() + v.floor()).rem_euclid(2.0) < 0.5;
                return (point, if even { black } else { white });
            }
            if within(RIM_SQUARES) {
                return (point, white);
            }
        }
        let point = ray * WALL_MM;
        let texture = f64::from(value_noise(self.scene.seed, point.x / 15.0, point.y / 15.0));
        (point, 0.3 + 0.15 * texture)
    }
}

/// A Gaussian blur in linear light, rows then columns.
pub(super) fn blur(pixels: &mut [Pixel], width: usize, sigma_px: f64) {
    if sigma_px <= 0.0 {
        return;
    }
    let reach = (4.0 * sigma_px).ceil() as usize;
    let kernel: Vec<f64> =
        (0..=2 * reach).map(|i| (-0.5 * ((i as f64 - reach as f64) / sigma_px).powi(2)).exp()).collect();
    let sum: f64 = kernel.iter().sum();
    let height = pixels.len() / width;
    for (step, count, lines, stride) in [(1, width, height, width), (width, height, width, 1)] {
        for line in 0..lines {
            let start = line * stride;
            let values: Vec<[f32; 3]> = (0..count).map(|i| pixels[start + i * step].rgb).collect();
            for i in 0..count {
                let mut mixed = [0.0; 3];
                for (k, weight) in kernel.iter().enumerate() {
                    let from = (i + k).saturating_sub(reach).min(count - 1);
                    (0..3).for_each(|c| mixed[c] += weight / sum * f64::from(values[from][c]));
                }
                pixels[start + i * step].rgb = mixed.map(|m| m as f32);
            }
        }
    }
}
