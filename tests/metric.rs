//! Method `metric` against the truth of simulated runs: through a video as robots send it, H.264 at crf 18.
//!
//! The runs are smaller and shorter than those of the bench (`make bench`), which holds the same figures at full HD.

use std::ops::ControlFlow;
use std::path::Path;

use stria_core::defects::Chainage;
use stria_core::export::{cloud_ply, manifest::Manifest, npy, trajectory_csv};
use stria_core::geometry::WorldFromCamera;
use stria_core::pipeline::{ProductGroup, Request, process};
use stria_core::recipe::Recipe;
use stria_core::synthetic::{FrameTruth, Motion, Quality, Scene, Simulation, VideoWriter};
use tempfile::TempDir;

const SIZE_PX: (u32, u32) = (1280, 720);

/// A processed run beside its truth.
struct Measured {
    simulation: Simulation,
    truth: Vec<FrameTruth>,
    manifest: Manifest,
    stripes: Vec<f32>,
    poses: Vec<Option<WorldFromCamera>>,
    folder: TempDir,
}

/// Simulates, encodes and measures; `laser_on` says in which frames the laser shines.
fn measure(scene: Scene, seconds: f64, fps: f64, seed: u64, laser_on: impl Fn(u32) -> bool) -> Measured {
    let mut dark = scene.clone();
    dark.laser.on = false;
    let simulation = Simulation::new(scene, SIZE_PX, fps, seconds, seed).expect("a simulation");
    let without = Simulation::new(dark, SIZE_PX, fps, seconds, seed).expect("a simulation");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let video = folder.path().join("video.mp4");
    let mut writer = VideoWriter::create(&video, SIZE_PX, fps, Quality::Camera).expect("a video");
    let mut truth = Vec::new();
    for index in 0..simulation.frames_total() {
        let (image, seen) = if laser_on(index) { simulation.render(index) } else { without.render(index) };
        writer.push(&image).expect("a frame");
        truth.push(seen);
    }
    writer.finish().expect("the video's end");
    let mut recipe = Recipe::load("metric").expect("built in");
    recipe.set("stripe.keep", "true").expect("a key");
    let out_dir = folder.path().join("out");
    let request = Request {
        source: video,
        topics: Vec::new(),
        source_name: "video.mp4".into(),
        fps: None,
        poses: None,
        recorded_at: jiff::Timestamp::UNIX_EPOCH,
        asset: String::new(),
        chainage: Chainage::default(),
        rig: simulation.rig().clone(),
        recipe,
        out_dir: out_dir.clone(),
        products: vec![ProductGroup::Depth, ProductGroup::Cloud, ProductGroup::Trajectory],
        live_segments: false,
    };
    let manifest = process(&request, &mut |_| ControlFlow::Continue(())).expect("the run is processed");
    let (_, _, stripes) = npy::read_f32(&out_dir.join("stripes.npy")).expect("stripes");
    let rows = trajectory_csv::read(&out_dir.join("trajectory.csv")).expect("trajectory");
    let poses = rows.into_iter().map(|row| row.world_from_camera).collect();
    Measured { simulation, truth, manifest, stripes, poses, folder }
}

fn scene(name: &str) -> Scene {
    Scene::named(name).expect("a scene")
}

fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    assert!(!values.is_empty(), "nothing was measured");
    values.iter_mut().for_each(|v| *v = v.abs());
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * share) as usize]
}

/// What a stripe is off the truth, and how much of it was found.
struct StripeErrors {
    median_px: f64,
    p95_px: f64,
    found: f64,
    false_share: f64,
}

impl Measured {
    fn stripe_errors(&self) -> StripeErrors {
        self.stripe_errors_in(0..self.truth.len())
    }

    fn stripe_errors_in(&self, frames: std::ops::Range<usize>) -> StripeErrors {
        let rows = self.truth[0].stripe_across_px.len();
        let (mut errors, mut measurable, mut found, mut wrong) = (Vec::new(), 0usize, 0usize, 0usize);
        for (frame, truth) in self.truth.iter().enumerate().filter(|(frame, _)| frames.contains(frame)) {
            for row in 0..rows {
                let (at, expected) = (self.stripes[frame * rows + row], truth.stripe_across_px[row]);
                measurable += usize::from(truth.measurable[row]);
                if !at.is_finite() {
                    continue;
                }
                let miss = f64::from(at - expected);
                wrong += usize::from(miss.is_nan() || miss.abs() > 3.0);
                if truth.measurable[row] {
                    found += 1;
                    errors.push(miss);
                }
            }
        }
        StripeErrors {
            median_px: quantile(errors.clone(), 0.5),
            p95_px: quantile(errors, 0.95),
            found: found as f64 / measurable as f64,
            false_share: wrong as f64 / (frames.len() * rows) as f64,
        }
    }

