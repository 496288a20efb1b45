//! `recording.rrd` and the live segments.

use std::path::{Path, PathBuf};

use serde_json::Value;
use stria_core::recipe::RecordingOptions;
use stria_core::recording::{RecordedRun, Recorder, Recordings, Segment};

use super::known_run::KnownRun;
use stria_tests::support::readers::read;

const ENTITIES: [&str; 23] = [
    "depth_image",
    "guide",
    "messages",
    "plots/rows_found",
    "plots/scale",
    "plots/shift",
    "steps/all_rows/scale",
    "steps/all_rows/sheet",
    "steps/all_rows/threshold",
    "steps/effective_area",
    "steps/one_row/gray",
    "steps/one_row/scale",
    "steps/one_row/sheet",
    "steps/one_row/spot",
    "steps/one_row/threshold",
    "steps/one_row/words",
    "world",
    "world/camera",
    "world/camera/image",
    "world/camera/image/corners",
    "world/camera/image/spots",
    "world/profile",
    "world/surface",
];

fn run_info(frames: Option<u64>, fps: f64) -> RecordedRun<'static> {
    RecordedRun {
        name: "known run",
        recorded_at: "2026-03-01T10:00:00Z".parse().expect("a time"),
        frames_expected: frames,
        duration_expected_s: frames.map(|n| n as f64 / fps),
        watched: false,
    }
}

fn record(dir: &Path, frames: u32, segments: bool) -> Vec<Segment> {
    let run = KnownRun::new(640, 360, 30.0);
    let options = RecordingOptions { segment_s: 0.1, image_width_px: 320, ..RecordingOptions::default() };
    let live = segments.then(|| dir.join("recording"));
    let info = run_info(Some(u64::from(frames)), run.fps);
    let mut recorder =
        Recorder::create(&options, &run.rig, &info, &dir.join("recording.rrd"), live.as_deref()).expect("starts");
    let mut done = Vec::new();
    for index in 0..frames {
        let frame = run.frame(index);
        done.extend(recorder.log_frame(&frame.steps()).expect("a frame"));
        if index == 40 {
            recorder.log_warning("frame 40 is blurred").expect("a warning");
        }
    }
    let map: Vec<u8> = (0..3 * 3000 * 400).map(|i| (i / 3 % 3000 / 12) as u8).collect();
    recorder.log_map(3000, 400, &map).expect("the map");
    done.extend(recorder.finish().expect("the end"));
    done
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number, not {value}"))
}

fn sum_of(read: &Value, entity: &str, component: &str) -> f64 {
    number(&read["entities"][entity]["components"][component]["sum"])
}

#[test]
fn a_recording_holds_every_step_with_its_values() {
    let dir = tempfile::tempdir().expect("a folder");
    record(dir.path(), 90, false);
    assert_eq!(names_in(dir.path()), ["recording.rrd"], "one finished file, nothing half-made");
    let read = read("rrd.py", &[&dir.path().join("recording.rrd")]);
    assert_eq!(read["verify"]["ok"], true, "{}", read["verify"]["output"]);
    assert_eq!(read["stores"][0][0], "stria");
    let entities = read["entities"].as_object().expect("entities");
    for name in ENTITIES.iter().chain(&["world/trajectory", "__properties"]) {
        assert!(entities.contains_key(*name), "{name} is missing among {:?}", entities.keys());
    }

    let run = KnownRun::new(640, 360, 30.0);
    let dx: f64 = (1..90).map(|i| run.frame(i).shift.dx_px.expect("moved")).sum();
    let expected = dx + 89.0 * (0.25 + 0.05);
    assert!((sum_of(&read, "plots/shift", "Scalars:scalars") - expected).abs() < 1e-3);
    assert_eq!(read["entities"]["plots/shift"]["rows"], 90);
    assert_eq!(sum_of(&read, "plots/rows_found", "Scalars:scalars"), 90.0 * 360.0);
    assert_eq!(read["entities"]["plots/shift"]["frames"], serde_json::json!([0, 89]));
    assert_eq!(read["entities"]["plots/shift"]["time_ns"], serde_json::json!([0, 2_966_666_667u64]));

    // 240 of 360 points a profile at most: every second one. Metres.
    let surface = &read["entities"]["world/surface"]["components"]["Points3D:positions"];
    assert_eq!(surface["values"], 90 * 180 * 3);
    let points = (0..90).flat_map(|i| run.frame(i).points.into_iter().step_by(2).map(|p| p.point_in_world));
    let expected: f64 = points.map(|p| (p.x + p.y + p.z) / 1000.0).sum();
    assert!((number(&surface["sum"]) / expected - 1.0).abs() < 1e-5, "{surface} is not {expected}");
    assert!(number(&surface["max"]) < 0.82);

    let translation = &read["entities"]["world/camera"]["components"]["Transform3D:translation"];
    assert!((number(&translation["max"]) - 0.178).abs() < 1e-6, "2 mm a frame, in metres");
    // 5 images a second: every 6th of 90 frames.
    assert_eq!(
        entities["world/camera/image"]["components"]["EncodedImage:blob"]["values"].as_u64().map(|n| n > 15_000),
        Some(true)
    );
    assert_eq!(entities["steps/effective_area"]["rows"], 15);
    let guide = read["entities"]["guide"]["components"]["TextDocument:text"]["text"].to_string();
    assert!(guide.contains("metres") && guide.contains("known run"), "{guide}");
    let message = read["entities"]["messages"]["components"]["TextLog:text"]["text"].to_string();
    assert!(message.contains("frame 40 is blurred"));
    assert!(read["blueprint"].as_array().is_some_and(|b| b.iter().any(|p| p.to_string().contains("visualizers"))));
}

