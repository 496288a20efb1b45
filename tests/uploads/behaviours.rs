//! What the protocol says of single requests, and what tusd tests of them by name: length exceeded, wrong offset,
//! deferred length; versions, checksums, creation.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use sha1::Sha1;
use sha2::{Digest, Sha256};
use stria_tests::support::eventually;
use stria_tests::support::server::{Server, header, problem_of, send, text};

use super::pieces::{
    Half, PIECE, ask, assert_source, authority, content, create, creation, fields, growing_file, metadata, number,
    offset, piece, runs, send_rest, server, wait_until_written,
};

/// A small upload, bytes.
const BYTES: usize = 50_000;

#[test]
fn a_file_in_pieces_becomes_a_run_with_what_was_said_of_it() {
    let server = server(&[]);
    let content = content(BYTES, 21);
    let mut all = fields();
    all.extend([
        ("filetype", "video/mp4".to_string()),
        ("recipe", "paper".into()),
        ("chainage_mm", "1250.5".into()),
        ("direction", "backward".into()),
        ("recorded_at", "2026-05-17T10:30:00+02:00".into()),
        ("note", "after rain".into()),
        ("sha256", super::pieces::sha256(&content)),
    ]);
    let said = metadata(&all);
    let request = server.post("/api/uploads").header("Tus-Resumable", "1.0.0").header("Upload-Metadata", &said);
    let made = send(request.header("Upload-Length", BYTES));
    assert_eq!(made.status(), 201);
    let path = header(&made, "location");
    for (from, to) in [(0, 1), (1, 20_000), (20_000, 20_000), (20_000, BYTES)] {
        let told = ask(&server, &path);
        assert_eq!((number(&told, "upload-offset"), number(&told, "upload-length")), (from, BYTES));
        assert_eq!(header(&told, "upload-metadata"), said);
        assert_eq!(header(&told, "cache-control"), "no-store");
        assert_eq!(header(&told, "stria-run"), "");
        let sent = send(piece(&server, &path, from).body(content[from..to].to_vec()));
        assert_eq!((sent.status().as_u16(), number(&sent, "upload-offset")), (204, to));
    }
    let told = ask(&server, &path);
    let run = server.json(&format!("/api/runs/{}", header(&told, "stria-run")));
    assert_eq!(text(&run, "/job/id"), header(&told, "stria-job"));
    for (pointer, expected) in [
        ("/asset", "Röhre 7"),
        ("/source/filename", "run 7.mp4"),
        ("/direction", "backward"),
        ("/recorded_at", "2026-05-17T08:30:00.000Z"),
        ("/job/recipe", "paper"),
        ("/note", "after rain"),
        ("/source/sha256", &super::pieces::sha256(&content)),
    ] {
        assert_eq!(text(&run, pointer), expected);
    }
    assert_eq!(run["chainage_mm"], 1250.5);
    assert_source(&server, &text(&run, "/id"), &content);
    let folder = growing_file(&server, &path).parent().map(std::path::Path::to_path_buf).expect("a folder");
    eventually("nothing is left of the upload but its run", || !folder.exists());
}

#[test]
fn length_exceeded() {
    let server = server(&["--max-upload-gb", "0.0001"]);
    let content = content(BYTES, 22);
    let path = create(&server, BYTES);
    send(piece(&server, &path, 0).body(content[..100].to_vec()));
    // Said before: nothing is taken.
    problem_of(send(piece(&server, &path, 100).body(content.clone())), 413);
    assert_eq!(offset(&server, &path), 100);
    // Not said before: what is too much is found as it comes.
    let unannounced = reqwest::blocking::Body::new(std::io::Cursor::new(content.clone()));
    problem_of(send(piece(&server, &path, 100).body(unannounced)), 413);
    assert_eq!(offset(&server, &path), 100, "no byte of a piece that is too long counts");
    let run = send_rest(&server, &path, &content);
    assert_source(&server, &run, &content);
    problem_of(send(piece(&server, &path, BYTES).body("more")), 413);
    assert_source(&server, &run, &content);

    let told = problem_of(send(creation(&server).header("Upload-Length", 100_001)), 413);
    assert!(text(&told, "/detail").contains("100000 bytes"), "{told:#}");
    let deferred = header(&send(creation(&server).header("Upload-Defer-Length", "1")), "location");
    problem_of(send(piece(&server, &deferred, 0).header("Upload-Length", 100_001).body("x")), 413);
    let endless = reqwest::blocking::Body::new(std::io::Cursor::new(vec![0; 100_001]));
    problem_of(send(piece(&server, &deferred, 0).body(endless)), 413);
    assert_eq!(offset(&server, &deferred), 0);
}

