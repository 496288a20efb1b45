//! Bags of ROS 2, written by PyPI's rosbags, as sources.

use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::Value;
use stria_core::export::manifest::{Manifest, sha256_of_file};
use stria_tests::support::readers::{python_program, run};
use stria_tests::support::server::Server;
use stria_tests::support::{Run, run_stria};
use tempfile::TempDir;

fn text(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

/// A simulated second as images.
struct Images {
    folder: TempDir,
    run: Run,
}

impl Images {
    fn new() -> Images {
        let images =
            Images { folder: tempfile::tempdir().expect("a folder"), run: Run::simulate("1", "30", "640x360") };
        for extension in ["jpg", "png"] {
            let folder = images.path(extension);
            std::fs::create_dir(&folder).expect("a folder");
            let pattern = folder.join(format!("%04d.{extension}"));
            run("ffmpeg", &["-v", "error", "-i", text(&images.run.video), "-q:v", "2", text(&pattern)]);
        }
        images
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn truth(&self) -> PathBuf {
        self.run.video.with_file_name("truth").join("trajectory.csv")
    }

    fn bag(&self, name: &str, images: &str, options: &[&str]) -> PathBuf {
        let bag = self.path(name);
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("writers/ros2_bag.py");
        let arguments = [text(&script), text(&self.path(images)), text(&bag)].map(String::from).to_vec();
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).chain(options.iter().copied()).collect();
        run(python_program("python"), &arguments);
        bag
    }

    fn process(&self, source: &Path, out: &str, more: &[&str]) -> (Manifest, PathBuf, Output) {
        let out = self.path(out);
        let command = ["process", text(source), "--rig", text(&self.run.rig), "--out", text(&out)];
        let done = run_stria(&[&command[..], &["--only", "depth,trajectory"], more].concat());
        assert!(matches!(done.status.code(), Some(0 | 3)), "{}", said(&done));
        (Manifest::load(&out).expect("a manifest"), out, done)
    }
}

fn map_hash(folder: &Path) -> String {
    sha256_of_file(&folder.join("depth.tif")).expect("hashed")
}

#[test]
fn a_bag_gives_the_same_map_as_its_images() {
    let images = Images::new();
    let (_, from_jpg, _) = images.process(&images.path("jpg"), "from-jpg", &["--fps", "30"]);
    let bag = images.bag("compressed", "jpg", &[]);
    let (manifest, out, done) = images.process(&bag, "from-bag", &[]);
    assert_eq!((manifest.quality.frames, map_hash(&out)), (30, map_hash(&from_jpg)));
    assert!(
        said(&done).contains("camera_info gives focal lengths of 100.0"),
        "another camera is said: {}",
        said(&done)
    );
    // The file inside the bag's folder is the same source.
    let (_, out, _) = images.process(&bag.join("compressed.mcap"), "from-file", &[]);
    assert_eq!(map_hash(&out), map_hash(&from_jpg));

    let (_, from_png, _) = images.process(&images.path("png"), "from-png", &["--fps", "30"]);
    for encoding in ["rgb8", "bgr8", "rgba8"] {
        let bag = images.bag(encoding, "png", &["--raw", encoding]);
        let (_, out, _) = images.process(&bag, &format!("from-{encoding}"), &["--only", "archive"]);
        assert_eq!(map_hash(&out), map_hash(&from_png), "{encoding}");
        // Its archive keeps the pixels as they came.
        let (_, again, _) = images.process(&out.join("archive.mcap"), &format!("again-{encoding}"), &[]);
        assert_eq!(map_hash(&again), map_hash(&from_png), "{encoding}");
    }
}

#[test]
fn a_bag_sent_to_a_server_is_a_run() {
    let images = Images::new();
    let bag = images.bag("sent", "jpg", &[]).join("sent.mcap");
    let server = Server::start(&["--workers", "1"]);
    let url = server.url("");
    let command = ["send", text(&bag), "--server", &url, "--asset", "Wall", "--rig", text(&images.run.rig), "--wait"];
    let done = run_stria(&command);
    assert!(matches!(done.status.code(), Some(0 | 3)), "{}", said(&done));
    let runs = server.json("/api/runs");
    assert_eq!(runs["items"][0]["source"]["filename"], "sent.mcap", "{runs}");
    let job = server.json(&format!("/api/jobs/{}", runs["items"][0]["job"]["id"].as_str().expect("a job")));
    assert_eq!((&job["state"], &job["quality"]["frames"]), (&"done".into(), &30.into()), "{job}");
}

#[test]
fn topics_are_listed_and_chosen() {
    let images = Images::new();
    let bag = images.bag("two", "jpg", &["--second-camera", "--odometry", text(&images.truth())]);
    let listed = run_stria(&["inspect", text(&bag), "--json"]);
    let listed: Value = serde_json::from_slice(&listed.stdout).expect("JSON");
    let topic = |name: &str| -> Value {
        let topics = listed["facts"]["topics"].as_array().expect("topics");
        topics.iter().find(|t| t["name"] == name).unwrap_or_else(|| panic!("no {name} in {listed}")).clone()
    };
    let images_topic = topic("/camera/image_raw/compressed");
    assert_eq!((&images_topic["messages"], &images_topic["use"]), (&30.into(), &"images".into()));
    assert_eq!(topic("/odom")["use"], "odometry");
    assert_eq!(topic("/tf_static")["use"], "transforms");
    assert_eq!(topic("/camera/camera_info")["use"], "camera");

    let (manifest, _, done) = images.process(&bag, "guessed", &[]);
    assert_eq!(manifest.quality.frames, 30);
    assert!(said(&done).contains("not of /front/image_raw; --topic chooses"), "{}", said(&done));
    let (manifest, _, _) = images.process(&bag, "chosen", &["--topic", "/front/image_raw"]);
    assert_eq!(manifest.quality.frames, 3);
    for (topic, expected) in [("/nothing", "one of /camera/camera_info"), ("/tf_static", "2")] {
        let out = images.path("refused");
        let command = ["process", text(&bag), "--rig", text(&images.run.rig), "--out", text(&out), "--topic", topic];
        let done = run_stria(&command);
        match topic {
            "/nothing" => assert_eq!(done.status.code(), Some(2), "{}", said(&done)),
            _ => assert!(matches!(done.status.code(), Some(0 | 3)), "{}", said(&done)),
        }
        assert!(topic != "/nothing" || said(&done).contains(expected), "{}", said(&done));
    }
    let video = run_stria(&[
        "process",
        text(&images.run.video),
        "--rig",
        text(&images.run.rig),
        "--out",
        text(&images.path("no")),
        "--topic",
        "/camera",
    ]);
    assert_eq!(video.status.code(), Some(2), "{}", said(&video));
    assert!(said(&video).contains("no MCAP file"), "{}", said(&video));
}

#[test]
fn a_robot_s_odometry_carries_the_pose_where_the_image_is_lost() {
    let images = Images::new();
    // The camera sees nothing for eight frames.
    let blind = images.path("blind");
    std::fs::create_dir(&blind).expect("a folder");
    let filter = "drawbox=enable='between(n,12,19)':color=black:t=fill";
    let pattern = blind.join("%04d.jpg");
    run("ffmpeg", &["-v", "error", "-i", text(&images.run.video), "-vf", filter, "-q:v", "2", text(&pattern)]);
    let truth = images.truth();
    let alone = images.bag("alone", "blind", &[]);
    let (lost, _, done) = images.process(&alone, "lost", &[]);
    assert!(said(&done).contains("the motion was lost"), "{}", said(&done));
    let helped = images.bag("helped", "blind", &["--odometry", text(&truth)]);
    let (carried, out, done) = images.process(&helped, "carried", &[]);
    assert!(said(&done).contains("the given poses carried it on there"), "{}", said(&done));
    assert_eq!((carried.quality.frames_tracked, lost.quality.frames_tracked < 22), (29, true), "{:?}", lost.quality);
    let rows = |path: &Path| -> Vec<Option<[f64; 3]>> {
        let text = std::fs::read_to_string(path).expect("read");
        let position = |line: &str| {
            let fields: Vec<f64> = line.split(',').skip(5).take(3).map_while(|f| f.parse().ok()).collect();
            <[f64; 3]>::try_from(fields).ok()
        };
        text.lines().skip(1).map(position).collect()
    };
    let (found, truth_rows) = (rows(&out.join("trajectory.csv")), rows(&truth));
    let (last, true_last) = (found.last().copied().flatten().expect("placed"), truth_rows[29].expect("known"));
    let off_mm = (0..3).map(|i| (last[i] - true_last[i]).powi(2)).sum::<f64>().sqrt();
    assert!(off_mm < 3.0, "{off_mm} mm off after the blind stretch: the odometry was turned into the camera's frame");

    let untied = images.bag("untied", "blind", &["--odometry", text(&truth), "--no-tf"]);
    let (manifest, _, done) = images.process(&untied, "untied-out", &[]);
    assert!(said(&done).contains("expected one in /tf_static"), "{}", said(&done));
    let (untied, alone) = (manifest.quality, lost.quality);
    assert_eq!((untied.frames_tracked, untied.travel_mm), (alone.frames_tracked, alone.travel_mm), "it is not used");
}

#[test]
fn a_bag_cut_off_by_a_power_loss_gives_what_it_holds() {
    let images = Images::new();
    let bag = images.bag("bag", "jpg", &[]).join("bag.mcap");
    let bytes = std::fs::read(&bag).expect("read");
    let cut = images.path("cut.mcap");
    let mut before = 0;
    for share in [40, 75] {
        std::fs::write(&cut, &bytes[..bytes.len() * share / 100]).expect("write");
        let (manifest, _, done) = images.process(&cut, &format!("cut-{share}"), &[]);
        assert_eq!(done.status.code(), Some(3));
        assert!(said(&done).contains("it was cut off; what it holds was read"), "{}", said(&done));
        assert!(manifest.quality.frames > before && manifest.quality.frames < 30, "{}", manifest.quality.frames);
        before = manifest.quality.frames;
    }
    // Damaged in the middle: what stands before is used; nothing is made up.
    let mut damaged = bytes.clone();
    let middle = damaged.len() / 2;
    damaged[middle..middle + 64].iter_mut().for_each(|byte| *byte ^= 0x5a);
    let path = images.path("damaged.mcap");
    std::fs::write(&path, damaged).expect("write");
    let done = run_stria(&[
        "process",
        text(&path),
        "--rig",
        text(&images.run.rig),
        "--out",
        text(&images.path("damaged")),
        "--only",
        "trajectory",
    ]);
    assert_eq!(done.status.code(), Some(3), "{}", said(&done));
    // Hostile sizes and other files under the name are refused in words.
    for (name, content) in [("empty.mcap", &b""[..]), ("magic.mcap", &bytes[..8]), ("text.mcap", &b"not a bag\n"[..])] {
        let path = images.path(name);
        std::fs::write(&path, content).expect("write");
        let out = images.path("none");
        let done = run_stria(&["process", text(&path), "--rig", text(&images.run.rig), "--out", text(&out)]);
        assert_eq!(done.status.code(), Some(2), "{name}: {}", said(&done));
        assert!(said(&done).contains(name) && said(&done).contains("expected") && !out.exists(), "{}", said(&done));
    }
}
