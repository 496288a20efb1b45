//! Finds a frame's landmarks and solves its pose.

use std::collections::HashMap;

use nalgebra::{Isometry3, Vector3};

use super::super::landmark::Search;
use super::super::patch::Found;
use super::super::pose::{self, MEDIAN_MISFIT, Sight};
use super::super::view::FrameView;
use super::{EARLY_KEYFRAMES, FEWEST_SIGHTS, HOLD_FIRM_RAD, HOLD_RAD, Last, Odometry, SIGMA_PX, hold};
use crate::geometry::RawPixel;
use crate::motion::similarity::median;

/// How far from the predicted place a patch is looked for, px of the full image.
const NEAR_PX: f32 = 5.0;
/// The same in the shrunk image, px of that.
const NEAR_SMALL_PX: f32 = 14.0;
/// Landmarks that a large shift of the whole image is looked for with, how far, as a share of the image's width, and
/// how well most of them must agree, px of the full image.
const SHIFT_PROBES: usize = 16;
const SHIFT_SHARE: f32 = 0.06;
const SHIFT_AGREES_PX: f64 = 16.0;
/// Landmarks that are tried first: when most are where they should be, the prediction is good.
const PROBES: usize = 14;
/// Share of the probes that must be found.
const PROBES_FOUND: f64 = 0.6;
/// Least likeness of a patch that is believed; in the shrunk image.
const LEAST_LIKENESS: f32 = 0.5;
const LEAST_LIKENESS_SMALL: f32 = 0.4;
/// Standard deviation of a place found in the shrunk image, px of the full one.
const COARSE_SIGMA_PX: f64 = 1.5;
/// Share of the landmarks in view that must be found in the full image; else the shrunk one helps, which is less noisy.
const FOUND_SHARE: f64 = 0.5;
/// Largest factor between how well patches seem to be found and how well they are, and how fast it is learned.
const NOISE_RANGE: f64 = 12.0;
const NOISE_GAIN: f64 = 0.3;
/// Sights further off than this many standard deviations are wrong.
const OUTLIER: f64 = 5.0;
/// Frames in a row without a landmark that should be there, after which it is given up.
const MISSES: u32 = 4;
/// Where the landmarks tell a rotation worse than this, radians, it is held as predicted: three degrees of freedom.
const ROTATION_SIGMA_RAD: f64 = 0.004;

/// Where landmarks are in an image, raw px.
type Places = HashMap<u32, (f64, f64)>;

/// A frame whose landmarks were found.
pub(super) struct Followed {
    pub pose: Isometry3<f64>,
    pub sights: Vec<Sight>,
    pub places: HashMap<u32, (f32, f32)>,
    pub degrees_of_freedom: u8,
}

impl Odometry {
    /// Finds the landmarks near where the last motion puts them; where that fails, in the shrunk image first.
    pub(super) fn follow(
        &mut self,
        view: &FrameView<'_>,
        last: &Last,
        given: Option<Isometry3<f64>>,
    ) -> Option<Followed> {
        let steady = last.velocity * last.pose;
        let predicted = given.map_or(steady, |moved| moved * last.pose);
        if self.probe(view, &predicted)
            && let Some(followed) = self.solve_frame(view, &predicted, &HashMap::new())
        {
            return Some(followed);
        }
        [Some(predicted), given.map(|_| steady), Some(last.pose)].iter().flatten().find_map(|start| {
            let (coarse, places) = self.coarse_pose(view, start)?;
            self.solve_frame(view, &coarse, &places)
        })
    }

    /// Landmarks in view and off the line, with where they should be.
    fn visible(&self, view: &FrameView<'_>, pose: &Isometry3<f64>) -> Vec<(u32, (f64, f64))> {
        let inside = |at: &(f64, f64)| view.gray.holds(at.0 as f32, at.1 as f32, 10.0) && !view.line.covers(*at);
        let alive = self.landmarks.iter().filter(|(_, landmark)| !landmark.dead);
        alive
            .filter_map(|(id, landmark)| Some((*id, landmark.seen_at(&self.rig.camera, pose)?)))
            .filter(|(_, at)| inside(at))
            .collect()
    }

