//! The order of the stages of method `metric`.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::thread::{Scope, ScopedJoinHandle};
use std::time::{Duration, Instant};

use super::colours::ColourFinder;
use super::late::{Improved, Late, LateFrames};
use super::poses::Poses;
use super::reading::{self, Seen};
use super::recent::{Recent, RecentFrames};
use super::{Cargo, Colours, Event, Newest, Picture, Products, QualityCounter, Run};
use nalgebra::Isometry3;

use crate::depth_map::sheet::WallColours;
use crate::error::{Error, Result};
use crate::motion::metric::SettledPose;
use crate::recipe::RecordingOptions;
use crate::recording;
use crate::rig::Rig;
use crate::source::{Image, Source};
use crate::stripe::metric::stripe_stages;
use crate::surface::{Measured, Placed};
use crate::triangulation::{Profile, triangulate};

/// Placed frames that may wait for being written.
const FRAMES_WAIT: usize = 16;
/// Pictures for the recording that may wait for their frame's pose.
const MAX_PICTURES: usize = 12;

/// The order of the stages, frame by frame.
pub(super) fn measure(run: &mut Run<'_, '_, '_, '_>, source: Box<dyn Source>) -> Result<()> {
    let Run { request, beside, products, quality, progress, timings } = run;
    let (rig, recipe) = (&request.rig, &request.recipe);
    let shows_newest = products.shows_newest();
    let (colours_wanted, between) = (products.wants_colours(), products.wants_wall_colours());
    let mut pictures = products.wants_pictures().then(|| Pictures::new(&recipe.recording, rig));
    let mut poses = Poses::new(request, beside)?;
    let mut recent = RecentFrames::default();
    let mut late = LateFrames::default();
    let mut waiting = WaitingFrames::default();
    let mut colours = ColourFinder::new(!between);
    let mut widths_px = (0.0, 0_u32);
    let measured = std::thread::scope(|scope| {
        // Surface ▶ maps, cloud, recording, archive, in a thread of their own.
        let writer = Writer::start(scope, products, quality);
        // Source ▶ Frame ▶ the line as the frame alone shows it, in two more.
        let (mut finder, mut measurer) = stripe_stages(&rig.laser, &recipe.spot);
        let (frames, reading) =
            reading::start(scope, source, rig, recipe, move |frame| Ok(finder.see(frame.image.yuv())));
        for seen in frames {
            let Seen { frame, found } = seen?;
            // Frame + line ▶ motion, against the surface measured so far.
            let plain = timings.time("triangulation", || triangulate(&found.stripe, rig));
            let (motion, moved_px) =
                timings.time("motion", || poses.track(&frame, &found.stripe, &plain, found.width_px()));
            widths_px = (widths_px.0 + f64::from(found.width_px()), widths_px.1 + 1);
            // Line + the wall without it ▶ Stripe ▶ Profile.
            let positions = found.stripe.across_px.len();
            let pose = motion.camera_from_world;
            let wall = pose.and_then(|pose| recent.wall(rig, &plain, &pose, positions, found.reach_px()));
            let stripe = timings.time("stripe", || measurer.measure(&found, wall.as_ref().map(|(_, wall)| wall)));
            let profile = timings.time("triangulation", || triangulate(&stripe, rig));
            // Where no earlier frame shows the wall, a later one will.
            match pose.filter(|_| wall.is_none() && recipe.spot.wall_reference) {
                Some(pose) => {
                    let world_from_camera = pose.inverse();
                    late.push(Late { frame: frame.index, seen: found, plain, world_from_camera }, &mut measurer);
                }
                None => measurer.done_with(found),
            }
            // The wall's colours, from a frame that shows it without the laser: an earlier one, or else a later one.
            if colours_wanted && let Some(pose) = pose {
                let earlier = wall.map(|(recent, _)| recent);
                timings.time("texture", || colours.add(frame.index, rig, &profile, &pose, earlier));
            }
            if shows_newest
                && let Some(pose) = pose
                && !writer.show(newest_of(frame.index, frame.time_s, &profile, &pose))
            {
                break;
            }
            let image = Arc::new(frame.image);
            let picture = pictures.as_mut().and_then(|pictures| pictures.take(frame.time_s, &image, &waiting));
            let cargo = Cargo { stripe, colours: Colours::Unknown, picture };
            let measured = Measured { frame: frame.index, time_s: frame.time_s, profile, shift: motion.shift, cargo };
            match pose {
                Some(pose) => recent.push(moved_px, || Recent::new(image, pose, &measured.cargo.stripe)),
                None => {
                    recent.clear();
                    late.clear(&mut measurer);
                }
            }
            waiting.push(measured);
            if let Some(newest) = recent.newest() {
                timings.time("texture", || colours.add_late(rig, newest));
                let improved = timings.time("stripe", || late.improve(frame.index, rig, newest, &mut measurer));
                improved.into_iter().for_each(|improved| waiting.improve(improved));
            }
            for (frame, wall) in colours.take_done() {
                waiting.colour(frame, wall);
            }
            // Poses that are final ▶ surface.
            if !writer.add(waiting.place(poses.take_settled(), &late)) {
                break;
            }
            writer.events().try_for_each(|event| progress.send(event))?;
            progress.frame()?;
        }
        timings.time("motion", || poses.finish());
        late.clear(&mut measurer);
        writer.add(waiting.place(poses.take_settled(), &late));
        let (time, events) = writer.finish()?;
        timings.add("products", time);
        events.into_iter().try_for_each(|event| progress.send(event))?;
        let report = reading.join()?;
        timings.add("decoding", report.decoding);
        timings.add("stripe", report.stripes);
        report.warnings.into_iter().chain(poses.warnings()).try_for_each(|warning| progress.warn(warning))
    });
    quality.note_drift(poses.drift());
    products.note_line_width(widths_px.0 / f64::from(widths_px.1.max(1)));
    measured
}