    /// Travel along x that was found against the true one, as a share.
    fn travel_error(&self) -> f64 {
        let found = self.poses.iter().rev().flatten().next().expect("a pose").translation.x;
        let last = self.poses.iter().rposition(Option::is_some).expect("a pose");
        let truth = self.truth[last].world_from_camera.translation.x;
        (found - truth) / truth
    }

    /// The last pose is where it should be within what is stated of the drift, and that is no blank cheque.
    fn assert_drift_as_stated(&self) {
        let drift = self.manifest.quality.drift.expect("a way without a break tells its drift");
        let found = self.poses.last().copied().flatten().expect("a pose").translation.vector;
        let off = found - self.truth[self.truth.len() - 1].world_from_camera.translation.vector;
        println!("end off by {:.2} {:.2} {:.2} mm, stated {drift:?}", off.x, off.y, off.z);
        for (off_mm, stated_mm) in [(off.x, drift.x_mm), (off.y, drift.y_mm), (off.z, drift.z_mm)] {
            assert!(off_mm.abs() < 3.0 * stated_mm && stated_mm < 0.01 * self.manifest.quality.travel_mm);
        }
    }

    /// Depth of each point of the cloud less that of the true surface there, mm: without any alignment.
    fn depth_errors_mm(&self) -> Vec<f64> {
        let points = cloud_ply::read(&self.out().join("cloud.ply")).expect("a cloud");
        let off = |p: &stria_core::surface::SurfacePoint| {
            let at = p.point_in_world;
            Some(at.z - self.simulation.surface_z_mm(at.x, at.y)?)
        };
        points.iter().step_by(7).filter_map(off).collect()
    }

