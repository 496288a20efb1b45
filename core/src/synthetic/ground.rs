//! The surface baked onto a grid about as fine as the image, for the millions of questions that rendering asks.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use super::bands::for_bands;
use super::noise::{hash, value_noise};
use super::scene::Material;
use super::texture::{Canvas, paint};
use super::wall::Wall;

/// What is known at a place: z (mm), dz/dx, dz/dy, share of light that comes back.
pub(super) type Sample = [f32; 4];

/// Columns of a strip; a strip also holds the next one's first column.
const STRIP: usize = 64;
const STRIDE: usize = STRIP + 1;

/// Strips that are kept on each side of the view.
const SPARE_STRIPS: i64 = 4;

/// Greatest random tilt of a glossy surface over each of two lengths: what frays the edge of its highlight.
const ROUGHNESS: f32 = 0.02;

/// The baked surface. Strips along x are made when they are first seen and dropped when they are far behind.
pub(super) struct Ground {
    pub wall: Wall,
    material: Material,
    step_mm: f64,
    y0_mm: f64,
    rows: usize,
    strips: Mutex<BTreeMap<i64, Arc<Vec<Sample>>>>,
}

impl Ground {
    /// A surface to be baked every `step_mm` between two y.
    pub(super) fn new(wall: Wall, material: Material, step_mm: f64, y_min_mm: f64, y_max_mm: f64) -> Ground {
        let rows = ((y_max_mm - y_min_mm) / step_mm).ceil().max(1.0) as usize + 2;
        Ground { wall, material, step_mm, y0_mm: y_min_mm, rows, strips: Mutex::default() }
    }

    /// The part between two x.
    pub(super) fn view(&self, x_min_mm: f64, x_max_mm: f64) -> GroundView {
        let strip_mm = STRIP as f64 * self.step_mm;
        let (first, last) = ((x_min_mm / strip_mm).floor() as i64, (x_max_mm / strip_mm).floor() as i64);
        let mut known = self.strips.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        known.retain(|k, _| (first - SPARE_STRIPS..=last + SPARE_STRIPS).contains(k));
        let mut missing: Vec<(i64, Vec<Sample>)> =
            (first..=last).filter(|k| !known.contains_key(k)).map(|k| (k, Vec::new())).collect();
        for_bands(&mut missing, 1, 1, |_, strips| {
            for (k, nodes) in strips {
                *nodes = self.bake(*k as f64 * strip_mm);
            }
        });
        known.extend(missing.into_iter().map(|(k, nodes)| (k, Arc::new(nodes))));
        let strips: Vec<Arc<Vec<Sample>>> = known.range(first..=last).map(|(_, strip)| strip.clone()).collect();
        GroundView {
            x0_mm: first as f64 * strip_mm,
            y0_mm: self.y0_mm as f32,
            nodes_per_mm: (1.0 / self.step_mm) as f32,
            last_column: (strips.len() * STRIP) as f32 - 0.01,
            last_row: self.rows as f32 - 1.01,
            strips,
        }
    }

    fn bake(&self, x0_mm: f64) -> Vec<Sample> {
        let seed = self.wall.seed;
        let (step_mm, y0_mm, rows) = (self.step_mm, self.y0_mm, self.rows);
        let mut canvas = Canvas { x0_mm, y0_mm, step_mm, columns: STRIDE, rows, albedo: vec![0.0; STRIDE * rows] };
        paint(&mut canvas, &self.material, self.wall.distance_mm / 850.0, seed);
        let window = self.wall.window(x0_mm - step_mm, x0_mm + (STRIDE + 1) as f64 * step_mm);
        let mut nodes = Vec::with_capacity(STRIDE * rows);
        for (i, albedo) in canvas.albedo.iter().enumerate() {
            let (x, y) = (x0_mm + (i % STRIDE) as f64 * step_mm, y0_mm + (i / STRIDE) as f64 * step_mm);
            let (slope_x, slope_y) = window.slope(x, y, 0.5 * step_mm);
            let tilt = |axis| match self.material.gloss > 0.0 {
                true => {
                    [14.0, 6.0].iter().map(|mm| value_noise(hash(seed, axis, 77), x / mm, y / mm)).sum::<f32>()
                        * ROUGHNESS
                }
                false => 0.0,
            };
            nodes.push([window.z_mm(x, y) as f32, slope_x as f32 + tilt(0), slope_y as f32 + tilt(1), *albedo]);
        }
        nodes
    }
}

/// The baked surface under one frame. Its x counts from `x0_mm`, so that single precision is enough anywhere.
pub(super) struct GroundView {
    /// World x of this view's x = 0, mm.
    pub x0_mm: f64,
    y0_mm: f32,
    nodes_per_mm: f32,
    last_column: f32,
    last_row: f32,
    strips: Vec<Arc<Vec<Sample>>>,
}

impl GroundView {
    /// The surface at a place, between its four nearest nodes; places outside get the rim's.
    #[inline]
    pub(super) fn sample(&self, x_mm: f32, y_mm: f32) -> Sample {
        let column = (x_mm * self.nodes_per_mm).clamp(0.0, self.last_column);
        let row = ((y_mm - self.y0_mm) * self.nodes_per_mm).clamp(0.0, self.last_row);
        let (c, r) = (column as usize, row as usize);
        let (fx, fy) = (column - c as f32, row - r as f32);
        let at = r * STRIDE + c % STRIP;
        let nodes = &self.strips[c / STRIP][at..at + STRIDE + 2];
        let (a, b, c, d) = (nodes[0], nodes[1], nodes[STRIDE], nodes[STRIDE + 1]);
        std::array::from_fn(|i| {
            let top = a[i] + (b[i] - a[i]) * fx;
            let bottom = c[i] + (d[i] - c[i]) * fx;
            top + (bottom - top) * fy
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::Scene;

    #[test]
    fn the_baked_surface_is_the_true_one() {
        let scene = Scene::named("wall").expect("scene");
        let ground = Ground::new(scene.wall.clone(), scene.material, 0.85, -200.0, 200.0);
        for x_min in [-300.0, 700_000.0] {
            let view = ground.view(x_min, x_min + 600.0);
            let window = scene.wall.window(x_min, x_min + 600.0);
            for i in 0..500 {
                let (x, y) = (x_min + 1.1 * f64::from(i), -190.0 + 0.7 * f64::from(i));
                let baked = view.sample((x - view.x0_mm) as f32, y as f32);
                assert!((f64::from(baked[0]) - window.z_mm(x, y)).abs() < 0.02, "at {x}, {y}");
            }
        }
    }
}
