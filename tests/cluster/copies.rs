//! A backup goes from one machine to many.

use stria_tests::support::cluster::Cluster;
use stria_tests::support::server::{Server, text};
use stria_tests::support::{run_stria, run_stria_with, short_run};

use super::many::assert_products_whole;

#[test]
fn a_backup_of_sqlite_and_a_folder_goes_into_postgresql_and_s3() {
    let server = Server::start(&["--workers", "1"]);
    let job = text(&server.upload(short_run(), "Wall"), "/job/id");
    server.wait_for_state(&job, "done");
    let folder = tempfile::tempdir().expect("folder");
    let copy = folder.path().join("copy").to_str().expect("plain").to_string();
    let data = server.data().to_str().expect("plain").to_string();
    let made = run_stria(&["backup", "--data", &data, "--out", &copy]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));

    let cluster = Cluster::start();
    let scratch = folder.path().join("data").to_str().expect("plain").to_string();
    let places = cluster.places();
    let mut arguments = vec!["restore", &copy, "--data", &scratch];
    arguments.extend(places.iter().map(String::as_str));
    let restored = run_stria_with(&arguments, &cluster.s3.variables());
    assert!(restored.status.success(), "{}", String::from_utf8_lossy(&restored.stderr));
    let many = cluster.server(&["--workers", "1"]);
    assert_products_whole(&many, &job);
    // And it goes on from there.
    let next = text(&many.upload(short_run(), "Wall"), "/job/id");
    many.wait_for_state(&next, "done");
}
