//! A watched folder: everything arrives once, oldest first, and nothing is lost on the way.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use serde_json::Value;
use stria_tests::support::server::Server;
use stria_tests::support::{eventually, short_run};

use super::relay::Relay;
use super::sender::{Robot, Sender, content, plain, runs, source, wait_for_file};

struct Scene {
    server: Server,
    relay: Relay,
    robot: Robot,
    folder: PathBuf,
}

impl Scene {
    fn new() -> Scene {
        let (server, relay, robot) = (Server::start(&["--workers", "0"]), Relay::start(), Robot::new());
        relay.lead_to(Some(&server.url("")));
        let folder = robot.path("recordings");
        std::fs::create_dir_all(&folder).expect("made");
        Scene { server, relay, robot, folder }
    }

    fn watch(&self, more: &[&str]) -> Sender {
        self.watch_settling("1", more)
    }

    fn watch_settling(&self, settle_s: &str, more: &[&str]) -> Sender {
        let (url, rig) = (self.relay.url(), plain(&short_run().rig));
        let folder = plain(&self.folder);
        let usual = [folder, "--watch", "--server", &url, "--asset", "A", "--rig", rig, "--settle-s", settle_s];
        self.robot.send(&[&usual[..], more].concat())
    }

    /// A file of so many minutes ago.
    fn record(&self, name: &str, bytes: usize, seed: u64, minutes_ago: u64) -> PathBuf {
        let path = self.robot.file(&format!("recordings/{name}"), bytes, seed);
        let time = SystemTime::now() - Duration::from_secs(60 * minutes_ago);
        std::fs::File::options().write(true).open(&path).expect("opens").set_modified(time).expect("set");
        path
    }

    fn names(&self, under: &str) -> Vec<String> {
        let Ok(entries) = std::fs::read_dir(self.folder.join(under)) else { return Vec::new() };
        let mut names: Vec<String> = entries
            .flatten()
            .filter(|entry| entry.path().is_file())
            .map(|entry| entry.file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }
}

fn stop(sender: Sender) -> (Vec<String>, String) {
    sender.terminate();
    let (code, lines, said) = sender.end();
    assert_eq!(code, Some(0), "{lines:?}\n{said}");
    (lines, said)
}

fn filenames(runs: &[Value]) -> Vec<&str> {
    runs.iter().map(|run| run["source"]["filename"].as_str().expect("a name")).collect()
}

#[test]
fn everything_arrives_once_whatever_dies_on_the_way() {
    let mut scene = Scene::new();
    let before = ["c.mp4", "a.mp4", "b.mp4"];
    for (i, name) in before.iter().enumerate() {
        scene.record(name, 3_000_000 + i, 20 + i as u64, 30 - i as u64);
    }
    // The server is away when the robot starts.
    scene.server.kill();
    scene.relay.lead_to(None);
    let cap = ["--limit-kbit-s", "16000"];
    let sender = scene.watch(&cap);
    sender.wait_for("a word of it", |s| s.said().contains("trying again"));
    for round in 0..2u64 {
        scene.server.start_again();
        scene.relay.lead_to(Some(&scene.server.url("")));
        let before = scene.relay.up();
        scene.relay.wait_for_up(before + 1_500_000);
        scene.record(&format!("later{round}.mp4"), 500_000, 30 + round, 1);
        scene.server.kill();
        scene.relay.lead_to(None);
    }
    // And the robot's own power goes, too.
    sender.kill();
    scene.server.start_again();
    scene.relay.lead_to(Some(&scene.server.url("")));
    let sender = scene.watch(&["--json"]);
    let all = BTreeSet::from(["a.mp4", "b.mp4", "c.mp4", "later0.mp4", "later1.mp4"]);
    eventually("all files in sent/", || scene.names("sent").iter().filter(|n| n.ends_with(".mp4")).count() == 5);
    let (lines, _) = stop(sender);
    assert!(lines.iter().all(|line| serde_json::from_str::<Value>(line).is_ok()), "{lines:?}");

    let runs = runs(&scene.server);
    assert_eq!(filenames(&runs)[..3], before, "the oldest first");
    assert_eq!(filenames(&runs).into_iter().collect::<BTreeSet<_>>(), all);
    assert_eq!(runs.len(), 5, "each once");
    for run in &runs {
        let name = run["source"]["filename"].as_str().expect("a name");
        let kept = scene.folder.join("sent").join(name);
        assert!(source(&scene.server, run) == std::fs::read(&kept).expect("kept"), "{name}");
        let confirmation = std::fs::read(format!("{}.run.json", kept.display())).expect("a confirmation");
        let confirmation: Value = serde_json::from_slice(&confirmation).expect("JSON");
        assert_eq!(confirmation["run"], run["id"]);
        assert_eq!(confirmation["sha256"], run["source"]["sha256"]);
        // The time of the recording, not of its arrival.
        let recorded: jiff::Timestamp = run["recorded_at"].as_str().expect("a time").parse().expect("RFC 3339");
        let modified = std::fs::metadata(&kept).and_then(|f| f.modified()).expect("a time");
        let modified = jiff::Timestamp::try_from(modified).expect("a time");
        assert!(
            recorded.duration_since(modified).abs() < jiff::SignedDuration::from_millis(2),
            "{recorded} {modified}"
        );
    }
    assert_eq!(scene.names(""), [".stria-send.lock"]);
}

#[test]
fn files_are_taken_when_they_are_whole_and_strangers_are_left_alone() {
    let scene = Scene::new();
    scene.record(".hidden.mp4", 100, 1, 9);
    scene.record("half.mp4.part", 100, 2, 9);
    let growing = scene.folder.join("growing.mp4");
    let whole = content(400_000, 3);
    let sender = scene.watch_settling("5", &[]);
    // Written as a camera does, with pauses shorter than --settle-s.
    for piece in whole.chunks(100_000) {
        let mut file = std::fs::OpenOptions::new().append(true).create(true).open(&growing).expect("opens");
        std::io::Write::write_all(&mut file, piece).expect("writes");
        std::thread::sleep(Duration::from_millis(400));
    }
    wait_for_file(&scene.folder.join("sent/growing.mp4"));
    stop(sender);
    let runs = runs(&scene.server);
    assert_eq!(filenames(&runs), ["growing.mp4"]);
    assert!(source(&scene.server, &runs[0]) == whole, "it was taken before it was whole");
    assert_eq!(scene.names(""), [".hidden.mp4", ".stria-send.lock", "half.mp4.part"]);
}

#[test]
fn a_refused_file_moves_aside_with_the_reason_and_others_go_on() {
    let mut scene = Scene::new();
    scene.server = Server::start(&["--workers", "0", "--max-upload-gb", "0.001"]);
    scene.relay.lead_to(Some(&scene.server.url("")));
    scene.record("empty.mp4", 0, 1, 9);
    scene.record("large.mp4", 1_500_000, 2, 8);
    scene.record("good.mp4", 200_000, 3, 7);
    let sender = scene.watch(&["--delete-sent"]);
    eventually("good.mp4 at the server", || runs(&scene.server).len() == 1);
    eventually("an empty folder", || scene.names("") == [".stria-send.lock"]);
    stop(sender);
    assert_eq!(scene.names("refused"), ["empty.mp4", "empty.mp4.txt", "large.mp4", "large.mp4.txt"]);
    let why = |name: &str| std::fs::read_to_string(scene.folder.join("refused").join(name)).expect("a reason");
    assert!(why("empty.mp4.txt").contains("empty"), "{}", why("empty.mp4.txt"));
    assert!(why("large.mp4.txt").contains("413"), "{}", why("large.mp4.txt"));
    assert_eq!(filenames(&runs(&scene.server)), ["good.mp4"]);
    assert!(!scene.folder.join("sent").exists(), "with --delete-sent nothing is kept");
}

#[test]
fn a_command_that_is_wrong_moves_no_file() {
    let scene = Scene::new();
    let file = scene.record("run.mp4", 1000, 1, 9);
    let (url, folder) = (scene.relay.url(), plain(&scene.folder));
    let usual = [folder, "--watch", "--server", &url, "--asset", "A", "--rig", "unknown", "--settle-s", "0.1"];
    let (code, _, said) = scene.robot.send(&usual).end();
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("no stored rig"), "{said}");
    assert!(file.exists() && scene.names("refused").is_empty());
}

