//! `stria calibrate` from outside: photos of simulated boards and walls against the rigs that took them.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;
use stria_core::rig::{LaserColour, LineDirection, Rig};
use stria_core::synthetic::{BoardScene, Motion, Output as Frames, Scene, Simulation, write_board_photos, write_run};
use stria_tests::support::run_stria;

/// The bars: plane within 0.05°, offset within 0.1 mm, focal length within 0.1 %. Held here with half to spare.
const ANGLE_DEG: f64 = 0.025;
const OFFSET_MM: f64 = 0.05;
const FOCAL_SHARE: f64 = 5e-4;

const PHOTOS: u32 = 15;

fn scene(lens: bool, line: LineDirection, colour: LaserColour, size_px: (u32, u32), seed: u64) -> BoardScene {
    let mut scene = Scene::named("wall").expect("a scene");
    (scene.line, scene.colour) = (line, colour);
    if lens {
        scene.distortion = [-0.28, 0.10, 0.0008, -0.0005, 0.0, 0.0, 0.0, 0.0];
    }
    BoardScene::new(scene.rig(size_px.0, size_px.1), seed).expect("a board")
}

fn plain(seed: u64) -> BoardScene {
    scene(false, LineDirection::Vertical, LaserColour::Green, (1280, 720), seed)
}

/// Photos with the laser on in all, in a new folder.
fn photos(scene: &BoardScene) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("photos");
    write_board_photos(scene, &out, PHOTOS, |_| Ok(())).expect("photos");
    (folder, out)
}

fn png(scene: &BoardScene, pose: &nalgebra::Isometry3<f64>, laser_on: bool, number: u32, path: &Path) {
    let image = scene.render(pose, laser_on, number);
    stria_core::synthetic::write_png(path, &image).expect("a photo");
}

