//! Frames from a pipe: all of them, once, in order, whatever dies on the way.

use std::io::Write;
use std::process::{Command, Stdio};
use std::time::Duration;

use futures::{SinkExt, StreamExt};
use serde_json::{Value, json};
use stria_core::source::frame_file::{FrameFile, FrameRecord};
use stria_tests::support::server::Server;
use stria_tests::support::{files_below, short_run};
use tokio_tungstenite::tungstenite::Message;

use super::relay::Relay;
use super::sender::{Robot, Sender, content, plain, runs, source};

/// A JPEG in form, with a content of its own.
pub(super) fn jpeg(seed: u64, bytes: usize) -> Vec<u8> {
    let mut image = vec![0xff, 0xd8, 0xff, 0xe0, 0, 4, 1, 1, 0xff, 0xda, 0, 3, 1];
    image.extend(content(bytes, seed + 1).into_iter().map(|b| if b == 0xff { 0 } else { b }));
    image.extend([0xff, 0xd9]);
    image
}

struct Scene {
    server: Server,
    relay: Relay,
    robot: Robot,
}

impl Scene {
    fn new() -> Scene {
        let (server, relay) = (Server::start(&["--workers", "0"]), Relay::start());
        relay.lead_to(Some(&server.url("")));
        Scene { server, relay, robot: Robot::new() }
    }

    fn live(&self, more: &[&str]) -> Sender {
        let (url, rig) = (self.relay.url(), plain(&short_run().rig));
        let usual = ["-", "--live", "--stream", "robot7", "--server", &url, "--asset", "A", "--rig", rig, "--json"];
        self.robot.send(&[&usual[..], more].concat())
    }

    fn away(&mut self) {
        self.server.kill();
        self.relay.lead_to(None);
    }

    fn back(&mut self) {
        self.server.start_again();
        self.relay.lead_to(Some(&self.server.url("")));
    }

    /// The frames that a run holds.
    fn frames(&self, run: &Value) -> Vec<FrameRecord> {
        let path = self.robot.path("source.frames");
        std::fs::write(&path, source(&self.server, run)).expect("writes");
        let mut file = FrameFile::open(&path, "source").expect("opens");
        let frames = std::iter::from_fn(|| file.next_record()).collect();
        assert_eq!(file.damage, None);
        frames
    }

    /// Files of frames on the robot's disk.
    fn segments(&self) -> usize {
        files_below(&self.robot.state()).iter().filter(|file| file.ends_with(".frames")).count()
    }

    /// One run holds just these frames.
    fn check_one_run(&self, seeds: std::ops::Range<u64>) {
        let runs = runs(&self.server);
        assert_eq!(runs.len(), 1, "{runs:#?}");
        let frames = self.frames(&runs[0]);
        assert_eq!(frames.len() as u64, seeds.end - seeds.start);
        for (i, (seed, frame)) in seeds.zip(&frames).enumerate() {
            assert_eq!(frame.seq, i as u64);
            assert!(frame.image == jpeg(seed, 20_000), "frame {i} is another");
        }
        assert!(frames.is_sorted_by_key(|frame| frame.capture_time_ns), "times go back");
        let left: Vec<_> = files_below(&self.robot.state()).into_iter().filter(|f| !f.ends_with(".lock")).collect();
        assert_eq!(left, [""; 0], "nothing waits any more");
    }
}

