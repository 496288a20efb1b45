//! What each format holds.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use serde_json::Value;
use stria_core::export::cloud_ply;
use stria_core::export::manifest::{Manifest, sha256_of_file};
use stria_tests::support::readers::{read, read_with_node};
use stria_tests::support::server::{Server, problem_of, send, text as field};
use stria_tests::support::{Run, long_run, run_stria};
use tempfile::TempDir;

use super::{said, text};

/// A job's products, made once.
fn products() -> &'static Path {
    static PRODUCTS: OnceLock<(TempDir, PathBuf)> = OnceLock::new();
    let made = PRODUCTS.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a folder");
        let out = folder.path().join("products");
        let run: &Run = long_run();
        let done = run_stria(&["process", text(&run.video), "--rig", text(&run.rig), "--out", text(&out)]);
        assert!(done.status.success(), "{}", said(&done));
        (folder, out)
    });
    &made.1
}

fn export(from: &str, format: &str, out: &Path, more: &[&str]) -> std::process::Output {
    run_stria(&[&["export", from, "--format", format, "--out", text(out)], more].concat())
}

/// Everything that an export of these products must be.
fn check(from: &str, more: &[&str]) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    for format in ["ply", "laz", "pcd", "e57"] {
        let done = export(from, format, &path(&format!("wall.{format}")), more);
        assert!(done.status.success(), "{format}: {}", said(&done));
    }
    let points = read("same_cloud.py", &[folder.path()]);
    let manifest = Manifest::load(products()).expect("a manifest");
    assert_eq!(points, manifest.quality.points);

    for (format, product) in [("tiff", "depth.tif"), ("ply", "cloud.ply")] {
        let copy = path(&format!("copy.{format}"));
        assert!(export(from, format, &copy, more).status.success(), "{format}");
        // A job on a server is another job of the same run: its map and cloud are the same bytes.
        let hash = |path: &Path| sha256_of_file(path).expect("hashed");
        assert_eq!(hash(&copy), hash(&products().join(product)), "{format}");
    }
    let mesh = path("wall.glb");
    let done = export(from, "glb", &mesh, &[&["--max-vertices", "50000"], more].concat());
    assert!(done.status.success() && said(&done).contains("with the wall's picture"), "{}", said(&done));
    let report = read_with_node("gltf.mjs", &mesh);
    assert_eq!((&report["issues"]["numErrors"], &report["issues"]["numWarnings"]), (&0.into(), &0.into()), "{report}");
    let vertices = report["info"]["totalVertexCount"].as_u64().unwrap_or(0);
    assert!((5_000..=50_000).contains(&vertices), "{vertices} vertices");

    let section = path("section.csv");
    let done = export(from, "csv", &section, &[&["--at-mm", "300"], more].concat());
    assert!(done.status.success(), "{}", said(&done));
    let text = std::fs::read_to_string(&section).expect("read");
    let map = manifest.depth_map.expect("a map");
    assert_eq!(text.lines().count(), map.height_px + 1);
    let archive = path("wall.mcap");
    let done = export(from, "mcap", &archive, &[&["--without-frames", "--every", "4"], more].concat());
    assert!(done.status.success(), "{}", said(&done));
    let part = read("mcap_archive.py", &[&archive]);
    assert_eq!(part["topics"]["/profile"]["times_ns"].as_array().map(Vec::len), Some(15));
    assert!(part["topics"]["/camera/video"].is_null());
}

#[test]
fn a_folder_s_products_in_every_format() {
    check(text(products()), &[]);
    // Without a name the file is named after the folder, here.
    let here = tempfile::tempdir().expect("a folder");
    let mut command = std::process::Command::new(stria_tests::support::stria());
    let done = command.args(["export", text(products()), "--format", "tiff"]).current_dir(here.path()).output();
    assert!(done.expect("starts").status.success());
    assert!(here.path().join("products.tif").exists());
}

/// Chainages that a part of the cloud lies between, and of so many points one.
const PART_MM: [f64; 2] = [1150.0, 1250.0];
const EVERY: usize = 3;

/// A part of the cloud is the same in every format: the run's own points between two chainages.
fn check_part(from: &str, more: &[&str], formats: &[&str], start_mm: f64) {
    let folder = tempfile::tempdir().expect("a folder");
    let [a, b] = PART_MM.map(|mm| (mm - 1000.0 + start_mm).to_string());
    let (path, every) = (|format: &str| folder.path().join(format!("wall.{format}")), EVERY.to_string());
    for format in formats {
        let part = ["--from-mm", &a, "--to-mm", &b, "--every", &every];
        let done = export(from, format, &path(format), &[&part[..], more].concat());
        assert!(done.status.success(), "{format}: {}", said(&done));
    }
    let whole = cloud_ply::read(&products().join("cloud.ply")).expect("a cloud");
    let inside = whole.iter().filter(|p| (PART_MM[0] - 1000.0..=PART_MM[1] - 1000.0).contains(&p.point_in_world.x));
    let expected: Vec<_> = inside.step_by(EVERY).copied().collect();
    assert!((1000..whole.len() / 3).contains(&expected.len()), "{} points", expected.len());
    assert_eq!(cloud_ply::read(&path("ply")).expect("a cloud"), expected);
    if formats.len() == 4 {
        assert_eq!(read("same_cloud.py", &[folder.path()]), expected.len());
    }
}

