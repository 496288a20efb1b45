//! What the surface looks like: clouds, spots and cracks, fixed to the wall.

use super::noise::{Stream, hash, value_noise};
use super::scene::Material;

/// A grid of reflectance to paint on: node (column, row) lies at (x0 + column·step, y0 + row·step), mm.
pub(super) struct Canvas {
    pub x0_mm: f64,
    pub y0_mm: f64,
    pub step_mm: f64,
    pub columns: usize,
    pub rows: usize,
    /// Share of light that comes back, row by row.
    pub albedo: Vec<f32>,
}

impl Canvas {
    /// Multiplies the nodes near a point by `f` of the way (dx, dy) from it, mm.
    fn touch(&mut self, x_mm: f64, y_mm: f64, reach_mm: f64, f: impl Fn(f64, f64) -> f32) {
        let range = |centre: f64, origin: f64, count: usize| {
            let low = ((centre - reach_mm - origin) / self.step_mm).ceil().max(0.0);
            let high = ((centre + reach_mm - origin) / self.step_mm).floor().min(count as f64 - 1.0);
            if high < low { 0..0 } else { low as usize..high as usize + 1 }
        };
        let columns = range(x_mm, self.x0_mm, self.columns);
        for row in range(y_mm, self.y0_mm, self.rows) {
            for column in columns.clone() {
                let dx = self.x0_mm + column as f64 * self.step_mm - x_mm;
                let dy = self.y0_mm + row as f64 * self.step_mm - y_mm;
                self.albedo[row * self.columns + column] *= f(dx, dy);
            }
        }
    }
}

/// Paints a material onto a canvas. `scale` is the size of its grain: 1 for a wall at 850 mm.
pub(super) fn paint(canvas: &mut Canvas, material: &Material, scale: f64, seed: u64) {
    canvas.albedo.fill(material.albedo as f32);
    if material.contrast <= 0.0 {
        return;
    }
    clouds(canvas, material, scale, seed);
    if material.spots {
        spots(canvas, scale, seed);
        cracks(canvas, scale, seed);
    }
}

/// Octaves of smooth noise; none finer than the grid can show.
fn clouds(canvas: &mut Canvas, material: &Material, scale: f64, seed: u64) {
    // (length in mm, share of the contrast)
    const OCTAVES: [(f64, f64); 7] =
        [(190.0, 0.34), (90.0, 0.32), (42.0, 0.28), (20.0, 0.26), (9.5, 0.25), (4.5, 0.24), (2.2, 0.22)];
    // The clean texture of exact scenes stays smooth over several pixels, so that no sampling error remains.
    let finest_mm = canvas.step_mm * if material.spots { 1.5 } else { 6.0 };
    let octaves: Vec<(f64, f32, u64)> = OCTAVES
        .iter()
        .enumerate()
        .filter(|(_, (length, _))| length * scale >= finest_mm)
        .map(|(i, (length, share))| {
            (1.0 / (length * scale), (share * material.contrast) as f32, hash(seed, i as i64, 1))
        })
        .collect();
    for row in 0..canvas.rows {
        let y = canvas.y0_mm + row as f64 * canvas.step_mm;
        for column in 0..canvas.columns {
            let x = canvas.x0_mm + column as f64 * canvas.step_mm;
            let mut deviation = 0.0;
            for (frequency, share, seed) in &octaves {
                deviation += share * value_noise(*seed, x * frequency, y * frequency);
            }
            canvas.albedo[row * canvas.columns + column] *= (1.0 + deviation).max(0.15);
        }
    }
}

