//! `archive.mcap`.

use std::path::Path;

use serde_json::{Value, json};
use stria_core::depth_map::{MapGeometry, MapWindow};
use stria_core::export::archive_mcap::ArchiveWriter;
use stria_core::recipe::Recipe;
use stria_core::source::{EncodedFormat, EncodedFrame};

use super::known_run::KnownRun;
use stria_tests::support::readers::{read, run};

const START: &str = "2026-03-01T10:00:00.25Z";
const START_NS: u64 = 1_772_359_200_250_000_000;
const FRAMES: u32 = 40;
const FPS: f64 = 25.0;

fn time_ns(index: u64) -> u64 {
    START_NS + index * 40_000_000
}

fn writer(path: &Path, run: &KnownRun) -> ArchiveWriter {
    let start = START.parse().expect("a time");
    ArchiveWriter::create(path, &run.rig, &Recipe::default(), "known run", start).expect("starts")
}

/// A real H.264 stream of the test's length, cut into its frames at the access unit delimiters.
fn video_frames() -> Vec<EncodedFrame> {
    let source = format!("testsrc=size=320x180:rate={FPS}:duration={}", f64::from(FRAMES) / FPS);
    let arguments = ["-v", "error", "-f", "lavfi", "-i", &source, "-c:v", "libx264", "-bf", "0", "-pix_fmt", "yuv420p"];
    let arguments = [&arguments[..], &["-x264-params", "aud=1:keyint=10:repeat-headers=1", "-f", "h264", "-"]].concat();
    let stream = run("ffmpeg", &arguments);
    let delimiter = [0, 0, 0, 1, 9];
    let starts: Vec<usize> = (0..stream.len()).filter(|i| stream[*i..].starts_with(&delimiter)).collect();
    let ends = starts.iter().skip(1).copied().chain([stream.len()]);
    let frame = |(i, (start, end)): (usize, (&usize, usize))| EncodedFrame {
        time_s: i as f64 / FPS,
        order_s: i as f64 / FPS,
        format: EncodedFormat::H264,
        key: i % 10 == 0,
        data: stream[*start..end].to_vec(),
    };
    starts.iter().zip(ends).enumerate().map(frame).collect()
}

