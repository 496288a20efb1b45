//! Surface → depth map and texture map: one regular grid in tiles, a bounded number of them in memory.
//!
//! The grid has no edges while the run goes on: a robot may go back past its start. Tiles that were not
//! touched for long wait in a scratch file, so a long run needs no more memory than a short one.

mod grid;
mod reader;
pub mod sheet;
pub mod strips;
mod window;

use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

pub use grid::GridMap;
pub use reader::{BAND_ROWS, FinishedMap, MapReader, MapWindow, SharedMap, SharedReader, band, rectangles};

/// Side of a map tile, px.
pub const TILE_SIDE_PX: usize = 256;

const TILE_PX: usize = TILE_SIDE_PX * TILE_SIDE_PX;
/// Tiles of a finished map that are held in memory, where it does not fit there as a whole: readers go through it once.
const READ_TILES: usize = 8;
/// A tile on disk: depth and its weight as float32, then red, green, blue and a flag a pixel.
const LAYER_BYTES: usize = TILE_PX * 4;
const TILE_BYTES: usize = LAYER_BYTES * 3;

/// Where a map lies: pixel (0, 0)'s centre is at (x0, y0) in the world; columns run along +x, rows along +y.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MapGeometry {
    /// World x of the first column's centre, mm.
    pub x0_mm: f64,
    /// World y of the first row's centre, mm.
    pub y0_mm: f64,
    /// Size of a pixel, mm.
    pub mm_per_px: f64,
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
}

/// How large a map may become; what is beyond is left out of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MapLimits {
    /// Most rows.
    pub rows: u64,
    /// Most pixels, the empty ones between what was measured included.
    pub pixels: u64,
}

impl MapLimits {
    /// For maps whose size is bounded by what they are made from.
    pub const NONE: MapLimits = MapLimits { rows: u64::MAX, pixels: u64::MAX };
}

/// How the grid lies in the world: the centre of grid pixel (0, 0) and the pixel's size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// World x of grid column 0, mm.
    pub x_mm: f64,
    /// World y of grid row 0, mm.
    pub y_mm: f64,
    /// Size of a pixel, mm.
    pub mm_per_px: f64,
}

/// What is put on a grid pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    /// World z, mm.
    pub depth_mm: f32,
    /// Above 0.
    pub weight: f32,
    /// Red, green, blue of the visible image, where it is known.
    pub rgb: Option<[u8; 3]>,
}

/// The depth map and the texture map of a run, on one grid.
pub struct SurfaceMap {
    grid: Grid,
    /// Tiles in memory, in no order, and where each is.
    tiles: Vec<Tile>,
    places: HashMap<TileIndex, usize>,
    /// The tile that was asked for last: mostly it is the next one too.
    last: Option<(TileIndex, usize)>,
    capacity: usize,
    clock: u64,
    scratch: File,
    scratch_path: std::path::PathBuf,
    slots: HashMap<TileIndex, u64>,
    changed: HashSet<TileIndex>,
    /// Bounds of the measured pixels on the grid: columns and rows, both ends included.
    bounds: Option<([i64; 2], [i64; 2])>,
    measured: u64,
    limits: MapLimits,
    left_out: u64,
}

/// Column and row of a tile on the grid; negative left of and above grid pixel (0, 0).
pub type TileIndex = (i64, i64);

struct Tile {
    index: TileIndex,
    /// Changed since the changes were last asked for.
    changed: bool,
    depth_mm: Vec<f32>,
    /// What the depths weigh so far: 0 where nothing was measured.
    weight: Vec<f32>,
    /// Red, green, blue, and 1 where there is an image.
    texture: Vec<[u8; 4]>,
    used: u64,
    /// Changed since it was last written to the scratch file.
    dirty: bool,
}

impl SurfaceMap {
    /// An empty map that holds `tiles_in_memory` tiles (three quarters of a megabyte each) and keeps the others in an
    /// unnamed file in `scratch_dir`.
    pub fn create(grid: Grid, tiles_in_memory: usize, scratch_dir: &Path) -> Result<SurfaceMap> {
        let scratch = tempfile::tempfile_in(scratch_dir).map_err(|e| Error::io(scratch_dir, e))?;
        Ok(SurfaceMap {
            grid,
            tiles: Vec::new(),
            places: HashMap::new(),
            last: None,
            capacity: tiles_in_memory.max(4),
            clock: 0,
            scratch,
            scratch_path: scratch_dir.to_path_buf(),
            slots: HashMap::new(),
            changed: HashSet::new(),
            bounds: None,
            measured: 0,
            limits: MapLimits::NONE,
            left_out: 0,
        })
    }

    /// The same map, which never becomes larger than `limits`.
    pub fn limited(self, limits: MapLimits) -> SurfaceMap {
        SurfaceMap { limits, ..self }
    }

