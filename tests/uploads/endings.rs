//! How uploads end: a lost last answer, given up, expired, not what was announced.

use std::collections::BTreeSet;

use stria_tests::support::server::{header, problem_of, send, text};
use stria_tests::support::{eventually, files_below};

use super::pieces::{
    PIECE, ask, ask_records, assert_source, content, create, creation, fields, growing_file, metadata, number, offset,
    piece, runs, send_rest, server, sha256,
};

/// A small upload, bytes.
const BYTES: usize = 50_000;

#[test]
fn a_lost_last_answer_is_the_same_run_and_job_however_often_it_is_asked_for() {
    let mut server = server(&[]);
    let content = content(BYTES, 31);
    let path = create(&server, BYTES);
    let last = send(piece(&server, &path, 0).body(content.clone()));
    let names = |answer: &reqwest::blocking::Response| (header(answer, "stria-run"), header(answer, "stria-job"));
    let first = names(&last);
    assert!(!first.0.is_empty() && !first.1.is_empty());
    for _ in 0..2 {
        let heard: BTreeSet<_> = std::thread::scope(|scope| {
            let asked = (0..4).map(|_| scope.spawn(|| names(&ask(&server, &path))));
            let sent = (0..4).map(|_| scope.spawn(|| names(&send(piece(&server, &path, BYTES).body("")))));
            let all: Vec<_> = asked.chain(sent).collect();
            all.into_iter().map(|thread| thread.join().expect("an answer")).collect()
        });
        assert_eq!(heard, BTreeSet::from([first.clone()]));
        server.stop();
        server.start_again();
    }
    // Who sends the last piece once more is told where it is.
    let again = send(piece(&server, &path, 0).body(content.clone()));
    assert_eq!((number(&again, "upload-offset"), again.status().as_u16()), (BYTES, 409));
    assert_eq!(runs(&server), 1);
    assert_eq!(server.json("/api/jobs")["items"].as_array().map(Vec::len), Some(1));
    assert_source(&server, &first.0, &content);
}

#[test]
fn a_creation_that_is_repeated_with_its_key_is_the_same_upload() {
    let server = server(&[]);
    let content = content(BYTES, 32);
    let with_all = |key: &str, length: usize| {
        let request = creation(&server).header("Idempotency-Key", key).header("Upload-Length", length);
        send(request.header("Content-Type", PIECE).body(content.clone()))
    };
    let first = with_all("k1", BYTES);
    let again = with_all("k1", BYTES);
    for name in ["location", "stria-run", "stria-job", "upload-offset"] {
        assert_eq!(header(&first, name), header(&again, name), "{name}");
    }
    assert_eq!((first.status().as_u16(), again.status().as_u16()), (201, 201));
    let other = send(creation(&server).header("Idempotency-Key", "k1").header("Upload-Length", BYTES + 1));
    problem_of(other, 422);
    assert_ne!(header(&with_all("k2", BYTES), "stria-run"), header(&first, "stria-run"));
    assert_eq!(runs(&server), 2);

    // Cut in the first piece, and begun again with the same key: it goes on.
    let begin = || creation(&server).header("Idempotency-Key", "k3").header("Upload-Length", BYTES);
    let path = header(&send(begin().header("Content-Type", PIECE).body(content[..1000].to_vec())), "location");
    let again = send(begin().header("Content-Type", PIECE).body(content.clone()));
    assert_eq!((header(&again, "location"), number(&again, "upload-offset")), (path.clone(), 1000));
    assert_source(&server, &send_rest(&server, &path, &content), &content);
}