/// A map whose cell at (column, row) is 800 + column + row / 8 mm deep, with a hole of 10 by 10 at its start.
fn window(column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> MapWindow {
    let cells = (row_px..row_px + height_px).flat_map(|r| (column_px..column_px + width_px).map(move |c| (c, r)));
    let hole = |c: usize, r: usize| c < 10 && r < 10;
    MapWindow {
        width_px,
        height_px,
        depth_mm: cells
            .clone()
            .map(|(c, r)| if hole(c, r) { f32::NAN } else { 800.0 + c as f32 + r as f32 / 8.0 })
            .collect(),
        texture: cells.map(|(c, r)| (!hole(c, r)).then_some([c as u8, r as u8, 7])).collect(),
    }
}

fn array(value: &Value) -> &Vec<Value> {
    value.as_array().unwrap_or_else(|| panic!("a list, not {value}"))
}

fn near(value: &Value, expected: f64, tolerance: f64) {
    let found = value.as_f64().unwrap_or(f64::NAN);
    assert!((found - expected).abs() <= tolerance, "{found} is not {expected}");
}

#[test]
fn an_archive_holds_the_run_at_its_capture_times() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("archive.mcap");
    let known = KnownRun::new(320, 180, FPS);
    let mut archive = writer(&path, &known);
    for index in 0..FRAMES {
        let frame = known.frame(index);
        archive.measurement(index, frame.time_s, &frame.stripe, &frame.shift, &frame.points).expect("a measurement");
        archive.pose(frame.time_s, &frame.pose).expect("a pose");
        archive.profile(frame.time_s, &frame.profile, &frame.points).expect("a profile");
        archive.surface(frame.time_s, &frame.points).expect("points");
        if index == 5 {
            archive.warning("frame 5 is blurred").expect("a warning");
        }
    }
    // The frames may come after all results: readers go by the time.
    let frames = video_frames();
    assert_eq!(frames.len(), FRAMES as usize);
    frames.iter().for_each(|frame| archive.frame(frame).expect("a frame"));
    archive.attach("manifest.json", "application/json", br#"{"schema_version": 1}"#).expect("attached");
    archive.metadata("hashes", &[("source_sha256", "abc")]).expect("written");
    assert!(!path.exists(), "under its name only when it is complete");
    archive.finish().expect("the end");
    assert_eq!(std::fs::read_dir(dir.path()).expect("a folder").count(), 1);

    let video = dir.path().join("video.h264");
    let read = read("mcap_archive.py", &[&path, &video]);
    whole_file(&read);
    camera(&read, &known, &frames, &video);
    results(&read, &known);

    let files = &read["attachments"];
    assert_eq!(files["rig.toml"]["text"], known.rig.to_toml());
    assert_eq!(files["recipe.toml"]["text"], Recipe::default().to_toml());
    assert_eq!(files["manifest.json"], json!({"media_type": "application/json", "text": "{\"schema_version\": 1}"}));
    assert_eq!(read["metadata"]["hashes"]["source_sha256"], "abc");
    assert_eq!(read["metadata"]["units"]["length"], "m");
    assert_eq!(read["metadata"]["run"]["recorded_at"], START);
}

fn whole_file(read: &Value) {
    assert_eq!(read["file"]["compression"], json!(["zstd"]));
    assert_eq!((&read["file"]["data_crc"], &read["file"]["summary_crc"]), (&json!(true), &json!(true)));
    assert_eq!(read["file"]["chunks"], read["file"]["chunk_crcs"], "a CRC in every chunk");
    assert_eq!(read["statistics"]["chunks"], read["file"]["chunks"]);
    assert_eq!(read["statistics"]["start_ns"], START_NS);
    assert_eq!(read["statistics"]["end_ns"], time_ns(u64::from(FRAMES) - 1));
    assert_eq!(read["statistics"]["messages"], 4 * FRAMES + 3 + 4);
    for (name, topic) in read["topics"].as_object().expect("topics") {
        let times = array(&topic["times_ns"]);
        let expected: Vec<Value> = match name.as_str() {
            "/camera/calibration" | "/tf_static" => vec![json!(START_NS)],
            "/surface/overview" => vec![json!(time_ns(u64::from(FRAMES) - 1))],
            "/log" => vec![json!(time_ns(5))],
            // Half a second of the surface in each message, which has its last frame's time.
            "/surface" => [13, 27, 39].map(|i| json!(time_ns(i))).to_vec(),
            _ => (0..u64::from(FRAMES)).map(|i| json!(time_ns(i))).collect(),
        };
        assert_eq!(*times, expected, "{name}");
        if topic["encoding"] == "protobuf" {
            assert_eq!(topic["stamps_ns"], topic["times_ns"], "{name}");
        }
    }
}

fn camera(read: &Value, known: &KnownRun, frames: &[EncodedFrame], video: &Path) {
    let messages = &read["topics"]["/camera/video"];
    assert_eq!(messages["schema"], "foxglove.CompressedVideo");
    for (message, frame) in array(&messages["of"]).iter().zip(frames) {
        assert_eq!(*message, json!({"format": "h264", "bytes": frame.data.len()}));
    }
    let probe = ["-v", "error", "-count_frames", "-show_entries", "stream=nb_read_frames,width", "-of", "csv=p=0"];
    let probed = run("ffprobe", &[&probe[..], &[video.to_str().expect("a path")]].concat());
    assert_eq!(String::from_utf8_lossy(&probed).trim(), format!("320,{FRAMES}"), "the channel decodes, frame by frame");

    let calibration = &read["topics"]["/camera/calibration"]["of"][0];
    let c = &known.rig.camera;
    assert_eq!(calibration["K"], json!([c.fx_px, 0.0, c.cx_px, 0.0, c.fy_px, c.cy_px, 0.0, 0.0, 1.0]));
    assert_eq!(calibration["model"], "plumb_bob");
    assert_eq!(calibration["D"], json!([0.0, 0.0, 0.0, 0.0, 0.0]));
}

fn results(read: &Value, known: &KnownRun) {
    let topics = &read["topics"];
    // The world stands upright in rerun's root: its y, which points down, is minus the root's z.
    let root = &topics["/tf_static"]["of"][0];
    assert_eq!((&root["parent"], &root["child"]), (&json!("tf#/"), &json!("world")));
    near(&root["rotation"][0], -std::f64::consts::FRAC_1_SQRT_2, 1e-12);
    near(&root["rotation"][3], std::f64::consts::FRAC_1_SQRT_2, 1e-12);
    for index in [0, 7, FRAMES - 1] {
        let (frame, at) = (known.frame(index), index as usize);
        let pose = &topics["/tf"]["of"][at];
        assert_eq!((&pose["parent"], &pose["child"]), (&json!("world"), &json!("camera")));
        near(&pose["translation"][0], f64::from(index) * 0.002, 1e-9);
        assert_eq!(pose["rotation"], json!([0.0, 0.0, 0.0, 1.0]));

        let (chunk, points) = [(0, 14 * 180), (1, 14 * 180), (2, 12 * 180)][at / 14];
        for (topic, at, frame_id, points, point) in [
            ("/surface", chunk, "world", points, known.frame(14 * chunk as u32).points[0].point_in_world),
            ("/profile", at, "camera", 180, frame.profile.points[0].point_in_camera),
        ] {
            let cloud = &topics[topic]["of"][at];
            assert_eq!((&cloud["frame_id"], &cloud["points"]), (&json!(frame_id), &json!(points)));
            assert_eq!(cloud["fields"], json!(["x", "y", "z", "red", "green", "blue", "alpha", "confidence"]));
            let expected = [point.x / 1e3, point.y / 1e3, point.z / 1e3, 120.0, 130.0, 140.0, 255.0, 0.8];
            array(&cloud["first"]).iter().zip(expected).for_each(|(value, e)| near(value, e, 1e-6));
        }
        let measured = &topics["/measurement"]["of"][at];
        assert_eq!((&measured["frame"], &measured["rows_found"]), (&json!(index), &json!(180)));
        near(&measured["x_mm"], frame.points.iter().map(|p| p.point_in_world.x).sum::<f64>() / 180.0, 1e-9);
        match frame.shift.dx_px {
            Some(dx_px) => near(&measured["dx_px"], dx_px, 1e-12),
            None => assert!(measured.get("dx_px").is_none(), "not known is absent, not zero"),
        }
    }
    assert_eq!(topics["/log"]["of"][0], json!({"level": 3, "message": "frame 5 is blurred"}));
}

#[test]
fn single_images_become_compressed_images() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("archive.mcap");
    let mut archive = writer(&path, &KnownRun::new(64, 48, FPS));
    for (i, format) in [EncodedFormat::Jpeg, EncodedFormat::Png, EncodedFormat::Webp].into_iter().enumerate() {
        let (time_s, data) = (i as f64, vec![7; 100 + i]);
        archive.frame(&EncodedFrame { time_s, order_s: time_s, format, key: true, data }).expect("a frame");
    }
    archive.finish().expect("the end");
    let images = &read("mcap_archive.py", &[&path])["topics"]["/camera/image"];
    assert_eq!(images["schema"], "foxglove.CompressedImage");
    let expected = json!([
        {"format": "jpeg", "bytes": 100}, {"format": "png", "bytes": 101}, {"format": "webp", "bytes": 102}
    ]);
    assert_eq!(images["of"], expected);
}

