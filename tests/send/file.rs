//! One file: whatever happens on the way, one run with the same bytes.

use std::io::Write;
use std::path::Path;

use stria_tests::support::files_below;
use stria_tests::support::server::Server;
use stria_tests::support::short_run;

use super::relay::Relay;
use super::sender::{Robot, Sender, content, plain, runs, source};

const MB: u64 = 1_000_000;

struct Scene {
    server: Server,
    relay: Relay,
    robot: Robot,
}

impl Scene {
    /// A server that takes runs and lets their jobs wait, and a relay to it.
    fn new() -> Scene {
        let (server, relay) = (Server::start(&["--workers", "0"]), Relay::start());
        relay.lead_to(Some(&server.url("")));
        Scene { server, relay, robot: Robot::new() }
    }

    fn send(&self, file: &Path, more: &[&str]) -> Sender {
        let (url, rig) = (self.relay.url(), &short_run().rig);
        let usual = [plain(file), "--server", &url, "--asset", "Pipe 7", "--rig", plain(rig)];
        self.robot.send(&[&usual[..], more].concat())
    }

    /// There is one run, and it holds the file.
    fn check_one_run(&self, file: &Path) {
        let runs = runs(&self.server);
        assert_eq!(runs.len(), 1, "{runs:#?}");
        assert_eq!(runs[0]["asset"], "Pipe 7");
        assert!(source(&self.server, &runs[0]) == std::fs::read(file).expect("the file"), "other bytes");
        assert_eq!(files_below(&self.robot.state()), [""; 0], "nothing is left to be gone on with");
    }
}

fn done(sender: Sender) -> Vec<String> {
    let (code, lines, said) = sender.end();
    assert_eq!(code, Some(0), "{lines:?}\n{said}");
    lines
}

#[test]
fn a_killed_sender_goes_on_where_it_was() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 20 * MB as usize, 1);
    let first = scene.send(&file, &["--limit-kbit-s", "40000"]);
    scene.relay.wait_for_up(12 * MB);
    first.kill();
    assert!(runs(&scene.server).is_empty());
    let before = scene.relay.up();
    let lines = done(scene.send(&file, &[]));
    assert!(lines[0].starts_with("sent: run.mp4 (20.0 MB), run "), "{lines:?}");
    let again = scene.relay.up() - before;
    assert!(again < 20 * MB - 11 * MB, "{again} bytes were sent by the second process; 12 MB had arrived before");
    scene.check_one_run(&file);
}

#[test]
fn a_server_that_dies_and_comes_back_is_waited_for() {
    let mut scene = Scene::new();
    let file = scene.robot.file("run.mp4", 16 * MB as usize, 2);
    let sender = scene.send(&file, &["--limit-kbit-s", "40000"]);
    for passed in [5, 10] {
        scene.relay.wait_for_up(passed * MB);
        scene.server.kill();
        scene.relay.lead_to(None);
        sender.wait_for("a word of it", |s| s.said().matches("trying again").count() as u64 >= passed / 5);
        scene.server.start_again();
        scene.relay.lead_to(Some(&scene.server.url("")));
    }
    done(sender);
    scene.check_one_run(&file);
}

#[test]
fn a_network_that_cuts_costs_time_and_no_bytes() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 6 * MB as usize, 3);
    scene.relay.cut_after(500_000);
    done(scene.send(&file, &[]));
    assert!(scene.relay.connections() >= 12, "{} connections", scene.relay.connections());
    scene.check_one_run(&file);
}

#[test]
fn a_lost_answer_is_asked_for_again() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 3 * MB as usize, 4);
    let sender = scene.send(&file, &["--limit-kbit-s", "16000", "--json"]);
    scene.relay.wait_for_up(MB);
    scene.relay.be_deaf(true);
    // The whole file arrives, and its run is made, but nobody hears of it.
    sender.wait_for("another try", |s| s.last("retry").is_some());
    stria_tests::support::eventually("the run", || runs(&scene.server).len() == 1);
    scene.relay.be_deaf(false);
    let lines = done(sender);
    let last: serde_json::Value = serde_json::from_str(lines.last().expect("a line")).expect("JSON");
    assert_eq!((last["type"].as_str(), last["bytes"].as_u64()), (Some("sent"), Some(3 * MB)));
    assert_eq!(last["run"], runs(&scene.server)[0]["id"]);
    scene.check_one_run(&file);
}

