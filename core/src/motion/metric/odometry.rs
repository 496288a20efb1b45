//! Frame by frame: predict, find the landmarks, solve the pose; at key frames choose landmarks and adjust.

mod choosing;
mod drift;
mod following;
mod settling;
mod window;

use std::collections::{BTreeMap, HashMap, VecDeque};

use nalgebra::{Isometry3, Point3, Vector3};

use drift::Added;
pub use drift::Drift;
use following::Followed;
use window::Keyframe;

use super::bundle::PlaceDepth;
use super::landmark::Landmark;
use super::pose::Sight;
use super::view::FrameView;
use crate::geometry::WorldFromCamera;
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
/// Key frames at the start of a part that are this much closer together: nothing is known of most depths yet.
const EARLY_KEYFRAMES: usize = 4;
const EARLY_STEP: f64 = 0.2;
/// Least and greatest standard deviation of a found place, px.
const SIGMA_PX: (f64, f64) = (0.04, 1.0);
/// Standard deviation of the laser's depth at one line position, px of the stripe.
const STRIPE_SIGMA_PX: f64 = 0.12;
/// Line positions on each side whose median gives a landmark's depth.
const DEPTH_REACH: i64 = 2;
/// Rounds of the adjustment at a key frame; more at the start, when little is known.
const ROUNDS: usize = 2;
const ROUNDS_AT_START: usize = 6;
/// Rotation that a pose is kept from where the landmarks do not tell it, radians and mm of one standard deviation.
const HOLD_RAD: f64 = 0.05;
const HOLD_MM: f64 = 50.0;
/// The same where the rotation is held as predicted.
const HOLD_FIRM_RAD: f64 = 1e-4;

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

    fn alive_places(&self, pose: &Isometry3<f64>) -> HashMap<u32, (f32, f32)> {
        let place = |landmark: &Landmark| landmark.seen_at(&self.rig.camera, pose);
        let alive = self.landmarks.iter().filter(|(_, l)| !l.dead);
        alive.filter_map(|(id, l)| place(l).map(|(x, y)| (*id, (x as f32, y as f32)))).collect()
    }
}

/// Information that keeps a pose near its start.
fn hold(rotation_rad: f64) -> [f64; 2] {
    [1.0 / (rotation_rad * rotation_rad), 1.0 / (HOLD_MM * HOLD_MM)]
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
