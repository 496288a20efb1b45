//! Poses given with a source: used instead of the image's motion, or to help it.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use stria_core::export::cloud_ply;
use stria_core::export::manifest::{Manifest, sha256_of_file};
use stria_core::export::trajectory_csv::{self, TrajectoryRow};
use stria_core::geometry::WorldFromCamera;
use stria_core::motion::track::PoseTrack;
use stria_core::rig::LineDirection;
use stria_core::synthetic::{Scene, Simulation};
use stria_tests::support::run_stria;
use tempfile::TempDir;

const FRAMES: u32 = 30;

/// A simulated second, with its truth.
struct Run {
    folder: TempDir,
    simulation: Simulation,
}

impl Run {
    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join("run").join(name)
    }

    fn truth(&self) -> PathBuf {
        self.path("truth/trajectory.csv")
    }
}

fn run() -> &'static Run {
    static RUN: OnceLock<Run> = OnceLock::new();
    RUN.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let out = folder.path().join("run");
        let made = run_stria(&[
            "simulate",
            "pipe",
            "--seconds",
            "1",
            "--size",
            "640x360",
            "--fps",
            "30",
            "--seed",
            "5",
            "--out",
            text(&out),
        ]);
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let scene = Scene::named("pipe").expect("a scene");
        let simulation = Simulation::new(scene, (640, 360), 30.0, 1.0, 5).expect("the same run");
        assert_eq!(simulation.frames_total(), FRAMES);
        Run { folder, simulation }
    })
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

/// Processes the run into `out`.
fn process(out: &Path, more: &[&str]) -> Output {
    process_video(&run().path("video.mp4"), out, more)
}

fn process_video(video: &Path, out: &Path, more: &[&str]) -> Output {
    let rig = run().path("rig.toml");
    let mut arguments = vec!["process", text(video), "--rig", text(&rig), "--out", text(out)];
    arguments.extend(["--only", "cloud,trajectory"]);
    arguments.extend(more);
    run_stria(&arguments)
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn rows(out: &Path) -> Vec<TrajectoryRow> {
    trajectory_csv::read(&out.join("trajectory.csv")).expect("a trajectory")
}

/// The truth as the file says it.
fn truth() -> Vec<WorldFromCamera> {
    let track = PoseTrack::read(&run().truth(), LineDirection::Vertical, 1000).expect("the truth is a track");
    (0..FRAMES).map(|frame| track.at(frame, 0.0).expect("every frame").world_from_camera).collect()
}

/// The largest distance of poses from the truth, mm, and the largest angle, degrees.
fn largest_errors(rows: &[TrajectoryRow]) -> (f64, f64) {
    let truth = truth();
    let poses = rows.iter().filter_map(|row| Some((row.world_from_camera?, truth[row.frame as usize])));
    poses.fold((0.0, 0.0), |(mm, deg), (pose, truth)| {
        let off_mm = (pose.translation.vector - truth.translation.vector).norm();
        (off_mm.max(mm), pose.rotation.angle_to(&truth.rotation).to_degrees().max(deg))
    })
}

/// Median distance of the cloud from the true surface, mm.
fn median_depth_error_mm(out: &Path) -> f64 {
    let points = cloud_ply::read(&out.join("cloud.ply")).expect("a cloud");
    let off = |p: &nalgebra::Point3<f64>| Some((p.z - run().simulation.surface_z_mm(p.x, p.y)?).abs());
    let mut errors: Vec<f64> = points.iter().filter_map(|point| off(&point.point_in_world)).collect();
    assert!(errors.len() > 2000, "{} points on the wall", errors.len());
    errors.sort_by(f64::total_cmp);
    errors[errors.len() / 2]
}

fn edited_truth(name: &str, keep: impl Fn(u32, &str) -> Option<String>) -> PathBuf {
    let truth = std::fs::read_to_string(run().truth()).expect("the truth");
    let (head, body) = truth.split_once('\n').expect("lines");
    let lines = (0..).zip(body.lines()).filter_map(|(frame, line)| keep(frame, line));
    let path = run().folder.path().join(name);
    std::fs::write(&path, format!("{head}\n{}\n", lines.collect::<Vec<_>>().join("\n"))).expect("write");
    path
}

#[test]
fn given_poses_are_the_run_s_poses() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("products");
    let done = process(&out, &["--poses", text(&run().truth())]);
    assert_eq!(done.status.code(), Some(0), "{}", stderr(&done));
    let rows = rows(&out);
    assert_eq!(rows.len() as u32, FRAMES);
    assert!(rows.iter().all(|row| row.world_from_camera.is_some() && row.rotation_determined));
    assert!(rows.iter().all(|row| row.dx_px.is_none() && row.tracked == 0), "the image was not followed");
    let (off_mm, off_deg) = largest_errors(&rows);
    let depth_mm = median_depth_error_mm(&out);
    println!("instead: poses to {off_mm:.5} mm and {off_deg:.6}°, cloud's median {depth_mm:.3} mm off the wall");
    assert!(off_mm < 2e-4 && off_deg < 2e-5, "{off_mm} mm, {off_deg}°");
    assert!(depth_mm < 0.5, "{depth_mm} mm");

    let manifest = Manifest::load(&out).expect("a manifest");
    let quality = &manifest.quality;
    assert_eq!((quality.frames_tracked, quality.frames_6_dof), (u64::from(FRAMES) - 1, u64::from(FRAMES)));
    let sources: Vec<(&str, &str)> =
        manifest.source.iter().map(|file| (file.name.as_str(), file.sha256.as_str())).collect();
    let hash = sha256_of_file(&run().truth()).expect("a hash");
    assert_eq!(sources.len(), 2, "{sources:?}");
    assert_eq!(sources[1], ("trajectory.csv", hash.as_str()), "the track belongs to the source");
}