/// A profile where its frame's first pose puts it.
fn newest_of(frame: u32, time_s: f64, profile: &Profile, camera_from_world: &Isometry3<f64>) -> Newest {
    let world_from_camera = camera_from_world.inverse();
    let points_in_world = profile.points.iter().map(|point| world_from_camera * point.point_in_camera).collect();
    Newest { frame, time_s, points_in_world }
}

/// What the writing thread gets.
enum Work {
    Placed(Box<Placed<Cargo>>),
    Newest(Newest),
}

/// The thread that adds placed frames to the products.
struct Writer<'scope> {
    work: SyncSender<Work>,
    events: Receiver<Event>,
    thread: ScopedJoinHandle<'scope, Result<Duration>>,
}

impl<'scope> Writer<'scope> {
    fn start<'r: 'scope>(
        scope: &'scope Scope<'scope, '_>,
        products: &'scope mut Products<'r>,
        quality: &'scope mut QualityCounter,
    ) -> Writer<'scope> {
        let (sender, work) = sync_channel::<Work>(FRAMES_WAIT);
        let (say, events) = channel();
        let thread = scope.spawn(move || {
            let mut time = Duration::ZERO;
            for one in work {
                let start = Instant::now();
                let events = match one {
                    Work::Placed(frame) => {
                        quality.add(&frame, &frame.measured.cargo.stripe);
                        products.add(&frame)?
                    }
                    Work::Newest(newest) => products.show_newest(&newest)?,
                };
                time += start.elapsed();
                // Nobody listens only after a cancel, which has said its own.
                events.into_iter().for_each(|event| drop(say.send(event)));
            }
            Ok(time)
        });
        Writer { work: sender, events, thread }
    }

    /// Hands frames over; false where the thread has ended, with an error that [`Writer::finish`] tells.
    fn add(&self, placed: Vec<Placed<Cargo>>) -> bool {
        placed.into_iter().all(|frame| self.work.send(Work::Placed(Box::new(frame))).is_ok())
    }

    /// Hands the newest profile over; false as in [`Writer::add`].
    fn show(&self, newest: Newest) -> bool {
        self.work.send(Work::Newest(newest)).is_ok()
    }

    /// What there is to say since this was last asked.
    fn events(&self) -> impl Iterator<Item = Event> + '_ {
        self.events.try_iter()
    }

    /// Waits until all is written: the time that took, and what is left to say.
    fn finish(self) -> Result<(Duration, Vec<Event>)> {
        drop(self.work);
        let time = self.thread.join().map_err(|_| Error::internal("products", "the writing thread panicked"))??;
        Ok((time, self.events.try_iter().collect()))
    }
}

/// Which frames' pictures are kept for the recording.
struct Pictures {
    interval_s: f64,
    next_s: f64,
    /// They wait as they will be shown: whole frames would take nine times the memory.
    shrink: usize,
}

impl Pictures {
    fn new(options: &RecordingOptions, rig: &Rig) -> Pictures {
        Pictures { interval_s: 1.0 / options.images_per_s, next_s: 0.0, shrink: recording::shrink(options, rig) }
    }

    fn take(&mut self, time_s: f64, image: &Image, waiting: &WaitingFrames) -> Option<Picture> {
        if time_s + 1e-9 < self.next_s || waiting.pictures() >= MAX_PICTURES {
            return None;
        }
        self.next_s = time_s + self.interval_s;
        Some(Picture { image: image.shrunk(self.shrink), effective_area: None, row_threshold: None })
    }
}

/// Frames in their order, until their poses are final and no later frame can tell more of them.
#[derive(Default)]
struct WaitingFrames {
    frames: VecDeque<Measured<Cargo>>,
    /// Final poses of the first of them.
    settled: VecDeque<SettledPose>,
}

impl WaitingFrames {
    fn push(&mut self, measured: Measured<Cargo>) {
        self.frames.push_back(measured);
    }

    fn pictures(&self) -> usize {
        self.frames.iter().filter(|frame| frame.cargo.picture.is_some()).count()
    }

    fn colour(&mut self, frame: u32, wall: WallColours) {
        if let Some(waiting) = self.find(frame) {
            waiting.cargo.colours = Colours::Wall(wall);
        }
    }

    fn improve(&mut self, improved: Improved) {
        if let Some(waiting) = self.find(improved.frame) {
            waiting.profile = improved.profile;
            waiting.cargo.stripe = improved.stripe;
        }
    }

    fn find(&mut self, frame: u32) -> Option<&mut Measured<Cargo>> {
        self.frames.iter_mut().rev().find(|waiting| waiting.frame == frame)
    }

    /// Joins final poses, in the order of the frames, with what was measured; frames that are `late` still wait.
    fn place(&mut self, settled: Vec<SettledPose>, late: &LateFrames) -> Vec<Placed<Cargo>> {
        self.settled.extend(settled);
        let mut placed = Vec::new();
        while self.settled.front().is_some_and(|pose| !late.holds(pose.frame))
            && let (Some(pose), Some(measured)) = (self.settled.pop_front(), self.frames.pop_front())
        {
            debug_assert_eq!(measured.frame, pose.frame, "every frame is settled once, in order");
            placed.push(Placed {
                measured,
                degrees_of_freedom: if pose.world_from_camera.is_some() { pose.degrees_of_freedom } else { 0 },
                world_from_camera: pose.world_from_camera,
                part: pose.part,
                strip: None,
            });
        }
        placed
    }
}
