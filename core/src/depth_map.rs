//! Surface → depth map and texture map: one regular grid in tiles, a bounded number of them in memory.

use serde::{Deserialize, Serialize};

use crate::error::Result;

mod grid;

pub use grid::GridMap;

/// Side of a map tile, px.
pub const TILE_SIDE_PX: usize = 256;

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
///
/// A caller that wants progress or a way to stop wraps its map and counts, or refuses, the windows.
pub trait MapReader {
    /// Where the map lies and how large it is.
    fn geometry(&self) -> MapGeometry;

    /// Reads a rectangle of the map; what lies outside is empty.
    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow>;
}

/// The depth map and the texture map of a run, on one grid.
pub struct SurfaceMap {
    geometry: MapGeometry,
}

impl SurfaceMap {
    /// Where the map lies and how large it is.
    pub fn geometry(&self) -> MapGeometry {
        self.geometry
    }

    /// Reads a rectangle of the map; what lies outside is empty.
    pub fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
        let _ = (column_px, row_px);
        let size = width_px * height_px;
        Ok(MapWindow { width_px, height_px, depth_mm: vec![f32::NAN; size], texture: vec![None; size] })
    }
}

impl MapReader for SurfaceMap {
    fn geometry(&self) -> MapGeometry {
        SurfaceMap::geometry(self)
    }

    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
        SurfaceMap::window(self, column_px, row_px, width_px, height_px)
    }
}
