//! Surface → depth map and texture map: one regular grid in tiles, a bounded number of them in memory.
//!
//! The grid has no edges while the run goes on: a robot may go back past its start. Tiles that were not
//! touched for long wait in a scratch file, so a long run needs no more memory than a short one.

mod grid;
pub mod sheet;
pub mod strips;

use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

pub use grid::GridMap;

/// Side of a map tile, px.
pub const TILE_SIDE_PX: usize = 256;

const TILE_PX: usize = TILE_SIDE_PX * TILE_SIDE_PX;
/// A tile on disk: depth and its weight as float32, then red, green, blue and a flag a pixel.
const TILE_BYTES: usize = TILE_PX * 12;

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

/// A rectangle of the map, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct MapWindow {
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// World z, mm; NaN where nothing was measured. `height_px * width_px` values.
    pub depth_mm: Vec<f32>,
    /// Red, green, blue of the visible image; `None` where no image fell. `height_px * width_px` values.
    pub texture: Vec<Option<[u8; 3]>>,
}

impl MapWindow {
    /// A window in which nothing was measured.
    pub fn empty(width_px: usize, height_px: usize) -> MapWindow {
        let size = width_px * height_px;
        MapWindow { width_px, height_px, depth_mm: vec![f32::NAN; size], texture: vec![None; size] }
    }
}

/// A map that can be read in rectangles, however large it is: what the exports read from.
pub trait MapReader {
    /// Where the map lies and how large it is.
    fn geometry(&self) -> MapGeometry;

    /// Reads a rectangle of the map; what lies outside is empty.
    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow>;
}

/// A map in which something was measured, for reading.
pub struct FinishedMap<'a> {
    map: &'a mut SurfaceMap,
    geometry: MapGeometry,
}

impl FinishedMap<'_> {
    /// Share of the map's pixels that have a depth, 0 to 1.
    pub fn coverage(&self) -> f64 {
        self.map.measured as f64 / (self.geometry.width_px * self.geometry.height_px) as f64
    }
}

impl MapReader for FinishedMap<'_> {
    fn geometry(&self) -> MapGeometry {
        self.geometry
    }

    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
        self.map.window(column_px, row_px, width_px, height_px)
    }
}

/// A map that several threads read, one rectangle at a time.
pub struct SharedMap<'a, 'm> {
    map: Mutex<&'a mut FinishedMap<'m>>,
}

/// One thread's view of a [`SharedMap`].
pub struct SharedReader<'s, 'a, 'm> {
    shared: &'s SharedMap<'a, 'm>,
    geometry: MapGeometry,
}

impl<'a, 'm> SharedMap<'a, 'm> {
    /// Shares a map.
    pub fn new(map: &'a mut FinishedMap<'m>) -> SharedMap<'a, 'm> {
        SharedMap { map: Mutex::new(map) }
    }