#[test]
fn live_segments_are_valid_alone_and_together_are_the_recording() {
    let dir = tempfile::tempdir().expect("a folder");
    let segments = record(dir.path(), 90, true);
    assert!(segments.len() >= 3, "{} segments", segments.len());
    let whole = read("rrd.py", &[&dir.path().join("recording.rrd")]);
    let paths: Vec<&Path> = segments.iter().map(|s| s.path.as_path()).collect();
    for (number, segment) in segments.iter().enumerate() {
        assert_eq!(segment.number as usize, number);
        assert_eq!(segment.path, dir.path().join(format!("recording/{number:06}.rrd")));
        assert_eq!(segment.bytes, segment.path.metadata().expect("a file").len());
        let alone = read("rrd.py", &[&segment.path]);
        assert_eq!(alone["verify"]["ok"], true, "segment {number}: {}", alone["verify"]["output"]);
        assert_eq!(alone["stores"], whole["stores"], "one recording");
        assert_eq!(alone["blueprint"].as_array().is_some_and(|b| !b.is_empty()), number == 0);
    }
    let together = read("rrd.py", &paths);
    assert_eq!(together["verify"]["ok"], true);
    let (whole, together) = (&whole["entities"], &together["entities"]);
    for (name, entity) in whole.as_object().expect("entities") {
        assert_eq!(together[name]["rows"], entity["rows"], "{name}");
        assert_eq!(together[name]["frames"], entity["frames"], "{name}");
        for (component, values) in entity["components"].as_object().expect("components") {
            assert_eq!(together[name]["components"][component]["values"], values["values"], "{name} {component}");
        }
    }
    let chunks = |of: &Value| of["plots/shift"]["chunks"].as_u64().unwrap_or_default();
    assert!(chunks(whole) < chunks(together), "the file joins what came in pieces");
}

