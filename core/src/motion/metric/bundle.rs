//! The poses of the last key frames and the places of all landmarks, adjusted together (bundle adjustment).
//!
//! Least squares over every sight of every landmark and every depth that the laser gave, robust against wrong ones. The
//! landmarks are taken out of the equations first (Schur's complement), so that what is solved has six unknowns per
//! free key frame.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix3, Matrix6, Point3, SMatrix, Vector3, Vector6};

use super::pose::{HUBER, MEDIAN_MISFIT, moved, projection};
use crate::motion::similarity::median;

/// Added to the diagonal, as a share of it (Levenberg and Marquardt): at first, least and most, and how it changes.
const DAMPING: f64 = 1e-4;
const DAMPING_RANGE: (f64, f64) = (1e-7, 1e3);
const DAMPING_STEP: f64 = 10.0;

/// A key frame's pose.
#[derive(Clone, Copy, Debug)]
pub(super) struct View {
    pub camera_from_world: Isometry3<f64>,
    /// Whether the pose may still change.
    pub free: bool,
}

/// A landmark as the adjustment sees it.
pub(super) struct Place {
    pub world: Point3<f64>,
    pub sights: Vec<PlaceSight>,
    pub depths: Vec<PlaceDepth>,
    /// Covariance of the place, mm², as if the poses were certain; set by the adjustment.
    pub covariance: Matrix3<f64>,
}

/// A landmark seen in a key frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct PlaceSight {
    pub view: usize,
    /// Undistorted (X / Z, Y / Z).
    pub ray: [f64; 2],
    pub sigma: f64,
}

/// What is known of a landmark's depth: `direction · point = distance_mm` in a key frame's camera.
///
/// A guess errs by a share, in the inverse of the depth: what is taken to be near may be far away, not the other way
/// round.
#[derive(Clone, Copy, Debug)]
pub(super) struct PlaceDepth {
    /// A guess from the neighbours, not a measurement.
    pub guess: bool,
    pub view: usize,
    pub direction: Vector3<f64>,
    pub distance_mm: f64,
    pub sigma_mm: f64,
}

impl PlaceDepth {
    /// How far short of the known depth a point is, mm, and how much less short it gets with each mm further away.
    fn miss_mm(&self, point: &Point3<f64>) -> (f64, f64) {
        let (known, found) = (self.distance_mm, self.direction.dot(&point.coords));
        if !self.guess {
            return (known - found, 1.0);
        }
        let found = found.max(0.05 * known);
        let share = known / found;
        (known * (share - 1.0), share * share)
    }
}

type Block = SMatrix<f64, 6, 3>;

/// Covariance of the last free view's pose as if the poses that are not free were certain: rotation, then translation, as
/// [`moved`] takes them (rad, mm). How well the sights fit says how sure they are, whatever they say of themselves. `None`
/// where nothing is free, or the equations do not tell it.
pub(super) fn last_covariance(views: &[View], places: &[Place]) -> Option<Matrix6<f64>> {
    let free = free_indices(views);
    let count = free.iter().flatten().count();
    let last = count.checked_sub(1)?;
    let NormalEquations { normal, .. } = NormalEquations::of(views, places, &free, 0.0);
    let mut unit = DMatrix::zeros(normal.nrows(), 6);
    unit.fixed_view_mut::<6, 6>(6 * last, 0).copy_from(&Matrix6::identity());
    let covariance: Matrix6<f64> = normal.cholesky()?.solve(&unit).fixed_view::<6, 6>(6 * last, 0).into();
    let scaled = covariance * unit_variance(views, places, count)?;
    scaled.iter().all(|v| v.is_finite()).then_some(scaled)
}

/// How much larger the squares of the sights' errors are than they should be (the variance of unit weight), from their
/// median, so that wrong sights have no say; at least 1.
fn unit_variance(views: &[View], places: &[Place], free_views: usize) -> Option<f64> {
    let mut misfits: Vec<f64> = Vec::new();
    for place in places {
        misfits.extend(place.sights.iter().filter_map(|sight| {
            let (seen, ..) = projection(&(views[sight.view].camera_from_world * place.world))?;
            Some((sight.ray[0] - seen.x).hypot(sight.ray[1] - seen.y) / sight.sigma)
        }));
    }
    let observed = 2 * misfits.len() + places.iter().map(|place| place.depths.len()).sum::<usize>();
    // What was fitted to the sights takes its share of their errors away.
    let spare = observed.checked_sub(3 * places.len() + 6 * free_views)?;
    if spare == 0 || misfits.is_empty() {
        return None;
    }
    let size = median(&mut misfits) / MEDIAN_MISFIT;
    Some((size * size * observed as f64 / spare as f64).max(1.0))
}

