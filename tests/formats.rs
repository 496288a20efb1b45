//! Products read back by programs that we did not write: GDAL (rasterio), tifffile, Pillow, plyfile, NumPy.
//!
//! Each test writes a product with the core's writer and, beside it, what it should hold (`expected.json` and
//! raw numbers); a script in `readers/` opens the product with the foreign program and compares.

use std::path::{Path, PathBuf};
use std::process::Command;

use nalgebra::{Point3, Vector3};
use serde_json::json;
use stria_core::depth_map::{GridMap, MapGeometry, MapReader};
use stria_core::export::cloud_ply::CloudPlyWriter;
use stria_core::export::manifest::{self, Manifest, Quality, SCHEMA_VERSION};
use stria_core::export::npy::NpyWriter;
use stria_core::export::preview::{self, PreviewText};
use stria_core::export::tiles::{TileGrid, TileWriter};
use stria_core::export::trajectory_csv::{TrajectoryRow, TrajectoryWriter};
use stria_core::export::{depth_png, depth_tif, texture};
use stria_core::geometry::world_from_camera;
use stria_core::surface::SurfacePoint;
use tempfile::TempDir;

fn read_with(script: &str, folder: &Path) {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..");
    let python = root.join("target/python/bin/python");
    assert!(python.exists(), "{} is missing: `make setup` installs it", python.display());
    let output =
        Command::new(&python).arg(root.join("tests/readers").join(script)).arg(folder).output().expect("Python starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{script}:\n{}{}", text(&output.stdout), text(&output.stderr));
}

fn folder() -> TempDir {
    tempfile::tempdir().expect("temporary folder")
}

fn write_json(folder: &Path, value: serde_json::Value) {
    std::fs::write(folder.join("expected.json"), value.to_string()).expect("write");
}

/// A wall with a dent, a hole in the data and a ragged left edge; the pixels are written as raw numbers too.
fn map(folder: &Path) -> GridMap {
    let geometry = MapGeometry { x0_mm: -544.25, y0_mm: -305.5, mm_per_px: 0.5, width_px: 1301, height_px: 611 };
    let map = GridMap::from_fn(geometry, |column, row| {
        let (c, r) = (column as f32, row as f32);
        let dent = 12.0 * (-((c - 700.0).powi(2) + (r - 300.0).powi(2)) / 9000.0).exp();
        let z = 850.0 + 18.0 * (c / 90.0).sin() + 0.01 * r + dent;
        let hole = (300..391).contains(&column) && (100..155).contains(&row) || column < row % 7;
        let rgb = [(c / 6.0) as u8, (r / 3.0) as u8, 120];
        if hole { (f32::NAN, None) } else { (z, Some(rgb)) }
    });
    let depth: Vec<u8> = map.pixels().depth_mm.iter().flat_map(|z| z.to_le_bytes()).collect();
    std::fs::write(folder.join("depth.f32"), depth).expect("write");
    let rgb: Vec<u8> = map.pixels().texture.iter().flat_map(|c| c.unwrap_or([128; 3])).collect();
    std::fs::write(folder.join("texture.rgb"), rgb).expect("write");
    write_json(folder, json!({"map": map.geometry()}));
    map
}

#[test]
fn depth_tif_is_a_cloud_optimised_geotiff() {
    let folder = folder();
    let mut map = map(folder.path());
    depth_tif::write(&mut map, &folder.path().join("depth.tif")).expect("write");
    depth_tif::write_big(&mut map, &folder.path().join("depth-big.tif")).expect("write");
    read_with("depth_tif.py", folder.path());
}

#[test]
fn depth_png_holds_the_depths_and_says_their_scale() {
    let folder = folder();
    let mut map = map(folder.path());
    let scale = depth_png::write(&mut map, folder.path()).expect("write").expect("measured");
    write_json(folder.path(), json!({"map": map.geometry(), "scale": scale}));
    read_with("depth_png.py", folder.path());
}

#[test]
fn texture_and_preview_are_pictures() {
    let folder = folder();
    let mut map = map(folder.path());
    texture::write(&mut map, folder.path()).expect("write");
    preview::picture(&mut map, &PreviewText::default())
        .expect("picture")
        .save(&folder.path().join("preview.png"))
        .expect("write");
    read_with("pictures.py", folder.path());
}