#[test]
fn times_and_metres_in_a_world_of_their_own_give_the_same() {
    let turn = WorldFromCamera::new(nalgebra::Vector3::new(5e4, -300.0, 70.0), nalgebra::Vector3::new(0.2, -0.9, 0.4));
    // Every second frame: what lies between is interpolated.
    let mut track = String::from("yaw_deg,time_s,z_m,roll_deg,x_m,note,pitch_deg,y_m\n");
    for (frame, pose) in (0..FRAMES).zip(truth()).filter(|(frame, _)| frame % 2 == 0 || *frame == FRAMES - 1) {
        let pose = turn * pose;
        let (roll, pitch, yaw) = stria_core::geometry::roll_pitch_yaw(&pose);
        let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_degrees);
        let [x, y, z]: [f64; 3] = (pose.translation.vector / 1000.0).into();
        let time_s = f64::from(frame) / 30.0;
        track += &format!("{yaw:.9},{time_s:.4},{z:.9},{roll:.9},{x:.9},wheel,{pitch:.9},{y:.9}\n");
    }
    let path = run().folder.path().join("odometry.csv");
    std::fs::write(&path, track).expect("write");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("products");
    let done = process(&out, &["--poses", text(&path)]);
    assert_eq!(done.status.code(), Some(0), "{}", stderr(&done));
    let rows = rows(&out);
    let (kept, between): (Vec<_>, Vec<_>) = rows.into_iter().partition(|row| row.frame % 2 == 0);
    // The times are rounded to 0.1 ms: 0.05 ms at some 200 mm/s. Between rows 67 ms apart the robot's gait (6 mm at 2 Hz,
    // 8 mm at 1.5 Hz) leaves the straight way by Aω²t²/8: up to 0.53 and 0.40 mm.
    let ((kept_mm, _), (between_mm, _)) = (largest_errors(&kept), largest_errors(&between));
    println!("odometry: {kept_mm:.4} mm at its rows, {between_mm:.4} mm between them");
    assert!(kept_mm < 0.05 && between_mm < 0.7, "{kept_mm} mm, {between_mm} mm");
}

#[test]
fn a_prior_helps_the_image_s_motion_and_does_not_replace_it() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("products");
    let done = process(&out, &["--poses", text(&run().truth()), "--set", "pose.track=prior"]);
    assert!(matches!(done.status.code(), Some(0 | 3)), "{}", stderr(&done));
    let quality = Manifest::load(&out).expect("a manifest").quality;
    let rows = rows(&out);
    assert!(rows.iter().skip(1).filter(|row| row.dx_px.is_some()).count() > 20, "the image was followed");
    let truth = truth();
    let travel_mm = |pose: &WorldFromCamera| pose.translation.x;
    let true_mm = travel_mm(truth.last().expect("poses")) - travel_mm(&truth[0]);
    let found = rows.last().and_then(|row| row.world_from_camera).expect("the last frame has a pose");
    let share = (travel_mm(&found) / true_mm - 1.0).abs();
    println!("prior: {:.2} of {true_mm:.2} mm, {:.3} %; {quality:?}", travel_mm(&found), 100.0 * share);
    assert!(share < 0.01, "travel off by {} %", 100.0 * share);
}

