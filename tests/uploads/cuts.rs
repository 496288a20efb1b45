//! What tusd tests of connections that end too soon, by its names: read time-out, network close, network reset, lock
//! release, stop, concurrent PATCH; and kill -9.

use std::time::{Duration, Instant};

use stria_tests::support::eventually;
use stria_tests::support::server::{Server, header, problem_of, send};

use super::pieces::{
    Half, ask_records, assert_source, authority, content, create, number, offset, piece, runs, send_rest, server,
    wait_until_written,
};
use super::storms::{BigFile, SYNC_BYTES, assert_arrived, tus_js_client};
use super::tunnel::{End, Tunnel, Weather};

/// A small upload, bytes.
const BYTES: usize = 100_000;
/// What of it arrives at first.
const FIRST: usize = 40_000;

/// An upload of which the first part is written, by a request that goes no further.
fn half_sent(server: &Server, through: &str, content: &[u8]) -> (String, Half) {
    let path = create(server, content.len());
    let half = Half::send(through, &path, 0, content.len(), &content[..FIRST]);
    wait_until_written(server, &path, FIRST);
    (path, half)
}

#[test]
fn read_timeout() {
    let server = server(&["--sender-silence-s", "0.3"]);
    let content = content(BYTES, 1);
    let (path, half) = half_sent(&server, &authority(&server), &content);
    // A client may take a 4xx for the end of all tries.
    assert_eq!(half.status(), 503);
    assert_eq!(offset(&server, &path), FIRST);
    assert_source(&server, &send_rest(&server, &path, &content), &content);
}

#[test]
fn network_close() {
    let server = server(&[]);
    let content = content(BYTES, 2);
    let (path, half) = half_sent(&server, &authority(&server), &content);
    drop(half);
    assert_eq!(offset(&server, &path), FIRST);
    assert_source(&server, &send_rest(&server, &path, &content), &content);
}

#[test]
fn network_reset() {
    let server = server(&[]);
    let tunnel = Tunnel::to(&[&authority(&server)], Weather::CALM, 3);
    let content = content(BYTES, 3);
    let (path, _half) = half_sent(&server, &tunnel.authority(), &content);
    tunnel.cut(End::Reset);
    assert_eq!(offset(&server, &path), FIRST);
    assert_source(&server, &send_rest(&server, &path, &content), &content);
}

#[test]
fn what_arrived_before_a_cut_is_kept_although_nobody_asks() {
    let server = server(&[]);
    let content = content(BYTES, 4);
    let (path, half) = half_sent(&server, &authority(&server), &content);
    drop(half);
    // A server that is killed keeps only what is in its records.
    let promised = || ask_records(&server, "SELECT offset_bytes FROM uploads WHERE id = ?", &path);
    eventually("the bytes are promised", || promised() == FIRST.to_string());
}

#[test]
fn lock_release() {
    let server = server(&[]);
    let tunnel = Tunnel::to(&[&authority(&server)], Weather::CALM, 5);
    let content = content(BYTES, 5);
    // The machine may be busy with something else for a moment: the quickest of some counts.
    let mut quickest = Duration::MAX;
    for _ in 0..5 {
        // The client has gone, and the server never hears of it.
        let (path, half) = half_sent(&server, &tunnel.authority(), &content);
        tunnel.cut(End::Dead);
        drop(half);
        let asked = Instant::now();
        assert_eq!(offset(&server, &path), FIRST, "HEAD takes over, and nothing that arrived is lost");
        quickest = quickest.min(asked.elapsed());
        assert_source(&server, &send_rest(&server, &path, &content), &content);

        let (path, half) = half_sent(&server, &tunnel.authority(), &content);
        tunnel.cut(End::Dead);
        drop(half);
        let sent = Instant::now();
        let rest = send(piece(&server, &path, FIRST).body(content[FIRST..].to_vec()));
        assert_eq!(rest.status(), 204, "PATCH takes over without a question");
        quickest = quickest.min(sent.elapsed());
        assert_source(&server, &header(&rest, "stria-run"), &content);
    }
    assert!(quickest < Duration::from_secs(1), "{quickest:?}");
}

