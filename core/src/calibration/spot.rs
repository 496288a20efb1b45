//! One row's laser spot: a Gaussian on a level ground, fitted to the row's light.

use nalgebra::{Matrix4, Vector4};

use crate::geometry::RawPixel;
use crate::rig::LineDirection;

/// Least height of a spot above the row's noise, standard deviations.
const MIN_SIGMAS: f64 = 6.0;
/// Least height of a spot, full scales of linear light: below it, the rounding to 8 bits makes spots.
const MIN_HEIGHT: f64 = 0.01;
/// Widths that a line can have, standard deviation in px.
const WIDTH_PX: (f64, f64) = (0.4, 15.0);
/// Fewest pixels of a row: four unknowns and a margin.
const MIN_PIXELS: usize = 7;
/// Rows longer than this are cut to so many pixels on each side of the peak.
const REACH_PX: usize = 30;
/// Largest remainder of the fit, as a share of the height: two spots leave more.
const MAX_REMAINDER: f64 = 0.2;
/// Largest standard deviation of a spot's place, px: worse ones say nothing.
const MAX_DEVIATION_PX: f64 = 0.7;
const MAX_ROUNDS: usize = 20;

/// A spot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Spot {
    /// The line position: the row, with a vertical line.
    pub along_px: f64,
    /// The place across the line: the column, with a vertical line.
    pub across_px: f64,
    /// Width, standard deviation in px.
    pub sigma_px: f64,
    /// Standard deviation of the place across, px.
    pub deviation_px: f64,
}

impl Spot {
    /// The spot of a row that begins elsewhere.
    pub(super) fn moved(self, along_px: f64, start_px: f64) -> Spot {
        Spot { along_px, across_px: self.across_px + start_px, ..self }
    }

    /// Its place in the image.
    pub(super) fn pixel(&self, direction: LineDirection) -> RawPixel {
        match direction {
            LineDirection::Vertical => RawPixel { u_px: self.across_px, v_px: self.along_px },
            LineDirection::Horizontal => RawPixel { u_px: self.along_px, v_px: self.across_px },
        }
    }
}

/// The spot in a row of light; `None` where there is none. Its place counts from the row's begin. NaN stands for
/// light that was clipped: the flanks tell where its peak was.
pub(super) fn find(row: &[f32]) -> Option<Spot> {
    let mut known: Vec<f32> = row.iter().copied().filter(|v| !v.is_nan()).collect();
    if known.len() < MIN_PIXELS {
        return None;
    }
    known.sort_by(f32::total_cmp);
    let ground = f64::from(known[known.len() / 5]);
    let (peak, height) = peak(row, ground, f64::from(known[known.len() - 1]))?;
    if height < MIN_HEIGHT || height < MIN_SIGMAS * noise(row) {
        return None;
    }
    let first = peak.saturating_sub(REACH_PX);
    let part = &row[first..(peak + REACH_PX + 1).min(row.len())];
    let half = part.iter().filter(|v| v.is_nan() || f64::from(**v) - ground > 0.5 * height).count();
    // A Gaussian is 2.35 standard deviations wide at half its height.
    let start = Vector4::new((peak - first) as f64, (half as f64 / 2.35).max(0.7).ln(), height, ground);
    let fit = gaussian(part, start)?;
    let spot = Spot {
        along_px: 0.0,
        across_px: fit.at[0] + first as f64,
        sigma_px: fit.at[1].exp(),
        deviation_px: fit.deviation_px,
    };
    let good = (0.0..=(row.len() - 1) as f64).contains(&spot.across_px)
        && (WIDTH_PX.0..WIDTH_PX.1).contains(&spot.sigma_px)
        && fit.at[2] >= MIN_HEIGHT
        && fit.remainder < MAX_REMAINDER * height
        && spot.deviation_px < MAX_DEVIATION_PX;
    good.then_some(spot)
}

/// The brightest pixel, or the middle of the widest clipped run, and its height above the ground.
fn peak(row: &[f32], ground: f64, brightest: f64) -> Option<(usize, f64)> {
    let (mut widest, mut begin) = (0..0, 0);
    for (i, value) in row.iter().enumerate() {
        if !value.is_nan() {
            begin = i + 1;
        } else if i + 1 - begin > widest.len() {
            widest = begin..i + 1;
        }
    }
    if !widest.is_empty() {
        return Some(((widest.start + widest.end) / 2, brightest - ground));
    }
    let smooth = |i: usize| f64::from(row[i - 1] + 2.0 * row[i] + row[i + 1]) / 4.0;
    let peak = (1..row.len() - 1).max_by(|a, b| smooth(*a).total_cmp(&smooth(*b)))?;
    Some((peak, smooth(peak) - ground))
}