/// Adjusts in at most `rounds` rounds; a round that would fit worse changes nothing.
pub(super) fn adjust(views: &mut [View], places: &mut [Place], rounds: usize) {
    let mut damping = DAMPING;
    let mut cost = total_cost(views, places);
    for _ in 0..rounds {
        let before: (Vec<View>, Vec<Point3<f64>>) = (views.to_vec(), places.iter().map(|p| p.world).collect());
        let solved = round(views, places, damping);
        let new_cost = if solved { total_cost(views, places) } else { f64::MAX };
        if new_cost <= cost {
            cost = new_cost;
            damping = (damping / DAMPING_STEP).max(DAMPING_RANGE.0);
            continue;
        }
        views.copy_from_slice(&before.0);
        places.iter_mut().zip(before.1).for_each(|(place, world)| place.world = world);
        damping = (damping * DAMPING_STEP * DAMPING_STEP).min(DAMPING_RANGE.1);
    }
}

/// What all sights and depths are off by: squares for small errors, straight for large ones (Huber).
fn total_cost(views: &[View], places: &[Place]) -> f64 {
    let huber = |size: f64| if size > HUBER { HUBER * (2.0 * size - HUBER) } else { size * size };
    let of_place = |place: &Place| {
        let sights = place.sights.iter().map(|sight| {
            let p = views[sight.view].camera_from_world * place.world;
            // Behind the camera nothing is seen: as wrong as can be.
            let Some((seen, ..)) = projection(&p) else { return huber(1e6) };
            huber((sight.ray[0] - seen.x).hypot(sight.ray[1] - seen.y) / sight.sigma)
        });
        let depths = place.depths.iter().map(|depth| {
            let p = views[depth.view].camera_from_world * place.world;
            huber(depth.miss_mm(&p).0.abs() / depth.sigma_mm)
        });
        sights.chain(depths).sum::<f64>()
    };
    places.iter().map(of_place).sum()
}

/// One round. False where the equations could not be solved; nothing has changed then.
fn round(views: &mut [View], places: &mut [Place], damping: f64) -> bool {
    let free = free_indices(views);
    let NormalEquations { normal, right, eliminated } = NormalEquations::of(views, places, &free, damping);
    let delta = if right.is_empty() {
        right
    } else {
        let Some(solved) = normal.cholesky().map(|c| c.solve(&right)) else { return false };
        solved
    };
    if !delta.iter().all(|v| v.is_finite()) {
        return false;
    }
    for (place, part) in places.iter_mut().zip(&eliminated) {
        let Some(inverse) = part.inverse else { continue };
        let mut right = part.right;
        for (view, block) in &part.blocks {
            right -= block.transpose() * delta.fixed_rows::<6>(6 * view);
        }
        place.world += inverse * right;
        place.covariance = inverse;
    }
    for (view, index) in views.iter_mut().zip(&free) {
        if let Some(index) = index {
            let step: Vector6<f64> = delta.fixed_rows::<6>(6 * index).into();
            view.camera_from_world = moved(&view.camera_from_world, &step);
        }
    }
    true
}

/// For each view its number among the free ones.
fn free_indices(views: &[View]) -> Vec<Option<usize>> {
    let mut free = 0..;
    views.iter().map(|view| if view.free { free.next() } else { None }).collect()
}

/// What the free poses must fulfil, the landmarks taken out.
struct NormalEquations {
    normal: DMatrix<f64>,
    right: DVector<f64>,
    eliminated: Vec<Eliminated>,
}

impl NormalEquations {
    fn of(views: &[View], places: &[Place], free: &[Option<usize>], damping: f64) -> NormalEquations {
        let count = free.iter().flatten().count();
        let mut normal = DMatrix::<f64>::zeros(6 * count, 6 * count);
        let mut right = DVector::<f64>::zeros(6 * count);
        let mut eliminate = |place| Equations::of(place, views, free).eliminate(&mut normal, &mut right, damping);
        let eliminated = places.iter().map(&mut eliminate).collect();
        for i in 0..6 * count {
            normal[(i, i)] *= 1.0 + damping;
            normal[(i, i)] += 1e-9;
        }
        NormalEquations { normal, right, eliminated }
    }
}

/// One landmark's part of the normal equations.
struct Equations {
    own: Matrix3<f64>,
    right: Vector3<f64>,
    /// Per free view: its own block, its right side, and the block that couples it with the landmark.
    views: Vec<(usize, Matrix6<f64>, Vector6<f64>, Block)>,
}

struct Eliminated {
    inverse: Option<Matrix3<f64>>,
    right: Vector3<f64>,
    blocks: Vec<(usize, Block)>,
}

