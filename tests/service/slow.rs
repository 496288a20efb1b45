//! Clients that take their time: each is let go of after a while, and nobody else waits for them.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use stria_tests::support::eventually;
use stria_tests::support::server::{Server, send};
use stria_tests::support::short_run;

/// How long the server of these tests waits for anyone, s.
const PATIENCE_S: &str = "2";
/// Long after that, a test fails.
const LATE: Duration = Duration::from_secs(30);

fn server() -> Server {
    Server::start(&["--workers", "0", "--head-timeout-s", PATIENCE_S, "--sender-silence-s", PATIENCE_S])
}

fn connect(server: &Server) -> TcpStream {
    let stream = TcpStream::connect(server.url("").trim_start_matches("http://")).expect("connects");
    stream.set_read_timeout(Some(LATE)).expect("sets");
    stream
}

/// Sends a byte now and then until the server hangs up; what it said.
fn drip(mut stream: TcpStream, byte: &[u8]) -> String {
    let begun = Instant::now();
    let mut said = Vec::new();
    let mut buffer = [0; 4096];
    stream.set_read_timeout(Some(Duration::from_millis(200))).expect("sets");
    loop {
        assert!(begun.elapsed() < LATE, "the server waits for a slow sender for ever");
        let _ = stream.write_all(byte);
        match stream.read(&mut buffer) {
            Ok(0) => break,
            Ok(n) => said.extend_from_slice(&buffer[..n]),
            Err(e) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) => {}
            Err(_) => break,
        }
    }
    String::from_utf8_lossy(&said).into_owned()
}

#[test]
fn heads_that_never_end_are_cut_off_and_keep_nobody_waiting() {
    let server = server();
    // More of them than the server would answer at once if each kept a thread.
    let slow: Vec<_> = (0..200)
        .map(|_| {
            let mut stream = connect(&server);
            stream.write_all(b"GET /livez HTTP/1.1\r\nHost: localhost\r\nX-").expect("sends");
            stream
        })
        .collect();
    let begun = Instant::now();
    assert_eq!(send(server.get("/livez")).status(), 200);
    assert!(begun.elapsed() < Duration::from_secs(PATIENCE_S.parse().expect("a number")), "others wait for the slow");
    std::thread::scope(|scope| {
        let ended: Vec<_> = slow.into_iter().map(|stream| scope.spawn(|| drip(stream, b"a"))).collect();
        for said in ended {
            let said = said.join().expect("it ends");
            assert!(!said.contains("200 OK"), "{said}");
        }
    });
    // One that connects and says nothing at all.
    assert_eq!(connect(&server).read(&mut [0; 1]).unwrap_or(0), 0);
}

#[test]
fn bodies_that_stop_are_given_up_and_leave_nothing() {
    let server = server();
    let rig = stria_tests::support::form::percent_encoded(&short_run().rig_text());
    let mut stream = connect(&server);
    let head =
        format!("POST /api/runs?asset=Wall&rig={rig} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000\r\n\r\n");
    stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(b"the first bytes of a video")).expect("sends");
    let mut said = [0; 1024];
    let bytes = stream.read(&mut said).expect("an answer in time");
    let said = String::from_utf8_lossy(&said[..bytes]).into_owned();
    assert!(said.starts_with("HTTP/1.1 408") && said.contains("\"retryable\":true"), "{said}");
    eventually("nothing of it stays", || {
        std::fs::read_dir(server.data().join("incoming")).is_ok_and(|entries| entries.count() == 0)
    });
    assert_eq!(server.json("/api/runs")["items"].as_array().map(Vec::len), Some(0));
}