    fn probe(&mut self, view: &FrameView<'_>, pose: &Isometry3<f64>) -> bool {
        let visible = self.visible(view, pose);
        let step = visible.len().div_ceil(PROBES).max(1);
        let probes: Vec<_> = visible.into_iter().step_by(step).collect();
        let found = probes.iter().filter(|(id, at)| {
            let Some(landmark) = self.landmarks.get_mut(id) else { return false };
            landmark.find(view.gray, &self.rig.camera, pose, &search(*at, *at)).is_some()
        });
        found.count() as f64 >= PROBES_FOUND * probes.len() as f64
    }

    /// A pose from the shrunk image, and where in the full one it shows each landmark, both good to about a pixel.
    fn coarse_pose(&self, view: &FrameView<'_>, start: &Isometry3<f64>) -> Option<(Isometry3<f64>, Places)> {
        let small = view.small();
        let visible = self.visible(view, start);
        let shift = self.large_shift(view, &visible);
        let found: Vec<(u32, (f64, f64), [f64; 2])> = visible
            .into_iter()
            .filter_map(|(id, at)| {
                let near = (at.0 + shift[0], at.1 + shift[1]);
                let found = self.landmarks.get(&id)?.find_small(small, near, NEAR_SMALL_PX)?;
                let off = [f64::from(found.x) - at.0, f64::from(found.y) - at.1];
                (found.likeness >= LEAST_LIKENESS_SMALL).then_some((id, at, off))
            })
            .collect();
        if found.len() < FEWEST_SIGHTS {
            return None;
        }
        let places: Places = found.iter().map(|(id, at, off)| (*id, (at.0 + off[0], at.1 + off[1]))).collect();
        let sights: Vec<Sight> =
            found.iter().filter_map(|(id, ..)| self.sight(*id, places[id], COARSE_SIGMA_PX, start)).collect();
        let pose = pose::solve(start, &sights, hold(HOLD_RAD))?.camera_from_world;
        Some((pose, places))
    }

    /// The shift of most of the image from where the landmarks should be, px, from a wide search in the shrunk image; none
    /// where they do not agree.
    fn large_shift(&self, view: &FrameView<'_>, visible: &[(u32, (f64, f64))]) -> [f64; 2] {
        let step = visible.len().div_ceil(SHIFT_PROBES).max(1);
        let reach = SHIFT_SHARE * view.small().width as f32;
        let shifts: Vec<[f64; 2]> = visible
            .iter()
            .step_by(step)
            .filter_map(|(id, at)| self.landmarks.get(id)?.search_small(view.small(), *at, reach))
            .filter(|(_, likeness)| *likeness >= LEAST_LIKENESS_SMALL)
            .map(|(off, _)| off)
            .collect();
        if shifts.is_empty() {
            return [0.0; 2];
        }
        let middle = |axis: usize| median(&mut shifts.iter().map(|off| off[axis]).collect::<Vec<_>>());
        let shift = [middle(0), middle(1)];
        let near = |off: &&[f64; 2]| (off[0] - shift[0]).hypot(off[1] - shift[1]) < SHIFT_AGREES_PX;
        let agreed = 2 * shifts.iter().filter(near).count() >= shifts.len();
        // A small one is found without help, and nearer places may shift more than farther ones.
        if agreed && shift[0].hypot(shift[1]) > SHIFT_AGREES_PX { shift } else { [0.0; 2] }
    }

    fn sight(&self, id: u32, at: (f64, f64), sigma_px: f64, pose: &Isometry3<f64>) -> Option<Sight> {
        let landmark = self.landmarks.get(&id)?;
        let camera = &self.rig.camera;
        let ray = camera.undistort(RawPixel { u_px: at.0, v_px: at.1 });
        // What is not known of the place itself counts as an error of its sight.
        let p = pose * landmark.world;
        let (_, _, by_point) = pose::projection(&p)?;
        let rotation = pose.rotation.to_rotation_matrix();
        let covariance = rotation.matrix() * landmark.covariance * rotation.matrix().transpose();
        let own: f64 = by_point.iter().map(|row| Vector3::from(*row)).map(|row| row.dot(&(covariance * row))).sum();
        let sigma = self.noise * sigma_px / camera.fx_px;
        Some(Sight {
            landmark: id,
            world: landmark.world,
            ray: [ray.x, ray.y],
            sigma: (sigma * sigma + own / 2.0).sqrt(),
        })
    }

