//! Frames wait until their key frames are settled; then their pose is final.

use nalgebra::Isometry3;

use super::super::pose::{self, Sight};
use super::{FEWEST_SIGHTS, HOLD_FIRM_RAD, HOLD_RAD, Odometry, SettledPose, Waiting, hold};

/// Landmarks out of view that are kept for a robot that comes back.
const DORMANT: usize = 300;

impl Odometry {
    pub(super) fn wait(
        &mut self,
        frame: u32,
        pose: Option<Isometry3<f64>>,
        sights: Vec<Sight>,
        degrees_of_freedom: u8,
    ) {
        let keyframe = self.next_keyframe;
        self.waiting.push_back(Waiting { frame, pose, sights, keyframe, part: self.part, degrees_of_freedom });
        if self.keyframes.is_empty() {
            self.settle_all_without_pose();
        }
    }

    /// Frames before the first key frame have no pose and never get one.
    pub(super) fn settle_all_without_pose(&mut self) {
        while self.waiting.front().is_some_and(|w| w.pose.is_none()) {
            if let Some(waiting) = self.waiting.pop_front() {
                self.settle(waiting);
            }
        }
    }

    pub(super) fn settle_all(&mut self) {
        while let Some(waiting) = self.waiting.pop_front() {
            self.settle(waiting);
        }
    }

    /// Frames whose following key frame is fixed are done.
    pub(super) fn settle_finished(&mut self) {
        let newest_fixed = self.keyframes.iter().rev().find(|k| k.fixed).map_or(0, |k| k.number);
        while self.waiting.front().is_some_and(|w| w.keyframe <= newest_fixed) {
            if let Some(waiting) = self.waiting.pop_front() {
                self.settle(waiting);
            }
        }
    }

    /// The pose once more, now that the landmarks are where they are.
    pub(super) fn settle(&mut self, waiting: Waiting) {
        let pose = waiting.pose.map(|pose| {
            let sights: Vec<Sight> = waiting
                .sights
                .iter()
                .filter_map(|s| {
                    let landmark = self.landmarks.get(&s.landmark)?;
                    Some(Sight { world: landmark.world, sigma: self.plain_sigma(s), ..*s })
                })
                .collect();
            if sights.len() < FEWEST_SIGHTS {
                return pose;
            }
            let held = if waiting.degrees_of_freedom == 6 { HOLD_RAD } else { HOLD_FIRM_RAD };
            pose::solve(&pose, &sights, hold(held)).map_or(pose, |solved| solved.camera_from_world)
        });
        self.settled.push(SettledPose {
            frame: waiting.frame,
            world_from_camera: pose.map(|p| p.inverse()),
            part: waiting.part,
            degrees_of_freedom: waiting.degrees_of_freedom,
        });
    }

    /// Drops landmarks that nothing needs any more.
    pub(super) fn prune(&mut self, frame: u32) {
        let oldest_waiting = self.waiting.front().map_or(frame, |w| w.frame);
        self.landmarks.retain(|_, l| l.last_frame >= oldest_waiting || (!l.dead && l.measured));
        let mut out_of_sight: Vec<(u32, u32)> = self
            .landmarks
            .iter()
            .filter(|(_, l)| l.last_frame < oldest_waiting)
            .map(|(id, l)| (l.last_frame, *id))
            .collect();
        out_of_sight.sort_unstable();
        for (_, id) in out_of_sight.iter().take(out_of_sight.len().saturating_sub(DORMANT)) {
            self.landmarks.remove(id);
        }
    }
}