#[test]
fn a_whole_upload_whose_server_died_becomes_a_run_although_nobody_asks() {
    let mut server = server(&[]);
    let content = content(BYTES, 36);
    let path = create(&server, BYTES + 1);
    send(piece(&server, &path, 0).body(content.clone()));
    server.stop();
    // As the records are after a death between the last byte and the run, more than a minute ago.
    let died = "UPDATE uploads SET length_bytes = offset_bytes, expires_ms = expires_ms - 61000 WHERE id = ?";
    ask_records(&server, died, &path);
    server.start_again();
    eventually("there is a run", || runs(&server) == 1);
    let told = ask(&server, &path);
    assert_eq!(number(&told, "upload-length"), BYTES);
    assert_source(&server, &header(&told, "stria-run"), &content);
    assert_eq!(runs(&server), 1);
}

#[test]
fn an_upload_that_is_given_up_is_gone_with_its_bytes() {
    let server = server(&[]);
    let content = content(BYTES, 33);
    let path = create(&server, BYTES);
    send(piece(&server, &path, 0).body(content[..1000].to_vec()));
    assert!(growing_file(&server, &path).exists());
    let give_up = |path: &str| send(server.delete(path).header("Tus-Resumable", "1.0.0"));
    assert_eq!(give_up(&path).status(), 204);
    assert!(!growing_file(&server, &path).exists());
    for gone in [ask(&server, &path), give_up(&path), send(piece(&server, &path, 1000).body("x"))] {
        assert_eq!(gone.status(), 404);
        assert_eq!(header(&gone, "upload-offset"), "");
    }
    // What it became stays.
    let path = create(&server, BYTES);
    let run = send_rest(&server, &path, &content);
    assert_eq!(give_up(&path).status(), 204);
    assert_source(&server, &run, &content);
}

#[test]
fn expired_upload() {
    // 1.08 s.
    let mut server = server(&["--upload-kept-h", "0.0003"]);
    let content = content(BYTES, 34);
    let path = create(&server, BYTES);
    let sent = send(piece(&server, &path, 0).body(content[..1000].to_vec()));
    let told = header(&sent, "upload-expires");
    let expires = jiff::fmt::rfc2822::parse(&told).expect("a date as HTTP writes it");
    let left_s = expires.timestamp().as_second() - jiff::Timestamp::now().as_second();
    assert!(told.ends_with(" GMT") && (-1..=2).contains(&left_s), "{told}");
    eventually("it expires", || ask(&server, &path).status() == 410);
    assert_eq!(header(&ask(&server, &path), "upload-offset"), "");
    problem_of(send(piece(&server, &path, 1000).body("x")), 410);
    problem_of(send(server.delete(&path).header("Tus-Resumable", "1.0.0")), 410);
    // The server looks when it starts.
    server.stop();
    server.start_again();
    let left = server.data().join("store/uploads");
    eventually("its bytes are deleted", || files_below(&left).is_empty());
    assert_eq!(ask(&server, &path).status(), 410, "that it was there is remembered");
}

#[test]
fn a_file_that_is_not_what_was_announced_becomes_no_run() {
    let server = server(&[]);
    let content = content(BYTES, 35);
    let mut spoiled = content.clone();
    spoiled[BYTES / 2] ^= 1;
    let announced = [fields(), vec![("sha256", sha256(&content))]].concat();
    let begin = || {
        let request = server.post("/api/uploads").header("Tus-Resumable", "1.0.0").header("Idempotency-Key", "k");
        let request = request.header("Upload-Metadata", metadata(&announced)).header("Upload-Length", BYTES);
        header(&send(request), "location")
    };
    let path = begin();
    send(piece(&server, &path, 0).body(spoiled[..1000].to_vec()));
    let told = problem_of(send(piece(&server, &path, 1000).body(spoiled[1000..].to_vec())), 460);
    assert!(text(&told, "/detail").contains(&sha256(&content)), "{told:#}");
    assert_eq!(ask(&server, &path).status(), 410);
    assert_eq!(runs(&server), 0);
    assert!(!growing_file(&server, &path).exists());
    let anew = begin();
    assert_ne!(anew, path, "who comes with the same key begins anew");
    assert_eq!(offset(&server, &anew), 0);
    assert_source(&server, &send_rest(&server, &anew, &content), &content);
}
