//! Sources as they come from the field: cut, empty, of one frame, of uneven rate, with hostile names and sizes.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::Command;

use stria_core::defects::Chainage;
use stria_core::export::manifest::Manifest;
use stria_core::pipeline::{ProductGroup, Request, process};
use stria_core::recipe::Recipe;
use stria_core::rig::Rig;
use stria_core::synthetic::{Output, Quality, Scene, Simulation, write_run};
use stria_core::{Error, Result};

const FRAMES: u64 = 24;

/// A short run in a folder of its own.
fn run() -> (tempfile::TempDir, PathBuf, Rig) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = Scene::named("wall").expect("a scene");
    let simulation = Simulation::new(scene, (640, 360), 24.0, 1.0, 4).expect("a simulation");
    let out = folder.path().join("run");
    write_run(&simulation, &out, Output::Video(Quality::Camera), &mut |_, _| ControlFlow::Continue(())).expect("a run");
    let rig = simulation.rig().clone();
    (folder, out.join("video.mp4"), rig)
}

/// Processes a source; a failure must leave no folder behind.
fn process_source(source: &Path, rig: &Rig) -> Result<Manifest> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out_dir = folder.path().join("products");
    let request = Request {
        source: source.to_path_buf(),
        topics: Vec::new(),
        source_name: source.file_name().expect("a name").to_string_lossy().into_owned(),
        fps: None,
        recorded_at: jiff::Timestamp::UNIX_EPOCH,
        asset: String::new(),
        chainage: Chainage::default(),
        rig: rig.clone(),
        recipe: Recipe::load("paper").expect("built in"),
        poses: None,
        out_dir: out_dir.clone(),
        products: vec![ProductGroup::Depth, ProductGroup::Cloud],
        live_segments: false,
    };
    let result = process(&request, &mut |_| ControlFlow::Continue(()));
    assert_eq!(out_dir.exists(), result.is_ok(), "nothing half-made stays");
    result
}

fn ffmpeg(arguments: &[&str], out: &Path) {
    let status = Command::new("ffmpeg").args(["-v", "error", "-y"]).args(arguments).arg(out).status();
    let status = status.expect("ffmpeg is missing: `make setup` installs it");
    assert!(status.success(), "ffmpeg {arguments:?}");
}

#[test]
fn a_video_cut_in_half_gives_the_half_it_has_with_a_warning() {
    let (folder, video, rig) = run();
    let bytes = std::fs::read(&video).expect("read");
    let half = folder.path().join("half.mp4");
    std::fs::write(&half, &bytes[..bytes.len() / 2]).expect("write");
    let manifest = process_source(&half, &rig).expect("the half is processed");
    assert!((FRAMES / 4..FRAMES).contains(&manifest.quality.frames), "{} frames", manifest.quality.frames);
    assert!(manifest.warnings.iter().any(|w| w.contains("announces 24 frames")), "{:?}", manifest.warnings);
}

#[test]
fn a_single_frame_gives_one_column_and_says_so() {
    let (folder, video, rig) = run();
    let single = folder.path().join("single.mp4");
    ffmpeg(&["-i", video.to_str().expect("a path"), "-frames:v", "1"], &single);
    let manifest = process_source(&single, &rig).expect("processed");
    assert_eq!(manifest.depth_map.expect("a map").width_px, 1);
    assert!(manifest.warnings.iter().any(|w| w.contains("single frame")), "{:?}", manifest.warnings);
}

#[test]
fn an_uneven_frame_rate_keeps_its_capture_times() {
    let (folder, video, rig) = run();
    let uneven = folder.path().join("uneven.mp4");
    let filter = "select='not(mod(n,3))+lt(mod(n,7),2)'";
    ffmpeg(&["-i", video.to_str().expect("a path"), "-vf", filter, "-fps_mode", "vfr"], &uneven);
    let (even, uneven) = (process_source(&video, &rig).expect("even"), process_source(&uneven, &rig).expect("uneven"));
    assert!(uneven.quality.frames < even.quality.frames);
    let lost_s = even.quality.duration_s - uneven.quality.duration_s;
    assert!(lost_s.abs() < 0.1, "the run lasts as long: {lost_s} s less");
    let share = uneven.quality.travel_mm / even.quality.travel_mm;
    assert!((share - 1.0).abs() < 0.05, "and goes as far: {share}");
}

#[test]
fn a_name_like_a_pattern_is_a_name() {
    let (folder, video, rig) = run();
    let odd = folder.path().join("a'b\" ..%03d*.mp4");
    std::fs::rename(&video, &odd).expect("renamed");
    assert_eq!(process_source(&odd, &rig).expect("processed").quality.frames, FRAMES);
}

#[test]
fn what_cannot_be_used_is_named_with_what_was_expected() {
    let (folder, video, rig) = run();
    let put = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).expect("write");
        path
    };
    let other =
        Simulation::new(Scene::named("wall").expect("a scene"), (320, 240), 24.0, 1.0, 4).expect("a simulation");
    for (source, rig, part) in [
        (put("empty.mp4", b""), &rig, "0 bytes"),
        (put("text.mp4", b"this is a letter\n"), &rig, "looks like text"),
        (put("zero.png", &png_header(0, 0)), &rig, "0x0"),
        (put("huge.png", &png_header(20_000, 20_000)), &rig, "16 to 8192 px"),
        (folder.path().join("missing.mp4"), &rig, "no such file"),
        (video, other.rig(), "320x240 px"),
    ] {
        let error = process_source(&source, rig).expect_err(part);
        assert!(matches!(error, Error::Input { .. }), "{error}");
        let message = error.to_string();
        let name = source.file_name().expect("a name").to_string_lossy().into_owned();
        assert!(message.contains(part) && message.contains(&name) && message.contains("expected"), "{message}");
    }
}

/// A PNG that claims a size and holds next to nothing.
fn png_header(width_px: u32, height_px: u32) -> Vec<u8> {
    let mut bytes = b"\x89PNG\r\n\x1a\n\x00\x00\x00\x0dIHDR".to_vec();
    bytes.extend(width_px.to_be_bytes());
    bytes.extend(height_px.to_be_bytes());
    bytes.extend([8, 2, 0, 0, 0]);
    let checksum = crc32(&bytes[12..]);
    bytes.extend(checksum.to_be_bytes());
    bytes.extend(b"\x00\x00\x00\x00IEND\xae\x42\x60\x82");
    bytes
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc: u32, _| (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg()))
    })
}
