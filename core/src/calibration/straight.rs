//! Spots → the straight line that most of them form, in undistorted coordinates.

use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};

use crate::geometry::UndistortedRay;
use crate::rig::LineDirection;

/// Pairs of spots that are tried. With half of the spots wrong, 60 are enough with a certainty of 1 − 10⁻⁷.
const TRIES: usize = 300;
/// How near a spot must be to the first guess, px.
const NEAR_PX: f64 = 2.0;
/// Then: within so many robust standard deviations.
const NEAR_SIGMAS: f64 = 4.0;
/// But never less than this, px.
const NEAR_FLOOR_PX: f64 = 0.1;
/// Share of the spots that must lie on the line.
const MIN_SHARE: f64 = 0.5;

/// Along, across, weight.
type Point = (f64, f64, f64);

/// A line x = offset + slope · y in undistorted coordinates (x and y exchanged for a horizontal line).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Straight {
    direction: LineDirection,
    offset: f64,
    slope: f64,
}

impl Straight {
    /// Signed distance of a ray from the line, at z = 1.
    pub(super) fn distance(&self, ray: UndistortedRay) -> f64 {
        let (along, across) = along_across(self.direction, ray);
        (across - self.offset - self.slope * along) / self.slope.hypot(1.0)
    }

    /// Where it stands at the optical axis, and how much it leans.
    pub(super) fn offset_slope(&self) -> (f64, f64) {
        (self.offset, self.slope)
    }

    /// Weighted least squares through points (along, across, weight).
    fn through(direction: LineDirection, points: impl Iterator<Item = Point> + Clone) -> Option<Straight> {
        let sum = |of: fn(&Point) -> f64| points.clone().map(|p| p.2 * of(&p)).sum::<f64>();
        let total = sum(|_| 1.0);
        let (mean_a, mean_c) = (sum(|p| p.0) / total, sum(|p| p.1) / total);
        let (mut square, mut product) = (0.0, 0.0);
        for (along, across, weight) in points {
            square += weight * (along - mean_a).powi(2);
            product += weight * (along - mean_a) * (across - mean_c);
        }
        let slope = product / square;
        slope.is_finite().then_some(Straight { direction, offset: mean_c - slope * mean_a, slope })
    }
}

fn along_across(direction: LineDirection, ray: UndistortedRay) -> (f64, f64) {
    match direction {
        LineDirection::Vertical => (ray.y, ray.x),
        LineDirection::Horizontal => (ray.x, ray.y),
    }
}

/// The line and the spots on it; `None` where fewer than half of them form one. `weights`: one a spot.
pub(super) fn fit(
    rays: &[UndistortedRay],
    weights: &[f64],
    direction: LineDirection,
    focal_px: f64,
) -> Option<(Straight, Vec<usize>)> {
    let point = |(ray, weight): (&UndistortedRay, &f64)| {
        let (along, across) = along_across(direction, *ray);
        (along, across, *weight)
    };
    let points: Vec<Point> = rays.iter().zip(weights).map(point).collect();
    let near = |line: &Straight, limit_px: f64| -> Vec<usize> {
        (0..rays.len()).filter(|i| line.distance(rays[*i]).abs() * focal_px < limit_px).collect()
    };
    // The same spots always give the same line.
    let mut random = StdRng::seed_from_u64(1);
    let mut best: Vec<usize> = Vec::new();
    for _ in 0..TRIES {
        let pair = [random.random_range(0..points.len().max(1)), random.random_range(0..points.len().max(1))];
        let ends = pair.iter().filter_map(|i| points.get(*i).copied());
        let Some(line) = Straight::through(direction, ends) else { continue };
        let inliers = near(&line, NEAR_PX);
        if inliers.len() > best.len() {
            best = inliers;
        }
    }
    let mut line = None;
    for _ in 0..4 {
        let through = Straight::through(direction, best.iter().map(|i| points[*i]))?;
        let mut off_px: Vec<f64> = best.iter().map(|i| through.distance(rays[*i]).abs() * focal_px).collect();
        let middle = off_px.len() / 2;
        let sigma_px = 1.4826 * *off_px.select_nth_unstable_by(middle, f64::total_cmp).1;
        best = near(&through, (NEAR_SIGMAS * sigma_px).max(NEAR_FLOOR_PX));
        line = Some(through);
    }
    let enough = best.len() >= 2 && best.len() as f64 >= MIN_SHARE * rays.len() as f64;
    line.filter(|_| enough).map(|line| (line, best))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_third_of_wrong_spots_changes_nothing() {
        let rays: Vec<UndistortedRay> = (0..90)
            .map(|i| {
                let along = f64::from(i) / 100.0;
                let across = if i % 3 == 0 { 0.3 - along } else { 0.1 + 0.05 * along };
                UndistortedRay { x: across, y: along }
            })
            .collect();
        let (line, inliers) = fit(&rays, &[1.0; 90], LineDirection::Vertical, 1000.0).expect("a line");
        assert!((line.offset - 0.1).abs() < 1e-9 && (line.slope - 0.05).abs() < 1e-9 && inliers.len() >= 60);
    }

    #[test]
    fn a_cloud_is_no_line() {
        let cloud: Vec<UndistortedRay> = (0..200)
            .map(|i| UndistortedRay { x: f64::from(i * 37 % 101) / 100.0, y: f64::from(i * 53 % 103) / 100.0 })
            .collect();
        assert!(fit(&cloud, &[1.0; 200], LineDirection::Vertical, 1000.0).is_none());
        assert!(fit(&[], &[], LineDirection::Vertical, 1000.0).is_none());
    }
}
