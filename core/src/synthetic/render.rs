//! A frame's light, pixel by pixel, before the sensor.

use super::bands::for_bands;
use super::light::{FrameView, Hit, laser_rgb};
use super::noise::value_noise;
use super::scene::{LineProfile, Scene};
use super::truth::LinePoint;
use crate::geometry::RawPixel;
use crate::rig::{Camera, LineDirection, Rig};

/// A pixel's light and where it comes from.
#[derive(Clone, Copy)]
pub(super) struct Pixel {
    /// Linear red, green, blue in full scales of the sensor; not clipped.
    pub rgb: [f32; 3],
    /// Signed distance of the place seen from the laser's plane, mm; NaN where no surface is seen.
    pub from_plane_mm: f32,
}

/// The directions that the pixels look into, computed once for a camera.
pub(super) enum Rays {
    /// Without distortion: x of each column, y of each row.
    Pinhole(Vec<f32>, Vec<f32>),
    /// (x, y) of each pixel.
    Lens(Vec<[f32; 2]>, usize),
}

impl Rays {
    pub(super) fn new(camera: &Camera) -> Rays {
        let (width, height) = (camera.width_px as usize, camera.height_px as usize);
        let ray = |column: usize, row: usize| camera.undistort(RawPixel { u_px: column as f64, v_px: row as f64 });
        if !camera.has_distortion() {
            return Rays::Pinhole(
                (0..width).map(|c| ray(c, 0).x as f32).collect(),
                (0..height).map(|r| ray(0, r).y as f32).collect(),
            );
        }
        let mut table = vec![[0.0; 2]; width * height];
        for_bands(&mut table, width, 16, |first_row, rows| {
            for (i, pixel) in rows.iter_mut().enumerate() {
                let ray = ray(i % width, first_row + i / width);
                *pixel = [ray.x as f32, ray.y as f32];
            }
        });
        Rays::Lens(table, width)
    }

    #[inline]
    fn at(&self, column: usize, row: usize) -> (f32, f32) {
        match self {
            Rays::Pinhole(x, y) => (x[column], y[row]),
            Rays::Lens(table, width) => {
                let [x, y] = table[row * width + column];
                (x, y)
            }
        }
    }
}

/// What is seen beside a pipe, linear.
const BACKGROUND: [f32; 3] = [0.004, 0.004, 0.004];

/// All light of a frame, but for a line that is drawn in the image ([`draw_line`]). `speckle_seed` makes the speckle.
pub(super) fn render(scene: &Scene, camera: &Camera, rays: &Rays, view: &FrameView, speckle_seed: u64) -> Vec<Pixel> {
    let (width, height) = (camera.width_px as usize, camera.height_px as usize);
    let mut pixels = vec![Pixel { rgb: BACKGROUND, from_plane_mm: f32::NAN }; width * height];
    for_bands(&mut pixels, width, 8, |first_row, rows| {
        let mut row_guess = scene.wall.distance_mm as f32;
        for (i, row) in rows.chunks_exact_mut(width).enumerate() {
            let mut guess = row_guess;
            for (column, pixel) in row.iter_mut().enumerate() {
                let (x, y) = rays.at(column, first_row + i);
                let Some(hit) = view.hit(x, y, guess) else { continue };
                guess = hit.depth_mm;
                if column == 0 {
                    row_guess = guess;
                }
                *pixel = light_of(scene, view, &hit, column, first_row + i, speckle_seed);
            }
        }
    });
    pixels
}

fn light_of(scene: &Scene, view: &FrameView, hit: &Hit, column: usize, row: usize, speckle_seed: u64) -> Pixel {
    let (ambient, laser) = view.shade(hit);
    let mut rgb = ambient;
    if laser.iter().any(|l| *l > 0.0) {
        let speckle = match scene.laser.speckle {
            0.0 => 1.0,
            s => {
                let grain = value_noise(speckle_seed, column as f64 / 1.7, row as f64 / 1.7);
                (1.0 + 2.0 * s as f32 * grain).max(0.0)
            }
        };
        (0..3).for_each(|c| rgb[c] += speckle * laser[c]);
    }
    Pixel { rgb, from_plane_mm: hit.from_plane_mm }
}

/// Draws the line of [`LineProfile::Image`]: at every line position a Gaussian about the true place.
pub(super) fn draw_line(scene: &Scene, rig: &Rig, truth: &[LinePoint], pixels: &mut [Pixel]) {
    let LineProfile::Image { sigma_px } = scene.laser.profile else { return };
    if !scene.laser.on {
        return;
    }
    let (width, height) = (rig.camera.width_px as usize, rig.camera.height_px as usize);
    let colour = laser_rgb(rig.laser.colour);
    let peak = scene.laser.power * scene.material.albedo;
    let variance = sigma_px * sigma_px + 1.0 / 12.0;
    let (across_count, across_step, along_step) = match rig.laser.line {
        LineDirection::Vertical => (width, 1, width),
        LineDirection::Horizontal => (height, width, 1),
    };
    for (position, point) in truth.iter().enumerate() {
        if point.across_px.is_nan() {
            continue;
        }
        let centre = point.across_px;
        let reach = 7.0 * sigma_px;
        let first = (centre - reach).ceil().max(0.0) as usize;
        let last = ((centre + reach).floor().max(0.0) as usize).min(across_count - 1);
        for across in first..=last {
            let away = across as f64 - centre;
            let signal = (peak * (-0.5 * away * away / variance).exp()) as f32;
            let pixel = &mut pixels[position * along_step + across * across_step];
            (0..3).for_each(|c| pixel.rgb[c] += signal * colour[c]);
        }
    }
}