/// The names in a folder, sorted.
fn names_in(dir: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(dir).expect("a folder");
    let mut names: Vec<String> =
        entries.map(|e| e.expect("an entry").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

fn long_run(dir: &Path, frames: u32, known_length: bool) -> (Value, u64, u64) {
    let run = KnownRun::new(160, 120, 60.0);
    let options = RecordingOptions {
        budget_mb: 5.0,
        image_width_px: 160,
        images_per_s: 60.0,
        segment_s: 0.1,
        ..RecordingOptions::default()
    };
    let info = run_info(known_length.then_some(u64::from(frames)), run.fps);
    let path: PathBuf = dir.join("recording.rrd");
    let live = dir.join("live");
    let mut recorder = Recorder::create(&options, &run.rig, &info, &path, Some(&live)).expect("starts");
    let mut frame = run.frame(1);
    let mut live_bytes = 0;
    for index in 0..frames {
        (frame.index, frame.time_s) = (index, f64::from(index) / run.fps);
        let segments = recorder.log_frame(&frame.steps()).expect("a frame");
        live_bytes += segments.iter().map(|s| s.bytes).sum::<u64>();
    }
    live_bytes += recorder.finish().expect("the end").iter().map(|s| s.bytes).sum::<u64>();
    let bytes = path.metadata().expect("a file").len();
    (read("rrd.py", &[&path]), bytes, live_bytes)
}

#[test]
fn a_long_run_stays_within_its_budget_and_reaches_its_end() {
    const FRAMES: u32 = 20_000;
    for known_length in [true, false] {
        let dir = tempfile::tempdir().expect("a folder");
        let (read, bytes, live_bytes) = long_run(dir.path(), FRAMES, known_length);
        assert_eq!(read["verify"]["ok"], true, "{}", read["verify"]["output"]);
        assert!(bytes < 5_000_000, "{bytes} bytes with a known length: {known_length}");
        assert!(live_bytes < 8_000_000, "{live_bytes} bytes of segments");
        for entity in ["plots/shift", "world/camera/image", "world/surface"] {
            let last = number(&read["entities"][entity]["frames"][1]);
            assert!(last > 0.85 * f64::from(FRAMES), "{entity} ends at frame {last}, known length: {known_length}");
        }
        let rows = number(&read["entities"]["plots/shift"]["rows"]);
        assert!(rows >= 2_000.0, "{rows} rows of plots");
    }
}

#[test]
fn frames_without_a_line_or_a_pose_are_recorded_too() {
    let dir = tempfile::tempdir().expect("a folder");
    let run = KnownRun::new(160, 120, 30.0);
    let path = dir.path().join("recording.rrd");
    let options = RecordingOptions::default();
    let mut recorder = Recorder::create(&options, &run.rig, &run_info(None, 30.0), &path, None).expect("starts");
    for index in 0..60 {
        let mut frame = run.frame(index);
        frame.stripe.across_px.fill(f32::NAN);
        frame.thresholds.fill(f32::NAN);
        frame.points.clear();
        let mut steps = frame.steps();
        steps.world_from_camera = None;
        if index > 30 {
            (steps.effective_area, steps.row_threshold) = (None, None);
        }
        recorder.log_frame(&steps).expect("a frame");
    }
    recorder.finish().expect("the end");
    let read = read("rrd.py", &[&path]);
    assert_eq!(read["verify"]["ok"], true, "{}", read["verify"]["output"]);
    assert_eq!(read["entities"]["plots/rows_found"]["rows"], 60);
    assert_eq!(sum_of(&read, "plots/rows_found", "Scalars:scalars"), 0.0);
    assert!(read["entities"].get("world/camera").is_none(), "no pose was known");
}

#[test]
fn a_recording_that_is_given_up_leaves_nothing() {
    let dir = tempfile::tempdir().expect("a folder");
    let run = KnownRun::new(160, 120, 30.0);
    let path = dir.path().join("recording.rrd");
    let options = RecordingOptions::default();
    let mut recorder = Recorder::create(&options, &run.rig, &run_info(None, 30.0), &path, None).expect("starts");
    recorder.log_frame(&run.frame(0).steps()).expect("a frame");
    assert!(!path.exists(), "under its name only when it is complete");
    drop(recorder);
    assert_eq!(names_in(dir.path()), Vec::<String>::new());
    let missing = dir.path().join("missing/recording.rrd");
    let error = Recorder::create(&options, &run.rig, &run_info(None, 30.0), &missing, None).err().expect("no folder");
    assert!(error.to_string().contains("missing"), "{error}");
}

#[test]
fn a_long_run_has_dense_recordings_of_its_stretches() {
    let dir = tempfile::tempdir().expect("a folder");
    let run = KnownRun::new(160, 120, 60.0);
    // 3,000 frames of 2 mm: six metres, of which the small budget shows every profile only for a while.
    let options =
        RecordingOptions { budget_mb: 5.0, image_width_px: 160, stretch_m: 2.0, ..RecordingOptions::default() };
    let whole = dir.path().join("recording.rrd");
    let info = run_info(Some(3000), run.fps);
    let mut recordings = Recordings::create(&options, &run.rig, &info, &whole, None).expect("starts");
    let mut frame = run.frame(1);
    for index in 0..3000 {
        (frame.index, frame.time_s, frame.pose) = (index, f64::from(index) / run.fps, run.pose(index));
        recordings.log_frame(&frame.steps()).expect("a frame");
    }
    let (_, stretches) = recordings.finish().expect("the end");
    assert_eq!(stretches.len(), 3, "{stretches:?}");
    let first = read("rrd.py", &[&whole]);
    let points =
        |read: &Value| read["entities"]["world/surface"]["components"]["Points3D:positions"]["values"].as_u64();
    let sparse = points(&first).expect("points") as f64 / 3000.0;
    let mut next = 0;
    for stretch in &stretches {
        assert_eq!(stretch.first_frame, next, "one begins where the one before ended");
        next = stretch.last_frame + 1;
        assert!(stretch.to_x_mm - stretch.from_x_mm <= 2000.0, "{stretch:?}");
        let path = dir.path().join(&stretch.name);
        assert!(path.metadata().expect("a file").len() < 5_000_000);
        let read = read("rrd.py", &[&path]);
        assert_eq!(read["verify"]["ok"], true, "{}: {}", stretch.name, read["verify"]["output"]);
        let frames = f64::from(stretch.last_frame - stretch.first_frame + 1);
        assert!(points(&read).expect("points") as f64 / frames > 1.9 * sparse, "{} is no denser", stretch.name);
    }
    assert_eq!(next, 3000, "the last one reaches the end");
    assert_eq!(names_in(dir.path()).len(), 4, "nothing half-made stays");
    // A run that fits has one recording.
    let short = tempfile::tempdir().expect("a folder");
    let path = short.path().join("recording.rrd");
    let options = RecordingOptions { stretch_m: 0.01, ..RecordingOptions::default() };
    let mut recordings =
        Recordings::create(&options, &run.rig, &run_info(Some(20), run.fps), &path, None).expect("starts");
    (0..20).for_each(|index| drop(recordings.log_frame(&run.frame(index).steps()).expect("a frame")));
    assert!(recordings.finish().expect("the end").1.is_empty());
    assert_eq!(names_in(short.path()), ["recording.rrd"]);
}