#[test]
fn one_folder_has_one_watcher() {
    let scene = Scene::new();
    let first = scene.watch(&[]);
    wait_for_file(&scene.folder.join(".stria-send.lock"));
    std::thread::sleep(Duration::from_millis(200));
    let (code, _, said) = scene.watch(&[]).end();
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("another stria"), "{said}");
    stop(first);
}

#[test]
fn what_is_kept_in_sent_is_bounded() {
    let scene = Scene::new();
    let names = ["a.mp4", "b.mp4", "c.mp4"];
    for (i, name) in names.iter().enumerate() {
        scene.record(name, 1_000_000, i as u64, 9 - i as u64);
    }
    let stranger = scene.robot.file("recordings/sent/stranger.mp4", 100, 9);
    let sender = scene.watch(&["--keep-sent-gb", "0.0025"]);
    eventually("c.mp4 in sent/", || scene.names("sent").contains(&"c.mp4.run.json".to_string()));
    eventually("a.mp4 gone", || !scene.folder.join("sent/a.mp4").exists());
    stop(sender);
    let kept: Vec<String> = scene.names("sent").into_iter().filter(|name| !name.ends_with(".json")).collect();
    assert_eq!(kept, ["b.mp4", "c.mp4", "stranger.mp4"]);
    assert!(Path::new(&stranger).exists());
    assert_eq!(filenames(&runs(&scene.server)), names);
}

#[test]
fn a_folder_that_fills_up_is_told_of_while_the_server_is_away() {
    let scene = Scene::new();
    scene.relay.lead_to(None);
    // A hole as large as a long recording.
    let large = std::fs::File::create(scene.folder.join("large.mp4")).expect("made");
    large.set_len(300_000_000).expect("a hole");
    let sender = scene.watch(&["--spool-gb", "0.25"]);
    sender.wait_for("a warning", |s| s.said().contains("300.0 MB in 1 file(s) wait"));
    let (_, said) = stop(sender);
    assert_eq!(said.matches("more than --spool-gb").count(), 1, "it is said once: {said}");
}
