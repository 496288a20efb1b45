//! Frames whose wall no earlier frame shows without the laser, as the first ones of a run: they are measured again once a
//! later frame shows it.

use std::collections::VecDeque;

use super::recent::Recent;
use crate::geometry::WorldFromCamera;
use crate::rig::Rig;
use crate::stripe::Stripe;
use crate::stripe::metric::{Seen, StripeMeasurer};
use crate::triangulation::{Profile, triangulate};

/// Frames that wait, at most: each keeps its light, a third of a megabyte.
const MAX_FRAMES: usize = 32;
/// Frames after which one no longer waits.
const MAX_WAIT: u32 = 64;

/// A frame that may be measured better.
pub(super) struct Late {
    pub frame: u32,
    pub seen: Seen,
    /// The line as the frame alone shows it.
    pub plain: Profile,
    pub world_from_camera: WorldFromCamera,
}

/// A frame as it was measured in the end.
pub(super) struct Improved {
    pub frame: u32,
    pub stripe: Stripe,
    pub profile: Profile,
}

/// Those that wait, the oldest first.
#[derive(Default)]
pub(super) struct LateFrames {
    frames: VecDeque<Late>,
}

impl LateFrames {
    /// Lets a frame wait; the oldest may have to give up.
    pub(super) fn push(&mut self, late: Late, measurer: &mut StripeMeasurer) {
        self.frames.push_back(late);
        if self.frames.len() > MAX_FRAMES {
            self.give_up_first(measurer);
        }
    }

    /// Whether a frame still waits.
    pub(super) fn holds(&self, frame: u32) -> bool {
        self.frames.iter().any(|late| late.frame == frame)
    }

    /// The way is broken, or the run has ended: what is measured stays.
    pub(super) fn clear(&mut self, measurer: &mut StripeMeasurer) {
        while !self.frames.is_empty() {
            self.give_up_first(measurer);
        }
    }

    /// Measures what the newest of the kept frames shows clear of the laser; `now` is the frame at hand.
    pub(super) fn improve(
        &mut self,
        now: u32,
        rig: &Rig,
        newest: &Recent,
        measurer: &mut StripeMeasurer,
    ) -> Vec<Improved> {
        while self.frames.front().is_some_and(|late| late.frame + MAX_WAIT < now) {
            self.give_up_first(measurer);
        }
        let mut improved = Vec::new();
        for late in std::mem::take(&mut self.frames) {
            let (margin_px, pose) = (late.seen.reach_px(), &late.world_from_camera);
            if !newest.shows_all(rig, &late.plain, pose, margin_px) {
                self.frames.push_back(late);
                continue;
            }
            let positions = late.seen.stripe.across_px.len();
            let wall = newest.wall_of(rig, &late.plain, pose, positions, margin_px);
            let stripe = measurer.measure(&late.seen, Some(&wall));
            let profile = triangulate(&stripe, rig);
            measurer.done_with(late.seen);
            improved.push(Improved { frame: late.frame, stripe, profile });
        }
        improved
    }

    fn give_up_first(&mut self, measurer: &mut StripeMeasurer) {
        self.frames.pop_front().into_iter().for_each(|late| measurer.done_with(late.seen));
    }
}
