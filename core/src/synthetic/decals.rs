//! Lamps and paint on the wall: colours that are not the laser's line.

use super::noise::Stream;

/// A coloured disc on the wall.
#[derive(Clone, Copy, Debug)]
pub(super) struct Decal {
    x_mm: f64,
    y_mm: f64,
    radius_mm: f64,
    /// Linear red, green, blue: reflectance of paint, signal of a lamp in full scales.
    rgb: [f32; 3],
    lamp: bool,
}

/// Length of wall that holds one set, mm.
const CELL_MM: f64 = 420.0;

/// (red, green, blue, lamp): what comes in turn.
const KINDS: [([f32; 3], bool); 7] = [
    ([0.03, 0.62, 0.10], false),
    ([0.12, 1.25, 0.28], true),
    ([1.2, 0.12, 0.18], true),
    ([0.62, 0.02, 0.06], false),
    ([0.10, 0.16, 1.2], true),
    ([0.03, 0.40, 0.08], false),
    ([1.3, 1.3, 1.3], true),
];

/// The discs that reach into a stretch of wall.
pub(super) fn decals_between(x_min_mm: f64, x_max_mm: f64, distance_mm: f64, seed: u64) -> Vec<Decal> {
    let scale = distance_mm / 850.0;
    let cell_mm = CELL_MM * scale;
    let (first, last) = ((x_min_mm / cell_mm).floor() as i64 - 1, (x_max_mm / cell_mm).floor() as i64 + 1);
    (first..=last)
        .flat_map(|cell| {
            let mut stream = Stream::at(seed ^ 0xdeca1, cell, 0);
            KINDS.map(|(rgb, lamp)| Decal {
                x_mm: (cell as f64 + stream.unit()) * cell_mm,
                y_mm: scale * stream.between(-250.0, 250.0),
                radius_mm: scale * if lamp { stream.between(10.0, 22.0) } else { stream.between(20.0, 42.0) },
                rgb,
                lamp,
            })
        })
        .filter(|d| d.x_mm + 3.0 * d.radius_mm > x_min_mm && d.x_mm - 3.0 * d.radius_mm < x_max_mm)
        .collect()
}

impl Decal {
    /// Changes the reflectance and the own light of a place of the wall (linear red, green, blue).
    pub(super) fn apply(&self, x_mm: f64, y_mm: f64, albedo: &mut [f32; 3], glow: &mut [f32; 3]) {
        let distance_mm = (x_mm - self.x_mm).hypot(y_mm - self.y_mm);
        if distance_mm > 3.0 * self.radius_mm {
            return;
        }
        let cover = (0.5 + (self.radius_mm - distance_mm) / if self.lamp { 4.0 } else { 1.2 }).clamp(0.0, 1.0) as f32;
        for channel in 0..3 {
            if self.lamp {
                let halo = 0.02 * (-0.5 * (distance_mm / self.radius_mm).powi(2)).exp() as f32;
                glow[channel] += self.rgb[channel] * (cover + halo);
            } else {
                albedo[channel] += (self.rgb[channel] - albedo[channel]) * cover;
            }
        }
    }
}
