//! Products read back by programs that we did not write: GDAL (rasterio), tifffile, Pillow, plyfile, NumPy, laspy,
//! Open3D, pye57, Khronos' glTF validator.
//!
//! Each test writes a product with the core's writer and, beside it, what it should hold (`expected.json` and
//! raw numbers); a script in `readers/` opens the product with the foreign program and compares.

use std::path::Path;

use nalgebra::{Point3, Vector3};
use serde_json::json;
use stria_core::depth_map::{GridMap, MapGeometry, MapReader};
use stria_core::export::cloud_laz::CloudLazWriter;
use stria_core::export::cloud_ply::CloudPlyWriter;
use stria_core::export::depth_tif::section::Cut;
use stria_core::export::manifest::{self, Manifest, Quality, SCHEMA_VERSION};
use stria_core::export::npy::NpyWriter;
use stria_core::export::preview::{self, PreviewText};
use stria_core::export::tiles::{TileGrid, TileWriter};
use stria_core::export::trajectory_csv::{TrajectoryRow, TrajectoryWriter};
use stria_core::export::{cloud_e57, cloud_pcd, depth_png, depth_tif, mesh_glb, section_csv, texture};
use stria_core::geometry::world_from_camera;
use stria_core::surface::SurfacePoint;
use stria_tests::support::readers::{python_program, read_with_node, run};
use tempfile::TempDir;

fn read_with(script: &str, folder: &Path) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("readers").join(script);
    run(python_program("python"), &[script.to_str().expect("a path"), folder.to_str().expect("a path")]);
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

fn points() -> impl Iterator<Item = SurfacePoint> {
    (0..3210_u32).map(|i| {
        let t = f64::from(i);
        SurfacePoint {
            point_in_world: Point3::new(t * 0.25, -40.0 + t * 0.125, 850.0 + (t * 0.01).sin()),
            rgb: [i as u8, (i / 256) as u8, 200],
            confidence: (i % 100) as f32 / 128.0,
            frame: i / 700,
        }
    })
}

fn write_points(folder: &Path) {
    let point = |point: SurfacePoint| {
        let [x, y, z] = [point.point_in_world.x, point.point_in_world.y, point.point_in_world.z];
        let [red, green, blue] = point.rgb;
        json!([x, y, z, red, green, blue, point.confidence, point.frame])
    };
    write_json(folder, json!({ "points": points().map(point).collect::<Vec<_>>() }));
}

#[test]
fn cloud_ply_holds_the_points() {
    let folder = folder();
    let mut writer = CloudPlyWriter::create(&folder.path().join("cloud.ply")).expect("create");
    points().for_each(|point| writer.push(&point).expect("push"));
    writer.finish().expect("finish");
    write_points(folder.path());
    read_with("cloud_ply.py", folder.path());
}

#[test]
fn clouds_for_other_programs_hold_the_points() {
    let folder = folder();
    let path = |name: &str| folder.path().join(name);
    let mut writer = CloudLazWriter::create(&path("cloud.laz")).expect("create");
    points().for_each(|point| writer.push(&point).expect("push"));
    writer.finish().expect("finish");
    cloud_pcd::write(&path("cloud.pcd"), 3210, points().map(Ok)).expect("PCD");
    cloud_e57::write(&path("cloud.e57"), "known cloud", 3210, points().map(Ok)).expect("E57");
    write_points(folder.path());
    for script in ["cloud_laz.py", "cloud_pcd.py", "cloud_e57.py"] {
        read_with(script, folder.path());
    }
}

/// A product folder's map and tiles; the map has holes and a ragged edge.
fn map_and_tiles(folder: &Path) -> GridMap {
    let mut map = map(folder);
    depth_tif::write(&mut map, &folder.join("depth.tif")).expect("write");
    let grid = TileGrid { x0_mm: -544.25 + 75.0, y0_mm: -305.5 + 3.5, mm_per_px: 0.5 };
    TileWriter::create(folder, grid).expect("create").finish(&mut map).expect("finish");
    map
}

