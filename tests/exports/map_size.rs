//! Maps whose parts lie far apart: little memory, and limits that say what they left out.

use std::path::{Path, PathBuf};

use stria_core::export::manifest::Manifest;
use stria_tests::support::{long_run, run_stria};

use super::memory::peak_mb;
use super::{said, text};

/// From this frame on the poses are those of another place.
const AWAY_FROM_FRAME: usize = 30;
const AWAY_MM: (f64, f64) = (1000.0, 8000.0);

/// The run's true poses, but from some frame on far away, as where the motion was lost.
fn poses(folder: &Path) -> PathBuf {
    let truth = long_run().video.with_file_name("truth").join("trajectory.csv");
    let truth = std::fs::read_to_string(truth).expect("the truth");
    let (head, body) = truth.split_once('\n').expect("lines");
    let columns: Vec<&str> = head.split(',').collect();
    let place = |name: &str| columns.iter().position(|c| *c == name).expect(name);
    let moved = body.lines().enumerate().map(|(frame, line)| {
        let mut values: Vec<String> = line.split(',').map(String::from).collect();
        if frame >= AWAY_FROM_FRAME {
            for (name, by_mm) in [("x_mm", AWAY_MM.0), ("y_mm", AWAY_MM.1)] {
                let value = &mut values[place(name)];
                *value = (value.parse::<f64>().expect("a number") + by_mm).to_string();
            }
        }
        values.join(",")
    });
    let path = folder.join("poses.csv");
    std::fs::write(&path, [head.to_string()].into_iter().chain(moved).collect::<Vec<_>>().join("\n")).expect("write");
    path
}

/// `process` of the run into `out`.
fn command(folder: &Path, out: &Path, more: &[&str]) -> Vec<String> {
    let (video, rig, poses) = (text(&long_run().video), text(&long_run().rig), poses(folder));
    let fixed =
        ["process", video, "--rig", rig, "--poses", text(&poses), "--out", text(out), "--set", "map.mm_per_px=0.5"];
    fixed.iter().chain(more).map(|word| (*word).to_string()).collect()
}

#[test]
fn a_map_with_parts_far_apart_is_written_in_little_memory() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("products");
    let peak_mb = peak_mb(&command(folder.path(), &out, &[]));
    let manifest = Manifest::load(&out).expect("a manifest");
    let map = manifest.depth_map.expect("a map");
    assert!(map.height_px > 16_000, "{map:?}");
    println!("{} x {} px in {peak_mb:.0} MB", map.width_px, map.height_px);
    assert!(peak_mb < 400.0, "{} x {} px took {peak_mb:.0} MB", map.width_px, map.height_px);
    // Both parts are on it, at full size: across at chainages that only one of them reaches.
    for (chainage_mm, lowest_mm, highest_mm) in [(150.0, -1000.0, 1000.0), (1350.0, 7000.0, 9000.0)] {
        let csv = folder.path().join("section.csv");
        let at = format!("{chainage_mm}");
        let done = run_stria(&["export", text(&out), "--format", "csv", "--at-mm", &at, "--out", text(&csv)]);
        assert!(done.status.success(), "{}", said(&done));
        let section = std::fs::read_to_string(&csv).expect("read");
        let measured: Vec<f64> = section
            .lines()
            .skip(1)
            .map(|line| line.split(',').collect::<Vec<_>>())
            .filter(|values| !values[4].is_empty())
            .map(|values| values[3].parse().expect("a number"))
            .collect();
        assert!(measured.len() > 500, "{} rows at {chainage_mm} mm", measured.len());
        assert!(measured.iter().all(|y_mm| (lowest_mm..highest_mm).contains(y_mm)), "{chainage_mm} mm: {measured:?}");
    }
}

#[test]
fn what_a_map_has_no_room_for_is_said_and_stays_in_the_cloud() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("products");
    let more = ["--set", "limits.map_rows=4000", "--only", "depth,texture,tiles,preview,cloud,defects,report"];
    let command = command(folder.path(), &out, &more);
    let done = run_stria(&command.iter().map(String::as_str).collect::<Vec<_>>());
    assert_eq!(done.status.code(), Some(3), "{}", said(&done));
    let manifest = Manifest::load(&out).expect("a manifest");
    let gaps: Vec<_> = manifest.gaps.iter().filter(|gap| gap.reason == "beyond_map").collect();
    assert_eq!(gaps.len(), 1, "{:?}", manifest.gaps);
    assert_eq!((gaps[0].first_frame, gaps[0].last_frame), (AWAY_FROM_FRAME as u32, 59));
    let warning = manifest.warnings.iter().find(|w| w.contains("limits.map_rows")).expect("a warning");
    assert!(warning.contains("30 frames between 30 and 59") && warning.contains("4000 rows"), "{warning}");
    let map = manifest.depth_map.expect("a map");
    assert!((1000..=4000).contains(&map.height_px), "{map:?}");
    let points = stria_core::export::cloud_ply::read(&out.join("cloud.ply")).expect("a cloud");
    assert_eq!(points.len() as u64, manifest.quality.points);
    assert!(points.iter().any(|p| p.point_in_world.y > 7000.0), "the cloud has what the map has not");
}
