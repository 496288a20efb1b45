//! Frame by frame: predict, find the landmarks, solve the pose; at key frames choose landmarks and adjust.

mod choosing;
mod drift;
mod settling;

use std::collections::{BTreeMap, HashMap, VecDeque};

use nalgebra::{Isometry3, Point3, Vector3};

use drift::Added;
pub use drift::Drift;

use super::bundle::{self, Place, PlaceDepth, PlaceSight, View};
use super::landmark::{Landmark, Search};
use super::patch::Found;
use super::pose::{self, MEDIAN_MISFIT, Sight};
use super::view::FrameView;
use crate::geometry::{RawPixel, WorldFromCamera};
use crate::motion::similarity::{FEWEST_CORNERS, median, scale_and_residual};
use crate::motion::{Shift, TrackedCorner, start_pose};
use crate::recipe::PoseOptions;
use crate::rig::Rig;
use crate::source::Yuv;
use crate::stripe::Stripe;
use crate::triangulation::Profile;

/// Fewest landmarks that a pose is solved from.
const FEWEST_SIGHTS: usize = 10;
/// With less than this in a key frame, new landmarks are looked for soon.
const FEW_SIGHTS: usize = 50;
/// Fewest points of a profile that a run can begin with.
const FEWEST_POINTS: usize = 30;
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
/// Key frames at the start of a part that are this much closer together: nothing is known of most depths yet.
const EARLY_KEYFRAMES: usize = 4;
const EARLY_STEP: f64 = 0.2;
/// Least and greatest standard deviation of a found place, px.
const SIGMA_PX: (f64, f64) = (0.04, 1.0);
/// Largest factor between how well patches seem to be found and how well they are, and how fast it is learned.
const NOISE_RANGE: f64 = 12.0;
const NOISE_GAIN: f64 = 0.3;
/// Sights further off than this many standard deviations are wrong.
const OUTLIER: f64 = 5.0;
/// Frames in a row without a landmark that should be there, after which it is given up.
const MISSES: u32 = 4;
/// Landmarks out of view that are kept for a robot that comes back.
const DORMANT: usize = 300;
/// Standard deviation of the laser's depth at one line position, px of the stripe.
const STRIPE_SIGMA_PX: f64 = 0.12;
/// Line positions on each side whose median gives a landmark's depth.
const DEPTH_REACH: i64 = 2;
/// A depth known better than this share is one that neighbours may rely on.
const SURE_SHARE: f64 = 0.01;
/// Rounds of the adjustment at a key frame; more at the start, when little is known.
const ROUNDS: usize = 2;
const ROUNDS_AT_START: usize = 6;
/// Rotation that a pose is kept from where the landmarks do not tell it, radians and mm of one standard deviation.
const HOLD_RAD: f64 = 0.05;
const HOLD_MM: f64 = 50.0;
/// Where the landmarks tell a rotation worse than this, radians, it is held as predicted: three degrees of freedom.
const ROTATION_SIGMA_RAD: f64 = 0.004;
const HOLD_FIRM_RAD: f64 = 1e-4;

/// Where landmarks are in an image, raw px.
type Places = HashMap<u32, (f64, f64)>;

/// What a frame's motion is at once; its pose may still be adjusted.
#[derive(Clone, Debug)]
pub struct Motion {
    /// The pose as far as it is known now; `None` where the frame could not be placed.
    pub camera_from_world: Option<Isometry3<f64>>,
    /// The image's motion since the frame before.
    pub shift: Shift,
}

/// A frame's pose, final.
#[derive(Clone, Debug, PartialEq)]
pub struct SettledPose {
    /// The frame's index.
    pub frame: u32,
    /// Where the camera was; `None` where the motion was lost or not yet known.
    pub world_from_camera: Option<WorldFromCamera>,
    /// Part of the way without a break that the frame belongs to, from 0; a surface is not joined across parts.
    pub part: u32,
    /// 6, or 3 where the scene did not tell the rotation, or 0 where a given motion carried the pose on.
    pub degrees_of_freedom: u8,
}

/// Finds the poses of a run.
pub struct Odometry {
    rig: Rig,
    options: PoseOptions,
    landmarks: BTreeMap<u32, Landmark>,
    next_landmark: u32,
    keyframes: VecDeque<Keyframe>,
    next_keyframe: u32,
    waiting: VecDeque<Waiting>,
    settled: Vec<SettledPose>,
    last: Option<Last>,
    lost: u32,
    /// Whether the given motion has carried the pose on in every frame since the image's was lost.
    carried: bool,
    carried_frames: u32,
    part: u32,
    /// How much worse patches are found than they seem to be.
    noise: f64,
    /// What the poses are open by; `None` before the first, and where a part of the way was not measured.
    added: Option<Added>,
}

