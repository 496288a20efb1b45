//! The last frames, for what the frame at hand hides under the laser: the wall's own look.

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::{Isometry3, Point3};

use crate::geometry::WorldFromCamera;
use crate::rig::{Camera, LineDirection, Rig};
use crate::source::{Image, Yuv};
use crate::stripe::Stripe;
use crate::stripe::metric::Wall;
use crate::triangulation::Profile;

/// Frames that are kept, at most.
const MAX_FRAMES: usize = 8;
/// A frame is kept when the image has moved this far since the last kept one, px.
const STEP_PX: f64 = 6.0;
/// Share of the line that must lie clear of the laser in an earlier frame.
const CLEAR_SHARE: f64 = 0.8;
/// Once a frame is chosen, its places may lie nearer to the laser: this share of the margin. Else just those would be left out
/// whose spots are drawn aside by what the wall should tell.
const CHOSEN_MARGIN: f32 = 0.8;
/// Share that counts as all of it: of the places that are looked at, one may have left the image at its rim.
const ALL_CLEAR_SHARE: f64 = 0.95;
/// Places of a profile that are looked at.
const PROBES: usize = 24;

/// A frame that may show the wall without the laser.
pub(super) struct Recent {
    image: Arc<Image>,
    camera_from_world: Isometry3<f64>,
    /// The line's place at each line position or its neighbours', px; empty where there was none.
    line_px: Vec<f32>,
    line: LineDirection,
}

impl Recent {
    pub(super) fn new(image: Arc<Image>, camera_from_world: Isometry3<f64>, stripe: &Stripe) -> Recent {
        let line_px = stripe.filled_px();
        Recent { image, camera_from_world, line_px, line: stripe.line }
    }

    /// Its luma and chroma.
    pub(super) fn yuv(&self) -> Yuv<'_> {
        self.image.yuv()
    }

    /// Where it shows a place of the world, (across, along) px, unless the laser falls within `margin_px` of it.
    pub(super) fn clear_place(&self, camera: &Camera, world: &Point3<f64>, margin_px: f32) -> Option<(f32, f32)> {
        let p = self.camera_from_world * world;
        if p.z < 1.0 {
            return None;
        }
        let pixel = camera.project(&p);
        let (u, v) = (pixel.u_px as f32, pixel.v_px as f32);
        let (across, along) = match self.line {
            LineDirection::Vertical => (u, v),
            LineDirection::Horizontal => (v, u),
        };
        let inside = u >= 0.0 && v >= 0.0 && u < (camera.width_px - 1) as f32 && v < (camera.height_px - 1) as f32;
        let lit =
            self.line_px.get(along.round().max(0.0) as usize).is_some_and(|line| (line - across).abs() < margin_px);
        (inside && !lit).then_some((across, along))
    }

    /// Whether it shows all of a profile's places, or nearly, clear of the laser.
    pub(super) fn shows_all(
        &self,
        rig: &Rig,
        profile: &Profile,
        world_from_camera: &WorldFromCamera,
        margin_px: f32,
    ) -> bool {
        self.clear_share(rig, profile, world_from_camera, margin_px) >= ALL_CLEAR_SHARE
    }

    /// The share of a profile's places that it shows clear of the laser.
    fn clear_share(&self, rig: &Rig, profile: &Profile, world_from_camera: &WorldFromCamera, margin_px: f32) -> f64 {
        let step = (profile.points.len() / PROBES).max(1);
        let (mut all, mut clear) = (0_u32, 0_u32);
        for point in profile.points.iter().skip(step / 2).step_by(step) {
            let world = world_from_camera * point.point_in_camera;
            all += 1;
            clear += u32::from(self.clear_place(&rig.camera, &world, margin_px).is_some());
        }
        f64::from(clear) / f64::from(all.max(1))
    }

    /// The wall of a profile as this frame shows it.
    pub(super) fn wall_of(
        &self,
        rig: &Rig,
        profile: &Profile,
        world_from_camera: &WorldFromCamera,
        positions: usize,
        margin_px: f32,
    ) -> Wall<'_> {
        let mut places = vec![None; positions];
        for point in &profile.points {
            let world = world_from_camera * point.point_in_camera;
            places[point.line_position as usize] = self.clear_place(&rig.camera, &world, CHOSEN_MARGIN * margin_px);
        }
        Wall { image: self.yuv(), places }
    }
}

/// The last frames, the newest last.
#[derive(Default)]
pub(super) struct RecentFrames {
    frames: VecDeque<Recent>,
    moved_px: f64,
}

impl RecentFrames {
    /// Keeps a frame if the image has moved far enough (`moved_px` since the frame before).
    pub(super) fn push(&mut self, moved_px: f64, frame: impl FnOnce() -> Recent) {
        self.moved_px += moved_px;
        if self.frames.is_empty() || self.moved_px >= STEP_PX {
            self.moved_px = 0.0;
            self.frames.push_back(frame());
            if self.frames.len() > MAX_FRAMES {
                self.frames.pop_front();
            }
        }
    }

    /// The newest.
    pub(super) fn newest(&self) -> Option<&Recent> {
        self.frames.back()
    }

    /// Forgets all: the way is broken.
    pub(super) fn clear(&mut self) {
        self.frames.clear();
    }

    /// The newest frame that shows all of a profile's places clear of the laser, or else the one that shows most, with these
    /// places.
    pub(super) fn wall(
        &self,
        rig: &Rig,
        profile: &Profile,
        camera_from_world: &Isometry3<f64>,
        positions: usize,
        margin_px: f32,
    ) -> Option<(&Recent, Wall<'_>)> {
        let world_from_camera = camera_from_world.inverse();
        let mut best: Option<(f64, &Recent)> = None;
        for recent in self.frames.iter().rev() {
            let share = recent.clear_share(rig, profile, &world_from_camera, margin_px);
            if share >= CLEAR_SHARE && best.is_none_or(|(most, _)| share > most) {
                best = Some((share, recent));
            }
            if share >= ALL_CLEAR_SHARE {
                break;
            }
        }
        let (_, recent) = best?;
        Some((recent, recent.wall_of(rig, profile, &world_from_camera, positions, margin_px)))
    }
}
