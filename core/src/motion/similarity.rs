//! The image's shift and scale from places followed from one frame to the next: the matrix of equation (14).

use super::TrackedCorner;

/// Fewest corners whose motion is believed.
pub(super) const FEWEST_CORNERS: usize = 6;
/// A corner this many times further from the fitted motion than the median is left out of the scale.
const SCALE_OUTLIER: f64 = 3.0;

/// The middle value.
pub(super) fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The S of (14) by least squares, once over all corners and once without those that fit badly; and the
/// median distance from that motion, px. `None` where the corners lie in one spot.
pub(super) fn scale_and_residual(corners: &[TrackedCorner]) -> (Option<f64>, f64) {
    let Some(first) = fit(corners.iter()) else { return (None, 0.0) };
    let limit = SCALE_OUTLIER * median(&mut corners.iter().map(|c| first.miss_px(c)).collect::<Vec<_>>()).max(0.01);
    let second = fit(corners.iter().filter(|c| first.miss_px(c) <= limit)).unwrap_or(first);
    (Some(second.scale), median(&mut corners.iter().map(|c| second.miss_px(c)).collect::<Vec<_>>()))
}

/// The matrix M of (14).
#[derive(Clone, Copy)]
struct ScaleAndShift {
    scale: f64,
    shift_px: [f64; 2],
}

impl ScaleAndShift {
    fn miss_px(&self, corner: &TrackedCorner) -> f64 {
        let miss = |axis: usize| {
            f64::from(corner.to_px[axis]) - self.scale * f64::from(corner.from_px[axis]) - self.shift_px[axis]
        };
        miss(0).hypot(miss(1))
    }
}

fn fit<'a>(corners: impl Iterator<Item = &'a TrackedCorner> + Clone) -> Option<ScaleAndShift> {
    let count = corners.clone().count() as f64;
    let mean = |of: fn(&TrackedCorner, usize) -> f32, axis: usize| {
        corners.clone().map(|c| f64::from(of(c, axis))).sum::<f64>() / count
    };
    let from: [f64; 2] = [mean(|c, a| c.from_px[a], 0), mean(|c, a| c.from_px[a], 1)];
    let to: [f64; 2] = [mean(|c, a| c.to_px[a], 0), mean(|c, a| c.to_px[a], 1)];
    let (mut product, mut square) = (0.0, 0.0);
    for corner in corners {
        for axis in 0..2 {
            let off = f64::from(corner.from_px[axis]) - from[axis];
            product += off * (f64::from(corner.to_px[axis]) - to[axis]);
            square += off * off;
        }
    }
    if count < FEWEST_CORNERS as f64 || square < count {
        return None;
    }
    let scale = product / square;
    Some(ScaleAndShift { scale, shift_px: [to[0] - scale * from[0], to[1] - scale * from[1]] })
}
