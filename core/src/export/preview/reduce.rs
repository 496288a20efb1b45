//! The map at the size of the picture, however long it is.

use crate::depth_map::{MapReader, TILE_SIDE_PX};
use crate::error::Result;

/// A whole map, made smaller by whole numbers.
pub(super) struct Reduced {
    pub width_px: usize,
    pub height_px: usize,
    /// Size of a pixel, mm.
    pub mm_per_px: f64,
    /// World z, mm; the mean of what was measured, NaN where less than a quarter was.
    pub depth_mm: Vec<f32>,
    /// Share of the full map's pixels with a depth, 0 to 1.
    pub coverage: f64,
}

impl Reduced {
    /// Reads the map, `factor` by `factor` pixels to one.
    pub(super) fn read(map: &mut dyn MapReader, factor: usize) -> Result<Reduced> {
        let geometry = map.geometry();
        let (width_px, height_px) = (geometry.width_px.div_ceil(factor), geometry.height_px.div_ceil(factor));
        let mut sums = vec![(0.0_f32, 0_u32); width_px * height_px];
        let mut measured = 0_u64;
        for first in (0..geometry.width_px).step_by(TILE_SIDE_PX) {
            let columns = TILE_SIDE_PX.min(geometry.width_px - first);
            let window = map.window(first, 0, columns, geometry.height_px)?;
            for (row, depths_mm) in window.depth_mm.chunks_exact(columns).enumerate() {
                let line = &mut sums[row / factor * width_px..][..width_px];
                for (column, z_mm) in depths_mm.iter().enumerate().filter(|(_, z)| z.is_finite()) {
                    let (sum_mm, count) = &mut line[(first + column) / factor];
                    *sum_mm += z_mm;
                    *count += 1;
                    measured += 1;
                }
            }
        }
        let enough = (factor * factor).div_ceil(4) as u32;
        let mean = |(sum_mm, count): (f32, u32)| if count >= enough { sum_mm / count as f32 } else { f32::NAN };
        Ok(Reduced {
            width_px,
            height_px,
            mm_per_px: geometry.mm_per_px * factor as f64,
            depth_mm: sums.into_iter().map(mean).collect(),
            coverage: measured as f64 / (geometry.width_px * geometry.height_px) as f64,
        })
    }

    /// The depth at a place between the pixels, NaN where its nearest pixel was not measured.
    pub(super) fn at(values: &[f32], width_px: usize, height_px: usize, x: f64, y: f64) -> f32 {
        let (x, y) = (x.clamp(0.0, (width_px - 1) as f64), y.clamp(0.0, (height_px - 1) as f64));
        if values[(y + 0.5) as usize * width_px + (x + 0.5) as usize].is_nan() {
            return f32::NAN;
        }
        let (left, top) = (x as usize, y as usize);
        let (part_x, part_y) = ((x - left as f64) as f32, (y - top as f64) as f32);
        let (mut sum, mut weights) = (0.0, 0.0);
        for (column, row, weight) in [
            (left, top, (1.0 - part_x) * (1.0 - part_y)),
            (left + 1, top, part_x * (1.0 - part_y)),
            (left, top + 1, (1.0 - part_x) * part_y),
            (left + 1, top + 1, part_x * part_y),
        ] {
            if column < width_px && row < height_px && values[row * width_px + column].is_finite() {
                sum += values[row * width_px + column] * weight;
                weights += weight;
            }
        }
        sum / weights
    }

    /// The depths below and above which a share `tail` lies, mm; `None` where nothing was measured.
    pub(super) fn range_mm(&self, tail: f64) -> Option<(f64, f64)> {
        let mut finite: Vec<f32> = self.depth_mm.iter().copied().filter(|z| z.is_finite()).collect();
        let last = finite.len().checked_sub(1)?;
        let mut at = |share: f64| {
            let index = (share * last as f64).round() as usize;
            f64::from(*finite.select_nth_unstable_by(index, f32::total_cmp).1)
        };
        Some((at(tail), at(1.0 - tail)))
    }
}