#[test]
fn a_sender_that_was_killed_before_it_heard_of_its_run_finds_it() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 2 * MB as usize, 5);
    let first = scene.send(&file, &["--limit-kbit-s", "16000"]);
    scene.relay.wait_for_up(MB);
    scene.relay.be_deaf(true);
    stria_tests::support::eventually("the run", || runs(&scene.server).len() == 1);
    first.kill();
    scene.relay.be_deaf(false);
    let before = scene.relay.up();
    done(scene.send(&file, &[]));
    assert!(scene.relay.up() - before < 10_000, "nothing of the file is sent again");
    scene.check_one_run(&file);
}

#[test]
fn other_fields_make_another_upload_and_the_old_one_is_given_up() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 8 * MB as usize, 6);
    let first = scene.send(&file, &["--limit-kbit-s", "16000", "--chainage-mm", "1"]);
    scene.relay.wait_for_up(2 * MB);
    first.kill();
    done(scene.send(&file, &["--chainage-mm", "-2.5"]));
    assert_eq!(runs(&scene.server)[0]["chainage_mm"], -2.5);
    scene.check_one_run(&file);
    assert!(scene.relay.heard().contains("DELETE /api/uploads/"));
}

#[test]
fn a_file_that_changes_while_it_is_sent_is_not_sent() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 4 * MB as usize, 7);
    let sender = scene.send(&file, &["--limit-kbit-s", "16000"]);
    scene.relay.wait_for_up(MB);
    let mut open = std::fs::OpenOptions::new().append(true).open(&file).expect("opens");
    open.write_all(b"one more frame").expect("writes");
    scene.relay.cut();
    let (code, _, said) = sender.end();
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("changed"), "{said}");
    assert!(runs(&scene.server).is_empty());
    done(scene.send(&file, &[]));
    scene.check_one_run(&file);
}

#[test]
fn two_senders_of_one_file_do_not_disturb_each_other() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 4 * MB as usize, 8);
    let first = scene.send(&file, &["--limit-kbit-s", "16000"]);
    scene.relay.wait_for_up(MB);
    let (code, _, said) = scene.send(&file, &[]).end();
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("another stria"), "{said}");
    done(first);
    scene.check_one_run(&file);
}

#[test]
fn a_signal_stops_it_and_the_same_command_goes_on() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 8 * MB as usize, 9);
    let first = scene.send(&file, &["--limit-kbit-s", "16000", "--json"]);
    scene.relay.wait_for_up(4 * MB);
    first.terminate();
    let (code, lines, _) = first.end();
    assert_eq!(code, Some(130));
    assert!(lines.last().is_some_and(|line| line.contains("cancelled")), "{lines:?}");
    let before = scene.relay.up();
    done(scene.send(&file, &[]));
    assert!(scene.relay.up() - before < 5 * MB);
    scene.check_one_run(&file);
}

#[test]
fn it_gives_up_at_its_limit_with_what_is_needed_to_go_on() {
    let scene = Scene::new();
    scene.relay.lead_to(None);
    let file = scene.robot.file("run.mp4", 1000, 10);
    // A little more than a second.
    let (code, _, said) = scene.send(&file, &["--give-up-h", "0.0004"]).end();
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("--give-up-h") && said.contains("trying again"), "{said}");
    assert_eq!(files_below(&scene.robot.state()).len(), 1);
    scene.relay.lead_to(Some(&scene.server.url("")));
    done(scene.send(&file, &[]));
    scene.check_one_run(&file);
}