#[test]
fn wrong_offset() {
    let server = server(&[]);
    let path = create(&server, BYTES);
    let content = content(BYTES, 23);
    send(piece(&server, &path, 0).body(content[..1000].to_vec()));
    for wrong in [0, 999, 1001, BYTES, usize::MAX] {
        let refused = send(piece(&server, &path, wrong).body(content[..10].to_vec()));
        assert_eq!(number(&refused, "upload-offset"), 1000, "a sender that asks by sending is told");
        problem_of(refused, 409);
    }
    let piece_with = |name: &str, value: &str| {
        let request = server.patch(&path).header("Tus-Resumable", "1.0.0").header("Content-Type", PIECE);
        problem_of(send(request.header(name, value).body("x")), 400)
    };
    for (name, value) in
        [("X-Nothing", "1"), ("Upload-Offset", "-1"), ("Upload-Offset", "+1"), ("Upload-Offset", "1e3")]
    {
        assert_eq!(piece_with(name, value)["field"], "Upload-Offset", "{name}: {value}");
    }
    let request = server.patch(&path).header("Tus-Resumable", "1.0.0").header("Upload-Offset", 1000);
    problem_of(send(request.header("Content-Type", "application/octet-stream").body("x")), 415);
    assert_source(&server, &send_rest(&server, &path, &content), &content);
}

#[test]
fn deferred_length() {
    let server = server(&[]);
    let content = content(BYTES, 24);
    for wrong in
        [vec![], vec![("Upload-Defer-Length", "2")], vec![("Upload-Defer-Length", "1"), ("Upload-Length", "9")]]
    {
        let request = wrong.iter().fold(creation(&server), |request, (name, value)| request.header(*name, *value));
        problem_of(send(request), 400);
    }
    let path = header(&send(creation(&server).header("Upload-Defer-Length", "1")), "location");
    send(piece(&server, &path, 0).body(content[..1000].to_vec()));
    let told = ask(&server, &path);
    assert_eq!((header(&told, "upload-defer-length"), header(&told, "upload-length")), ("1".into(), String::new()));
    assert_eq!(number(&told, "upload-offset"), 1000);

    let too_small = send(piece(&server, &path, 1000).header("Upload-Length", 999).body(""));
    assert_eq!(problem_of(too_small, 400)["field"], "Upload-Length");
    // A piece that is refused says nothing about the file either.
    problem_of(send(piece(&server, &path, 0).header("Upload-Length", 2000).body("x")), 409);
    assert_eq!(header(&ask(&server, &path), "upload-defer-length"), "1");

    let next = send(piece(&server, &path, 1000).header("Upload-Length", BYTES).body(content[1000..2000].to_vec()));
    assert_eq!(next.status(), 204);
    let told = ask(&server, &path);
    assert_eq!((number(&told, "upload-length"), header(&told, "upload-defer-length")), (BYTES, String::new()));
    let other = send(piece(&server, &path, 2000).header("Upload-Length", BYTES + 1).body(""));
    assert_eq!(problem_of(other, 400)["field"], "Upload-Length", "a size is said once");
    assert_source(&server, &send_rest(&server, &path, &content), &content);

    // The size comes when all bytes are there.
    let path = header(&send(creation(&server).header("Upload-Defer-Length", "1")), "location");
    send(piece(&server, &path, 0).body(content.clone()));
    assert_eq!(header(&ask(&server, &path), "stria-run"), "");
    let last = send(piece(&server, &path, BYTES).header("Upload-Length", BYTES).body(""));
    assert_source(&server, &header(&last, "stria-run"), &content);
}