#[test]
fn tiles_hold_the_map() {
    let folder = folder();
    let mut map = map(folder.path());
    // The robot went backwards: the map begins 150 px left of, and 7 px above, the grid's origin.
    let grid = TileGrid { x0_mm: -544.25 + 75.0, y0_mm: -305.5 + 3.5, mm_per_px: 0.5 };
    TileWriter::create(folder.path(), grid).expect("create").finish(&mut map).expect("finish");
    read_with("tiles.py", folder.path());
}

#[test]
fn cloud_ply_holds_the_points() {
    let folder = folder();
    let mut writer = CloudPlyWriter::create(&folder.path().join("cloud.ply")).expect("create");
    let mut expected = Vec::new();
    for i in 0..3210_u32 {
        let t = f64::from(i);
        let point = SurfacePoint {
            point_in_world: Point3::new(t * 0.25, -40.0 + t * 0.125, 850.0 + (t * 0.01).sin()),
            rgb: [i as u8, (i / 256) as u8, 200],
            confidence: (i % 100) as f32 / 128.0,
            frame: i / 700,
        };
        let [x, y, z] = [point.point_in_world.x, point.point_in_world.y, point.point_in_world.z];
        let [red, green, blue] = point.rgb;
        expected.push(json!([x, y, z, red, green, blue, point.confidence, point.frame]));
        writer.push(&point).expect("push");
    }
    writer.finish().expect("finish");
    write_json(folder.path(), json!({ "points": expected }));
    read_with("cloud_ply.py", folder.path());
}

#[test]
fn trajectory_csv_has_the_contract_s_columns() {
    let folder = folder();
    let mut writer = TrajectoryWriter::create(&folder.path().join("trajectory.csv")).expect("create");
    writer.push(&TrajectoryRow { frame: 0, rows_found: 720, ..TrajectoryRow::default() }).expect("push");
    let angles_deg: [f64; 3] = [0.5, -1.25, 2.0];
    let [roll, pitch, yaw] = angles_deg.map(f64::to_radians);
    let row = TrajectoryRow {
        frame: 1,
        time_s: 1.0 / 30.0,
        dx_px: Some(-13.125),
        dy_px: Some(0.5),
        scale: Some(1.000_25),
        world_from_camera: Some(world_from_camera(Vector3::new(6.625, -0.25, 1.5), roll, pitch, yaw)),
        rotation_determined: true,
        rows_found: 719,
        tracked: 97,
        residual_px: Some(0.0625),
    };
    writer.push(&row).expect("push");
    writer.finish().expect("finish");
    read_with("trajectory_csv.py", folder.path());
}

#[test]
fn stripes_npy_loads_in_numpy() {
    let folder = folder();
    let mut writer = NpyWriter::create(&folder.path().join("stripes.npy"), 720).expect("create");
    for frame in 0..9 {
        let row: Vec<f32> =
            (0..720).map(|r| if r % 11 == 0 { f32::NAN } else { 600.0 + frame as f32 + r as f32 / 64.0 }).collect();
        writer.push_row(&row).expect("push");
    }
    writer.finish().expect("finish");
    read_with("stripes_npy.py", folder.path());
}

#[test]
fn manifest_json_lists_what_is_there() {
    let folder = folder();
    let mut map = map(folder.path());
    depth_tif::write(&mut map, &folder.path().join("depth.tif")).expect("write");
    let grid = TileGrid { x0_mm: -544.25, y0_mm: -305.5, mm_per_px: 0.5 };
    TileWriter::create(folder.path(), grid).expect("create").finish(&mut map).expect("finish");
    let manifest = Manifest {
        schema_version: SCHEMA_VERSION,
        software: "stria".into(),
        source: Vec::new(),
        rig: json!({}),
        rig_sha256: String::new(),
        recipe: json!({}),
        recipe_sha256: String::new(),
        depth_map: Some(map.geometry()),
        depth_png: None,
        resolution: None,
        quality: Quality::default(),
        gaps: Vec::new(),
        warnings: Vec::new(),
        timings_s: Default::default(),
        products: manifest::list_products(folder.path()).expect("list"),
    };
    manifest.write(folder.path()).expect("write");
    read_with("manifest.py", folder.path());
}
