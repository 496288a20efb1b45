//! An archive is enough: the job runs again from it alone with the same result, readers of others see what the job saw, and
//! parts of it are archives too.

use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::Value;
use stria_core::export::manifest::{Manifest, sha256_of_file};
use stria_tests::support::readers::{python_program, read, read_with_node, run};
use stria_tests::support::{Run, run_stria};
use tempfile::TempDir;

fn text(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

/// A simulated second and what it was made of.
struct Made {
    folder: TempDir,
    run: Run,
}

impl Made {
    fn new() -> Made {
        Made { folder: tempfile::tempdir().expect("a folder"), run: Run::simulate("1", "30", "640x360") }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The video packed otherwise by FFmpeg.
    fn packed(&self, name: &str, arguments: &[&str]) -> PathBuf {
        let out = self.path(name);
        run("ffmpeg", &[&["-v", "error", "-i", text(&self.run.video)], arguments, &[text(&out)]].concat());
        out
    }

    /// The video as a folder of images.
    fn images(&self, extension: &str) -> PathBuf {
        let folder = self.path(extension);
        std::fs::create_dir(&folder).expect("a folder");
        self.packed(&format!("{extension}/%04d.{extension}"), &["-q:v", "2"]);
        folder
    }

    fn process(&self, source: &Path, out: &str, more: &[&str]) -> (PathBuf, Output) {
        let out = self.path(out);
        let done = run_stria(&[&["process", text(source), "--out", text(&out)], more].concat());
        let code = done.status.code();
        assert!(matches!(code, Some(0 | 3)), "{code:?}: {}", said(&done));
        (out, done)
    }
}

fn same_again(made: &Made, name: &str, source: &Path, more: &[&str]) -> Output {
    let rig = ["--rig", text(&made.run.rig)];
    let (first, done) = made.process(source, &format!("{name}-1"), &[&rig[..], more].concat());
    // The archive alone: no rig, no recipe, no poses, no rate are named.
    let (second, _) = made.process(&first.join("archive.mcap"), &format!("{name}-2"), &[]);
    for product in ["depth.tif", "cloud.ply", "texture.jpg", "trajectory.csv"] {
        let hash = |folder: &Path| sha256_of_file(&folder.join(product)).expect("hashed");
        assert_eq!(hash(&first), hash(&second), "{name}: {product}");
    }
    let (a, b) = (Manifest::load(&first).expect("a manifest"), Manifest::load(&second).expect("a manifest"));
    assert_eq!((a.rig_sha256, a.recipe_sha256), (b.rig_sha256, b.recipe_sha256), "{name}");
    assert!(a.quality.points > 1000, "{name}: something was measured");
    done
}

#[test]
fn from_an_archive_alone_comes_the_same_map_bit_for_bit() {
    let made = Made::new();
    same_again(&made, "h264", &made.run.video, &["--set", "map.mm_per_px=2"]);
    let matroska = made.packed("run.mkv", &["-c", "copy"]);
    same_again(&made, "mkv", &matroska, &[]);
    let stream = made.packed("run.ts", &["-c:v", "libx264", "-bf", "0", "-crf", "20"]);
    same_again(&made, "ts", &stream, &[]);
    let hevc = made.packed("hevc.mp4", &["-c:v", "libx265", "-x265-params", "log-level=none", "-crf", "24"]);
    same_again(&made, "hevc", &hevc, &[]);
    let motion_jpeg = made.packed("run.avi", &["-c:v", "mjpeg", "-q:v", "3"]);
    same_again(&made, "mjpeg", &motion_jpeg, &[]);
    for extension in ["jpg", "png"] {
        same_again(&made, extension, &made.images(extension), &["--fps", "30"]);
    }
    let truth = made.run.video.with_file_name("truth").join("trajectory.csv");
    same_again(&made, "poses", &made.run.video, &["--poses", text(&truth)]);
    same_again(&made, "paper", &made.run.video, &["--recipe", "paper"]);
}

#[test]
fn b_frames_are_kept_in_decoding_order_and_said() {
    let made = Made::new();
    let video = made.packed("b.mp4", &["-c:v", "libx264", "-bf", "3", "-g", "12", "-crf", "18"]);
    let done = same_again(&made, "b", &video, &[]);
    assert_eq!(done.status.code(), Some(3), "it is a warning");
    assert!(said(&done).contains("B-frames"), "{}", said(&done));
    let archive = made.path("b-1").join("archive.mcap");
    let read = read("mcap_archive.py", &[&archive]);
    assert_eq!(read["metadata"]["video"]["order"], "decoding");
    let times = |name: &str| -> Vec<u64> {
        let list = read["topics"]["/camera/video"][name].as_array().expect("times");
        list.iter().map(|t| t.as_u64().expect("a time")).collect()
    };
    let (log, own) = (times("times_ns"), times("stamps_ns"));
    assert!(log.is_sorted(), "players take messages by their log time: that is the order for decoding");
    assert!(!own.is_sorted(), "the capture times are the messages' own");
    let mut sorted = own.clone();
    sorted.sort_unstable();
    assert!(log.iter().zip(&sorted).all(|(log, own)| log.abs_diff(*own) < 1_000_000), "each is a frame's capture time");
    // An archive without them says nothing.
    let (plain, done) = made.process(&made.run.video, "plain", &["--rig", text(&made.run.rig)]);
    assert!(!said(&done).contains("B-frames"));
    let plain = self::read("mcap_archive.py", &[&plain.join("archive.mcap")]);
    assert_eq!(plain["metadata"]["video"]["order"], "capture");
    let video = &plain["topics"]["/camera/video"];
    assert_eq!(video["times_ns"], video["stamps_ns"]);
}

#[test]
fn the_readers_of_others_see_what_the_job_saw() {
    let made = Made::new();
    let (out, _) = made.process(&made.run.video, "job", &["--rig", text(&made.run.rig)]);
    let archive = out.join("archive.mcap");
    let manifest = Manifest::load(&out).expect("a manifest");
    let python = read("mcap_archive.py", &[&archive]);
    let node = read_with_node("mcap.mjs", &archive);
    assert_eq!(node["messages"], python["statistics"]["messages"]);
    for (name, topic) in python["topics"].as_object().expect("topics") {
        let times = topic["times_ns"].as_array().expect("times");
        let ends = [times.first(), times.last()].map(|t| t.expect("a time").to_string());
        let seen = &node["topics"][name];
        assert_eq!(seen["messages"], times.len(), "{name}");
        assert_eq!(
            [&seen["first_ns"], &seen["last_ns"]].map(|t| t.as_str().expect("a time").to_string()),
            ends,
            "{name}"
        );
    }
    let frames = manifest.quality.frames;
    for name in ["/camera/video", "/tf", "/profile", "/measurement"] {
        assert_eq!(python["topics"][name]["times_ns"].as_array().map(Vec::len), Some(frames as usize), "{name}");
    }
    let surface = python["topics"]["/surface"]["of"].as_array().expect("chunks");
    assert_eq!(surface.iter().filter_map(|c| c["points"].as_u64()).sum::<u64>(), manifest.quality.points);
    let poses = std::fs::read_to_string(out.join("trajectory.csv")).expect("read");
    for (line, pose) in poses.lines().skip(1).zip(python["topics"]["/tf"]["of"].as_array().expect("poses")) {
        let x_mm: f64 = line.split(',').nth(5).expect("x").parse().expect("a number");
        assert!((pose["translation"][0].as_f64().unwrap_or(f64::NAN) * 1000.0 - x_mm).abs() < 1e-3, "{line}");
    }
    for name in ["rig.toml", "recipe.toml", "manifest.json", "preview.png"] {
        assert!(python["attachments"][name].is_object(), "{name} is attached");
        assert!(node["attachments"].as_array().is_some_and(|files| files.iter().any(|file| file == name)), "{name}");
    }

    let rerun = python_program("rerun");
    let checked = String::from_utf8_lossy(&run(&rerun, &["mcap", "check", "--full", text(&archive)])).into_owned();
    let issues: Vec<&str> = checked.lines().filter(|line| line.contains(" /")).collect();
    assert!(issues.len() >= 8 && issues.iter().all(|line| line.starts_with("ok")), "{checked}");
    let recording = made.path("converted.rrd");
    run(&rerun, &["mcap", "convert", text(&archive), "-o", text(&recording)]);
    run(&rerun, &["rrd", "verify", text(&recording)]);
    let converted = read("rrd.py", &[&recording]);
    let entities = converted["entities"].as_object().expect("entities");
    assert_eq!(
        entities["camera/video"]["components"]["VideoStream:sample"]["values"].as_u64().map(|n| n > 0),
        Some(true)
    );
    let points = |name: &str| entities[name]["components"]["Points3D:positions"]["values"].as_u64();
    assert_eq!(points("surface"), Some(3 * manifest.quality.points), "three numbers a point");
    let overview = points("surface/overview").expect("the whole surface in one message");
    assert!((1..=3 * manifest.quality.points).contains(&overview), "{overview} numbers");
}

fn count(read: &Value, topic: &str) -> usize {
    read["topics"][topic]["times_ns"].as_array().map_or(0, Vec::len)
}

#[test]
fn a_part_of_an_archive_is_an_archive() {
    let made = Made::new();
    let (out, _) = made.process(&made.run.video, "job", &["--rig", text(&made.run.rig)]);
    let whole = read("mcap_archive.py", &[&out.join("archive.mcap")]);
    let part = |name: &str, options: &[&str]| {
        let path = made.path(name);
        let command = ["export", text(&out), "--format", "mcap", "--out", text(&path)];
        let done = run_stria(&[&command[..], options].concat());
        assert!(done.status.success(), "{}", said(&done));
        (read("mcap_archive.py", &[&path]), path)
    };
    let (copy, path) = part("copy.mcap", &[]);
    assert_eq!(copy, whole);
    assert_eq!(sha256_of_file(&path).ok(), sha256_of_file(&out.join("archive.mcap")).ok());

    let (bare, path) = part("bare.mcap", &["--without-frames"]);
    assert_eq!((count(&bare, "/camera/video"), count(&bare, "/profile")), (0, 30));
    assert_eq!(bare["topics"]["/tf"], whole["topics"]["/tf"]);
    assert_eq!(bare["metadata"]["cut"]["frames"], "false");
    assert_eq!(bare["attachments"], whole["attachments"]);
    assert_eq!(read_with_node("mcap.mjs", &path)["messages"], bare["statistics"]["messages"]);

    let (third, _) = part("third.mcap", &["--every", "3"]);
    assert_eq!((count(&third, "/profile"), count(&third, "/tf"), count(&third, "/measurement")), (10, 10, 10));
    assert!((1..10).contains(&count(&third, "/camera/video")), "where decoding can start");

    // 0.2 m/s: 6.7 mm a frame; the line lies some 134 mm ahead of the camera.
    let (middle, path) = part("middle.mcap", &["--from-mm", "1200", "--to-mm", "1250", "--chainage-mm", "1000"]);
    let kept = count(&middle, "/measurement");
    assert!((6..=9).contains(&kept), "{kept} frames in 50 mm");
    for measured in middle["topics"]["/measurement"]["of"].as_array().expect("measurements") {
        assert!(measured["x_mm"].as_f64().is_some_and(|x| (200.0..=250.0).contains(&x)), "{measured}");
    }
    assert_eq!((count(&middle, "/profile"), count(&middle, "/tf")), (kept, kept));
    assert!(count(&middle, "/camera/video") >= kept, "from the last frame at which decoding can start");
    let backward = ["--from-mm", "750", "--to-mm", "800", "--chainage-mm", "1000", "--direction", "backward"];
    assert_eq!(part("backward.mcap", &backward).0["topics"], middle["topics"]);
    // What is left of the video decodes and can be processed again.
    let (again, _) = made.process(&path, "again", &["--only", "trajectory"]);
    assert!(Manifest::load(&again).is_ok_and(|m| m.quality.frames >= kept as u64));

    let none = run_stria(&["export", text(&out), "--format", "mcap", "--every", "0"]);
    assert_eq!(none.status.code(), Some(2), "{}", said(&none));
}

#[test]
fn an_archive_cut_off_by_a_power_loss_gives_what_it_holds() {
    let made = Made::new();
    // JPEG frames are most of this archive, so that a cut hits them.
    let (out, _) = made.process(&made.images("jpg"), "job", &["--rig", text(&made.run.rig), "--fps", "30"]);
    let bytes = std::fs::read(out.join("archive.mcap")).expect("read");
    let cut = made.path("cut.mcap");
    let mut found = Vec::new();
    for share in [35, 45, 55, 65, 75] {
        std::fs::write(&cut, &bytes[..bytes.len() * share / 100]).expect("write");
        let out = made.path(&format!("again-{share}"));
        let done = run_stria(&["process", text(&cut), "--out", text(&out), "--only", "trajectory,cloud"]);
        if done.status.code() == Some(2) {
            // The frames stand behind what was measured: this cut left none.
            assert!(said(&done).contains("images") && !out.exists(), "{}", said(&done));
            continue;
        }
        assert_eq!(done.status.code(), Some(3), "with a warning: {}", said(&done));
        assert!(said(&done).contains("it was cut off; what it holds was read"), "{}", said(&done));
        found.push(Manifest::load(&out).expect("a manifest").quality.frames);
    }
    assert!(found.is_sorted() && found.iter().any(|n| (1..30).contains(n)), "{found:?} frames");
    let inspected = run_stria(&["inspect", text(&cut)]);
    assert!(inspected.status.success() && said(&inspected).contains("it was cut off"), "{}", said(&inspected));
}