#[test]
fn a_small_map_is_one_grid_and_a_wide_one_comes_in_pieces() {
    let dir = tempfile::tempdir().expect("a folder");
    let known = KnownRun::new(64, 48, FPS);
    for (width_px, height_px, pieces) in [(500, 300, 1), (5000, 700, 4)] {
        let path = dir.path().join(format!("{width_px}.mcap"));
        let geometry = MapGeometry { x0_mm: 100.0, y0_mm: -50.0, mm_per_px: 0.5, width_px, height_px };
        let mut archive = writer(&path, &known);
        let frame = known.frame(3);
        archive.measurement(3, 0.12, &frame.stripe, &frame.shift, &frame.points).expect("a measurement");
        let mut largest = 0;
        let reader = |column: usize, row: usize, width: usize, height: usize| {
            largest = largest.max(width * height);
            Ok(window(column, row, width, height))
        };
        archive.depth_map(&geometry, reader).expect("the map");
        archive.finish().expect("the end");
        assert!(largest <= 1 << 20, "{largest} cells at once");

        let read = read("mcap_archive.py", &[&path]);
        let grids = array(&read["topics"]["/depth_map"]["of"]);
        assert_eq!((grids.len(), &read["metadata"]["depth_map"]["pieces"]), (pieces, &json!(pieces.to_string())));
        assert_eq!(read["topics"]["/depth_map"]["times_ns"], json!(vec![time_ns(3); pieces]));
        let cells: u64 = grids.iter().map(|g| g["finite"].as_u64().unwrap_or_default()).sum();
        assert_eq!(cells as usize, width_px * height_px - 100, "all but the hole");
        let sum: f64 = grids.iter().map(|g| g["sum"].as_f64().unwrap_or_default()).sum();
        let whole = window(0, 0, width_px, height_px);
        let expected: f64 = whole.depth_mm.iter().filter(|z| z.is_finite()).map(|z| f64::from(*z) / 1000.0).sum();
        assert!((sum / expected - 1.0).abs() < 1e-6, "{sum} m is not {expected} m");

        let first = &grids[0];
        assert_eq!((&first["frame_id"], &first["first"]), (&json!("world"), &json!(-1.0)), "the hole is NaN");
        near(&first["origin"][0], 0.1 - 0.00025, 1e-12);
        near(&first["origin"][1], -0.05 - 0.00025, 1e-12);
        near(&first["cell"][0], 0.0005, 1e-12);
        let image = &read["topics"]["/depth_map/image"];
        assert_eq!((&image["schema"], &image["of"][0]["encoding"]), (&json!("foxglove.RawImage"), &json!("32FC1")));
        let step = if pieces == 1 { 1 } else { 5 };
        assert_eq!(image["of"][0]["shape"], json!([height_px / step, width_px / step]));
        near(
            &image["of"][0]["last"],
            f64::from(whole.depth_mm[(height_px - step) * width_px + width_px - step]) / 1e3,
            1e-6,
        );
        let overview = &read["topics"]["/depth_map/overview"]["of"][0];
        if pieces == 1 {
            assert!(overview.is_null(), "one piece is its own overview");
        } else {
            assert_eq!(overview["shape"], json!([140, 1000]));
            near(&overview["cell"][0], 0.0025, 1e-12);
            // The second piece begins where the first one ends.
            let width_m = array(&first["shape"])[1].as_f64().unwrap_or_default() * 0.0005;
            near(&grids[1]["origin"][0], 0.1 - 0.00025 + width_m, 1e-9);
        }
    }
}

