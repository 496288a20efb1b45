//! The simulated run against its own truth.

use std::process::Command;

use nalgebra::Point3;

use super::*;
use crate::geometry::world_from_camera;

const SIZE: (u32, u32) = (640, 360);

fn simulation(scene: Scene) -> Simulation {
    Simulation::new(scene, SIZE, 30.0, 1.0, 5).expect("a valid run")
}

/// Runs a program of FFmpeg's; a missing one fails the test with what to do.
fn ffmpeg(program: &str, arguments: &[&str], file: &std::path::Path) -> Vec<u8> {
    let output = Command::new(program)
        .args(["-v", "error"])
        .args(arguments.iter().map(|a| if *a == "FILE" { file.as_os_str() } else { std::ffi::OsStr::new(a) }))
        .output()
        .unwrap_or_else(|e| panic!("{program}: {e}; `make setup` installs it"));
    assert!(output.status.success(), "{program}: {}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

/// The centroid of the laser's own channel in linear light, without the ambient level: no estimator of ours.
fn centroid(image: &Image, rig: &Rig, position: usize, near_px: f64) -> f64 {
    let linear = |v: u8| {
        let v = f64::from(v) / 255.0;
        if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    };
    let width = image.width_px() as usize;
    let at = |across: usize| match rig.laser.line {
        LineDirection::Vertical => 3 * (position * width + across) + 1,
        LineDirection::Horizontal => 3 * (across * width + position) + 1,
    };
    let centre = near_px.round() as usize;
    let level = linear(image.bgr()[at(centre - 20)]);
    let window = centre - 16..=centre + 16;
    let weights: Vec<(f64, f64)> = window.map(|a| (a as f64, linear(image.bgr()[at(a)]) - level)).collect();
    weights.iter().map(|(a, w)| a * w).sum::<f64>() / weights.iter().map(|(_, w)| w).sum::<f64>()
}

#[test]
fn the_true_line_triangulates_onto_the_true_surface() {
    for (name, line) in [
        ("wall", LineDirection::Vertical),
        ("pipe", LineDirection::Vertical),
        ("lens", LineDirection::Vertical),
        ("pipe", LineDirection::Horizontal),
        ("lens", LineDirection::Horizontal),
    ] {
        let simulation = simulation(Scene { line, ..Scene::named(name).expect(name) });
        let (_, truth) = simulation.render(17);
        let rig = simulation.rig();
        let (mut seen, mut worst_mm) = (0, 0f64);
        for (position, across) in truth.stripe_across_px.iter().enumerate().filter(|(_, a)| a.is_finite()) {
            let (position, across) = (position as f64, f64::from(*across));
            let pixel = match line {
                LineDirection::Vertical => RawPixel { u_px: across, v_px: position },
                LineDirection::Horizontal => RawPixel { u_px: position, v_px: across },
            };
            let point = rig.laser.plane.meet(rig.camera.undistort(pixel)).expect("in front of the camera");
            let world = truth.world_from_camera * point;
            let z = simulation.surface_z_mm(world.x, world.y).expect("on the surface");
            worst_mm = worst_mm.max((z - world.z).abs());
            seen += 1;
        }
        assert!(seen * 10 >= truth.stripe_across_px.len() * 9, "{name} {line:?}: only {seen} line positions");
        assert!(worst_mm < 1e-3, "{name} {line:?}: {worst_mm} mm off the surface");
    }
}

#[test]
fn the_exact_image_shows_the_line_at_its_true_place() {
    for (name, line) in [
        ("wall", LineDirection::Vertical),
        ("pipe", LineDirection::Vertical),
        ("lens", LineDirection::Vertical),
        ("wall", LineDirection::Horizontal),
    ] {
        for scene in [Scene::named(name).expect(name).exact(), Scene::named(name).expect(name).exact_with_texture()] {
            let simulation = simulation(Scene { line, ..scene });
            let (image, truth) = simulation.render(9);
            assert!(image.bgr().iter().all(|v| *v < 250), "nothing saturates");
            let mut misses: Vec<f64> = truth
                .stripe_across_px
                .iter()
                .enumerate()
                .map(|(i, a)| (centroid(&image, simulation.rig(), i, f64::from(*a)) - f64::from(*a)).abs())
                .collect();
            misses.sort_by(f64::total_cmp);
            let (middle, worst) = (misses[misses.len() / 2], misses[misses.len() - 1]);
            assert!(middle < 0.003 && worst < 0.01, "{name} {line:?}: median {middle} px, worst {worst} px");
        }
    }
}

#[test]
fn the_rendered_fan_agrees_with_the_solved_line() {
    // The fan's light comes from the baked surface, the truth from the exact one. On a lens and curved relief.
    let mut scene = Scene::named("lens").expect("lens").exact();
    scene.laser.profile = LineProfile::Fan { sigma_mm: 3.5 };
    let simulation = simulation(scene);
    let (image, truth) = simulation.render(3);
    for (row, across) in truth.stripe_across_px.iter().enumerate() {
        let miss = centroid(&image, simulation.rig(), row, f64::from(*across)) - f64::from(*across);
        assert!(miss.abs() < 0.06, "row {row}: {miss} px");
    }
}

#[test]
fn the_same_seed_gives_the_same_frames_in_any_order() {
    let run = || simulation(Scene::named("distractor").expect("scene"));
    let (first, second) = (run(), run());
    let late = first.render(20);
    let early = first.render(2);
    assert_eq!(early, second.render(2));
    assert_eq!(late, second.render(20));
    let other = Simulation::new(Scene::named("distractor").expect("scene"), SIZE, 30.0, 1.0, 6).expect("valid");
    assert_ne!(other.render(2).0, early.0);
}

#[test]
fn a_steady_run_shifts_by_focal_length_times_way_over_distance() {
    let scene = Scene { motion: Motion::Steady, ..Scene::named("wall").expect("wall").without_relief() };
    let simulation = simulation(scene);
    let expected = -simulation.rig().camera.fx_px * 200.0 / 30.0 / 850.0;
    for frame in [1, 12] {
        let (_, truth) = simulation.render(frame);
        assert!((truth.dx_px - expected).abs() < 1e-3, "{} px, expected {expected} px", truth.dx_px);
        assert!(truth.dy_px.abs() < 1e-6 && (truth.scale - 1.0).abs() < 1e-6);
    }
    // With the line along the rows the robot moves along the image's columns.
    let horizontal =
        Simulation::new(Scene { line: LineDirection::Horizontal, ..simulation.scene().clone() }, SIZE, 30.0, 1.0, 5);
    let (_, truth) = horizontal.expect("valid").render(1);
    assert!((truth.dy_px - expected).abs() < 1e-3 && truth.dx_px.abs() < 1e-6, "{} {}", truth.dx_px, truth.dy_px);
}

#[test]
fn coming_closer_enlarges_the_image() {
    let poses = vec![WorldFromCamera::identity(), world_from_camera(Vector3::new(0.0, 0.0, 85.0), 0.0, 0.0, 0.0)];
    let scene = Scene { motion: Motion::Poses(poses), ..Scene::named("wall").expect("wall").without_relief() };
    let (_, truth) = simulation(scene).render(1);
    assert!((truth.scale - 850.0 / 765.0).abs() < 1e-9, "{}", truth.scale);
}

#[test]
fn standing_still_shows_the_same_wall() {
    let scene = Scene { noise: None, ..Scene::named("stop").expect("stop") };
    let simulation = Simulation::new(scene, SIZE, 30.0, 3.0, 5).expect("valid");
    let ((here, here_truth), (there, there_truth)) = (simulation.render(50), simulation.render(60));
    assert_eq!(here, there, "the camera stands still, so nothing changes, not even speckle");
    assert_eq!(here_truth.stripe_across_px, there_truth.stripe_across_px);
    assert_eq!((there_truth.dx_px, there_truth.dy_px), (0.0, 0.0));
    let back = simulation.render(75).1;
    assert!(back.dx_px > 1.0, "going back moves the image to the right: {}", back.dx_px);
}

#[test]
fn no_laser_has_no_line() {
    let (_, truth) = simulation(Scene::named("no-laser").expect("scene")).render(0);
    assert!(truth.stripe_across_px.iter().all(|a| a.is_nan()) && truth.measurable.iter().all(|m| !m));
}

#[test]
fn a_highlight_washes_the_line_out_and_a_block_hides_it() {
    let (_, pipe) = simulation(Scene::named("pipe").expect("pipe")).render(0);
    let washed = pipe.measurable.iter().filter(|m| !**m).count();
    assert!(washed > 3 && washed < pipe.measurable.len() / 4, "{washed} positions");
    // Rows that look past a block's lower edge see plate and line behind it; a turned camera loses some of them.
    let gauge = simulation(Scene::named("step-gauge").expect("gauge"));
    let (_, truth) = gauge.render(0);
    let deepest = |y: f64| {
        let row = gauge.rig().camera.project(&Point3::new(0.0, y, 450.0)).v_px.round() as usize;
        truth.stripe_across_px[row]
    };
    // 20 mm of height move the line by C1·(1/430 − 1/450).
    let expected = gauge.rig().camera.fx_px * 150.0 * (1.0 / 430.0 - 1.0 / 450.0);
    let moved = f64::from(deepest(90.0) - deepest(67.0));
    assert!((moved - expected).abs() < 0.01, "{moved} px, expected {expected} px");
}

#[test]
fn nonsense_is_refused() {
    let new = |size, fps, seconds| Simulation::new(Scene::named("wall").expect("wall"), size, fps, seconds, 1);
    for (run, word) in [
        (new((0, 0), 30.0, 1.0), "0x0"),
        (new((20_000, 20_000), 30.0, 1.0), "20000x20000"),
        (new((8192, 8192), 30.0, 1.0), "8192x4320"),
        (new(SIZE, 0.0, 1.0), "frames/s"),
        (new(SIZE, f64::NAN, 1.0), "frames/s"),
        (new(SIZE, 30.0, 0.0), "3600"),
        (new(SIZE, 30.0, f64::INFINITY), "3600"),
        (new(SIZE, 30.0, 4000.0), "3600"),
    ] {
        let message = run.err().expect(word).to_string();
        assert!(message.contains(word), "{message}");
    }
}

#[test]
fn a_camera_video_comes_back_by_ffmpeg() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let out = folder.path().join("run");
    let simulation = Simulation::new(Scene::named("pipe").expect("pipe"), SIZE, 30.0, 1.4, 5).expect("valid");
    let mut heard = 0;
    write_run(&simulation, &out, Output::Video(Quality::Camera), &mut |done, total| {
        assert_eq!((done, total), (heard + 1, 42));
        heard = done;
        std::ops::ControlFlow::Continue(())
    })
    .expect("written");
    let video = out.join("video.mp4");
    let arguments =
        ["-i", "FILE", "-f", "rawvideo", "-pix_fmt", "bgr24", "-sws_flags", "accurate_rnd+full_chroma_int", "-"];
    let decoded = ffmpeg("ffmpeg", &arguments, &video);
    let frame_bytes = 3 * 640 * 360;
    assert_eq!(decoded.len(), 42 * frame_bytes, "every frame, once");
    for frame in [0usize, 17, 41] {
        let (image, _) = simulation.render(frame as u32);
        let seen = &decoded[frame * frame_bytes..][..frame_bytes];
        let mean = |c: usize, bytes: &[u8]| {
            bytes.iter().skip(c).step_by(3).map(|v| f64::from(*v)).sum::<f64>() / (bytes.len() / 3) as f64
        };
        for c in 0..3 {
            let (a, b) = (mean(c, image.bgr()), mean(c, seen));
            assert!((a - b).abs() < 1.0, "frame {frame}, channel {c}: {a} became {b}");
        }
        let worst_luma = image.bgr().chunks_exact(3).zip(seen.chunks_exact(3)).map(|(a, b)| {
            let luma = |p: &[u8]| 0.0722 * f64::from(p[0]) + 0.7152 * f64::from(p[1]) + 0.2126 * f64::from(p[2]);
            (luma(a) - luma(b)).abs()
        });
        assert!(worst_luma.sum::<f64>() / (640.0 * 360.0) < 2.5, "frame {frame}: not the same picture");
    }
    let probe = ffmpeg(
        "ffprobe",
        &[
            "-show_entries",
            "stream=nb_frames,has_b_frames,color_space,color_range,avg_frame_rate:packet=flags",
            "-of",
            "compact",
            "FILE",
        ],
        &video,
    );
    let probe = String::from_utf8_lossy(&probe);
    for word in ["nb_frames=42", "has_b_frames=0", "color_space=bt709", "color_range=tv", "avg_frame_rate=30/1"] {
        assert!(probe.contains(word), "{word} in {probe}");
    }
    assert_eq!(probe.matches("flags=K").count(), 2, "a key frame each second");
    half_of_it_plays(&video, 10);
}

/// A file cut in half still gives at least so many frames.
fn half_of_it_plays(video: &std::path::Path, at_least: usize) {
    let bytes = std::fs::read(video).expect("video");
    let half = video.with_file_name("half.mp4");
    std::fs::write(&half, &bytes[..bytes.len() / 2]).expect("half");
    let output = Command::new("ffmpeg").args(["-v", "quiet", "-i"]).arg(&half).args(["-f", "framemd5", "-"]).output();
    let text = String::from_utf8_lossy(&output.expect("ffmpeg runs").stdout).into_owned();
    let frames = text.lines().filter(|l| !l.starts_with('#')).count();
    assert!(frames >= at_least, "{frames} frames of half the file");
}

#[test]
fn lossless_video_and_images_hold_the_very_pixels() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let scene = Scene::named("wall").expect("wall").exact_with_texture();
    let simulation = Simulation::new(scene, (321, 181), 25.0, 0.2, 5).expect("valid");
    let go_on = &mut |_, _| std::ops::ControlFlow::Continue(());
    write_run(&simulation, &folder.path().join("a"), Output::Video(Quality::Lossless), go_on).expect("video");
    write_run(&simulation, &folder.path().join("b"), Output::Images, go_on).expect("images");
    let arguments = ["-i", "FILE", "-f", "rawvideo", "-pix_fmt", "bgr24", "-"];
    let video = ffmpeg("ffmpeg", &arguments, &folder.path().join("a/video.mp4"));
    let image = ffmpeg("ffmpeg", &arguments, &folder.path().join("b/frames/000003.png"));
    let (expected, _) = simulation.render(3);
    assert_eq!(image, expected.bgr());
    assert_eq!(&video[3 * expected.bgr().len()..][..expected.bgr().len()], expected.bgr());
    let (rows, columns, stripes) =
        crate::export::npy::read_f32(&folder.path().join("b/truth/stripes.npy")).expect("stripes");
    assert_eq!((rows, columns), (5, 181));
    assert_eq!(stripes[3 * 181..4 * 181], simulation.render(3).1.stripe_across_px[..]);
    assert_eq!(Rig::load(&folder.path().join("b/rig.toml")).expect("rig"), *simulation.rig());
}

#[test]
fn a_stopped_or_refused_run_leaves_nothing_behind() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let out = folder.path().join("run");
    let run = simulation(Scene::named("wall").expect("wall"));
    let stopped = write_run(&run, &out, Output::Images, &mut |_, _| std::ops::ControlFlow::Break(()));
    assert_eq!(stopped.expect_err("stopped").kind(), "cancelled");
    let odd = Simulation::new(Scene::named("wall").expect("wall"), (321, 181), 30.0, 1.0, 1).expect("valid");
    let refused =
        write_run(&odd, &out, Output::Video(Quality::Camera), &mut |_, _| std::ops::ControlFlow::Continue(()));
    assert!(refused.expect_err("odd").to_string().contains("even"));
    assert_eq!(std::fs::read_dir(folder.path()).expect("folder").count(), 0);
    std::fs::create_dir(&out).expect("folder");
    std::fs::write(out.join("mine.txt"), "mine").expect("file");
    let taken = write_run(&run, &out, Output::Images, &mut |_, _| std::ops::ControlFlow::Continue(()));
    assert!(taken.expect_err("taken").to_string().contains("empty folder"));
    assert!(out.join("mine.txt").exists());
}