#[test]
fn the_token_is_in_the_header_and_nowhere_else() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 3 * MB as usize, 11);
    let token_file = scene.robot.path("token");
    std::fs::write(&token_file, "from-a-file\n").expect("writes");
    let own = std::os::unix::fs::PermissionsExt::from_mode(0o600);
    std::fs::set_permissions(&token_file, own).expect("changes");
    let (url, rig) = (scene.relay.url(), plain(&short_run().rig));
    let usual = [plain(&file), "--server", &url, "--asset", "A", "--rig", rig, "--limit-kbit-s", "16000"];
    for (more, variables, expected) in [
        (vec![], vec![("STRIA_TOKEN", "from-the-environment")], "from-the-environment"),
        (vec!["--token-file", plain(&token_file)], vec![("STRIA_TOKEN", "not this one")], "from-a-file"),
    ] {
        let before = scene.relay.up();
        let sender = scene.robot.send_with(&[&usual[..], &more].concat(), &variables);
        scene.relay.wait_for_up(before + MB);
        let arguments = std::fs::read_to_string(format!("/proc/{}/cmdline", sender.id())).expect("Linux");
        assert!(!arguments.contains(expected), "{arguments}");
        done(sender);
        let heard = scene.relay.heard().to_lowercase();
        assert!(heard.contains(&format!("authorization: bearer {expected}\r\n")), "{heard}");
    }
    let kept = files_below(&scene.robot.state());
    assert_eq!(kept, [""; 0], "no token on disk");
    for (text, expected) in [("", "is empty"), ("two words", "one line"), ("a\nb", "one line")] {
        std::fs::write(&token_file, text).expect("writes");
        let sender = scene.robot.send(&[&usual[..], &["--token-file", plain(&token_file)]].concat());
        let (code, _, said) = sender.end();
        assert_eq!(code, Some(2), "{said}");
        assert!(said.contains(expected) && (text.is_empty() || !said.contains(text)), "{said}");
    }
}

#[test]
fn the_bandwidth_stays_below_its_cap() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 2 * MB as usize, 12);
    let begun = std::time::Instant::now();
    done(scene.send(&file, &["--limit-kbit-s", "8000"]));
    // 1 MB/s; an eighth of a second's worth goes at once.
    assert!(begun.elapsed().as_secs_f64() > 1.8, "{:?}", begun.elapsed());
    scene.check_one_run(&file);
}

#[test]
fn what_is_wrong_is_said_before_anything_is_sent() {
    let scene = Scene::new();
    let file = scene.robot.file("run.mp4", 10, 13);
    let folder = scene.robot.path("");
    for (source, more, expected) in [
        (plain(&file), vec!["--stream", "a"], "--live"),
        (plain(&file), vec!["--live", "--stream", "a"], "stdin"),
        ("-", vec![], "--live"),
        ("-", vec!["--live", "--stream", "a/b"], "letters"),
        (plain(&folder), vec![], "--watch"),
        (plain(&file), vec!["--watch"], "no folder"),
        (plain(&file), vec!["--delete-sent"], "--watch"),
        (plain(&file), vec!["--limit-kbit-s", "1"], "8"),
        (plain(&file), vec!["--stall-s", "0"], "--stall-s"),
        (plain(&file), vec!["--chainage-mm", "nan"], "--chainage-mm"),
        ("missing.mp4", vec![], "missing.mp4"),
    ] {
        let usual = [source, "--server", &scene.relay.url(), "--asset", "A", "--rig", "wall"].map(String::from);
        let arguments: Vec<&str> = usual.iter().map(String::as_str).chain(more.iter().copied()).collect();
        let (code, _, said) = scene.robot.send(&arguments).end();
        assert_eq!(code, Some(2), "{arguments:?}: {said}");
        assert!(said.contains(expected), "{arguments:?}: {said}");
    }
    assert_eq!(scene.relay.connections(), 0);
    assert_eq!(content(5, 1).len(), 5);
}