impl Equations {
    fn of(place: &Place, views: &[View], free: &[Option<usize>]) -> Equations {
        let mut equations = Equations { own: Matrix3::zeros(), right: Vector3::zeros(), views: Vec::new() };
        for sight in &place.sights {
            let pose = &views[sight.view].camera_from_world;
            let p = pose * place.world;
            let Some((seen, by_move, by_point)) = projection(&p) else { continue };
            let miss = [sight.ray[0] - seen.x, sight.ray[1] - seen.y];
            let size = (miss[0] * miss[0] + miss[1] * miss[1]).sqrt() / sight.sigma;
            let weight = robust(size) / (sight.sigma * sight.sigma);
            let rotation = pose.rotation.to_rotation_matrix();
            for (axis, miss) in miss.into_iter().enumerate() {
                let row = Vector3::from(by_point[axis]);
                let by_place = rotation.transpose() * row;
                equations.add(free[sight.view], &Vector6::from(by_move[axis]), &by_place, weight, miss);
            }
        }
        for depth in &place.depths {
            let pose = &views[depth.view].camera_from_world;
            let p = pose * place.world;
            let (miss, slope) = depth.miss_mm(&p);
            let weight = robust(miss.abs() / depth.sigma_mm) / (depth.sigma_mm * depth.sigma_mm);
            let d = slope * depth.direction;
            let turn = p.coords.cross(&d);
            let by_move = Vector6::new(turn.x, turn.y, turn.z, d.x, d.y, d.z);
            let by_place = pose.rotation.inverse() * d;
            equations.add(free[depth.view], &by_move, &by_place, weight, miss);
        }
        equations
    }

    fn add(&mut self, view: Option<usize>, by_move: &Vector6<f64>, by_place: &Vector3<f64>, weight: f64, miss: f64) {
        self.own += weight * by_place * by_place.transpose();
        self.right += weight * miss * by_place;
        let Some(view) = view else { return };
        let at = self.views.iter().position(|v| v.0 == view).unwrap_or_else(|| {
            self.views.push((view, Matrix6::zeros(), Vector6::zeros(), Block::zeros()));
            self.views.len() - 1
        });
        let (_, own, right, block) = &mut self.views[at];
        *own += weight * by_move * by_move.transpose();
        *right += weight * miss * by_move;
        *block += weight * by_move * by_place.transpose();
    }

    /// Adds what is left of the equations when the landmark is taken out.
    fn eliminate(self, normal: &mut DMatrix<f64>, right: &mut DVector<f64>, damping: f64) -> Eliminated {
        let mut own = self.own;
        (0..3).for_each(|i| own[(i, i)] *= 1.0 + damping);
        let inverse = own.try_inverse().filter(|m| m.iter().all(|v| v.is_finite()));
        let blocks: Vec<(usize, Block)> = self.views.iter().map(|v| (v.0, v.3)).collect();
        let Some(inverse) = inverse else {
            return Eliminated { inverse: None, right: self.right, blocks };
        };
        for (view, own, own_right, block) in &self.views {
            let scaled = block * inverse;
            let mut part = right.fixed_rows_mut::<6>(6 * view);
            part += own_right - scaled * self.right;
            let mut diagonal = normal.fixed_view_mut::<6, 6>(6 * view, 6 * view);
            diagonal += own;
            for (other, other_block) in &blocks {
                let mut cross = normal.fixed_view_mut::<6, 6>(6 * view, 6 * other);
                cross -= scaled * other_block.transpose();
            }
        }
        Eliminated { inverse: Some(inverse), right: self.right, blocks }
    }
}

/// Huber's weight.
fn robust(size: f64) -> f64 {
    if size > HUBER { HUBER / size } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bent_way_is_straightened_by_depths_and_sights() {
        let truth = |i: usize| Isometry3::translation(-40.0 * i as f64, 0.3 * i as f64, 0.0);
        let world: Vec<Point3<f64>> = (0..60)
            .map(|i| Point3::new(-150.0 + 9.0 * i as f64, (i * 37 % 200) as f64 - 100.0, 450.0 + (i % 7) as f64))
            .collect();
        let mut views: Vec<View> = (0..5)
            .map(|i| {
                let error = Vector6::new(0.002, -0.001, 0.001, 1.5, -1.0, 2.0) * if i == 0 { 0.0 } else { 1.0 };
                View { camera_from_world: moved(&truth(i), &error), free: i > 0 }
            })
            .collect();
        let mut places: Vec<Place> = world
            .iter()
            .enumerate()
            .map(|(n, p)| {
                let sights = (0..5).map(|view| {
                    let c = truth(view) * p;
                    PlaceSight { view, ray: [c.x / c.z, c.y / c.z], sigma: 1e-4 }
                });
                let depth = PlaceDepth {
                    guess: n % 3 != 0,
                    view: 2,
                    direction: Vector3::z(),
                    distance_mm: (truth(2) * p).z,
                    sigma_mm: if n % 3 == 0 { 0.1 } else { 30.0 },
                };
                Place {
                    world: p + Vector3::new(1.0, -2.0, 12.0),
                    sights: sights.collect(),
                    depths: vec![depth],
                    covariance: Matrix3::zeros(),
                }
            })
            .collect();
        adjust(&mut views, &mut places, 12);
        for (i, view) in views.iter().enumerate() {
            let off = (view.camera_from_world.translation.vector - truth(i).translation.vector).norm();
            assert!(off < 1e-3, "view {i}: {off} mm");
        }
        for (place, truth) in places.iter().zip(&world) {
            assert!((place.world - truth).norm() < 1e-3);
        }
    }
}