#[test]
fn a_part_of_the_cloud_in_every_format() {
    check_part(text(products()), &["--chainage-mm", "1000"], &["ply", "laz", "pcd", "e57"], 1000.0);
}

#[test]
fn a_server_s_job_in_every_format() {
    let server = Server::start(&["--workers", "1"]);
    let run = server.upload(long_run(), "Wall");
    let job = field(&run, "/job/id");
    server.wait_for_state(&job, "done");
    let url = server.url("");
    check(&job, &["--server", &url]);
    check_part(&job, &["--server", &url], &["ply"], 0.0);

    let unknown = export("no-such-job", "ply", Path::new("none.ply"), &["--server", &url]);
    assert_eq!(unknown.status.code(), Some(2), "{}", said(&unknown));
    assert!(said(&unknown).contains("no-such-job") && !Path::new("none.ply").exists(), "{}", said(&unknown));
}

#[test]
fn a_part_of_an_archive_is_made_while_it_is_sent() {
    let server = Server::start(&["--workers", "1"]);
    let run = server.upload(long_run(), "Wall");
    let job = field(&run, "/job/id");
    server.wait_for_state(&job, "done");
    let base = format!("/api/jobs/{job}/archive.mcap");
    let folder = tempfile::tempdir().expect("a folder");
    let fetch = |query: &str, name: &str| -> Value {
        let response = send(server.get(&format!("{base}?{query}")));
        assert_eq!(response.status(), 200, "{query}");
        assert!(response.headers().get("content-length").is_none(), "its length is not known before it is made");
        let path = folder.path().join(name);
        std::fs::write(&path, response.bytes().expect("a body")).expect("write");
        read("mcap_archive.py", &[&path])
    };
    let whole = fetch("every=1", "whole.mcap");
    let stored = folder.path().join("stored.mcap");
    std::fs::write(&stored, send(server.get(&base)).bytes().expect("a body")).expect("write");
    let stored = read("mcap_archive.py", &[&stored]);
    assert_eq!(whole["topics"], stored["topics"], "all of it is what the job wrote");
    let part = fetch("frames=false&from_mm=150&to_mm=250", "part.mcap");
    let times = |read: &Value, topic: &str| read["topics"][topic]["times_ns"].as_array().map_or(0, Vec::len);
    assert!((10..=20).contains(&times(&part, "/profile")), "{} profiles in 100 mm", times(&part, "/profile"));
    assert_eq!(times(&part, "/camera/video"), 0);

    let problem = problem_of(send(server.get(&format!("{base}?every=0"))), 400);
    assert_eq!(problem["field"], "every");
    problem_of(send(server.get(&format!("{base}?from_mm=5&to_mm=4"))), 400);
    problem_of(send(server.get(&format!("{base}?colour=green"))), 400);
    problem_of(send(server.get("/api/jobs/none/archive.mcap?every=2")), 404);
}

#[test]
fn what_cannot_be_exported_is_said() {
    let from = text(products());
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("out");
    for (format, more, expected) in [
        ("stl", &[][..], "mcap"),
        ("glb", &["--every", "2"], "--every is for --format mcap"),
        ("pcd", &["--from-mm", "900000"], "no point there"),
        ("csv", &[], "--at-mm or --line"),
        ("csv", &["--line", "1,2,3"], "four numbers"),
        ("csv", &["--at-mm", "999999"], "beside the map"),
        ("mcap", &["--from-mm", "9", "--to-mm", "3"], "at least --from-mm"),
        ("glb", &["--max-vertices", "3"], "1000 to"),
    ] {
        let done = export(from, format, &out, more);
        assert_eq!(done.status.code(), Some(2), "{format} {more:?}: {}", said(&done));
        assert!(said(&done).contains(expected), "{format} {more:?}: {}", said(&done));
    }
    for from in ["/nowhere/at/all", text(folder.path())] {
        let done = export(from, "laz", &out, &[]);
        assert_eq!(done.status.code(), Some(2), "{}", said(&done));
        assert!(said(&done).contains(from) && said(&done).contains("expected"), "{}", said(&done));
    }
    std::fs::write(folder.path().join("cloud.ply"), "ply\n").expect("write");
    let done = export(text(folder.path()), "laz", &out, &[]);
    assert_eq!(done.status.code(), Some(2), "{}", said(&done));
    assert!(said(&done).contains("cloud.ply") && !out.exists(), "{}", said(&done));
}
