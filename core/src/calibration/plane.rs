//! Lines on boards of known pose → the plane of the laser's light.
//!
//! The photos, not the spots, are what counts: the spots of one photo share the error of its board's pose. So a
//! photo is taken or left as a whole, and the uncertainty comes from how far the photos disagree (White's
//! covariance, one cluster a photo) instead of from the many spots.

use nalgebra::{Matrix3, Point3, Vector3};

use crate::geometry::Plane;

/// Fewest photos with a line: three unknowns, and one more to see whether they agree.
pub(super) const MIN_LINES: usize = 4;
/// A photo whose line lies farther off the plane than so many times the median is left out.
const OUTLIER_RATIO: f64 = 4.0;
/// Lines nearer than this to the plane are never left out, as a share of their distance.
const OUTLIER_FLOOR: f64 = 2e-4;
/// Rounds of leaving out and fitting again.
const ROUNDS: usize = 4;

/// The points of one photo's line, in the camera's frame.
#[derive(Clone, Debug)]
pub(super) struct Line3 {
    pub photo: usize,
    pub points: Vec<Point3<f64>>,
}

impl Line3 {
    /// Root mean square distance from a plane, mm.
    pub(super) fn rms_mm(&self, plane: &Plane) -> f64 {
        let sum: f64 = self.points.iter().map(|p| (plane.normal.dot(&p.coords) - plane.offset_mm).powi(2)).sum();
        (sum / self.points.len() as f64).sqrt()
    }

    fn depth_mm(&self) -> f64 {
        self.points.iter().map(|p| p.z).sum::<f64>() / self.points.len() as f64
    }
}

/// The fit.
#[derive(Clone, Debug)]
pub(super) struct PlaneFit {
    pub plane: Plane,
    /// Photos whose lines were used.
    pub photos: Vec<usize>,
    /// Root mean square distance of their points, mm.
    pub rms_mm: f64,
    /// Standard deviation of the normal's direction, radians, and of the offset, mm, by the photos' disagreement.
    pub angle_rad: f64,
    pub offset_mm: f64,
    /// How far the points spread within the plane across their main direction, as a share of their distance.
    pub spread: f64,
    /// Depths at which the plane was seen, mm.
    pub depth_mm: (f64, f64),
}