#[test]
fn the_mesh_is_valid_gltf_where_the_wall_is() {
    let folder = folder();
    let map = map_and_tiles(folder.path());
    let path = folder.path().join("wall.glb");
    let facts = mesh_glb::write(&path, folder.path(), 250_000, &mesh_glb::ALL_MM).expect("a mesh");
    // Half size: 651 x 306 px, less the hole of 45 x 27.
    assert!((190_000..199_206).contains(&facts.vertices) && facts.textured && facts.mm_per_vertex == 1.0, "{facts:?}");
    let report = read_with_node("gltf.mjs", &path);
    let issues = &report["issues"];
    assert_eq!((&issues["numErrors"], &issues["numWarnings"]), (&json!(0), &json!(0)), "{issues}");
    assert_eq!(report["info"]["totalVertexCount"], facts.vertices);
    assert_eq!(report["info"]["totalTriangleCount"], facts.triangles);
    assert_eq!(report["info"]["hasTextures"], true, "{}", report["info"]);
    let g = map.geometry();
    let end = |start: f64, count: usize| start + (count - 1) as f64 * g.mm_per_px;
    let near = |value: &serde_json::Value, expected_mm: f64| {
        let found_mm = value.as_f64().unwrap_or(f64::NAN) * 1000.0;
        assert!((found_mm - expected_mm).abs() <= 1.01, "{found_mm} is not {expected_mm} mm: {report}");
    };
    // x along the travel; y up; z towards who looks.
    near(&report["low"][0], g.x0_mm);
    near(&report["high"][0], end(g.x0_mm, g.width_px));
    near(&report["low"][1], -end(g.y0_mm, g.height_px));
    near(&report["high"][1], -g.y0_mm);
    let depths = || map.pixels().depth_mm.iter().filter(|z| z.is_finite()).map(|z| f64::from(*z));
    near(&report["high"][2], -depths().fold(f64::INFINITY, f64::min));
    near(&report["low"][2], -depths().fold(f64::NEG_INFINITY, f64::max));
    let whole = mesh_glb::write(&path, folder.path(), 1_000_000, &mesh_glb::ALL_MM).expect("a mesh");
    assert!(whole.mm_per_vertex == 0.5 && whole.vertices > 3 * facts.vertices, "{whole:?}");
    // A stretch of the way has as many vertices for itself.
    let stretch = mesh_glb::write(&path, folder.path(), 250_000, &(-300.0..=-150.0)).expect("a mesh");
    assert!(stretch.mm_per_vertex == 0.5 && stretch.textured, "{stretch:?}");
    let report = read_with_node("gltf.mjs", &path);
    assert_eq!((&report["issues"]["numErrors"], &report["issues"]["numWarnings"]), (&json!(0), &json!(0)), "{report}");
    for (end, expected_m) in [("low", -0.3), ("high", -0.15)] {
        let found_m = report[end][0].as_f64().unwrap_or(f64::NAN);
        assert!((found_m - expected_m).abs() < 0.0005, "{end}: {found_m} m");
    }
    let beside = mesh_glb::write(&path, folder.path(), 250_000, &(5000.0..=6000.0)).expect_err("nothing there");
    assert!(beside.to_string().contains("beside the map"), "{beside}");
}

#[test]
fn a_section_is_the_map_s_own_pixels() {
    let folder = folder();
    let map = map_and_tiles(folder.path());
    let (tif, path) = (folder.path().join("depth.tif"), folder.path().join("section.csv"));
    let chainage_mm = |x_mm: f64| 10_000.0 - x_mm;
    let across = Cut::Across { x_mm: -544.25 + 310.0 * 0.5 };
    let (measured, rows) = section_csv::write(&path, &tif, across, chainage_mm).expect("a section");
    assert_eq!((measured, rows), (611 - 55, 611), "the hole is empty");
    let text = std::fs::read_to_string(&path).expect("read");
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some("distance_mm,chainage_mm,x_mm,y_mm,z_mm"));
    for (row, line) in lines.enumerate() {
        let fields: Vec<&str> = line.split(',').collect();
        let places: Vec<f64> = fields[..4].iter().map_while(|field| field.parse().ok()).collect();
        assert_eq!(places, [row as f64 * 0.5, 10_389.25, -389.25, -305.5 + row as f64 * 0.5]);
        let z_mm = map.pixels().depth_mm[row * 1301 + 310];
        assert_eq!(fields[4].parse().ok(), z_mm.is_finite().then_some(z_mm), "{line}");
    }
    let slanted = Cut::Line { from_mm: [-500.0, -300.0], to_mm: [100.0, -1.0] };
    let (measured, rows) = section_csv::write(&path, &tif, slanted, chainage_mm).expect("a section");
    assert!(rows > 1201 && measured > 1000, "{measured} of {rows}");
    let beside = Cut::Line { from_mm: [5000.0, 0.0], to_mm: [5000.0, 100.0] };
    let refused = section_csv::write(&path, &tif, beside, chainage_mm).expect_err("beside the map").to_string();
    assert!(refused.contains("chainage from 10544.2"), "{refused}");
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
        recordings: Vec::new(),
        warnings: Vec::new(),
        timings_s: Default::default(),
        products: manifest::list_products(folder.path()).expect("list"),
    };
    manifest.write(folder.path()).expect("write");
    read_with("manifest.py", folder.path());
}