/// Feeds frames as a camera does.
fn feed(sender: &mut Sender, seeds: std::ops::Range<u64>) {
    let stdin = sender.stdin.as_mut().expect("open");
    for seed in seeds {
        stdin.write_all(&jpeg(seed, 20_000)).expect("it reads");
        stdin.flush().expect("it reads");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Waits until it has so many frames.
fn wait_for_read(sender: &Sender, frames: u64) {
    sender.wait_for("frames read", |s| s.last("frames").is_some_and(|line| line["read"] == frames));
}

fn done(sender: Sender, frames: u64) {
    let (code, lines, said) = sender.end();
    assert_eq!(code, Some(0), "{lines:?}\n{said}");
    let closed: Value = serde_json::from_str(lines.last().expect("a line")).expect("JSON");
    assert_eq!((closed["type"].as_str(), closed["frames"].as_u64()), (Some("closed"), Some(frames)), "{lines:?}");
    assert_eq!(closed["missing"], json!([]));
}

#[test]
fn frames_that_meet_no_server_arrive_later_in_order() {
    let mut scene = Scene::new();
    let mut sender = scene.live(&[]);
    feed(&mut sender, 0..60);
    sender.wait_for("its run", |s| s.last("stream").is_some());
    scene.away();
    feed(&mut sender, 60..160);
    wait_for_read(&sender, 160);
    sender.wait_for("frames that wait", |s| s.last("frames").is_some_and(|line| line["waiting"].as_u64() >= Some(100)));
    scene.back();
    feed(&mut sender, 160..200);
    done(sender, 200);
    scene.check_one_run(0..200);
}

#[test]
fn a_robot_whose_power_goes_sends_what_it_had_first() {
    let mut scene = Scene::new();
    let mut first = scene.live(&[]);
    feed(&mut first, 0..50);
    first.wait_for("its run", |s| s.last("stream").is_some());
    scene.away();
    feed(&mut first, 50..120);
    wait_for_read(&first, 120);
    first.kill();
    scene.back();
    let mut second = scene.live(&[]);
    feed(&mut second, 120..180);
    done(second, 180);
    scene.check_one_run(0..180);
}

#[test]
fn a_network_that_cuts_loses_and_doubles_nothing() {
    let scene = Scene::new();
    let mut sender = scene.live(&[]);
    for round in 0..6 {
        feed(&mut sender, 40 * round..40 * (round + 1));
        scene.relay.cut();
    }
    done(sender, 240);
    scene.check_one_run(0..240);
}

#[test]
fn an_end_whose_answer_was_lost_begins_no_new_run() {
    let scene = Scene::new();
    let mut sender = scene.live(&[]);
    feed(&mut sender, 0..30);
    sender.wait_for("all safe", |s| s.last("frames").is_some_and(|line| line["waiting"] == 0 && line["read"] == 30));
    scene.relay.be_deaf(true);
    drop(sender.stdin.take());
    sender.wait_for("another try", |s| s.last("retry").is_some());
    scene.relay.be_deaf(false);
    done(sender, 30);
    scene.check_one_run(0..30);
}

#[test]
fn another_mission_is_another_run_after_what_was_left_of_the_first() {
    let mut scene = Scene::new();
    let mut first = scene.live(&["--chainage-mm", "1000"]);
    feed(&mut first, 0..20);
    first.wait_for("its run", |s| s.last("stream").is_some());
    scene.away();
    feed(&mut first, 20..60);
    wait_for_read(&first, 60);
    first.kill();
    scene.back();
    let mut second = scene.live(&["--chainage-mm", "2000"]);
    feed(&mut second, 60..90);
    done(second, 30);
    let runs = runs(&scene.server);
    let chainages: Vec<_> = runs.iter().map(|run| run["chainage_mm"].as_f64()).collect();
    assert_eq!(chainages, [Some(1000.0), Some(2000.0)]);
    for (run, seeds) in runs.iter().zip([0..60, 60..90]) {
        let images: Vec<_> = scene.frames(run).into_iter().map(|frame| frame.image).collect();
        assert!(images == seeds.map(|seed| jpeg(seed, 20_000)).collect::<Vec<_>>());
    }
}

#[test]
fn a_signal_ends_the_stream_and_what_was_read_arrives() {
    let scene = Scene::new();
    let mut sender = scene.live(&[]);
    feed(&mut sender, 0..40);
    wait_for_read(&sender, 40);
    let stdin = sender.stdin.take();
    sender.terminate();
    done(sender, 40);
    drop(stdin);
    scene.check_one_run(0..40);
}

#[test]
fn what_is_no_stream_of_images_is_refused() {
    let scene = Scene::new();
    for (bytes, expected) in [(Vec::new(), "no frame"), (vec![0x47; 400_000], "MJPEG")] {
        let mut sender = scene.live(&[]);
        let mut stdin = sender.stdin.take().expect("piped");
        let _ = stdin.write_all(&bytes);
        drop(stdin);
        let (code, lines, said) = sender.end();
        assert_eq!(code, Some(2), "{lines:?} {said}");
        assert!(said.contains(expected), "{said}");
    }
    let mut sender = scene.live(&["--recipe", "fast"]);
    feed(&mut sender, 0..3);
    let (code, _, said) = sender.end();
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("fast"), "{said}");
    // Frames of the wrong command stay, out of the way of the right one's.
    let mut sender = scene.live(&[]);
    feed(&mut sender, 3..6);
    let (code, lines, _) = sender.end();
    assert_eq!(code, Some(3), "{lines:?}");
    assert!(lines.iter().any(|line| line.contains("refused")), "{lines:?}");
    assert_eq!(scene.frames(&runs(&scene.server)[0]).len(), 3);
}

#[test]
fn ffmpeg_writes_and_the_job_is_done() {
    let (server, robot, run) = (Server::start(&["--workers", "1"]), Robot::new(), short_run());
    let mut ffmpeg = Command::new("ffmpeg")
        .args(["-v", "error", "-i", plain(&run.video), "-q:v", "2", "-f", "mpjpeg", "-"])
        .stdout(Stdio::piped())
        .spawn()
        .expect("ffmpeg is missing: apt-get install ffmpeg");
    let url = server.url("");
    let usual = ["-", "--live", "--stream", "r", "--server", &url, "--asset", "A", "--rig", plain(&run.rig)];
    let mut sender = robot.send(&[&usual[..], &["--fps", "8", "--wait"]].concat());
    let mut stdin = sender.stdin.take().expect("piped");
    std::io::copy(&mut ffmpeg.stdout.take().expect("piped"), &mut stdin).expect("carried");
    drop(stdin);
    assert!(ffmpeg.wait().expect("ends").success());
    let (code, lines, said) = sender.end();
    assert!(matches!(code, Some(0 | 3)), "{lines:?} {said}");
    let done = lines.iter().find(|line| line.starts_with("Done: ")).unwrap_or_else(|| panic!("{lines:?}"));
    assert!(done.starts_with("Done: 8 frames"), "{done}");
    assert_eq!(runs(&server)[0]["state"], "done");
}

/// A server that gives little credit, and says what it saw.
async fn miser(listener: tokio::net::TcpListener, credit: u64, frames: u64) -> Vec<Value> {
    let (stream, _) = listener.accept().await.expect("a sender");
    let mut socket = tokio_tungstenite::accept_async(stream).await.expect("a WebSocket");
    let hello = socket.next().await.expect("a message").expect("sound").into_text().expect("text");
    let mut seen = vec![serde_json::from_str(&hello).expect("JSON")];
    let welcome = json!({"type": "welcome", "run": "r", "job": "j", "next_seq": 0, "credit": credit});
    socket.send(Message::text(welcome.to_string())).await.expect("sent");
    let (mut next, mut durable) = (0u64, 0u64);
    while next < frames {
        let wait = tokio::time::timeout(Duration::from_millis(300), socket.next()).await;
        let Ok(message) = wait else {
            if next - durable < credit {
                continue;
            }
            durable += 1;
            let ack = json!({"type": "ack", "durable_seq": durable - 1, "credit": credit});
            socket.send(Message::text(ack.to_string())).await.expect("sent");
            continue;
        };
        let Message::Binary(frame) = message.expect("a message").expect("sound") else { continue };
        assert_eq!(u64::from_le_bytes(frame[..8].try_into().expect("8 bytes")), next);
        assert!(i64::from_le_bytes(frame[8..16].try_into().expect("8 bytes")) > 1_600_000_000_000_000_000);
        assert_eq!(u32::from_le_bytes(frame[16..20].try_into().expect("4 bytes")), crc32c::crc32c(&frame[20..]));
        assert!(frame[20..] == jpeg(next, 20_000));
        next += 1;
        assert!(next <= durable + credit, "frame {next} is beyond the credit");
    }
    loop {
        let message = socket.next().await.expect("a message").expect("sound");
        if let Message::Text(text) = message {
            seen.push(serde_json::from_str(&text).expect("JSON"));
            break;
        }
    }
    let closed = json!({"type": "closed", "frames": frames, "missing": [[3, 4]]});
    socket.send(Message::text(closed.to_string())).await.expect("sent");
    let _ = socket.close(None).await;
    seen
}

#[test]
fn the_credit_is_kept_and_what_is_missing_is_told() {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime");
    let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).expect("a port");
    let url = format!("http://{}", listener.local_addr().expect("an address"));
    let miser = runtime.spawn(miser(listener, 3, 8));
    let robot = Robot::new();
    let rig = plain(&short_run().rig);
    let mut sender =
        robot.send(&["-", "--live", "--stream", "r", "--server", &url, "--asset", "A", "--rig", rig, "--json"]);
    feed(&mut sender, 0..8);
    let (code, lines, said) = sender.end();
    assert_eq!(code, Some(3), "{lines:?} {said}");
    let closed: Value = serde_json::from_str(lines.last().expect("a line")).expect("JSON");
    assert_eq!(closed["missing"], json!([[3, 4]]));
    let seen = runtime.block_on(miser).expect("no panic");
    assert_eq!((seen[0]["type"].as_str(), seen[0]["resume"].as_bool()), (Some("hello"), Some(false)));
    assert_eq!(seen[0]["asset"], "A");
    assert_eq!(seen[1], json!({"type": "end"}));
}

#[test]
fn frames_leave_the_robot_s_disk_only_when_they_are_safe() {
    let mut scene = Scene::new();
    let mut sender = scene.live(&[]);
    feed(&mut sender, 0..20);
    sender.wait_for("its run", |s| s.last("stream").is_some());
    scene.away();
    feed(&mut sender, 20..60);
    wait_for_read(&sender, 60);
    assert!(scene.segments() > 0);
    sender.terminate();
    let (code, lines, _) = sender.end();
    assert_eq!(code, Some(130), "{lines:?}");
    assert!(lines.iter().any(|line| line.contains("the same command sends them")), "{lines:?}");
    assert!(scene.segments() > 0);
    scene.back();
    // The input had ended; the same command with nothing new delivers it.
    let (code, lines, said) = scene.live(&[]).end();
    assert_eq!(code, Some(0), "{lines:?} {said}");
    scene.check_one_run(0..60);
    assert_eq!(scene.segments(), 0);
}