    /// How often something was left out since it would have made the map larger than its limits.
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Puts a depth on a grid pixel; a later one replaces an earlier one.
    pub fn put_depth(&mut self, column: i64, row: i64, depth_mm: f32) -> Result<()> {
        if !self.makes_room([column, column], row) {
            return Ok(());
        }
        let (index, at) = place(column, row);
        let tile = self.tile(index)?;
        let was_empty = tile.depth_mm[at].is_nan();
        (tile.depth_mm[at], tile.weight[at]) = (depth_mm, 1.0);
        (tile.dirty, tile.changed) = (true, true);
        self.measured += u64::from(was_empty);
        Ok(())
    }

    /// Puts cells side by side from a grid pixel on, along +x: a depth becomes the weighted mean of all that were put
    /// there, the first colour stays.
    pub fn blend_run(&mut self, column: i64, row: i64, cells: &[Cell]) -> Result<()> {
        if cells.is_empty() || !self.makes_room([column, column + cells.len() as i64 - 1], row) {
            return Ok(());
        }
        let mut done = 0;
        while done < cells.len() {
            let (index, at) = place(column + done as i64, row);
            let room = TILE_SIDE_PX - at % TILE_SIDE_PX;
            let part = &cells[done..(done + room).min(cells.len())];
            let tile = self.tile(index)?;
            let mut new = 0;
            for (at, cell) in (at..).zip(part) {
                let (depth, weight) = (&mut tile.depth_mm[at], &mut tile.weight[at]);
                new += u64::from(depth.is_nan());
                *weight += cell.weight;
                *depth = if depth.is_nan() {
                    cell.depth_mm
                } else {
                    *depth + (cell.depth_mm - *depth) * cell.weight / *weight
                };
                if let (Some([red, green, blue]), [.., 0]) = (cell.rgb, tile.texture[at]) {
                    tile.texture[at] = [red, green, blue, 1];
                }
            }
            (tile.dirty, tile.changed) = (true, true);
            self.measured += new;
            done += part.len();
        }
        Ok(())
    }

    /// The bounds with some pixels of a row within them; `None` where the map would pass its limits.
    fn reach(&self, [first, last]: [i64; 2], row: i64) -> Option<([i64; 2], [i64; 2])> {
        let (columns, rows) = self.bounds.unwrap_or(([first, last], [row, row]));
        let wider = ([columns[0].min(first), columns[1].max(last)], [rows[0].min(row), rows[1].max(row)]);
        if Some(wider) == self.bounds {
            return Some(wider);
        }
        let length = |[first, last]: [i64; 2]| last.abs_diff(first).saturating_add(1);
        let (width, height) = (length(wider.0), length(wider.1));
        (height <= self.limits.rows && width.saturating_mul(height) <= self.limits.pixels).then_some(wider)
    }

    /// Widens the bounds of what was measured; false, and counted, where there is no room.
    pub(crate) fn makes_room(&mut self, columns: [i64; 2], row: i64) -> bool {
        match self.reach(columns, row) {
            Some(wider) => {
                self.bounds = Some(wider);
                true
            }
            None => {
                self.left_out += 1;
                false
            }
        }
    }

    /// Puts a colour on a grid pixel that has none, or on any with `replace`; what the map has no room for is left out.
    pub fn put_texture(&mut self, column: i64, row: i64, rgb: [u8; 3], replace: bool) -> Result<()> {
        if self.reach([column, column], row).is_none() {
            return Ok(());
        }
        let (index, at) = place(column, row);
        let tile = self.tile(index)?;
        if replace || tile.texture[at][3] == 0 {
            tile.texture[at] = [rgb[0], rgb[1], rgb[2], 1];
            (tile.dirty, tile.changed) = (true, true);
        }
        Ok(())
    }