    /// Finds the landmarks near where the pose puts them, or where `places` says, and solves the pose.
    fn solve_frame(&mut self, view: &FrameView<'_>, start: &Isometry3<f64>, places: &Places) -> Option<Followed> {
        let visible = self.visible(view, start);
        let (mut sights, mut seen) = (Vec::new(), Vec::new());
        let mut found: Vec<(u32, Option<Found>)> = Vec::with_capacity(visible.len());
        for (id, at) in &visible {
            let camera = &self.rig.camera;
            let Some(landmark) = self.landmarks.get_mut(id) else { continue };
            let near = places.get(id).copied().unwrap_or(*at);
            found.push((*id, landmark.find(view.gray, camera, start, &search(*at, near))));
        }
        if (found.iter().filter(|(_, f)| f.is_some()).count() as f64) < FOUND_SHARE * found.len() as f64 {
            for ((id, place), (_, at)) in found.iter_mut().zip(&visible).filter(|((_, place), _)| place.is_none()) {
                let near = places.get(id).copied().unwrap_or(*at);
                let coarse = self.landmarks.get(id).and_then(|l| l.find_small(view.small(), near, NEAR_PX));
                *place = coarse.filter(|f| f.likeness >= LEAST_LIKENESS_SMALL);
            }
        }
        for (id, found) in found {
            let Some(landmark) = self.landmarks.get_mut(&id) else { continue };
            let Some(found) = found else {
                landmark.misses += 1;
                landmark.dead = landmark.misses > MISSES;
                continue;
            };
            let sigma_px = f64::from(found.sigma).clamp(SIGMA_PX.0, SIGMA_PX.1);
            if let Some(sight) = self.sight(id, (f64::from(found.x), f64::from(found.y)), sigma_px, start) {
                sights.push(sight);
                seen.push((found.x, found.y));
            }
        }
        if sights.len() < FEWEST_SIGHTS {
            return None;
        }
        let mut solved = pose::solve(start, &sights, hold(HOLD_RAD))?;
        let mut degrees_of_freedom = 6;
        if self.keyframes.len() > EARLY_KEYFRAMES && rotation_sigma(&solved.information) > ROTATION_SIGMA_RAD {
            degrees_of_freedom = 3;
            solved = pose::solve(start, &sights, hold(HOLD_FIRM_RAD))?;
        }
        let pose = solved.camera_from_world;
        // In a noisy image patches are found worse than they seem to be: the sights themselves tell by how much.
        let misfits: Vec<f64> = sights.iter().map(|sight| pose::misfit(&pose, sight)).collect();
        let noise = (median(&mut misfits.clone()) / MEDIAN_MISFIT).clamp(1.0 / NOISE_RANGE, NOISE_RANGE);
        let outlier = OUTLIER * noise.max(1.0);
        self.noise = (self.noise * noise.powf(NOISE_GAIN)).clamp(1.0, NOISE_RANGE);
        let (mut good, mut places) = (Vec::new(), HashMap::new());
        for ((sight, at), misfit) in sights.into_iter().zip(seen).zip(misfits) {
            let Some(landmark) = self.landmarks.get_mut(&sight.landmark) else { continue };
            if misfit > outlier {
                landmark.misses += 1;
                landmark.dead = landmark.misses > MISSES;
                continue;
            }
            landmark.misses = 0;
            landmark.last_frame = view.frame;
            landmark.remember(view.gray, at);
            places.insert(sight.landmark, at);
            good.push(sight);
        }
        (good.len() >= FEWEST_SIGHTS).then_some(Followed { pose, sights: good, places, degrees_of_freedom })
    }
}

/// A search in the full image around a place.
fn search(at: (f64, f64), near: (f64, f64)) -> Search {
    Search { at, near, largest_px: NEAR_PX, least_likeness: LEAST_LIKENESS }
}

/// Largest standard deviation of the rotation, radians.
fn rotation_sigma(information: &nalgebra::Matrix6<f64>) -> f64 {
    let Some(covariance) = information.try_inverse() else { return f64::MAX };
    (0..3).map(|i| covariance[(i, i)].max(0.0).sqrt()).fold(0.0, f64::max)
}