/// The frame before.
struct Last {
    pose: Isometry3<f64>,
    /// Move of the camera's frame from the frame before that.
    velocity: Isometry3<f64>,
    places: HashMap<u32, (f32, f32)>,
    profile: Vec<Option<Point3<f64>>>,
    since_keyframe_px: f64,
    tracked_at_keyframe: usize,
}

struct Keyframe {
    number: u32,
    camera_from_world: Isometry3<f64>,
    fixed: bool,
}

/// A frame whose pose is not settled.
struct Waiting {
    frame: u32,
    pose: Option<Isometry3<f64>>,
    sights: Vec<Sight>,
    /// The first key frame at or after it.
    keyframe: u32,
    part: u32,
    degrees_of_freedom: u8,
}

impl Odometry {
    /// An odometry at the start of a run.
    pub fn new(rig: &Rig, options: &PoseOptions) -> Odometry {
        Odometry {
            rig: rig.clone(),
            options: options.clone(),
            landmarks: BTreeMap::new(),
            next_landmark: 0,
            keyframes: VecDeque::new(),
            next_keyframe: 0,
            waiting: VecDeque::new(),
            settled: Vec::new(),
            last: None,
            lost: 0,
            carried: false,
            carried_frames: 0,
            part: 0,
            noise: 1.0,
            added: None,
        }
    }

    /// Takes the next frame with its stripe (`line_width_px` wide at half its height) and profile.
    ///
    /// `given` is the motion since the frame before as something else knows it, `camera_now_from_camera_before`: the
    /// landmarks are looked for where it puts them, and it carries the pose on while they are lost.
    pub fn track(
        &mut self,
        frame: u32,
        image: Yuv<'_>,
        stripe: &Stripe,
        profile: &Profile,
        line_width_px: f32,
        given: Option<Isometry3<f64>>,
    ) -> Motion {
        let view = FrameView::new(frame, image, stripe, line_width_px);
        let rows = dense(profile, stripe.across_px.len());
        let Some(last) = self.last.take() else {
            return self.begin(&view, profile, rows, start_pose(self.rig.laser.line));
        };
        match self.follow(&view, &last, given) {
            Some(followed) => {
                self.lost = 0;
                self.advance(&view, profile, rows, last, followed)
            }
            None => self.miss(&view, profile, rows, last, given),
        }
    }

    /// The poses that are final since this was last asked, in the order of the frames.
    pub fn take_settled(&mut self) -> Vec<SettledPose> {
        std::mem::take(&mut self.settled)
    }

    /// The run has ended: all poses are final.
    pub fn finish(&mut self) {
        self.adjust(ROUNDS);
        self.add_drift(1);
        while let Some(waiting) = self.waiting.pop_front() {
            self.settle(waiting);
        }
    }

    /// How far the last pose may be off against the first one, once the run has ended; `None` where the way was broken, or
    /// carried on by a given motion, and where the camera hardly moved: nothing is known of the errors there.
    pub fn drift(&self) -> Option<Drift> {
        let whole = self.part == 0 && self.carried_frames == 0;
        self.added.as_ref().filter(|_| whole).and_then(Added::drift)
    }

    /// Frames, so far, whose image's motion was lost and whose pose the given motion carried on.
    pub fn carried_frames(&self) -> u32 {
        self.carried_frames
    }

    /// The first frame of a part: nothing to follow yet.
    fn begin(
        &mut self,
        view: &FrameView<'_>,
        profile: &Profile,
        rows: Vec<Option<Point3<f64>>>,
        pose: Isometry3<f64>,
    ) -> Motion {
        if profile.points.len() < FEWEST_POINTS {
            // Without a depth there is no measure: the run begins with the first line.
            self.wait(view.frame, None, Vec::new(), 6);
            return Motion { camera_from_world: None, shift: Shift::default() };
        }
        self.wait(view.frame, Some(pose), Vec::new(), 6);
        self.keyframes.push_back(Keyframe { number: self.next_keyframe, camera_from_world: pose, fixed: true });
        self.added = Some(Added::from(self.next_keyframe, pose));
        self.next_keyframe += 1;
        self.choose_landmarks(view, profile, &pose);
        let places = self.alive_places(&pose);
        self.last = Some(Last {
            pose,
            velocity: Isometry3::identity(),
            tracked_at_keyframe: places.len(),
            places,
            profile: rows,
            since_keyframe_px: 0.0,
        });
        Motion { camera_from_world: Some(pose), shift: Shift::default() }
    }

