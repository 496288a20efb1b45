//! The pose that puts known places where they are seen.

use nalgebra::{Isometry3, Matrix6, Point3, Translation3, UnitQuaternion, Vector2, Vector3, Vector6};

/// Rounds of Gauss and Newton, at most.
const ROUNDS: usize = 10;
/// Settled when the pose changes by less than this, mm and radians times mm.
const SETTLED: f64 = 1e-6;
/// A place further off than this many of its standard deviations counts less (Huber).
pub(super) const HUBER: f64 = 2.0;

/// Median distance of a sight with normal errors in two directions, in standard deviations.
pub(super) const MEDIAN_MISFIT: f64 = 1.18;

/// A place in the world and where it was seen.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight {
    /// The landmark.
    pub landmark: u32,
    /// Where it is, mm.
    pub world: Point3<f64>,
    /// Where it was seen, undistorted: (X / Z, Y / Z).
    pub ray: [f64; 2],
    /// Standard deviation of that, in the same measure.
    pub sigma: f64,
}

/// What a pose was found with.
#[derive(Clone, Copy, Debug)]
pub(super) struct Solved {
    pub camera_from_world: Isometry3<f64>,
    /// Inverse of the pose's covariance: rotation, then translation.
    pub information: Matrix6<f64>,
}

/// Moves a pose by a small rotation and translation in the camera's frame.
pub(super) fn moved(camera_from_world: &Isometry3<f64>, delta: &Vector6<f64>) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(delta[0], delta[1], delta[2]));
    let turned = rotation * camera_from_world.rotation;
    let shifted = rotation * camera_from_world.translation.vector + Vector3::new(delta[3], delta[4], delta[5]);
    // Poses are made from poses without end: their rotations must not lose their length.
    Isometry3::from_parts(Translation3::from(shifted), UnitQuaternion::new_normalize(turned.into_inner()))
}

/// Where a point is seen, and the rows of its change with the camera's move and with the point.
pub(super) type Projection = (Vector2<f64>, [[f64; 6]; 2], [[f64; 3]; 2]);

/// Where a point of the camera's frame is seen, and how that changes with the camera's move (two rows of six) and with
/// the point (two rows of three). `None` behind the camera.
pub(super) fn projection(p: &Point3<f64>) -> Option<Projection> {
    if p.z < 1.0 {
        return None;
    }
    let inverse = 1.0 / p.z;
    let (x, y) = (p.x * inverse, p.y * inverse);
    let by_point = [[inverse, 0.0, -x * inverse], [0.0, inverse, -y * inverse]];
    // The point moves by ω × p + t.
    let by_move =
        [[-x * y, 1.0 + x * x, -y, inverse, 0.0, -x * inverse], [-(1.0 + y * y), x * y, x, 0.0, inverse, -y * inverse]];
    Some((Vector2::new(x, y), by_move, by_point))
}

/// How far off a sight is, in its own standard deviations.
pub(super) fn misfit(camera_from_world: &Isometry3<f64>, sight: &Sight) -> f64 {
    let p = camera_from_world * sight.world;
    if p.z < 1.0 {
        return f64::MAX;
    }
    (p.x / p.z - sight.ray[0]).hypot(p.y / p.z - sight.ray[1]) / sight.sigma
}

/// Robust least squares over the sights. `hold` is the information that keeps the pose at its start where the sights do
/// not say enough (rotation, then translation; 0 for none).
pub(super) fn solve(start: &Isometry3<f64>, sights: &[Sight], hold: [f64; 2]) -> Option<Solved> {
    let mut pose = *start;
    let mut information = Matrix6::<f64>::zeros();
    for round in 0..ROUNDS {
        // Far off at first, the sights must not be called outliers for the start's error.
        let huber = if round < 2 { 10.0 * HUBER } else { HUBER };
        let mut normal = Matrix6::<f64>::zeros();
        let mut right = Vector6::<f64>::zeros();
        for sight in sights {
            let Some((seen, by_move, _)) = projection(&(pose * sight.world)) else { continue };
            let miss = [sight.ray[0] - seen.x, sight.ray[1] - seen.y];
            let size = (miss[0] * miss[0] + miss[1] * miss[1]).sqrt() / sight.sigma;
            let weight = (if size > huber { huber / size } else { 1.0 }) / (sight.sigma * sight.sigma);
            for (row, miss) in by_move.iter().zip(miss) {
                for i in 0..6 {
                    let scaled = weight * row[i];
                    right[i] += scaled * miss;
                    for j in i..6 {
                        normal[(i, j)] += scaled * row[j];
                    }
                }
            }
        }
        normal.fill_lower_triangle_with_upper_triangle();
        information = normal;
        let away = difference(start, &pose);
        for i in 0..6 {
            normal[(i, i)] += hold[i / 3];
            right[i] -= hold[i / 3] * away[i];
        }
        let delta = normal.cholesky()?.solve(&right);
        if !delta.iter().all(|v| v.is_finite()) {
            return None;
        }
        pose = moved(&pose, &delta);
        let size = delta.fixed_rows::<3>(0).norm() * 1000.0 + delta.fixed_rows::<3>(3).norm();
        if round > 2 && size < SETTLED * 1000.0 {
            break;
        }
    }
    Some(Solved { camera_from_world: pose, information })
}

/// The small move from one pose to another, as [`moved`] takes it (to first order).
pub(super) fn difference(from: &Isometry3<f64>, to: &Isometry3<f64>) -> Vector6<f64> {
    let change = to * from.inverse();
    let turn = change.rotation.scaled_axis();
    let shift = change.translation.vector;
    Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z)
}