/// Round dark and light spots of all sizes.
fn spots(canvas: &mut Canvas, scale: f64, seed: u64) {
    let cell_mm = 60.0 * scale;
    let soft_mm = 0.7 * canvas.step_mm.max(0.3 * scale);
    for_cells(canvas, cell_mm, |canvas, i, j| {
        let mut stream = Stream::at(seed ^ 0x5907, i, j);
        for _ in 0..3 {
            let (x, y) = ((i as f64 + stream.unit()) * cell_mm, (j as f64 + stream.unit()) * cell_mm);
            let radius = scale * (0.7 + 5.8 * stream.unit().powi(4));
            let factor = if stream.unit() < 0.7 { stream.between(0.45, 0.8) } else { stream.between(1.15, 1.4) } as f32;
            canvas.touch(x, y, radius + soft_mm, |dx, dy| {
                let inside = (0.5 + (radius - dx.hypot(dy)) / (2.0 * soft_mm)).clamp(0.0, 1.0) as f32;
                1.0 + (factor - 1.0) * inside
            });
        }
    });
}

/// Fine dark cracks that wander.
fn cracks(canvas: &mut Canvas, scale: f64, seed: u64) {
    let cell_mm = 240.0 * scale;
    for_cells(canvas, cell_mm, |canvas, i, j| {
        let mut stream = Stream::at(seed ^ 0xc4ac, i, j);
        if stream.unit() > 0.7 {
            return;
        }
        let (mut x, mut y) = ((i as f64 + stream.unit()) * cell_mm, (j as f64 + stream.unit()) * cell_mm);
        let mut heading = stream.between(0.0, std::f64::consts::TAU);
        let mut turn = 0.0;
        let half_mm = scale * stream.between(0.25, 0.5);
        let depth = stream.between(0.3, 0.5) as f32;
        // At most 200 pieces of 1 mm · scale: shorter than a cell, so that its neighbours are enough to look at.
        for _ in 0..stream.between(60.0, 200.0) as usize {
            turn = 0.9 * turn + stream.between(-0.05, 0.05);
            heading += turn;
            let (sine, cosine) = heading.sin_cos();
            let reach_mm = half_mm + canvas.step_mm;
            let step_mm = canvas.step_mm;
            canvas.touch(x, y, reach_mm + 0.5 * scale, |dx, dy| {
                let (along, across) = (dx * cosine + dy * sine, (dy * cosine - dx * sine).abs());
                if along < 0.0 || along >= scale {
                    return 1.0;
                }
                let cover =
                    ((half_mm + 0.5 * step_mm - across) / step_mm).clamp(0.0, (2.0 * half_mm / step_mm).min(1.0));
                1.0 - depth * cover as f32
            });
            (x, y) = (x + scale * cosine, y + scale * sine);
        }
    });
}

/// Visits the cells under a canvas and one more on each side: nothing painted reaches farther than a cell.
fn for_cells(canvas: &mut Canvas, cell_mm: f64, mut visit: impl FnMut(&mut Canvas, i64, i64)) {
    let cells = |origin: f64, count: usize| {
        let first = (origin / cell_mm).floor() as i64;
        let last = ((origin + count as f64 * canvas.step_mm) / cell_mm).floor() as i64;
        first - 1..=last + 1
    };
    let (columns, rows) = (cells(canvas.x0_mm, canvas.columns), cells(canvas.y0_mm, canvas.rows));
    for i in columns {
        for j in rows.clone() {
            visit(canvas, i, j);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbouring_canvases_agree_where_they_overlap() {
        let material = Material { albedo: 0.4, contrast: 0.5, spots: true, gloss: 0.0, tint: [1.0; 3] };
        let canvas = |x0_mm: f64| {
            let mut canvas =
                Canvas { x0_mm, y0_mm: -100.0, step_mm: 0.5, columns: 65, rows: 400, albedo: vec![0.0; 65 * 400] };
            paint(&mut canvas, &material, 1.0, 11);
            canvas
        };
        let (left, right) = (canvas(64.0), canvas(96.0));
        for row in 0..400 {
            let (a, b) = (left.albedo[row * 65 + 64], right.albedo[row * 65]);
            assert!((a - b).abs() < 1e-4, "row {row}: {a} and {b}");
        }
        let dark = left.albedo.iter().filter(|a| **a < 0.2).count();
        assert!(left.albedo.iter().all(|a| (0.01..0.95).contains(a)) && dark < left.albedo.len() / 10);
    }
}