    /// A reader for one thread.
    pub fn reader(&self) -> SharedReader<'_, 'a, 'm> {
        SharedReader { shared: self, geometry: self.lock().geometry }
    }

    /// A thread that panicked while it read has changed nothing that matters.
    fn lock(&self) -> MutexGuard<'_, &'a mut FinishedMap<'m>> {
        self.map.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl MapReader for SharedReader<'_, '_, '_> {
    fn geometry(&self) -> MapGeometry {
        self.geometry
    }

    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
        self.shared.lock().window(column_px, row_px, width_px, height_px)
    }
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
        })
    }

    /// Puts a depth on a grid pixel; a later one replaces an earlier one.
    pub fn put_depth(&mut self, column: i64, row: i64, depth_mm: f32) -> Result<()> {
        let (index, at) = place(column, row);
        let tile = self.tile(index)?;
        let was_empty = tile.depth_mm[at].is_nan();
        (tile.depth_mm[at], tile.weight[at]) = (depth_mm, 1.0);
        (tile.dirty, tile.changed) = (true, true);
        self.measured += u64::from(was_empty);
        self.reach([column, column], row);
        Ok(())
    }

    /// Puts cells side by side from a grid pixel on, along +x: a depth becomes the weighted mean of all that were put
    /// there, the first colour stays.
    pub fn blend_run(&mut self, column: i64, row: i64, cells: &[Cell]) -> Result<()> {
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
        if !cells.is_empty() {
            self.reach([column, column + cells.len() as i64 - 1], row);
        }
        Ok(())
    }

    /// Widens the bounds of what was measured.
    fn reach(&mut self, [first, last]: [i64; 2], row: i64) {
        let (columns, rows) = self.bounds.get_or_insert(([first, last], [row, row]));
        *columns = [columns[0].min(first), columns[1].max(last)];
        *rows = [rows[0].min(row), rows[1].max(row)];
    }

    /// Puts a colour on a grid pixel that has none, or on any with `replace`.
    pub fn put_texture(&mut self, column: i64, row: i64, rgb: [u8; 3], replace: bool) -> Result<()> {
        let (index, at) = place(column, row);
        let tile = self.tile(index)?;
        if replace || tile.texture[at][3] == 0 {
            tile.texture[at] = [rgb[0], rgb[1], rgb[2], 1];
            (tile.dirty, tile.changed) = (true, true);
        }
        Ok(())
    }

    /// The map as it is now, for reading; `None` where nothing was measured.
    pub fn finished(&mut self) -> Option<FinishedMap<'_>> {
        let geometry = self.geometry()?;
        Some(FinishedMap { map: self, geometry })
    }

    /// The tiles that changed since this was last asked.
    pub fn take_changed(&mut self) -> Vec<TileIndex> {
        let in_memory =
            self.tiles.iter_mut().filter_map(|tile| std::mem::take(&mut tile.changed).then_some(tile.index));
        self.changed.extend(in_memory);
        self.changed.drain().collect()
    }

    /// A whole tile of the grid.
    pub fn tile_window(&mut self, index: TileIndex) -> Result<MapWindow> {
        let mut window = MapWindow::empty(TILE_SIDE_PX, TILE_SIDE_PX);
        copy_part(self.tile(index)?, (0, 0), &mut window);
        Ok(window)
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

    /// Reads a rectangle of [`SurfaceMap::geometry`]; what lies outside the measured tiles is empty.
    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
        let mut window = MapWindow::empty(width_px, height_px);
        let Some((columns, rows)) = self.bounds else { return Ok(window) };
        let (left, top) = (columns[0] + column_px as i64, rows[0] + row_px as i64);
        let side = TILE_SIDE_PX as i64;
        for tile_row in top.div_euclid(side)..=(top + height_px as i64 - 1).div_euclid(side) {
            for tile_column in left.div_euclid(side)..=(left + width_px as i64 - 1).div_euclid(side) {
                if self.exists((tile_column, tile_row)) {
                    let tile = self.tile((tile_column, tile_row))?;
                    copy_part(tile, (tile_column * side - left, tile_row * side - top), &mut window);
                }
            }
        }
        Ok(window)
    }

    fn exists(&self, index: TileIndex) -> bool {
        self.places.contains_key(&index) || self.slots.contains_key(&index)
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

    /// Writes the tile that was not used for longest to the scratch file, if it changed; its place is free then.
    fn put_oldest_aside(&mut self) -> Result<usize> {
        let oldest = (0..self.tiles.len()).min_by_key(|at| self.tiles[*at].used).unwrap_or(0);
        let tile = &self.tiles[oldest];
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
        Ok(oldest)
    }

    fn read_tile(&self, slot: u64) -> Result<Tile> {
        let mut bytes = vec![0; TILE_BYTES];
        self.scratch
            .read_exact_at(&mut bytes, slot * TILE_BYTES as u64)
            .map_err(|e| Error::io(&self.scratch_path, e))?;
        let (depth, rest) = bytes.split_at(TILE_PX * 4);
        let (weight, texture) = rest.split_at(TILE_PX * 4);
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
            weight: vec![0.0; TILE_PX],
            texture: vec![[0; 4]; TILE_PX],
            used: 0,
            dirty: false,
        }
    }
}

/// The tile of a grid pixel and the pixel's place in it.
fn place(column: i64, row: i64) -> (TileIndex, usize) {
    let side = TILE_SIDE_PX as i64;
    let at = row.rem_euclid(side) * side + column.rem_euclid(side);
    ((column.div_euclid(side), row.div_euclid(side)), at as usize)
}

/// Copies the part of a tile that lies in the window; `offset` is the tile's corner in the window.
fn copy_part(tile: &Tile, offset: (i64, i64), window: &mut MapWindow) {
    let side = TILE_SIDE_PX as i64;
    for row in offset.1.max(0)..(offset.1 + side).min(window.height_px as i64) {
        for column in offset.0.max(0)..(offset.0 + side).min(window.width_px as i64) {
            let from = ((row - offset.1) * side + column - offset.0) as usize;
            let to = row as usize * window.width_px + column as usize;
            window.depth_mm[to] = tile.depth_mm[from];
            let [red, green, blue, there] = tile.texture[from];
            window.texture[to] = (there != 0).then_some([red, green, blue]);
        }
    }
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
        for column in -700..3000_i64 {
            for row in [-3_i64, 0, 300] {
                map.put_depth(column, row, (column * 1000 + row) as f32).expect("put");
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
        assert_eq!(map.measured, 3 * 3700);
        assert!(map.tiles.len() <= 4);
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
