//! The wall's colours between one profile and the next, from frames that show it without the laser.

use std::collections::VecDeque;

use nalgebra::{Isometry3, Point3};

use super::recent::Recent;
use crate::depth_map::sheet::WallColours;
use crate::rig::{LineDirection, Rig};
use crate::triangulation::Profile;

/// Colours between two profiles, at most.
const MAX_STEPS: usize = 48;
/// Frames whose colours wait until a later frame shows their wall, at most.
const MAX_LATE: usize = 64;
/// Share of a profile that must be clear in a frame for it to give the colours.
const CLEAR_SHARE: f64 = 0.9;
/// Distance from the laser line that counts as clear, as a share of the image's width.
const CLEAR_OF_LINE: f32 = 0.02;

/// Finds colours for frames, at once or later.
pub(super) struct ColourFinder {
    /// Only at the profiles themselves, not between them.
    points_only: bool,
    before: Vec<Option<Point3<f64>>>,
    late: VecDeque<Strip>,
    done: Vec<(u32, WallColours)>,
}

/// The surface between two profiles, as placed when they were seen.
struct Strip {
    frame: u32,
    before: Vec<Option<Point3<f64>>>,
    now: Vec<Option<Point3<f64>>>,
    steps: usize,
}

impl ColourFinder {
    /// A finder of the colours at the profiles (`points_only`), or also between them.
    pub(super) fn new(points_only: bool) -> ColourFinder {
        ColourFinder { points_only, before: Vec::new(), late: VecDeque::new(), done: Vec::new() }
    }

    /// Takes a frame's profile; `earlier` is a frame that shows its wall without the laser.
    pub(super) fn add(
        &mut self,
        frame: u32,
        rig: &Rig,
        profile: &Profile,
        camera_from_world: &Isometry3<f64>,
        earlier: Option<&Recent>,
    ) {
        let positions = match rig.laser.line {
            LineDirection::Vertical => rig.camera.height_px,
            LineDirection::Horizontal => rig.camera.width_px,
        };
        let world_from_camera = camera_from_world.inverse();
        let mut now = vec![None; positions as usize];
        for point in &profile.points {
            now[point.line_position as usize] = Some(world_from_camera * point.point_in_camera);
        }
        if self.points_only {
            return self.keep(Strip { frame, before: Vec::new(), now, steps: 1 }, rig, earlier);
        }
        let pixel_mm = profile.median_z_mm().unwrap_or(1.0) / rig.camera.fx_px;
        let before = std::mem::replace(&mut self.before, now.clone());
        let mut apart: Vec<f64> =
            before.iter().zip(&now).step_by(8).filter_map(|(a, b)| Some((a.as_ref()? - b.as_ref()?).norm())).collect();
        let middle = apart.len() / 2;
        let apart_mm = if apart.is_empty() { 0.0 } else { *apart.select_nth_unstable_by(middle, f64::total_cmp).1 };
        let steps = ((apart_mm / (1.5 * pixel_mm)).ceil() as usize).clamp(1, MAX_STEPS);
        self.keep(Strip { frame, before, now, steps }, rig, earlier);
    }

    fn keep(&mut self, strip: Strip, rig: &Rig, earlier: Option<&Recent>) {
        match earlier {
            Some(recent) => self.done.push((strip.frame, strip.colours(rig, recent))),
            None => {
                self.late.push_back(strip);
                if self.late.len() > MAX_LATE {
                    self.late.pop_front();
                }
            }
        }
    }

    /// Colours what waits and lies clear of the laser in this frame.
    pub(super) fn add_late(&mut self, rig: &Rig, newest: &Recent) {
        let done = &mut self.done;
        self.late.retain(|strip| {
            let clear = strip.clear_in(rig, newest);
            if clear {
                done.push((strip.frame, strip.colours(rig, newest)));
            }
            !clear
        });
    }

    /// The colours found since this was last asked.
    pub(super) fn take_done(&mut self) -> Vec<(u32, WallColours)> {
        std::mem::take(&mut self.done)
    }
}

impl Strip {
    fn clear_in(&self, rig: &Rig, recent: &Recent) -> bool {
        let step = (self.now.len() / 24).max(1);
        let probes: Vec<&Point3<f64>> = self.now.iter().step_by(step).flatten().collect();
        let clear = probes.iter().filter(|p| recent.clear_place(&rig.camera, p, margin_px(rig)).is_some()).count();
        !probes.is_empty() && clear as f64 >= CLEAR_SHARE * probes.len() as f64
    }

    fn colours(&self, rig: &Rig, recent: &Recent) -> WallColours {
        let image = recent.yuv();
        let mut rgb = vec![None; self.now.len() * self.steps];
        for (position, out) in rgb.chunks_exact_mut(self.steps).enumerate() {
            let Some(now) = &self.now[position] else { continue };
            let Some(to) = recent.clear_place(&rig.camera, now, margin_px(rig)) else { continue };
            let before = self.before.get(position).copied().flatten();
            let from = before.and_then(|p| recent.clear_place(&rig.camera, &p, margin_px(rig)));
            for (step, out) in out.iter_mut().enumerate() {
                let share = (step as f32 + 0.5) / self.steps as f32;
                let (across, along) = match from {
                    Some(from) => (from.0 + share * (to.0 - from.0), from.1 + share * (to.1 - from.1)),
                    None => to,
                };
                let (across, along) = (across.round() as usize, along.round() as usize);
                *out = Some(match rig.laser.line {
                    LineDirection::Vertical => image.rgb(across, along),
                    LineDirection::Horizontal => image.rgb(along, across),
                });
            }
        }
        WallColours { steps: self.steps, rgb }
    }
}

fn margin_px(rig: &Rig) -> f32 {
    CLEAR_OF_LINE * rig.camera.width_px.max(rig.camera.height_px) as f32
}
