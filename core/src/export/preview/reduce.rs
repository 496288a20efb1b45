//! The map at the size of the picture, however long it is.

use crate::depth_map::{MapReader, TILE_SIDE_PX, rectangles, written};
use crate::error::Result;

/// Rows that are read at once.
const PIECE_ROWS: usize = 4096;

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
        let mut sums = written((0.0_f32, 0_u32), width_px * height_px);
        let size_px = [geometry.width_px, geometry.height_px];
        for [first, top, columns, rows] in rectangles(size_px, [TILE_SIDE_PX, PIECE_ROWS]) {
            let window = map.window(first, top, columns, rows)?;
            for (row, depths_mm) in (top..).zip(window.depth_mm.chunks_exact(columns)) {
                let line = &mut sums[row / factor * width_px..][..width_px];
                // A square may have begun in the window before.
                let (part, rest) = depths_mm.split_at(((factor - first % factor) % factor).min(columns));
                let squares = std::iter::once(part).filter(|part| !part.is_empty()).chain(rest.chunks(factor));
                for ((sum_mm, count), depths_mm) in line[first / factor..].iter_mut().zip(squares) {
                    for z_mm in depths_mm.iter().filter(|z| z.is_finite()) {
                        *sum_mm += z_mm;
                        *count += 1;
                    }
                }
            }
        }
        let measured: u64 = sums.iter().map(|(_, count)| u64::from(*count)).sum();
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

/// Where a place between the pixels lies along one side: the pixel before it, and the share of the way to the next.
#[derive(Clone, Copy)]
pub(super) struct Between {
    first: usize,
    second: usize,
    share: f32,
}

impl Between {
    /// A place along a side of `length_px` pixels; beyond the ends, the end.
    pub(super) fn of(place: f64, length_px: usize) -> Between {
        let place = place.clamp(0.0, (length_px - 1) as f64);
        let first = place as usize;
        Between { first, second: (first + 1).min(length_px - 1), share: (place - first as f64) as f32 }
    }

    fn nearest(self) -> usize {
        if self.share < 0.5 { self.first } else { self.second }
    }
}

/// The value at a place between the pixels, from those of its four that are numbers; NaN where its nearest is none.
pub(super) fn between(values: &[f32], width_px: usize, x: Between, y: Between) -> f32 {
    if values[y.nearest() * width_px + x.nearest()].is_nan() {
        return f32::NAN;
    }
    let (upper, lower) = (&values[y.first * width_px..], &values[y.second * width_px..]);
    let four = [upper[x.first], upper[x.second], lower[x.first], lower[x.second]];
    let weights =
        [(1.0 - x.share) * (1.0 - y.share), x.share * (1.0 - y.share), (1.0 - x.share) * y.share, x.share * y.share];
    let (mut sum, mut total) = (0.0, 0.0);
    for (value, weight) in four.into_iter().zip(weights) {
        if value.is_finite() {
            sum += value * weight;
            total += weight;
        }
    }
    sum / total
}