#[test]
fn defects_are_boxes_where_they_are() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("archive.mcap");
    let known = KnownRun::new(64, 48, FPS);
    let mut archive = writer(&path, &known);
    archive.surface(0.4, &known.frame(10).points).expect("points");
    let bounds = json!({"x_min_mm": 100.0, "x_max_mm": 140.0, "y_min_mm": -30.0, "y_max_mm": -10.0});
    let defect = json!({"id": 7, "kind": "missing_material", "severity": "severe", "chainage_mm": 2120.0, "z_mm": 812.0,
        "depth_mm": 8.0, "area_mm2": 5.0, "bounds": bounds});
    archive.defects(json!({"schema_version": 1, "defects": [defect]}).to_string().as_bytes()).expect("defects");
    assert!(archive.defects(b"{}").is_err(), "another text is refused");
    archive.finish().expect("the end");
    let read = read("mcap_archive.py", &[&path]);
    let topic = &read["topics"]["/defects"];
    assert_eq!((&topic["schema"], &topic["times_ns"]), (&json!("foxglove.SceneUpdate"), &json!([time_ns(10)])));
    let entity = &topic["of"][0]["entities"][0];
    assert_eq!((&entity["id"], &entity["frame_id"]), (&json!("defect 7"), &json!("world")));
    assert_eq!(entity["text"], "7 missing material: 8.0 mm");
    for (value, expected) in [("position", [0.12, -0.02, 0.808]), ("size", [0.04, 0.02, 0.008])] {
        array(&entity[value]).iter().zip(expected).for_each(|(found, expected)| near(found, expected, 1e-12));
    }
    assert_eq!(entity["metadata"]["chainage_mm"], "2120");
}

#[test]
fn a_damaged_archive_is_noticed_and_one_given_up_leaves_nothing() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("archive.mcap");
    let known = KnownRun::new(64, 48, FPS);
    let mut archive = writer(&path, &known);
    archive.surface(0.0, &known.frame(0).points).expect("points");
    drop(archive);
    assert_eq!(std::fs::read_dir(dir.path()).expect("a folder").count(), 0);

    let mut archive = writer(&path, &known);
    archive.surface(0.0, &known.frame(0).points).expect("points");
    archive.finish().expect("the end");
    let mut bytes = std::fs::read(&path).expect("written");
    let name = bytes.windows(8).position(|w| w == b"rig.toml").expect("the attachment");
    bytes[name + 60] ^= 1;
    std::fs::write(&path, bytes).expect("written");
    let damaged = std::panic::catch_unwind(|| read("mcap_archive.py", &[&path]));
    assert!(damaged.is_err(), "the reader checks the CRCs");
}