    /// Lost: wait for the wall to come back; after a while take the way to be broken and begin anew where it was lost.
    /// Where the given motion carries the pose on, the way is not broken.
    fn miss(
        &mut self,
        view: &FrameView<'_>,
        profile: &Profile,
        rows: Vec<Option<Point3<f64>>>,
        mut last: Last,
        given: Option<Isometry3<f64>>,
    ) -> Motion {
        self.lost += 1;
        self.carried = given.is_some() && (self.carried || self.lost == 1);
        self.carried_frames += u32::from(self.carried);
        last.pose = given.map_or(last.pose, |moved| moved * last.pose);
        // At the very start of a part nothing is lost with it.
        let lost_max = if self.keyframes.len() < 2 { 0 } else { self.options.lost_max };
        if self.lost > lost_max && profile.points.len() >= FEWEST_POINTS {
            self.lost = 0;
            self.part += u32::from(!self.carried);
            let pose = last.pose;
            self.adjust(ROUNDS);
            self.settle_all();
            self.landmarks.clear();
            self.keyframes.clear();
            return self.begin(view, profile, rows, pose);
        }
        let pose = self.carried.then_some(last.pose);
        self.wait(view.frame, pose, Vec::new(), 0);
        last.velocity = given.unwrap_or_default();
        last.places.clear();
        last.profile.clear();
        self.landmarks.values_mut().for_each(|landmark| landmark.from_line_px = None);
        self.last = Some(last);
        Motion { camera_from_world: pose, shift: Shift::default() }
    }

    fn advance(
        &mut self,
        view: &FrameView<'_>,
        profile: &Profile,
        rows: Vec<Option<Point3<f64>>>,
        last: Last,
        followed: Followed,
    ) -> Motion {
        let pose = followed.pose;
        let shift = shift_between(&last.places, &followed.places);
        self.cross_line(view, &pose, &rows, &last);
        let moved_px = shift.dx_px.unwrap_or(0.0).hypot(shift.dy_px.unwrap_or(0.0));
        let tracked = followed.sights.len();
        let mut last = Last {
            pose,
            velocity: pose * last.pose.inverse(),
            places: followed.places,
            profile: rows,
            since_keyframe_px: last.since_keyframe_px + moved_px,
            tracked_at_keyframe: last.tracked_at_keyframe,
        };
        let early = self.keyframes.len() < EARLY_KEYFRAMES;
        let share = self.options.keyframe_share * if early { EARLY_STEP } else { 1.0 };
        let step_px = share * f64::from(self.rig.camera.width_px);
        let is_keyframe = last.since_keyframe_px >= step_px || (tracked as f64) < 0.6 * last.tracked_at_keyframe as f64;
        self.wait(view.frame, Some(pose), followed.sights.clone(), followed.degrees_of_freedom);
        if is_keyframe {
            self.add_keyframe(pose, &followed.sights);
            let first = self.next_keyframe <= 2 * self.options.window;
            self.adjust(if first { ROUNDS_AT_START } else { ROUNDS });
            self.add_drift(self.options.window);
            let adjusted = self.keyframes.back().map_or(pose, |k| k.camera_from_world);
            last.pose = adjusted;
            self.choose_landmarks(view, profile, &adjusted);
            self.settle_finished();
            last.since_keyframe_px = 0.0;
            last.tracked_at_keyframe = tracked.max(FEW_SIGHTS);
            self.prune(view.frame);
        }
        while self.waiting.len() > self.options.waiting_max as usize {
            if let Some(waiting) = self.waiting.pop_front() {
                self.settle(waiting);
            }
        }
        let camera_from_world = Some(last.pose);
        self.last = Some(last);
        Motion { camera_from_world, shift }
    }
}

/// A frame whose landmarks were found.
struct Followed {
    pose: Isometry3<f64>,
    sights: Vec<Sight>,
    places: HashMap<u32, (f32, f32)>,
    degrees_of_freedom: u8,
}