/// The noise by the lower third of the neighbours' differences: the spot's own slopes are in the minority.
fn noise(row: &[f32]) -> f64 {
    let mut steps: Vec<f32> = row.windows(2).map(|w| (w[1] - w[0]).abs()).filter(|s| !s.is_nan()).collect();
    if steps.is_empty() {
        return f64::MAX;
    }
    let third = steps.len() / 3;
    // A third of a normal error's absolute values lie below 0.43 standard deviations; differences are √2 as large.
    f64::from(*steps.select_nth_unstable_by(third, f32::total_cmp).1) / (0.43 * std::f64::consts::SQRT_2)
}

/// A fitted Gaussian: place, ln width, height, ground.
struct Fit {
    at: Vector4<f64>,
    /// Root mean square of what it does not explain.
    remainder: f64,
    /// Standard deviation of the place, px.
    deviation_px: f64,
}

/// Levenberg and Marquardt's fit to the light that is known.
fn gaussian(row: &[f32], start: Vector4<f64>) -> Option<Fit> {
    let linearise = |at: &Vector4<f64>| {
        let (sigma, mut cost) = (at[1].exp(), 0.0);
        let (mut normal, mut slope) = (Matrix4::zeros(), Vector4::zeros());
        for (i, value) in row.iter().enumerate().filter(|(_, value)| !value.is_nan()) {
            let t = (i as f64 - at[0]) / sigma;
            let bell = (-0.5 * t * t).exp();
            let jacobian = Vector4::new(at[2] * bell * t / sigma, at[2] * bell * t * t, bell, 1.0);
            let miss = f64::from(*value) - at[2] * bell - at[3];
            cost += miss * miss;
            normal += jacobian * jacobian.transpose();
            slope += jacobian * miss;
        }
        (cost, normal, slope)
    };
    let mut at = start;
    let (mut cost, mut normal, mut slope) = linearise(&at);
    let mut damping = 1e-3;
    for _ in 0..MAX_ROUNDS {
        let mut damped = normal;
        (0..4).for_each(|i| damped[(i, i)] *= 1.0 + damping);
        let step = damped.cholesky()?.solve(&slope);
        let next = at + step;
        let (next_cost, next_normal, next_slope) = linearise(&next);
        if next_cost < cost {
            (at, cost, normal, slope) = (next, next_cost, next_normal, next_slope);
            damping *= 0.2;
        } else {
            damping *= 8.0;
        }
        if step[0].abs() < 1e-4 {
            break;
        }
    }
    let count = row.iter().filter(|v| !v.is_nan()).count() as f64;
    let place = normal.try_inverse()?[(0, 0)] * cost / (count - 4.0).max(1.0);
    let finite = at.iter().all(|v| v.is_finite());
    finite.then(|| Fit { at, remainder: (cost / count).sqrt(), deviation_px: place.max(0.0).sqrt() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bell(centre: f64, sigma: f64, length: usize) -> Vec<f32> {
        (0..length).map(|i| (0.02 + 0.4 * (-0.5 * ((i as f64 - centre) / sigma).powi(2)).exp()) as f32).collect()
    }

    #[test]
    fn a_spot_is_met_also_where_it_is_cut_or_clipped() {
        for (centre, sigma, length) in [(20.3, 3.0, 45), (9.7, 2.2, 22), (4.6, 2.5, 20)] {
            let found = find(&bell(centre, sigma, length)).expect("a spot");
            assert!((found.across_px - centre).abs() < 1e-3 && (found.sigma_px - sigma).abs() < 1e-2, "{found:?}");
            let clip = |v: &f32| if *v > 0.25 { f32::NAN } else { *v };
            let clipped: Vec<f32> = bell(centre, sigma, length).iter().map(clip).collect();
            assert!((find(&clipped).expect("a spot").across_px - centre).abs() < 0.01);
        }
    }

    #[test]
    fn a_level_row_and_noise_have_no_spot() {
        assert_eq!(find(&[0.3; 40]), None);
        assert_eq!((find(&[0.3; 3]), find(&[f32::NAN; 40]), find(&[])), (None, None, None));
        let noise: Vec<f32> = (0..60).map(|i| 0.02 * ((i * 7919 % 101) as f32 / 101.0)).collect();
        assert_eq!(find(&noise), None);
    }
}