fn calibrate(images: &Path, out: &Path, more: &[&str]) -> Output {
    let text = |path: &Path| path.to_str().expect("a plain path").to_string();
    let (images, out) = (text(images), text(out));
    let mut arguments = vec!["calibrate", &images, "--board", "9x6", "--square-mm", "25", "--out", &out];
    arguments.extend(more);
    run_stria(&arguments)
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Angle of the planes in degrees, difference of the offsets in mm, of the focal lengths as a share.
fn errors(found: &Rig, truth: &Rig) -> (f64, f64, f64) {
    let (a, b) = (&found.laser.plane, &truth.laser.plane);
    let sign = a.normal.dot(&b.normal).signum();
    (
        (a.normal * sign).angle(&b.normal).to_degrees(),
        (a.offset_mm * sign - b.offset_mm).abs(),
        (found.camera.fx_px / truth.camera.fx_px - 1.0).abs(),
    )
}

/// Calibrates and holds the bars.
fn hold_the_bars(name: &str, scene: &BoardScene, images: &Path, more: &[&str]) -> Rig {
    let out = images.with_file_name(format!("{name}.toml"));
    let done = calibrate(images, &out, more);
    assert!(matches!(done.status.code(), Some(0 | 3)), "{name}: {}", stderr(&done));
    assert!(out.with_extension("coverage.png").exists(), "a picture lies beside the rig");
    let rig = Rig::load(&out).expect("the rig is read back");
    assert_eq!((rig.name.as_str(), rig.laser.line), (name, scene.rig().laser.line));
    let (angle_deg, offset_mm, focal) = errors(&rig, scene.rig());
    println!("{name}: plane {angle_deg:.4}°, offset {offset_mm:.4} mm, focal length {:.4} %", 100.0 * focal);
    assert!(angle_deg < ANGLE_DEG && offset_mm < OFFSET_MM && focal < FOCAL_SHARE, "{name} holds the bars");
    rig
}

#[test]
fn a_pinhole_and_a_vertical_line() {
    let scene = plain(11);
    let (_folder, images) = photos(&scene);
    let rig = hold_the_bars("pinhole", &scene, &images, &[]);
    assert!(!rig.camera.has_distortion(), "no lens terms without a lens: {:?}", rig.camera.distortion);
}

#[test]
fn a_lens_and_a_red_horizontal_line() {
    let scene = scene(true, LineDirection::Horizontal, LaserColour::Red, (1280, 720), 12);
    let (_folder, images) = photos(&scene);
    let rig = hold_the_bars("lens", &scene, &images, &["--laser", "red"]);
    assert!((rig.camera.distortion[0] + 0.28).abs() < 0.005, "{:?}", rig.camera.distortion);
}

#[test]
fn full_hd_jpeg_photos_through_a_lens() {
    let scene = scene(true, LineDirection::Vertical, LaserColour::Green, (1920, 1080), 13);
    let (folder, images) = photos(&scene);
    let jpegs = folder.path().join("jpegs");
    std::fs::create_dir(&jpegs).expect("a folder");
    let quality = ["-pix_fmt", "yuvj420p", "-q:v", "3"];
    let made = Command::new("ffmpeg")
        .args(["-v", "error", "-i"])
        .arg(images.join("board_%02d.png"))
        .args(quality)
        .arg(jpegs.join("board_%02d.jpg"))
        .status();
    assert!(made.expect("ffmpeg is missing: `make setup` installs it").success());
    hold_the_bars("jpeg", &scene, &jpegs, &[]);
}

#[test]
fn some_photos_with_the_line_and_the_same_poses_without_it() {
    let mut scene = plain(14);
    // Bright light, a weak line, a wide fan.
    (scene.ambient, scene.laser_power, scene.line_sigma_mm) = (0.8, 0.25, 1.5);
    let folder = tempfile::tempdir().expect("a temporary folder");
    let images = folder.path().join("photos");
    std::fs::create_dir(&images).expect("a folder");
    for (number, pose) in (0..).zip(scene.poses(12).expect("poses")) {
        png(&scene, &pose, true, number, &images.join(format!("{number:02}_on.png")));
        if number % 2 == 0 {
            png(&scene, &pose, false, number + 100, &images.join(format!("{number:02}_off.png")));
        }
    }
    hold_the_bars("pairs", &scene, &images, &[]);
}

#[test]
fn programs_get_json_and_files_are_not_replaced() {
    let scene = plain(15);
    let (folder, images) = photos(&scene);
    let out = folder.path().join("rig.toml");
    let done = calibrate(&images, &out, &["--json", "--name", "robot 7", "--line", "vertical"]);
    let lines: Vec<Value> =
        String::from_utf8_lossy(&done.stdout).lines().map(|l| serde_json::from_str(l).expect("JSON")).collect();
    let (last, before) = lines.split_last().expect("lines");
    assert_eq!(before.iter().filter(|l| l["type"] == "photo").count(), PHOTOS as usize);
    assert_eq!((last["type"].as_str(), last["rig"]["name"].as_str()), (Some("result"), Some("robot 7")));
    assert!(last["standard_deviations"]["focal_px"].as_f64().is_some_and(|s| s > 0.0 && s < 1.0), "{last}");

    let again = calibrate(&images, &out, &[]);
    assert_eq!(again.status.code(), Some(2));
    assert!(stderr(&again).contains("--overwrite"), "{}", stderr(&again));

    // People count squares.
    let squares = run_stria(&[
        "calibrate",
        images.join("board_01.png").to_str().expect("a path"),
        "--board",
        "10x7",
        "--square-mm",
        "25",
        "--out",
        folder.path().join("squares.toml").to_str().expect("a path"),
    ]);
    assert_eq!(squares.status.code(), Some(2));
    assert!(
        stderr(&squares).contains("--board 9x6") && stderr(&squares).contains("count squares"),
        "{}",
        stderr(&squares)
    );
}

#[test]
fn thin_data_is_refused_with_advice() {
    let scene = plain(16);
    let folder = tempfile::tempdir().expect("a temporary folder");
    let set = |name: &str, count: u32, tilt_deg: f64, laser_on: bool| {
        let images = folder.path().join(name);
        std::fs::create_dir(&images).expect("a folder");
        for number in 0..count {
            let pose = scene.pose(number, tilt_deg).expect("a pose");
            png(&scene, &pose, laser_on, number, &images.join(format!("{number:02}.png")));
        }
        images
    };
    for (name, count, tilt_deg, laser_on, words) in [
        ("few", 4, 30.0, true, ["in 4 of 4", "at least 6"]),
        ("frontal", 9, 2.0, true, ["tilted", "15° to 40°"]),
        ("dark", 8, 30.0, false, ["laser's line is seen on the board in 0 of 8", "laser on"]),
    ] {
        let images = set(name, count, tilt_deg, laser_on);
        let out = folder.path().join(format!("{name}.toml"));
        let done = calibrate(&images, &out, &[]);
        assert_eq!(done.status.code(), Some(2), "{name}: {}", stderr(&done));
        assert!(words.iter().all(|w| stderr(&done).contains(w)), "{name}: {}", stderr(&done));
        assert!(!out.exists(), "{name}: a rig that is not to be trusted is not written");
        assert!(out.with_extension("coverage.png").exists(), "{name}: the picture shows why");
    }
}

/// A flat wall at a distance, seen squarely: some frames along it.
fn wall(folder: &Path, distance_mm: f64) -> PathBuf {
    let mut scene = Scene::named("wall").expect("a scene").without_relief();
    (scene.wall.distance_mm, scene.motion) = (distance_mm, Motion::Steady);
    let simulation = Simulation::new(scene, (1280, 720), 10.0, 1.0, 5).expect("a simulation");
    let out = folder.join(format!("wall_{distance_mm}"));
    write_run(&simulation, &out, Frames::Images, &mut |_, _| ControlFlow::Continue(())).expect("a wall");
    out.join("frames")
}

#[test]
fn flat_walls_at_known_distances() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let walls: Vec<(PathBuf, f64)> =
        [450.0, 600.0, 800.0, 1000.0].iter().map(|mm| (wall(folder.path(), *mm), *mm)).collect();
    let out = folder.path().join("flat.toml");
    let run = |told: &[f64]| {
        let mut arguments: Vec<String> =
            ["calibrate", "--fov-deg", "65.4", "--overwrite", "--out"].map(String::from).into();
        arguments.push(out.display().to_string());
        for ((source, _), mm) in walls.iter().zip(told) {
            arguments.extend(["--flat".into(), format!("{}={mm}", source.display())]);
        }
        run_stria(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
    };
    let truth = Scene::named("wall").expect("a scene").rig(1280, 720);
    let done = run(&[450.0, 600.0, 800.0, 1000.0]);
    assert_eq!(done.status.code(), Some(3), "a lens that nobody measured is a warning: {}", stderr(&done));
    let (angle_deg, offset_mm, _) = errors(&Rig::load(&out).expect("the rig"), &truth);
    println!("flat walls: plane {angle_deg:.4}°, offset {offset_mm:.3} mm");
    assert!(angle_deg < 0.05 && offset_mm < 0.5, "{angle_deg}°, {offset_mm} mm");

    let wrong = run(&[450.0, 600.0, 830.0, 1000.0]);
    assert_eq!(wrong.status.code(), Some(2));
    assert!(stderr(&wrong).contains("=830") && stderr(&wrong).contains("px"), "{}", stderr(&wrong));
    let two = run(&[450.0, 600.0]);
    assert_eq!(two.status.code(), Some(2));
    assert!(stderr(&two).contains("no residual"), "{}", stderr(&two));
}

#[test]
fn wrong_usage_says_what_was_expected() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("rig.toml");
    let out = out.to_str().expect("a path");
    for (arguments, word) in [
        (vec!["calibrate", "--out", out], "<IMAGES>"),
        (vec!["calibrate", "x.png", "--board", "9by6", "--square-mm", "25", "--out", out], "9x6"),
        (vec!["calibrate", "x.png", "--board", "9x6", "--square-mm=-1", "--out", out], "square-mm"),
        (vec!["calibrate", "nowhere.png", "--board", "9x6", "--square-mm", "25", "--out", out], "nowhere.png"),
        (
            vec!["calibrate", "--flat", "a.png=300", "--flat", "b.png=400", "--flat", "c.png=500", "--out", out],
            "--fov-deg",
        ),
        (vec!["calibrate", "--flat", "a.png", "--fov-deg", "60", "--out", out], "SOURCE=DISTANCE_MM"),
        (vec!["calibrate", "x.png", "--board", "9x6", "--square-mm", "25", "--out", "/nowhere/rig.toml"], "--out"),
    ] {
        let done = run_stria(&arguments);
        assert_eq!(done.status.code(), Some(2), "{arguments:?}: {}", stderr(&done));
        assert!(stderr(&done).contains(word), "{arguments:?}: {}", stderr(&done));
    }
}
