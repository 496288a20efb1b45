//! Where each frame's pose comes from: the image, the track given with the source, or the one with the other's help.

use nalgebra::{Isometry3, Point3};

use super::Request;
use crate::error::Result;
use crate::geometry::WorldFromCamera;
use crate::motion::metric::{Drift, Motion, Odometry, SettledPose};
use crate::motion::track::{GivenPose, PoseTrack, TrackUse};
use crate::motion::{Shift, start_pose};
use crate::rig::Rig;
use crate::source::{Beside, Frame};
use crate::stripe::Stripe;
use crate::triangulation::Profile;

/// The poses of a run, frame by frame.
pub(super) struct Poses<'a> {
    rig: &'a Rig,
    track: Option<PoseTrack>,
    way: Way,
    given_before: Option<GivenPose>,
    pose_before: Option<Isometry3<f64>>,
    frames: u32,
    frames_given: u32,
}

enum Way {
    Image(Box<Odometry>),
    Track(Given),
}

impl<'a> Poses<'a> {
    /// Reads the track, where there is one; else the odometry that the source brought is the prior.
    pub(super) fn new(request: &'a Request, beside: &Beside) -> Result<Poses<'a>> {
        let (rig, recipe) = (&request.rig, &request.recipe);
        let read = |path| PoseTrack::read(path, rig.laser.line, recipe.limits.max_frames);
        let way = match request.track_use(beside) {
            Some(TrackUse::Instead) => Way::Track(Given { start: start_pose(rig.laser.line), ..Given::default() }),
            Some(TrackUse::Prior) | None => Way::Image(Box::new(Odometry::new(rig, &recipe.pose))),
        };
        let track = match request.poses.as_deref() {
            Some(path) => Some(read(path)?),
            None if beside.poses.is_empty() => None,
            None => Some(PoseTrack::from_times(beside.poses.iter().map(|pose| (pose.time_s, pose.world_from_camera)))),
        };
        Ok(Poses { rig, track, way, given_before: None, pose_before: None, frames: 0, frames_given: 0 })
    }

    /// The next frame's motion, and how far the image moved with it, px.
    pub(super) fn track(&mut self, frame: &Frame, stripe: &Stripe, profile: &Profile, width_px: f32) -> (Motion, f64) {
        let given = self.track.as_ref().and_then(|track| track.at(frame.index, frame.time_s));
        self.frames += 1;
        self.frames_given += u32::from(given.is_some());
        let motion = match &mut self.way {
            Way::Image(odometry) => {
                let both = self.given_before.zip(given);
                let moved = both.map(|(before, now)| now.world_from_camera.inverse() * before.world_from_camera);
                odometry.track(frame.index, frame.image.yuv(), stripe, profile, width_px, moved)
            }
            Way::Track(poses) => poses.track(frame.index, given),
        };
        let pose = motion.camera_from_world;
        let moved_px = match (motion.shift.dx_px, motion.shift.dy_px) {
            (Some(dx_px), Some(dy_px)) => dx_px.hypot(dy_px),
            _ => self.pose_before.zip(pose).map_or(0.0, |(before, now)| self.moved_px(&before, &now, profile)),
        };
        (self.given_before, self.pose_before) = (given, pose);
        (motion, moved_px)
    }

    /// How far the wall in the image's middle moved from one pose to the next, px.
    fn moved_px(&self, before: &Isometry3<f64>, now: &Isometry3<f64>, profile: &Profile) -> f64 {
        let Some(z_mm) = profile.median_z_mm() else { return 0.0 };
        let camera = &self.rig.camera;
        let middle = before * now.inverse() * Point3::new(0.0, 0.0, z_mm);
        if middle.z < 1.0 {
            return 0.0;
        }
        (camera.fx_px * middle.x / middle.z).hypot(camera.fy_px * middle.y / middle.z)
    }

    /// The run has ended: all poses are final.
    pub(super) fn finish(&mut self) {
        if let Way::Image(odometry) = &mut self.way {
            odometry.finish();
        }
    }

    /// The poses that are final since this was last asked, in the order of the frames.
    pub(super) fn take_settled(&mut self) -> Vec<SettledPose> {
        match &mut self.way {
            Way::Image(odometry) => odometry.take_settled(),
            Way::Track(poses) => std::mem::take(&mut poses.settled),
        }
    }

    /// How far the last pose may be off against the first one, where the image tells it.
    pub(super) fn drift(&self) -> Option<Drift> {
        match &self.way {
            Way::Image(odometry) => odometry.drift(),
            Way::Track(_) => None,
        }
    }

    /// What a person should know of the poses at the end.
    pub(super) fn warnings(&self) -> Vec<String> {
        let Some(track) = &self.track else { return Vec::new() };
        let (frames, without) = (self.frames, self.frames - self.frames_given);
        let reach = track.reach();
        match &self.way {
            _ if self.frames_given == 0 => {
                let count = "frames count from 0, times from the source's first frame";
                vec![format!("the given poses ({reach}) meet none of {frames} frames: {count}")]
            }
            Way::Track(_) if without > 0 => {
                vec![format!(
                    "the given poses ({reach}) leave out {without} of {frames} frames: these are not on the surface"
                )]
            }
            Way::Image(odometry) if odometry.carried_frames() > 0 => {
                let carried = odometry.carried_frames();
                vec![format!(
                    "the motion was lost in {carried} of {frames} frames: the given poses carried it on there"
                )]
            }
            _ => Vec::new(),
        }
    }
}

/// Poses as they are given. The world is the track's own, turned and shifted so that the first frame with a pose
/// has the start's ([`start_pose`]).
#[derive(Default)]
struct Given {
    start: Isometry3<f64>,
    world_from_track: Option<Isometry3<f64>>,
    settled: Vec<SettledPose>,
}

impl Given {
    fn track(&mut self, frame: u32, given: Option<GivenPose>) -> Motion {
        let pose: Option<WorldFromCamera> = given.map(|given| {
            let start = self.start;
            let first = || start.inverse() * given.world_from_camera.inverse();
            *self.world_from_track.get_or_insert_with(first) * given.world_from_camera
        });
        self.settled.push(SettledPose {
            frame,
            world_from_camera: pose,
            part: 0,
            degrees_of_freedom: given.map_or(0, |given| given.degrees_of_freedom),
        });
        Motion { camera_from_world: pose.map(|pose| pose.inverse()), shift: Shift::default() }
    }
}