fn checksums(content: &[u8]) -> [String; 2] {
    let encode = |bytes: &[u8]| BASE64_STANDARD.encode(bytes);
    [format!("sha1 {}", encode(&Sha1::digest(content))), format!("sha256 {}", encode(&Sha256::digest(content)))]
}

#[test]
fn checksums_are_checked_and_what_is_wrong_is_thrown_away() {
    let server = server(&[]);
    let content = content(BYTES, 25);
    for right in checksums(&content[1000..]) {
        let path = create(&server, BYTES);
        send(piece(&server, &path, 0).body(content[..1000].to_vec()));
        let mut spoiled = content[1000..].to_vec();
        spoiled[30_000] ^= 1;
        let refused = send(piece(&server, &path, 1000).header("Upload-Checksum", &right).body(spoiled));
        assert!(text(&problem_of(refused, 460), "/detail").contains("expected"));
        assert_eq!(offset(&server, &path), 1000);
        // A piece with a checksum that is cut counts for nothing: nobody can say whether it was right.
        let sent = send(piece(&server, &path, 1000).header("Upload-Checksum", &right).body(content[1000..].to_vec()));
        assert_eq!(sent.status(), 204, "{right}");
        assert_source(&server, &header(&sent, "stria-run"), &content);
    }
    let path = create(&server, BYTES);
    for wrong in ["md5 rL0Y20zC+Fzt72VPzMSk2A==", "sha1", "sha1 not/base64!", "sha256"] {
        let refused = send(piece(&server, &path, 0).header("Upload-Checksum", wrong).body("x"));
        assert_eq!(problem_of(refused, 400)["field"], "Upload-Checksum", "{wrong}");
    }
    assert_eq!(offset(&server, &path), 0);
}

#[test]
fn a_piece_with_a_checksum_that_is_cut_counts_for_nothing() {
    let server = server(&[]);
    let content = content(BYTES, 26);
    let path = create(&server, BYTES);
    // A header more in the same line of the head.
    let with = format!("{path} HTTP/1.1\r\nUpload-Checksum: {}\r\nX-Rest:", checksums(&content)[0]);
    let half = Half::send(&authority(&server), &with, 0, BYTES, &content[..20_000]);
    wait_until_written(&server, &path, 20_000);
    drop(half);
    assert_eq!(offset(&server, &path), 0);
    assert_source(&server, &send_rest(&server, &path, &content), &content);
}

#[test]
fn only_this_version_of_the_protocol_is_spoken() {
    let server = server(&[]);
    let path = create(&server, BYTES);
    for version in ["0.2.2", "1.0", "2.0.0", ""] {
        for request in [server.post("/api/uploads"), server.head(&path), server.patch(&path), server.delete(&path)] {
            let refused = send(request.header("Tus-Resumable", version).header("Upload-Length", 1));
            assert_eq!(refused.status(), 412);
            assert_eq!(
                (header(&refused, "tus-version"), header(&refused, "tus-resumable")),
                ("1.0.0".into(), "1.0.0".into())
            );
        }
    }
    problem_of(send(server.delete(&path)), 412);
    assert_eq!(offset(&server, &path), 0, "what was refused did nothing");

    let client = reqwest::blocking::Client::new();
    for at in ["/api/uploads", &path] {
        let told = send(client.request(reqwest::Method::OPTIONS, server.url(at)));
        assert_eq!(told.status(), 204);
        assert_eq!((header(&told, "tus-version"), number(&told, "tus-max-size")), ("1.0.0".into(), 64_000_000_000));
        assert_eq!(header(&told, "tus-checksum-algorithm"), "sha1,sha256");
        let can = "creation,creation-with-upload,creation-defer-length,checksum,expiration,termination";
        assert_eq!(header(&told, "tus-extension"), can);
    }
}