#[test]
fn the_older_of_two_requests_hears_that_it_was_taken_over() {
    let server = server(&[]);
    let content = content(BYTES, 6);
    let (path, mut older) = half_sent(&server, &authority(&server), &content);
    assert_eq!(offset(&server, &path), FIRST);
    // What it goes on to send counts no more.
    older.more(&content[FIRST..FIRST + 1000]);
    assert_eq!(older.status(), 423);
    assert_eq!(offset(&server, &path), FIRST);
}

#[test]
fn stop() {
    let mut server = server(&[]);
    let content = content(BYTES, 7);
    let (path, half) = half_sent(&server, &authority(&server), &content);
    let asked = Instant::now();
    let stopped = std::thread::scope(|scope| {
        let told = scope.spawn(move || half.status());
        assert!(server.stop().success());
        told.join().expect("an answer")
    });
    assert_eq!(stopped, 503, "the sender shall come back");
    assert!(asked.elapsed() < Duration::from_secs(20), "{:?}", asked.elapsed());
    server.start_again();
    assert_eq!(offset(&server, &path), FIRST);
    assert_source(&server, &send_rest(&server, &path, &content), &content);
}

#[test]
fn concurrent_patch() {
    let server = server(&[]);
    let content = content(BYTES, 8);
    // One after the other: the second finds the upload where the first one left it.
    let (path, first) = half_sent(&server, &authority(&server), &content);
    let second = send(piece(&server, &path, 0).body(content.clone()));
    assert_eq!(number(&second, "upload-offset"), FIRST);
    problem_of(second, 409);
    assert_eq!(first.status(), 423);
    assert_source(&server, &send_rest(&server, &path, &content), &content);

    // All at once: whatever each of them hears, the bytes are right and there is one run.
    let path = create(&server, content.len());
    let heard: Vec<u16> = std::thread::scope(|scope| {
        let one = || send(piece(&server, &path, 0).body(content.clone())).status().as_u16();
        let all: Vec<_> = (0..8).map(|_| scope.spawn(one)).collect();
        all.into_iter().map(|thread| thread.join().expect("an answer")).collect()
    });
    assert!(heard.iter().all(|status| [204, 409, 423].contains(status)), "{heard:?}");
    assert_source(&server, &send_rest(&server, &path, &content), &content);
    assert_eq!(runs(&server), 2);
}

#[test]
fn a_server_that_is_killed_in_the_middle_of_pieces_loses_nothing_confirmed() {
    const FILE_BYTES: usize = 100_000_000;
    const KILLS: u64 = 5;
    /// What goes with a process beside what it did not sync yet: it lies in the kernel's buffers, unread.
    const IN_BUFFERS_BYTES: u64 = 8 << 20;
    let mut server = server(&[]);
    let file = BigFile::of(FILE_BYTES, 9);
    // Slow enough to be met in the middle.
    let weather = Weather { cuts: 0, bytes_between_cuts: 1, throttle_mb_s: Some(40) };
    let tunnel = Tunnel::to(&[&authority(&server)], weather, 9);
    let endpoint = tunnel.url("/api/uploads");
    let sent = std::thread::scope(|scope| {
        let client = scope.spawn(|| tus_js_client(&endpoint, &file.path));
        for kill in 1..=KILLS {
            let far_enough = FILE_BYTES as u64 * kill / (KILLS + 1);
            eventually("the client goes on", || tunnel.look(|ledger| ledger.reached()) > far_enough);
            server.kill();
            assert!(!client.is_finished(), "the upload ended before kill {kill}");
            server.start_again();
            tunnel.lead_to(&[&authority(&server)]);
        }
        client.join().expect("it arrives")
    });
    assert_arrived(&server, &tunnel, &sent, &file, SYNC_BYTES + IN_BUFFERS_BYTES);
}
