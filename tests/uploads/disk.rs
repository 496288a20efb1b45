//! A disk that fills up in the middle of an upload: 507, nothing is corrupt, and it goes on when there is room again.

use std::path::PathBuf;
use std::process::Command;

use stria_tests::support::eventually;
use stria_tests::support::server::{Server, problem_of, send};

use super::pieces::{assert_source, content, create, creation, growing_file, offset, piece, runs, send_rest};

/// The upload, bytes.
const BYTES: usize = 24_000_000;
/// What there is room for at first, bytes: the records are on the same disk.
const ROOM_BYTES: usize = 16_000_000;
/// The disk, bytes.
const DISK_BYTES: usize = 64_000_000;

/// What the server keeps free of itself would be more than the whole disk.
const FLAGS: [&str; 4] = ["--workers", "0", "--disk-reserve-gb", "0"];

/// An upload that fits, then does not, then does.
fn fills_up(server: &Server, fill: impl FnOnce(&Server), make_room: impl FnOnce(&Server)) {
    let content = content(BYTES, 41);
    let path = create(server, BYTES);
    send(piece(server, &path, 0).body(content[..1_000_000].to_vec()));
    fill(server);
    let full = problem_of(send(piece(server, &path, 1_000_000).body(content[1_000_000..].to_vec())), 507);
    assert_eq!(full["retryable"], true, "{full:#}");
    let kept = offset(server, &path);
    assert!((1_000_000..BYTES).contains(&kept), "{kept}");
    // It is still full, and says so again instead of anything worse.
    problem_of(send(piece(server, &path, kept).body(content[kept..].to_vec())), 507);
    let kept = offset(server, &path);
    assert_eq!(runs(server), 0);
    make_room(server);
    assert!(offset(server, &path) >= kept);
    assert_source(server, &send_rest(server, &path, &content), &content);
    assert_eq!(runs(server), 1);
}

#[test]
fn a_file_system_that_takes_no_larger_file() {
    // The limit of one process stands for a quota, also where a test may mount nothing.
    let limit = format!("--fsize={ROOM_BYTES}:unlimited");
    let wrapper = ["prlimit", &limit, "env", "--ignore-signal=XFSZ"];
    let folder = tempfile::tempdir().expect("a temporary folder");
    let server = Server::start_in(folder, &FLAGS, &[], &wrapper);
    let nothing = |_: &Server| {};
    fills_up(&server, nothing, |server| {
        let raised = Command::new("prlimit").args(["--fsize=unlimited", "--pid", &server.id().to_string()]).status();
        assert!(raised.expect("prlimit is there").success());
    });
}

#[test]
fn a_disk_of_its_own_that_is_full() {
    let Some(unshare) = namespaces() else {
        // The other test fills what it may; this machine lets nobody mount a disk.
        println!("no disk can be mounted here (neither as root nor in a user namespace): a quota was tried instead");
        return a_file_system_that_takes_no_larger_file();
    };
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = folder.path().to_str().expect("a plain path").to_string();
    let mount = format!("mount -t tmpfs -o size={DISK_BYTES} tmpfs {at} && exec \"$@\"");
    let wrapper = [unshare, &["sh", "-c", &mount, "sh"]].concat();
    let server = Server::start_in(folder, &FLAGS, &[], &wrapper);
    // Only the server's own world has the disk.
    let disk = PathBuf::from(format!("/proc/{}/root{at}", server.id()));
    let filler = disk.join("filler");
    let fill = |server: &Server| {
        std::fs::write(&filler, vec![1; DISK_BYTES - ROOM_BYTES]).expect("there is room for it");
        // Who comes with more than there is room for hears so at once.
        problem_of(send(creation(server).header("Upload-Length", BYTES)), 507);
    };
    fills_up(&server, fill, |_| std::fs::remove_file(&filler).expect("it goes"));
    let left = disk.join(growing_file(&server, "/x").strip_prefix(&at).expect("inside").parent().expect("a folder"));
    eventually("nothing of the upload is left", || !left.exists());
}

/// How a disk can be mounted for one process, where it can.
fn namespaces() -> Option<&'static [&'static str]> {
    let ways: [&[&str]; 2] = [&["unshare", "--mount"], &["unshare", "--user", "--map-root-user", "--mount"]];
    ways.into_iter().find(|way| {
        let tried = Command::new(way[0]).args(&way[1..]).args(["mount", "-t", "tmpfs", "tmpfs", "/mnt"]).output();
        tried.is_ok_and(|tried| tried.status.success())
    })
}