    /// The map as it is now, for reading; `None` where nothing was measured. One that does not fit into memory is put aside
    /// whole: what is made of it needs the room.
    ///
    /// # Errors
    /// What the scratch file's disk says.
    pub fn finished(&mut self) -> Result<Option<FinishedMap<'_>>> {
        let Some(geometry) = self.geometry() else { return Ok(None) };
        if !self.slots.is_empty() {
            (0..self.tiles.len()).try_for_each(|at| self.put_aside(at))?;
            (self.tiles, self.last) = (Vec::new(), None);
            self.capacity = self.capacity.min(READ_TILES);
        }
        Ok(Some(FinishedMap { map: self, geometry }))
    }

    /// The tiles that changed since this was last asked.
    pub fn take_changed(&mut self) -> Vec<TileIndex> {
        let in_memory =
            self.tiles.iter_mut().filter_map(|tile| std::mem::take(&mut tile.changed).then_some(tile.index));
        self.changed.extend(in_memory);
        self.changed.drain().collect()
    }

    /// The rectangle of the measured pixels; `None` where nothing was measured.
    fn geometry(&self) -> Option<MapGeometry> {
        let (columns, rows) = self.bounds?;
        Some(MapGeometry {
            x0_mm: self.grid.x_mm + columns[0] as f64 * self.grid.mm_per_px,
            y0_mm: self.grid.y_mm + rows[0] as f64 * self.grid.mm_per_px,
            mm_per_px: self.grid.mm_per_px,
            width_px: (columns[1] - columns[0] + 1) as usize,
            height_px: (rows[1] - rows[0] + 1) as usize,
        })
    }

    /// The tile, from memory, from the scratch file, or new.
    fn tile(&mut self, index: TileIndex) -> Result<&mut Tile> {
        self.clock += 1;
        let at = match self.last {
            Some((last, at)) if last == index => at,
            _ => self.find_tile(index)?,
        };
        self.last = Some((index, at));
        let tile = &mut self.tiles[at];
        tile.used = self.clock;
        Ok(tile)
    }

    fn find_tile(&mut self, index: TileIndex) -> Result<usize> {
        if let Some(at) = self.places.get(&index) {
            return Ok(*at);
        }
        let tile = match self.slots.get(&index) {
            Some(slot) => Tile { index, ..self.read_tile(*slot)? },
            None => Tile::empty(index),
        };
        let at = if self.tiles.len() < self.capacity {
            self.tiles.push(tile);
            self.tiles.len() - 1
        } else {
            let at = self.put_oldest_aside()?;
            self.tiles[at] = tile;
            at
        };
        self.places.insert(index, at);
        Ok(at)
    }

    /// Puts the tile aside that was not used for longest; says its place.
    fn put_oldest_aside(&mut self) -> Result<usize> {
        let oldest = (0..self.tiles.len()).min_by_key(|at| self.tiles[*at].used).unwrap_or(0);
        self.put_aside(oldest)?;
        Ok(oldest)
    }

    /// Writes a tile to the scratch file, if it changed; its place is free then.
    fn put_aside(&mut self, at: usize) -> Result<()> {
        let tile = &self.tiles[at];
        if tile.dirty {
            let next = self.slots.len() as u64;
            let slot = *self.slots.entry(tile.index).or_insert(next);
            let mut bytes = Vec::with_capacity(TILE_BYTES);
            bytes.extend(tile.depth_mm.iter().flat_map(|z| z.to_le_bytes()));
            bytes.extend(tile.weight.iter().flat_map(|w| w.to_le_bytes()));
            bytes.extend(tile.texture.iter().flatten());
            self.scratch
                .write_all_at(&bytes, slot * TILE_BYTES as u64)
                .map_err(|e| Error::io(&self.scratch_path, e))?;
        }
        if tile.changed {
            self.changed.insert(tile.index);
        }
        self.places.remove(&tile.index);
        Ok(())
    }

    fn read_tile(&self, slot: u64) -> Result<Tile> {
        let mut bytes = vec![0; TILE_BYTES];
        self.scratch
            .read_exact_at(&mut bytes, slot * TILE_BYTES as u64)
            .map_err(|e| Error::io(&self.scratch_path, e))?;
        let (depth, rest) = bytes.split_at(LAYER_BYTES);
        let (weight, texture) = rest.split_at(LAYER_BYTES);
        let floats =
            |bytes: &[u8]| bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        Ok(Tile {
            index: (0, 0),
            changed: false,
            depth_mm: floats(depth),
            weight: floats(weight),
            texture: texture.chunks_exact(4).map(|b| [b[0], b[1], b[2], b[3]]).collect(),
            used: 0,
            dirty: false,
        })
    }
}

impl Tile {
    fn empty(index: TileIndex) -> Tile {
        Tile {
            index,
            changed: false,
            depth_mm: vec![f32::NAN; TILE_PX],
            weight: written(0.0, TILE_PX),
            texture: written([0; 4], TILE_PX),
            used: 0,
            dirty: false,
        }
    }
}

/// Cells of one value, written here. What `vec![0.0; cells]` gives is memory that the system zeroes when it is touched: where
/// sums are read before they are written, each page costs two faults, and the second interrupts all cores.
pub(crate) fn written<T: Copy>(value: T, cells: usize) -> Vec<T> {
    std::iter::repeat_n(value, cells).collect()
}

