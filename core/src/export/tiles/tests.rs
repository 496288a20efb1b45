use super::*;
use crate::depth_map::GridMap;

/// A map that starts left of and above the grid's origin.
fn map() -> GridMap {
    let geometry = MapGeometry { x0_mm: -300.0, y0_mm: -20.0, mm_per_px: 2.0, width_px: 700, height_px: 300 };
    GridMap::from_fn(geometry, |c, r| {
        let z = 850.0 + c as f32 * 0.013 - r as f32 * 0.27;
        (if c % 50 == 3 { f32::NAN } else { z }, Some([c as u8, r as u8, 0]))
    })
}

const GRID: TileGrid = TileGrid { x0_mm: 0.0, y0_mm: 0.0, mm_per_px: 2.0 };

#[test]
fn every_tile_of_every_level_is_there_and_holds_its_depths() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let writer = TileWriter::create(folder.path(), GRID).expect("create");
    let mut map = map();
    writer.finish(&mut map).expect("finish");
    let index = TilesIndex::load(folder.path()).expect("index");
    assert!(index.complete);
    assert_eq!(
        index.levels.iter().map(|l| (l.first_column, l.last_column)).collect::<Vec<_>>(),
        [(-1, 2), (-1, 1), (-1, 0)]
    );
    let mut tiles = 0;
    for level in &index.levels {
        for column in level.first_column..=level.last_column {
            for row in level.first_row..=level.last_row {
                let name = |kind, end| format!("tiles/{kind}/{}/{column}_{row}.{end}", level.level);
                assert!(folder.path().join(name("texture", "jpg")).exists());
                let depth_mm = read_depth_tile(&folder.path().join(name("depth", "png"))).expect("tile");
                if level.level == 0 {
                    check_level_0(&map, column, row, &depth_mm);
                }
                tiles += 1;
            }
        }
    }
    let products = crate::export::manifest::list_products(folder.path()).expect("list");
    assert_eq!(products.len(), 2 * tiles + 1, "no tile outside the ranges");
}

fn check_level_0(map: &GridMap, column: i64, row: i64, depth_mm: &[f32]) {
    for (i, z_mm) in depth_mm.iter().enumerate() {
        let (c, r) = (column * 256 + (i % 256) as i64 + 150, row * 256 + (i / 256) as i64 + 10);
        let inside = (0..700).contains(&c) && (0..300).contains(&r);
        let truth = if inside { map.pixels().depth_mm[(r * 700 + c) as usize] } else { f32::NAN };
        assert!(z_mm.is_nan() == truth.is_nan() && (z_mm.is_nan() || (z_mm - truth).abs() < 0.0006));
    }
}

#[test]
fn tiles_can_be_read_while_the_run_goes_on_and_stale_ones_are_replaced() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let mut writer = TileWriter::create(folder.path(), GRID).expect("create");
    let mut early = MapWindow::empty(256, 256);
    early.depth_mm[0] = 123.0;
    writer.put(-1, 0, &early).expect("put");
    writer.put(0, 0, &early).expect("put");
    writer.publish().expect("publish");
    let index = TilesIndex::load(folder.path()).expect("index");
    assert!(!index.complete && index.depth_map.is_none());
    assert_eq!((index.levels[0].first_column, index.levels[0].last_column), (-1, 0));
    let path = folder.path().join("tiles/depth/0/0_0.png");
    assert_eq!(read_depth_tile(&path).expect("tile")[0], 123.0);
    let mut map = map();
    writer.finish(&mut map).expect("finish");
    check_level_0(&map, 0, 0, &read_depth_tile(&path).expect("tile"));
}

#[test]
fn upper_levels_grow_with_the_run_as_they_are_at_its_end() {
    let (live, done) = (tempfile::tempdir().expect("folder"), tempfile::tempdir().expect("folder"));
    let mut writer = TileWriter::create(live.path(), GRID).expect("create");
    let mut map = map();
    // Column by column, as a robot goes; the map's first pixel is the grid's (-150, -10).
    let mut named = BTreeSet::new();
    for column in -1..=2_i64 {
        for row in -1..=1_i64 {
            let mut tile = MapWindow::empty(256, 256);
            for at in 0..256 * 256 {
                let (c, r) = (column * 256 + (at % 256) as i64 + 150, row * 256 + (at / 256) as i64 + 10);
                if (0..700).contains(&c) && (0..300).contains(&r) {
                    tile.depth_mm[at] = map.pixels().depth_mm[(r * 700 + c) as usize];
                }
            }
            writer.put(column, row, &tile).expect("put");
        }
        let names = writer.publish().expect("publish");
        assert_eq!(names.last().map(String::as_str), Some("tiles/tiles.json"));
        assert!(names.iter().all(|name| live.path().join(name).exists()));
        named.extend(names);
    }
    assert!(writer.publish().expect("publish").is_empty(), "nothing new, nothing said");
    TileWriter::create(done.path(), GRID).expect("create").finish(&mut map).expect("finish");
    let (grown, end) = (TilesIndex::load(live.path()).expect("index"), TilesIndex::load(done.path()).expect("index"));
    assert_eq!(grown.revision, 4);
    assert_eq!(grown.levels.len(), end.levels.len());
    for level in &end.levels[1..] {
        for (column, row) in all_tiles(level) {
            let name = format!("tiles/depth/{}/{column}_{row}.png", level.level);
            assert!(named.contains(&name), "{name} was announced");
            let read = |folder: &Path| read_depth_tile(&folder.join(&name)).expect("tile");
            let same = |(a, b): (&f32, &f32)| a == b || (a.is_nan() && b.is_nan()) || (a - b).abs() < 0.0011;
            assert!(read(live.path()).iter().zip(&read(done.path())).all(same), "{name}");
        }
    }
}

#[test]
fn depths_out_of_range_are_not_measured() {
    assert_eq!(value_bytes(f32::NAN), [0; 3]);
    assert_eq!(value_bytes(-4000.5), [0; 3]);
    assert_eq!(value_bytes(13_000.0), [0; 3]);
    assert_eq!(value_bytes(0.0), [0x3d, 0x09, 0x00]);
    assert_eq!(value_bytes(0.001), [0x3d, 0x09, 0x01]);
}

#[test]
fn a_map_off_the_grid_is_refused() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let grid = TileGrid { x0_mm: 0.7, ..GRID };
    let writer = TileWriter::create(folder.path(), grid).expect("create");
    assert!(writer.finish(&mut map()).expect_err("off").to_string().contains("does not lie on"));
}