#[test]
fn a_prior_carries_the_pose_on_where_the_camera_is_blind() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let blind = folder.path().join("blind.mp4");
    let cover = "drawbox=x=0:y=0:w=iw:h=ih:color=gray:t=fill:enable='between(n,14,19)'";
    let made = Command::new("ffmpeg")
        .args(["-v", "error", "-i", text(&run().path("video.mp4")), "-vf", cover, "-crf", "14", text(&blind)])
        .status();
    assert!(made.expect("ffmpeg is missing: `make setup` installs it").success());
    let out = folder.path().join("products");
    let done = process_video(&blind, &out, &["--poses", text(&run().truth()), "--set", "pose.track=prior"]);
    assert_eq!(done.status.code(), Some(3), "{}", stderr(&done));
    let manifest = Manifest::load(&out).expect("a manifest");
    let warnings = manifest.warnings.join("\n");
    assert!(warnings.contains("lost in 6 of 30 frames: the given poses carried it on"), "{warnings}");
    assert_eq!((manifest.quality.breaks, manifest.quality.frames_tracked), (0, u64::from(FRAMES) - 1));
    assert_eq!(manifest.quality.frames_6_dof, u64::from(FRAMES) - 6, "what was carried on is not called measured");
    let rows = rows(&out);
    assert!(rows.iter().all(|row| row.world_from_camera.is_some()));
    assert!(rows.iter().all(|row| row.rotation_determined != (14..=19).contains(&row.frame)));
    let travel_mm = rows[29].world_from_camera.expect("a pose").translation.x;
    let true_mm = truth()[29].translation.x;
    println!("blind for 0.2 s: {travel_mm:.2} of {true_mm:.2} mm");
    assert!((travel_mm / true_mm - 1.0).abs() < 0.01, "{travel_mm} of {true_mm} mm");
}

#[test]
fn a_hole_in_the_track_is_a_gap_and_a_warning() {
    let with_hole = edited_truth("hole.csv", |frame, line| match frame {
        10..=12 => None,
        // Not known, in words of the file.
        13 => Some(format!("{}{}", line.split(',').take(2).collect::<Vec<_>>().join(","), ",".repeat(9))),
        _ => Some(line.to_string()),
    });
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("products");
    let done = process(&out, &["--poses", text(&with_hole)]);
    assert_eq!(done.status.code(), Some(3), "{}", stderr(&done));
    let manifest = Manifest::load(&out).expect("a manifest");
    let gaps: Vec<_> = manifest.gaps.iter().filter(|gap| gap.reason == "not_tracked").collect();
    assert_eq!(gaps.len(), 1, "{gaps:?}");
    assert_eq!((gaps[0].first_frame, gaps[0].last_frame), (10, 13));
    let warnings = manifest.warnings.join("\n");
    assert!(warnings.contains("frames 0 to 29") && warnings.contains("leave out 4 of 30 frames"), "{warnings}");
    let rows = rows(&out);
    assert!(rows.iter().all(|row| row.world_from_camera.is_some() != (10..=13).contains(&row.frame)));
    let cloud = cloud_ply::read(&out.join("cloud.ply")).expect("a cloud");
    assert!(cloud.iter().all(|point| !(10..=13).contains(&point.frame)), "no pose, no points");
    assert!(largest_errors(&rows).0 < 2e-4, "after the hole the world is the same");
}

#[test]
fn a_track_that_meets_no_frame_is_told() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("unix_times.csv");
    std::fs::write(&path, "time_s,x_mm,y_mm,z_mm\n1700000000.0,0,0,0\n1700000001.0,200,0,0\n").expect("write");
    let out = folder.path().join("products");
    let done = process(&out, &["--poses", text(&path)]);
    assert_eq!(done.status.code(), Some(3), "{}", stderr(&done));
    let warnings = Manifest::load(&out).expect("a manifest").warnings.join("\n");
    assert!(warnings.contains("meet none of 30 frames") && warnings.contains("1700000000.000 s to"), "{warnings}");
}

#[test]
fn bad_tracks_and_method_paper_are_refused() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let bad = folder.path().join("bad.csv");
    std::fs::write(&bad, "frame,x_mm,y_mm,z_mm\n0,0,0,0\n1,6.7,left,0\n").expect("write");
    let truth = run().truth();
    let missing = folder.path().join("missing.csv");
    for (arguments, expected) in [
        (vec!["--poses", text(&bad)], "line 3: y_mm is `left`; expected a number"),
        (vec!["--poses", text(&truth), "--recipe", "paper"], "expected a recipe with method `metric`, or no poses"),
        (vec!["--poses", text(&missing)], "missing.csv"),
        (vec!["--poses", text(&truth), "--set", "pose.track=sometimes"], "one of instead, prior"),
    ] {
        let out = folder.path().join("products");
        let refused = process(&out, &arguments);
        assert_eq!(refused.status.code(), Some(2), "{}", stderr(&refused));
        assert!(stderr(&refused).contains(expected), "{}", stderr(&refused));
        assert!(!out.exists(), "nothing half-made stays");
    }
}
