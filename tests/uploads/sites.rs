//! Uploads on PostgreSQL and S3: any server goes on where any other was cut off.

use stria_tests::support::cluster::Cluster;
use stria_tests::support::server::{header, problem_of, send};
use stria_tests::support::{eventually, files_below};

use super::pieces::{
    Half, ask, assert_source, authority, content, create, number, offset, piece, runs, send_rest, source_sha256,
};
use super::storms::{BigFile, SYNC_BYTES, assert_arrived, tus_js_client};
use super::tunnel::{Tunnel, Weather};

/// Nothing of any upload is left in the bucket but what became a run.
fn assert_nothing_left(cluster: &Cluster) {
    let files = || files_below(&cluster.files());
    eventually("tails are deleted", || !files().iter().any(|file| file.starts_with("uploads/")));
    assert!(files().iter().all(|file| file.starts_with("runs/")), "{:?}", files());
}

#[test]
fn an_upload_goes_on_at_whichever_server_the_next_connection_reaches() {
    const FILE_BYTES: usize = 60_000_000;
    const CUTS: u32 = 30;
    let cluster = Cluster::start();
    let servers = [cluster.server(&["--workers", "0"]), cluster.server(&["--workers", "0"])];
    let file = BigFile::of(FILE_BYTES, 51);
    let weather = Weather { cuts: CUTS, bytes_between_cuts: FILE_BYTES / CUTS as usize / 2, throttle_mb_s: None };
    let tunnel = Tunnel::to(&[&authority(&servers[0]), &authority(&servers[1])], weather, 51);
    let sent = tus_js_client(&tunnel.url("/api/uploads"), &file.path);
    assert_eq!(tunnel.cuts().len(), CUTS as usize, "the tunnel became calm too late");
    assert_arrived(&servers[0], &tunnel, &sent, &file, SYNC_BYTES);
    assert_eq!(source_sha256(&servers[1], &sent.run), file.sha256);
    let names = |server| (header(&ask(server, &sent.path), "stria-run"), header(&ask(server, &sent.path), "stria-job"));
    assert_eq!(names(&servers[0]), names(&servers[1]), "one run, one job, whoever is asked");
    assert_nothing_left(&cluster);
}

#[test]
fn a_server_that_is_killed_leaves_its_uploads_to_the_others() {
    const BYTES: usize = 20_000_000;
    // Parts and a tail: 8 MiB, 8 MiB, the rest.
    const FIRST: usize = 18_000_000;
    let cluster = Cluster::start();
    let (mut a, b) = (cluster.server(&["--workers", "0"]), cluster.server(&["--workers", "0"]));
    let content = content(BYTES, 52);
    let path = create(&a, BYTES);
    let whole = send(piece(&a, &path, 0).body(content[..FIRST].to_vec()));
    assert_eq!((whole.status().as_u16(), number(&whole, "upload-offset")), (204, FIRST));
    let _half = Half::send(&authority(&a), &path, FIRST, BYTES - FIRST, &content[FIRST..FIRST + 100_000]);
    a.kill();
    let kept = offset(&b, &path);
    assert!((FIRST..=FIRST + 100_000).contains(&kept), "{kept}");
    assert_source(&b, &send_rest(&b, &path, &content), &content);
    a.start_again();
    assert_eq!(number(&ask(&a, &path), "upload-offset"), BYTES);
    assert_eq!(runs(&a), 1);
    assert_nothing_left(&cluster);
}

#[test]
fn an_older_request_at_another_server_cannot_spoil_what_its_successor_wrote() {
    const BYTES: usize = 1_000_000;
    let cluster = Cluster::start();
    let (a, b) = (cluster.server(&["--workers", "0"]), cluster.server(&["--workers", "0"]));
    let content = content(BYTES, 53);
    let path = create(&a, BYTES);
    let mut older = Half::send(&authority(&a), &path, 0, BYTES, &content[..300_000]);
    // B takes over: what A has not promised counts no more.
    let from = offset(&b, &path);
    let sent = send(piece(&b, &path, from).body(content[from..600_000].to_vec()));
    assert_eq!(number(&sent, "upload-offset"), 600_000);
    older.more(&content[300_000..]);
    assert_eq!(older.status(), 423);
    assert_eq!(offset(&a, &path), 600_000);
    assert_source(&a, &send_rest(&a, &path, &content), &content);
    assert_eq!(runs(&b), 1);
    assert_nothing_left(&cluster);
}

#[test]
fn an_upload_that_is_given_up_leaves_nothing_on_s3() {
    const BYTES: usize = 9_000_000;
    let cluster = Cluster::start();
    let server = cluster.server(&["--workers", "0"]);
    let content = content(BYTES, 54);
    let path = create(&server, BYTES);
    send(piece(&server, &path, 0).body(content[..BYTES - 1].to_vec()));
    assert!(!files_below(&cluster.files().join("uploads")).is_empty(), "there is a tail");
    assert_eq!(send(server.delete(&path).header("Tus-Resumable", "1.0.0")).status(), 204);
    problem_of(send(piece(&server, &path, BYTES - 1).body("x")), 404);
    assert!(files_below(&cluster.files()).is_empty(), "{:?}", files_below(&cluster.files()));
}