impl Odometry {
    /// Finds the landmarks near where the last motion puts them; where that fails, in the shrunk image first.
    fn follow(&mut self, view: &FrameView<'_>, last: &Last, given: Option<Isometry3<f64>>) -> Option<Followed> {
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

    /// Landmarks that the line passed over since the last frame get their depth from it.
    fn cross_line(&mut self, view: &FrameView<'_>, pose: &Isometry3<f64>, rows: &[Option<Point3<f64>>], last: &Last) {
        let Some(keyframe) = self.keyframes.back() else { return };
        let from_keyframe = pose * keyframe.camera_from_world.inverse();
        let before_to_now = pose * last.pose.inverse();
        let number = keyframe.number;
        for landmark in self.landmarks.values_mut().filter(|l| !l.dead) {
            let at = landmark.seen_at(&self.rig.camera, pose);
            let now_px = at.and_then(|at| view.line.distance_px(at));
            let before_px = std::mem::replace(&mut landmark.from_line_px, now_px);
            let (Some(at), Some(now_px), Some(before_px)) = (at, now_px, before_px) else { continue };
            let jump_px = now_px - before_px;
            if now_px.signum() == before_px.signum() || jump_px.abs() > 0.2 * f64::from(self.rig.camera.width_px) {
                continue;
            }
            let (along, _) = view.line.axes(at);
            let (Some(now), Some(before)) = (nearby(rows, along), nearby(&last.profile, along)) else { continue };
            let before = before_to_now * before;
            let share = before_px / (before_px - now_px);
            let z_mm = before.z + share * (now.z - before.z);
            // An edge between the two profiles: the place could be on either side.
            if (now.z - before.z).abs() > 0.02 * z_mm {
                continue;
            }
            let rotation = from_keyframe.rotation.inverse();
            let depth = PlaceDepth {
                guess: false,
                view: 0,
                direction: rotation * Vector3::z(),
                distance_mm: z_mm - from_keyframe.translation.z,
                sigma_mm: STRIPE_SIGMA_PX * self.rig.depth_step_mm(z_mm),
            };
            landmark.depths.retain(|(_, d)| d.sigma_mm < 0.01 * z_mm);
            landmark.depths.push((number, depth));
            landmark.measured = true;
        }
    }

    fn add_keyframe(&mut self, pose: Isometry3<f64>, sights: &[Sight]) {
        let number = self.next_keyframe;
        self.next_keyframe += 1;
        self.keyframes.push_back(Keyframe { number, camera_from_world: pose, fixed: false });
        for sight in sights {
            let sigma = self.plain_sigma(sight);
            if let Some(landmark) = self.landmarks.get_mut(&sight.landmark) {
                landmark.sights.push((number, PlaceSight { view: 0, ray: sight.ray, sigma }));
            }
        }
        let keep = 2 * self.options.window as usize;
        while self.keyframes.len() > keep {
            self.keyframes.pop_front();
        }
        let oldest = self.keyframes.front().map_or(0, |k| k.number);
        for landmark in self.landmarks.values_mut() {
            landmark.sights.retain(|(n, _)| *n >= oldest);
            // A depth is worth keeping: it is carried on by the place itself once its key frame is gone.
            landmark.depths.retain(|(n, _)| *n >= oldest);
        }
        let free = self.options.window as usize;
        let count = self.keyframes.len();
        for keyframe in self.keyframes.iter_mut().take(count.saturating_sub(free)) {
            keyframe.fixed = true;
        }
    }

    /// A sight's own error, without that of the place.
    fn plain_sigma(&self, sight: &Sight) -> f64 {
        sight.sigma.clamp(SIGMA_PX.0 / self.rig.camera.fx_px, self.noise * 0.15 / self.rig.camera.fx_px)
    }

    /// The free key frames and what ties them, for the adjustment; and whose places the latter are.
    fn window(&self) -> (Vec<View>, Vec<Place>, Vec<u32>) {
        let oldest = self.keyframes.front().map_or(0, |k| k.number);
        let index = |number: u32| (number - oldest) as usize;
        let views: Vec<View> =
            self.keyframes.iter().map(|k| View { camera_from_world: k.camera_from_world, free: !k.fixed }).collect();
        let newest_fixed = self.keyframes.iter().rev().find(|k| k.fixed).map_or(0, |k| k.number);
        let (mut ids, mut places) = (Vec::new(), Vec::new());
        for (id, landmark) in self.landmarks.iter().filter(|(_, l)| !l.dead) {
            // What no free key frame saw cannot change.
            let recent = landmark.sights.last().is_some_and(|(n, _)| *n > newest_fixed);
            if !recent || landmark.sights.len() + landmark.depths.len() < 2 {
                continue;
            }
            ids.push(*id);
            places.push(Place {
                world: landmark.world,
                sights: landmark.sights.iter().map(|(n, s)| PlaceSight { view: index(*n), ..*s }).collect(),
                depths: landmark.depths.iter().map(|(n, d)| PlaceDepth { view: index(*n), ..*d }).collect(),
                covariance: landmark.covariance,
            });
        }
        (views, places, ids)
    }

    fn adjust(&mut self, rounds: usize) {
        let (mut views, mut places, ids) = self.window();
        bundle::adjust(&mut views, &mut places, rounds);
        for (keyframe, view) in self.keyframes.iter_mut().zip(views) {
            keyframe.camera_from_world = view.camera_from_world;
        }
        for (id, place) in ids.into_iter().zip(places) {
            if let Some(landmark) = self.landmarks.get_mut(&id) {
                landmark.world = place.world;
                landmark.covariance = place.covariance;
            }
        }
    }

    /// Adds up what the newest key frame is open by, `window` key frames after it was last added or later.
    fn add_drift(&mut self, window: u32) {
        let (Some(newest), Some(added)) = (self.keyframes.back(), &self.added) else { return };
        if !added.is_due(newest.number, window) {
            return;
        }
        let (number, pose) = (newest.number, newest.camera_from_world);
        let (views, places, _) = self.window();
        let own = bundle::last_covariance(&views, &places);
        self.added = self.added.take().zip(own).map(|(mut added, own)| {
            added.add(number, &pose, &own);
            added
        });
    }

    fn alive_places(&self, pose: &Isometry3<f64>) -> HashMap<u32, (f32, f32)> {
        let place = |landmark: &Landmark| landmark.seen_at(&self.rig.camera, pose);
        let alive = self.landmarks.iter().filter(|(_, l)| !l.dead);
        alive.filter_map(|(id, l)| place(l).map(|(x, y)| (*id, (x as f32, y as f32)))).collect()
    }
}

/// A search in the full image around a place.
fn search(at: (f64, f64), near: (f64, f64)) -> Search {
    Search { at, near, largest_px: NEAR_PX, least_likeness: LEAST_LIKENESS }
}

/// Information that keeps a pose near its start.
fn hold(rotation_rad: f64) -> [f64; 2] {
    [1.0 / (rotation_rad * rotation_rad), 1.0 / (HOLD_MM * HOLD_MM)]
}

/// Largest standard deviation of the rotation, radians.
fn rotation_sigma(information: &nalgebra::Matrix6<f64>) -> f64 {
    let Some(covariance) = information.try_inverse() else { return f64::MAX };
    (0..3).map(|i| covariance[(i, i)].max(0.0).sqrt()).fold(0.0, f64::max)
}

/// The image's motion from the landmarks that both frames saw.
fn shift_between(before: &HashMap<u32, (f32, f32)>, now: &HashMap<u32, (f32, f32)>) -> Shift {
    let mut ids: Vec<u32> = now.keys().copied().filter(|id| before.contains_key(id)).collect();
    ids.sort_unstable();
    let corners: Vec<TrackedCorner> = ids
        .iter()
        .map(|id| TrackedCorner { from_px: [before[id].0, before[id].1], to_px: [now[id].0, now[id].1] })
        .collect();
    if corners.len() < FEWEST_CORNERS {
        return Shift { corners, ..Shift::default() };
    }
    let along = |axis: usize| {
        let mut values: Vec<f64> =
            corners.iter().map(|c| f64::from(c.to_px[axis]) - f64::from(c.from_px[axis])).collect();
        median(&mut values)
    };
    let (dx, dy) = (along(0), along(1));
    let (scale, residual_px) = scale_and_residual(&corners);
    Shift { dx_px: Some(dx), dy_px: Some(dy), scale, residual_px: Some(residual_px), corners }
}

/// The profile with a place for each line position.
fn dense(profile: &Profile, positions: usize) -> Vec<Option<Point3<f64>>> {
    let mut rows = vec![None; positions];
    for point in &profile.points {
        if let Some(row) = rows.get_mut(point.line_position as usize) {
            *row = Some(point.point_in_camera);
        }
    }
    rows
}

/// The point of middle depth around a line position.
fn nearby(rows: &[Option<Point3<f64>>], along: f64) -> Option<Point3<f64>> {
    let at = along.round() as i64;
    let mut near: Vec<Point3<f64>> = (at - DEPTH_REACH..=at + DEPTH_REACH)
        .filter_map(|i| usize::try_from(i).ok().and_then(|i| rows.get(i).copied().flatten()))
        .collect();
    near.sort_by(|a, b| a.z.total_cmp(&b.z));
    (near.len() >= 3).then(|| near[near.len() / 2])
}
