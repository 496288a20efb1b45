//! A robot sends to one server, people watch through another; two servers never write one stream.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use serde_json::Value;
use stria_tests::support::cluster::Cluster;
use stria_tests::support::server::{Server, header, send, text};
use stria_tests::support::{Run, eventually, form, long_run};

/// Longer than any test.
const ENDLESSLY: u32 = 10_000;

/// ffmpeg sends the run at the pace at which it was recorded, `times` over.
fn robot(server: &Server, run: &Run, times: u32) -> Child {
    let url = server.url(&format!("/api/live/robot7?asset=Live&rig={}", form::percent_encoded(&run.rig_text())));
    Command::new("ffmpeg")
        .args(["-hide_banner", "-loglevel", "quiet", "-nostdin", "-stream_loop", &(times - 1).to_string(), "-re", "-i"])
        .arg(&run.video)
        .args(["-q:v", "3", "-f", "mpjpeg", "-method", "POST", &url])
        .stdin(Stdio::null())
        .spawn()
        .expect("ffmpeg is installed: docker/set-up.sh brings it")
}

fn stream(server: &Server) -> Value {
    let streams = server.json("/api/live");
    streams["items"].as_array().and_then(|all| all.first()).cloned().unwrap_or(Value::Null)
}

/// Reads a job's events until one is wanted; what it brought.
fn event(server: &Server, job: &str, wanted: &str) -> Value {
    let response = send(server.get(&format!("/api/jobs/{job}/events")));
    let mut name = String::new();
    for line in BufReader::new(response).lines() {
        let line = line.expect("text");
        if let Some(event) = line.strip_prefix("event: ") {
            name = event.into();
        } else if let Some(data) = line.strip_prefix("data: ")
            && name == wanted
        {
            return serde_json::from_str(data).expect("JSON");
        }
    }
    panic!("the stream of events ended without {wanted}");
}

#[test]
fn a_live_run_is_watched_through_the_other_server() {
    let cluster = Cluster::start();
    let (a, b) = (cluster.server(&["--workers", "0"]), cluster.server(&["--workers", "0"]));
    let _worker = cluster.worker(&["--slots", "1"]);
    let mut robot = robot(&a, long_run(), 5);
    eventually("the other server lists the stream", || stream(&b)["frames"].as_u64().is_some_and(|n| n > 0));
    let job = text(&stream(&b), "/job");
    // While the robot still walks: a recording segment is told by the other server, and can be fetched there.
    let told = event(&b, &job, "segment");
    let segment = send(b.get(&text(&told, "/url")));
    assert_eq!(segment.status(), 200);
    assert_eq!(segment.bytes().expect("a body").len() as u64, told["bytes"].as_u64().expect("a size"));
    let frame = || send(b.get(&format!("/api/jobs/{job}/live/frame.jpg")));
    eventually("the newest frame is seen through the other server", || frame().status() == 200);
    assert_eq!(header(&frame(), "content-type"), "image/jpeg");
    let (running, open) = (b.json(&format!("/api/jobs/{job}")), stream(&b));
    assert!(robot.try_wait().expect("it can be waited for").is_none(), "the robot was to walk longer than this takes");
    assert_eq!((&running["state"], &open["open"]), (&"running".into(), &true.into()), "{running:#} {open:#}");
    assert!(robot.wait().expect("it ends").success());
    let done = b.wait_for_state(&job, "done");
    assert_eq!(done["frames"].as_u64(), stream(&a)["frames"].as_u64(), "{done:#}");
}

/// Whoever begins a run has looked whether the stream is open already, and waits here for the others.
const MEET: &str = "CREATE FUNCTION meet() RETURNS trigger LANGUAGE plpgsql AS \
    'BEGIN PERFORM pg_advisory_xact_lock(7); RETURN NEW; END'; \
    CREATE TRIGGER meet BEFORE INSERT ON runs FOR EACH ROW EXECUTE FUNCTION meet()";
/// The lock's number in it.
const MEETING: u32 = 7;

#[test]
fn two_servers_that_race_for_a_stream_leave_it_to_one() {
    let cluster = Cluster::start();
    // Long enough that a robot on a busy machine is not taken for one that is gone.
    let come_back = ["--workers", "0", "--live-come-back-s", "8"];
    let servers = [cluster.server(&come_back), cluster.server(&come_back)];
    let [a, b] = &servers;
    let _worker = cluster.worker(&["--slots", "1"]);
    cluster.ask(MEET);
    // Both find no open stream, and only then may go on, one after the other: whichever comes later takes the stream over,
    // and the other one is told so. Who is turned away because the machine is busy comes again.
    let gate = cluster.hold(MEETING);
    let mut robots = [robot(a, long_run(), ENDLESSLY), robot(b, long_run(), ENDLESSLY)];
    let come_again = |robots: &mut [Child; 2]| {
        for (server, walking) in servers.iter().zip(robots) {
            if walking.try_wait().expect("it can be waited for").is_some() {
                *walking = robot(server, long_run(), ENDLESSLY);
            }
        }
    };
    eventually("both servers are about to begin the run", || {
        come_again(&mut robots);
        // One waits at the gate, the other there too, or for the first (both make the asset).
        cluster.ask("SELECT count(*) FROM pg_locks WHERE NOT granted") == ["2"]
    });
    drop(gate);
    let mut fences: Vec<i64> = Vec::new();
    let mut look = || {
        let open = cluster.ask("SELECT count(*) FROM streams WHERE is_open <> 0");
        assert!(open == ["0"] || open == ["1"], "{open:?}");
        fences.extend(cluster.ask("SELECT fence FROM streams").iter().filter_map(|f| f.parse::<i64>().ok()));
        fences.last().copied()
    };
    eventually("one takes over from the other", || {
        let taken_over = look().is_some_and(|fence| fence >= 2);
        if !taken_over {
            come_again(&mut robots);
        }
        taken_over
    });
    eventually("the other is told so", || {
        look();
        robots.iter_mut().any(|walking| walking.try_wait().expect("it can be waited for").is_some())
    });
    for walking in &mut robots {
        let _ = walking.kill();
        walking.wait().expect("it ends");
    }
    look();
    assert!(fences.windows(2).all(|pair| pair[0] <= pair[1]), "an older owner came back: {fences:?}");
    eventually("the run is closed, by either server", || stream(a)["open"] == false);
    // Segments are numbered without a gap or a second one of any number, and what is in the records is what the job read.
    let runs = cluster.ask("SELECT id FROM runs");
    assert_eq!(runs.len(), 1, "one robot, one run: {runs:?}");
    let numbers = cluster.ask("SELECT number FROM source_segments ORDER BY number");
    let expected: Vec<String> = (0..numbers.len()).map(|n| n.to_string()).collect();
    assert_eq!(numbers, expected);
    let (by_a, by_b) = (stream(a), stream(b));
    assert_eq!(by_a, by_b, "both tell the same");
    let done = b.wait_for_state(&text(&by_b, "/job"), "done");
    assert_eq!(done["frames"], by_b["frames"], "{done:#}");
}