    fn out(&self) -> std::path::PathBuf {
        Path::new(self.folder.path()).join("out")
    }
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

#[test]
fn a_wall_is_met_within_the_bars() {
    let run = measure(scene("wall"), 2.0, 30.0, 21, |_| true);
    let (stripe, depth_mm) = (run.stripe_errors(), rms(&run.depth_errors_mm()));
    println!(
        "wall: stripe median {:.3} px, p95 {:.3} px, found {:.4}, false {:.5}; travel {:+.3} %; depth RMS {depth_mm:.3} mm",
        stripe.median_px,
        stripe.p95_px,
        stripe.found,
        stripe.false_share,
        100.0 * run.travel_error()
    );
    assert!(stripe.median_px < 0.06 && stripe.p95_px < 0.20);
    assert!(stripe.found > 0.99 && stripe.false_share < 0.001);
    // No earlier frame shows the first ones' wall without the laser: later ones do.
    let first = run.stripe_errors_in(0..5);
    println!("wall, first five frames: stripe median {:.3} px, p95 {:.3} px", first.median_px, first.p95_px);
    assert!(first.median_px < 1.3 * stripe.median_px && first.p95_px < 1.3 * stripe.p95_px);
    assert!(run.travel_error().abs() < 0.003);
    assert!(depth_mm < 0.6, "{depth_mm} mm");
    assert_eq!(run.manifest.quality.frames_6_dof, u64::from(run.simulation.frames_total()));
    assert_eq!(run.manifest.quality.breaks, 0);
    run.assert_drift_as_stated();
}

#[test]
fn a_pipe_with_gait_and_highlight_is_met_within_the_bars() {
    let run = measure(scene("pipe"), 2.0, 60.0, 22, |_| true);
    let (stripe, depth_mm) = (run.stripe_errors(), rms(&run.depth_errors_mm()));
    println!(
        "pipe: stripe median {:.3} px, p95 {:.3} px, found {:.4}, false {:.5}; travel {:+.3} %; depth RMS {depth_mm:.3} mm",
        stripe.median_px,
        stripe.p95_px,
        stripe.found,
        stripe.false_share,
        100.0 * run.travel_error()
    );
    assert!(stripe.median_px < 0.09 && stripe.p95_px < 0.30);
    assert!(stripe.found > 0.98 && stripe.false_share < 0.001);
    assert!(run.travel_error().abs() < 0.005);
    assert!(depth_mm < 0.4, "{depth_mm} mm");
    run.assert_drift_as_stated();
}

#[test]
fn standing_still_does_not_creep_and_coming_back_lands_on_the_same_place() {
    let run = measure(scene("stop"), 4.0, 30.0, 23, |_| true);
    let still: Vec<usize> = (1..run.truth.len())
        .filter(|i| run.truth[*i].world_from_camera == run.truth[i - 1].world_from_camera)
        .collect();
    assert!(still.len() > 15, "the robot stands still for a while");
    let place = |i: usize| run.poses[i].expect("placed").translation.vector;
    let first = still[0];
    let last = still.iter().zip(first..).take_while(|(i, expected)| **i == *expected).count() + first - 1;
    let creep_mm = (place(last) - place(first)).norm();
    println!("creep {creep_mm:.3} mm over {} frames, travel {:+.3} %", last - first, 100.0 * run.travel_error());
    assert!(creep_mm < 0.3, "{creep_mm} mm");
    assert!(run.travel_error().abs() < 0.003);
    // The way back and forth over the same ground: the same surface.
    let depth_mm = run.depth_errors_mm();
    assert!(rms(&depth_mm) < 0.6 && quantile(depth_mm, 0.95) < 1.8);
}

#[test]
fn a_laser_that_is_off_for_a_while_gives_no_point_from_those_frames() {
    let off = 30..45;
    let run = measure(scene("wall"), 2.0, 30.0, 24, |frame| !off.contains(&frame));
    let points = cloud_ply::read(&run.out().join("cloud.ply")).expect("a cloud");
    assert!(points.iter().all(|p| !off.contains(&p.frame)), "no point without a laser");
    assert!(points.iter().any(|p| p.frame >= off.end) && points.iter().any(|p| p.frame < off.start));
    let gap = run.manifest.gaps.iter().find(|g| g.reason == "no_stripe").expect("the gap is declared");
    assert_eq!((gap.first_frame, gap.last_frame), (off.start, off.end - 1));
    // The way goes on over the gap: the landmarks are still there.
    assert!(run.travel_error().abs() < 0.01, "{}", run.travel_error());
}

#[test]
fn the_stripes_own_sigma_holds_against_the_truth() {
    let run = measure(scene("wall"), 1.0, 30.0, 25, |_| true);
    let points = cloud_ply::read(&run.out().join("cloud.ply")).expect("a cloud");
    let rows = run.truth[0].stripe_across_px.len();
    let mut in_order = points.iter();
    let mut scaled = Vec::new();
    for (frame, truth) in run.truth.iter().enumerate() {
        for row in 0..rows {
            let at = run.stripes[frame * rows + row];
            if !at.is_finite() {
                continue;
            }
            let point = in_order.next().expect("a point for each spot");
            assert_eq!(point.frame as usize, frame);
            // The confidence is 1 / (1 + (σ / 0.2 px)²).
            let sigma_px = 0.2 * (1.0 / f64::from(point.confidence) - 1.0).sqrt();
            if truth.measurable[row] {
                scaled.push(f64::from(at - truth.stripe_across_px[row]) / sigma_px);
            }
        }
    }
    let rms = rms(&scaled);
    println!("errors in their own standard deviations: RMS {rms:.2}");
    assert!((0.5..1.6).contains(&rms), "{rms}");
}

#[test]
fn a_lens_and_lamps_change_nothing() {
    for (name, seed) in [("lens", 26), ("distractor", 27)] {
        let run = measure(scene(name), 1.0, 30.0, seed, |_| true);
        let (stripe, depth_mm) = (run.stripe_errors(), rms(&run.depth_errors_mm()));
        println!(
            "{name}: median {:.3} px, false {:.5}, depth RMS {depth_mm:.3} mm",
            stripe.median_px, stripe.false_share
        );
        assert!(stripe.median_px < 0.06 && stripe.found > 0.99 && stripe.false_share < 0.001, "{name}");
        assert!(run.travel_error().abs() < 0.005 && depth_mm < 0.6, "{name}: {} {depth_mm}", run.travel_error());
    }
}

#[test]
fn a_wall_without_texture_says_that_it_cannot_be_followed() {
    let mut blank = scene("wall").exact();
    blank.motion = Motion::Steady;
    let run = measure(blank, 0.5, 30.0, 28, |_| true);
    assert_eq!(run.manifest.quality.frames_tracked, 0);
    assert!(run.manifest.warnings.iter().any(|w| w.contains("motion was lost")), "{:?}", run.manifest.warnings);
    assert!(run.manifest.gaps.iter().any(|g| g.reason == "not_tracked"));
}

#[test]
fn few_frames_a_second_with_gait_are_followed() {
    // Some 37 px from frame to frame, and not evenly.
    let run = measure(scene("pipe"), 2.0, 12.0, 29, |_| true);
    println!("12 frames/s: travel {:+.3} %", 100.0 * run.travel_error());
    assert_eq!(run.manifest.quality.frames_tracked, u64::from(run.simulation.frames_total()) - 1);
    assert!(run.travel_error().abs() < 0.01, "{}", run.travel_error());
}