/// The tile of a grid pixel and the pixel's place in it.
fn place(column: i64, row: i64) -> (TileIndex, usize) {
    let side = TILE_SIDE_PX as i64;
    let at = row.rem_euclid(side) * side + column.rem_euclid(side);
    ((column.div_euclid(side), row.div_euclid(side)), at as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(tiles: usize) -> SurfaceMap {
        let grid = Grid { x_mm: 10.0, y_mm: -20.0, mm_per_px: 0.5 };
        SurfaceMap::create(grid, tiles, &std::env::temp_dir()).expect("map")
    }

    #[test]
    fn values_come_back_from_memory_and_from_the_scratch_file() {
        let mut map = map(4);
        let weight_of = |column: i64| 0.5 + (column & 3) as f32;
        for column in -700..3000_i64 {
            for row in [-3_i64, 0, 300] {
                let depth_mm = (column * 1000 + row) as f32;
                map.blend_run(column, row, &[Cell { depth_mm, weight: weight_of(column), rgb: None }]).expect("put");
            }
            map.put_texture(column, 0, [(column & 255) as u8, 2, 3], false).expect("put");
        }
        let geometry = map.geometry().expect("measured");
        assert_eq!((geometry.width_px, geometry.height_px), (3700, 304));
        assert_eq!((geometry.x0_mm, geometry.y0_mm), (10.0 - 350.0, -20.0 - 1.5));
        let window = map.window(0, 0, 3700, 304).expect("window");
        for column in -700..3000_i64 {
            let at = |row: i64| (row + 3) as usize * 3700 + (column + 700) as usize;
            assert_eq!(window.depth_mm[at(300)], (column * 1000 + 300) as f32);
            assert!(window.depth_mm[at(1)].is_nan());
            assert_eq!(window.texture[at(0)], Some([(column & 255) as u8, 2, 3]));
            assert_eq!(window.texture[at(-3)], None);
        }
        let weights = map.weights(0, 0, 3700, 304).expect("weights");
        for (at, weight) in weights.iter().enumerate() {
            let (column, row) = ((at % 3700) as i64 - 700, at / 3700);
            assert_eq!(*weight, if [0, 3, 303].contains(&row) { weight_of(column) } else { 0.0 }, "{column}, {row}");
        }
        assert_eq!(map.measured, 3 * 3700);
        assert!(map.tiles.len() <= 4);
        // Finished, nothing of it is in memory, and all of it can be read: whole, in bands of some rows, in narrow pieces.
        let same = |a: &MapWindow, at: usize, b: &MapWindow, from: usize, count: usize| {
            let bits =
                |w: &MapWindow, at: usize| w.depth_mm[at..at + count].iter().map(|z| z.to_bits()).collect::<Vec<_>>();
            bits(a, at) == bits(b, from) && a.texture[at..at + count] == b.texture[from..from + count]
        };
        let mut finished = map.finished().expect("put aside").expect("measured");
        assert!(finished.map.tiles.is_empty());
        for (column, row, width, height) in
            [(0, 0, 3700, 304), (100, 1, 3000, 64), (5, 250, 300, 54), (1020, 0, 7, 304)]
        {
            let piece = finished.window(column, row, width, height).expect("window");
            let weighs = finished.weights(column, row, width, height).expect("weights");
            for line in 0..height {
                let from = (row + line) * 3700 + column;
                assert_eq!(weighs[line * width..(line + 1) * width], weights[from..from + width]);
                assert!(same(&piece, line * width, &window, from, width), "{column} {row} {line}");
            }
        }
    }

    #[test]
    fn what_would_make_the_map_too_large_is_left_out_and_counted() {
        let mut map = map(4).limited(MapLimits { rows: 1000, pixels: 1_000_000 });
        for row in [0, 999, 1000, -1, i64::MIN, i64::MAX] {
            map.put_depth(0, row, 1.0).expect("put");
        }
        let cells = [Cell { depth_mm: 1.0, weight: 1.0, rgb: None }; 3];
        for column in [997, 998, -1, i64::MIN] {
            map.blend_run(column, 500, &cells).expect("put");
        }
        map.put_texture(5, 1000, [1; 3], true).expect("put");
        let geometry = map.geometry().expect("measured");
        assert_eq!((geometry.width_px, geometry.height_px), (1000, 1000));
        assert_eq!((map.measured, map.left_out()), (2 + 3, 4 + 3));
        assert!(map.slots.is_empty(), "nothing was put anywhere else");
    }

    #[test]
    fn texture_is_kept_unless_it_shall_be_replaced() {
        let mut map = map(16);
        map.put_texture(0, 0, [1, 1, 1], false).expect("put");
        map.put_texture(0, 0, [2, 2, 2], false).expect("put");
        map.put_depth(0, 0, 1.0).expect("put");
        assert_eq!(map.window(0, 0, 1, 1).expect("window").texture[0], Some([1, 1, 1]));
        map.put_texture(0, 0, [3, 3, 3], true).expect("put");
        assert_eq!(map.window(0, 0, 1, 1).expect("window").texture[0], Some([3, 3, 3]));
    }
}