#[test]
fn a_client_that_can_only_post_names_its_method() {
    let server = server(&[]);
    let path = create(&server, 4);
    let by_post = |method: &str| {
        let request = server.post(&path).header("Tus-Resumable", "1.0.0").header("X-HTTP-Method-Override", method);
        request.header("Content-Type", PIECE)
    };
    assert_eq!(number(&send(by_post("PATCH").header("Upload-Offset", 0).body("ab")), "upload-offset"), 2);
    assert_eq!(number(&send(by_post("HEAD")), "upload-offset"), 2);
    problem_of(send(by_post("PUT")), 405);
    assert_eq!(send(by_post("DELETE")).status(), 204);
    assert_eq!(ask(&server, &path).status(), 404);
}

#[test]
fn a_creation_says_what_is_wrong_before_any_byte_is_sent() {
    let server = server(&[]);
    let creation_of = |metadata: &str| {
        let request = server.post("/api/uploads").header("Tus-Resumable", "1.0.0").header("Upload-Length", 10);
        request.header("Upload-Metadata", metadata)
    };
    let without = |name: &str| metadata(&fields().into_iter().filter(|(n, _)| *n != name).collect::<Vec<_>>());
    let with = |more: &str| format!("{},{more}", metadata(&fields()));
    for (said, field) in [
        (String::new(), "asset"),
        (without("asset"), "asset"),
        (without("rig"), "rig"),
        (with("chainage_mm bm9uZQ=="), "chainage_mm"),
        (with("colour Z3JlZW4="), "colour"),
        (with("note !!!"), "note"),
        (with("note /w=="), "note"),
        (with("asset V2FsbA=="), "asset"),
        (with("sha256 YWJj"), "sha256"),
        (with(&format!("note {}", "QUJD".repeat(20_000))), "Upload-Metadata"),
    ] {
        let told = problem_of(send(creation_of(&said)), 400);
        assert_eq!(told["field"], field, "{told:#}");
    }
    for (length, status) in [("0", 400), ("-1", 400), ("ten", 400), ("99999999999999999999", 400), ("64000000001", 413)]
    {
        problem_of(send(creation(&server).header("Upload-Length", length)), status);
    }
    assert_eq!(runs(&server), 0);
}

/// A creation that brings its first piece, to be sent.
fn creation_with(server: &Server, length: usize, content: &[u8]) -> reqwest::blocking::RequestBuilder {
    creation(server).header("Upload-Length", length).header("Content-Type", PIECE).body(content.to_vec())
}

#[test]
fn a_creation_may_bring_the_first_piece_or_all_of_it() {
    let server = server(&[]);
    let content = content(BYTES, 27);
    let part = send(creation_with(&server, BYTES, &content[..1000]));
    assert_eq!((part.status().as_u16(), number(&part, "upload-offset")), (201, 1000));
    assert_source(&server, &send_rest(&server, &header(&part, "location"), &content), &content);

    let whole = send(creation_with(&server, BYTES, &content));
    assert_eq!((whole.status().as_u16(), number(&whole, "upload-offset")), (201, BYTES));
    assert_source(&server, &header(&whole, "stria-run"), &content);

    problem_of(send(creation_with(&server, 10, &content)), 413);
    let spoiled = creation_with(&server, BYTES, &content).header("Upload-Checksum", &checksums(b"other")[1]);
    let refused = send(spoiled);
    let path = header(&refused, "location");
    problem_of(refused, 460);
    assert_eq!(offset(&server, &path), 0, "the upload is there, and can be gone on with");
    assert_source(&server, &send_rest(&server, &path, &content), &content);
}