/// Fits the plane; `None` with fewer than [`MIN_LINES`] lines.
pub(super) fn fit(lines: &[Line3]) -> Option<PlaneFit> {
    if lines.len() < MIN_LINES {
        return None;
    }
    let mut plane = first_guess(lines)?;
    let mut used: Vec<&Line3> = Vec::new();
    for _ in 0..ROUNDS {
        let ratio = |line: &Line3, plane: &Plane| line.rms_mm(plane) / line.depth_mm();
        let limit = (OUTLIER_RATIO * median(lines.iter().map(|l| ratio(l, &plane)))).max(OUTLIER_FLOOR);
        used = lines.iter().filter(|l| ratio(l, &plane) <= limit).collect();
        plane = least_squares(&used)?;
    }
    if used.len() < MIN_LINES {
        return None;
    }
    let points = used.iter().map(|l| l.points.len()).sum::<usize>() as f64;
    let square: f64 = used.iter().map(|l| l.rms_mm(&plane).powi(2) * l.points.len() as f64).sum();
    let (angle_rad, offset_mm) = deviations(&used, &plane)?;
    let depths = used.iter().flat_map(|l| l.points.iter().map(|p| p.z));
    Some(PlaneFit {
        plane,
        photos: used.iter().map(|l| l.photo).collect(),
        rms_mm: (square / points).sqrt(),
        angle_rad,
        offset_mm,
        spread: spread(&used),
        depth_mm: depths.fold((f64::MAX, f64::MIN), |(low, high), z| (low.min(z), high.max(z))),
    })
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The plane through two lines that most of the others agree with.
fn first_guess(lines: &[Line3]) -> Option<Plane> {
    let mut best: Option<(f64, Plane)> = None;
    for (i, first) in lines.iter().enumerate() {
        for second in &lines[i + 1..] {
            let Some(plane) = least_squares(&[first, second]) else { continue };
            let off = median(lines.iter().map(|l| l.rms_mm(&plane) / l.depth_mm()));
            if best.as_ref().is_none_or(|(least, _)| off < *least) {
                best = Some((off, plane));
            }
        }
    }
    best.map(|(_, plane)| plane)
}

/// A point's weight: a pixel is as wide as the point is far. Every photo counts by its own points, up to a share.
fn weight(line: &Line3, point: &Point3<f64>) -> f64 {
    1.0 / (point.z * point.z * line.points.len() as f64)
}

/// The weighted points' centre and scatter.
fn scatter(lines: &[&Line3]) -> (Vector3<f64>, Matrix3<f64>, f64) {
    let points = || lines.iter().flat_map(|l| l.points.iter().map(|p| (weight(l, p), p.coords)));
    let total: f64 = points().map(|(w, _)| w).sum();
    let centre = points().map(|(w, p)| p * w).sum::<Vector3<f64>>() / total;
    let scatter = points().map(|(w, p)| (p - centre) * (p - centre).transpose() * w).sum::<Matrix3<f64>>() / total;
    (centre, scatter, total)
}

/// The plane of least squared distances; its normal points away from the camera's side of it.
fn least_squares(lines: &[&Line3]) -> Option<Plane> {
    let (centre, scatter, _) = scatter(lines);
    let eigen = scatter.try_symmetric_eigen(1e-14, 200)?;
    let normal: Vector3<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let offset_mm = normal.dot(&centre);
    let sign = if offset_mm < 0.0 { -1.0 } else { 1.0 };
    (offset_mm.is_finite() && normal.norm() > 0.5)
        .then_some(Plane { normal: normal * sign, offset_mm: offset_mm * sign })
}

/// How far the points spread within the plane, across their main direction, as a share of their distance.
fn spread(lines: &[&Line3]) -> f64 {
    let (centre, scatter, _) = scatter(lines);
    let mut values: Vec<f64> = scatter.symmetric_eigenvalues().iter().copied().collect();
    values.sort_by(f64::total_cmp);
    values[1].max(0.0).sqrt() / centre.norm()
}

/// Standard deviations of direction and offset, one cluster a photo.
fn deviations(lines: &[&Line3], plane: &Plane) -> Option<(f64, f64)> {
    let first = plane.normal.cross(&if plane.normal.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() }).normalize();
    let second = plane.normal.cross(&first);
    let (mut normal, mut meat) = (Matrix3::zeros(), Matrix3::zeros());
    for line in lines {
        let mut score = Vector3::zeros();
        for point in &line.points {
            let w = weight(line, point);
            let jacobian = Vector3::new(first.dot(&point.coords), second.dot(&point.coords), -1.0);
            normal += jacobian * jacobian.transpose() * w;
            score += jacobian * w * (plane.normal.dot(&point.coords) - plane.offset_mm);
        }
        meat += score * score.transpose();
    }
    let bread = normal.try_inverse()?;
    let count = lines.len() as f64;
    let covariance = bread * meat * bread * (count / (count - 3.0));
    Some(((covariance[(0, 0)] + covariance[(1, 1)]).sqrt(), covariance[(2, 2)].sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth() -> Plane {
        let normal = Vector3::new(0.99, 0.05, 0.13).normalize();
        Plane { normal, offset_mm: 140.0 }
    }

    /// A line on the plane at about a depth, its points off by a small known pattern.
    fn line(photo: usize, depth_mm: f64, off_mm: f64) -> Line3 {
        let plane = truth();
        let point = |i: i32| {
            let (y, z) = (f64::from(i) * 2.0, depth_mm + 0.3 * f64::from(i));
            let x = (plane.offset_mm - plane.normal.y * y - plane.normal.z * z) / plane.normal.x;
            Point3::new(x, y, z) + plane.normal * (off_mm + 0.02 * f64::from(i.rem_euclid(4) - 1 - i.rem_euclid(4) / 2))
        };
        Line3 { photo, points: (-40..40).map(point).collect() }
    }

    #[test]
    fn a_photo_that_disagrees_is_left_out() {
        let mut lines: Vec<Line3> = (0..8).map(|i| line(i, 400.0 + 60.0 * i as f64, 0.0)).collect();
        lines.push(line(8, 600.0, 4.0));
        let fit = fit(&lines).expect("a plane");
        assert!(!fit.photos.contains(&8) && fit.photos.len() == 8);
        assert!(fit.plane.normal.angle(&truth().normal) < 1e-4, "{}", fit.plane.normal.angle(&truth().normal));
        assert!((fit.plane.offset_mm - 140.0).abs() < 0.05 && fit.rms_mm < 0.05);
    }

    #[test]
    fn lines_on_one_another_spread_little() {
        let near = fit(&(0..6).map(|i| line(i, 500.0 + 0.5 * i as f64, 0.01)).collect::<Vec<_>>()).expect("a plane");
        let far = fit(&(0..6).map(|i| line(i, 400.0 + 90.0 * i as f64, 0.01)).collect::<Vec<_>>()).expect("a plane");
        assert!(near.spread < 0.01 && far.spread > 0.05, "{} and {}", near.spread, far.spread);
        assert!(fit(&[line(0, 400.0, 0.0), line(1, 500.0, 0.0), line(2, 600.0, 0.0)]).is_none());
    }
}
