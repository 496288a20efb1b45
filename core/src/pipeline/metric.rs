//! The order of the stages of method `metric`.

use std::collections::VecDeque;
use std::sync::Arc;

use super::colours::ColourFinder;
use super::poses::Poses;
use super::reading::{self, Seen};
use super::recent::{Recent, RecentFrames};
use super::{Cargo, Colours, Picture, Run};
use crate::depth_map::sheet::WallColours;
use crate::error::Result;
use crate::motion::metric::SettledPose;
use crate::source::Source;
use crate::stripe::metric::stripe_stages;
use crate::surface::{Measured, Placed};
use crate::triangulation::triangulate;

/// Pictures for the recording that may wait for their frame's pose: they are large.
const MAX_PICTURES: usize = 12;

/// The order of the stages, frame by frame.
pub(super) fn measure(run: &mut Run<'_, '_, '_, '_>, source: Box<dyn Source>) -> Result<()> {
    let (rig, recipe) = (&run.request.rig, &run.request.recipe);
    let (colours_wanted, between) = (run.products.wants_colours(), run.products.wants_wall_colours());
    let mut poses = Poses::new(run.request)?;
    let mut recent = RecentFrames::default();
    let mut waiting = WaitingFrames::default();
    let mut colours = ColourFinder::new(!between);
    std::thread::scope(|scope| {
        // Source ▶ Frame ▶ the line as the frame alone shows it, in a thread of their own.
        let (mut finder, mut measurer) = stripe_stages(&rig.laser, &recipe.spot);
        let (frames, reading) =
            reading::start(scope, source, rig, recipe, move |frame| Ok(finder.see(frame.image.yuv())));
        for seen in frames {
            let Seen { frame, found } = seen?;
            // Frame + line ▶ motion, against the surface measured so far.
            let plain = run.timings.time("triangulation", || triangulate(&found.stripe, rig));
            let (motion, moved_px) =
                run.timings.time("motion", || poses.track(&frame, &found.stripe, &plain, found.width_px()));
            // Line + the wall without it ▶ Stripe ▶ Profile.
            let positions = found.stripe.across_px.len();
            let pose = motion.camera_from_world;
            let wall = pose.and_then(|pose| recent.wall(rig, &plain, &pose, positions, found.reach_px()));
            let stripe = run.timings.time("stripe", || measurer.measure(found, wall.as_ref().map(|(_, wall)| wall)));
            let profile = run.timings.time("triangulation", || triangulate(&stripe, rig));
            run.products.stripe(&stripe)?;
            let image = Arc::new(frame.image);
            let picture = run.products.wants_picture(frame.time_s) && waiting.pictures() < MAX_PICTURES;
            let picture = picture.then(|| Picture { image: image.clone(), effective_area: None, row_threshold: None });
            // The wall's colours, from a frame that shows it without the laser: an earlier one, or else a later one.
            if colours_wanted && let Some(pose) = pose {
                let earlier = wall.map(|(recent, _)| recent);
                run.timings.time("texture", || colours.add(frame.index, rig, &profile, &pose, earlier));
            }
            let cargo = Cargo { stripe, colours: Colours::Unknown, picture };
            let measured = Measured { frame: frame.index, time_s: frame.time_s, profile, shift: motion.shift, cargo };
            match pose {
                Some(pose) => recent.push(moved_px, || Recent::new(image, pose, &measured.cargo.stripe)),
                None => recent.clear(),
            }
            waiting.push(measured);
            if let Some(newest) = recent.newest() {
                run.timings.time("texture", || colours.add_late(rig, newest));
            }
            for (frame, wall) in colours.take_done() {
                waiting.colour(frame, wall);
            }
            // Poses that are final ▶ surface.
            let settled = poses.take_settled();
            run.add(waiting.place(settled))?;
            run.progress.frame()?;
        }
        run.timings.time("motion", || poses.finish());
        let settled = poses.take_settled();
        run.add(waiting.place(settled))?;
        let report = reading.join()?;
        run.timings.add("decoding", report.decoding);
        run.timings.add("stripe", report.stripes);
        report.warnings.into_iter().chain(poses.warnings()).try_for_each(|warning| run.progress.warn(warning))
    })
}

/// Frames in their order, until their poses are final.
#[derive(Default)]
struct WaitingFrames {
    frames: VecDeque<Measured<Cargo>>,
}

impl WaitingFrames {
    fn push(&mut self, measured: Measured<Cargo>) {
        self.frames.push_back(measured);
    }

    fn pictures(&self) -> usize {
        self.frames.iter().filter(|frame| frame.cargo.picture.is_some()).count()
    }

    fn colour(&mut self, frame: u32, wall: WallColours) {
        if let Some(waiting) = self.frames.iter_mut().rev().find(|waiting| waiting.frame == frame) {
            waiting.cargo.colours = Colours::Wall(wall);
        }
    }

    /// Joins final poses, in the order of the frames, with what was measured.
    fn place(&mut self, settled: Vec<SettledPose>) -> Vec<Placed<Cargo>> {
        let placed = settled.into_iter().filter_map(|pose| {
            let measured = self.frames.pop_front()?;
            debug_assert_eq!(measured.frame, pose.frame, "every frame is settled once, in order");
            Some(Placed {
                measured,
                degrees_of_freedom: if pose.world_from_camera.is_some() { pose.degrees_of_freedom } else { 0 },
                world_from_camera: pose.world_from_camera,
                part: pose.part,
                strip: None,
            })
        });
        placed.collect()
    }
}
