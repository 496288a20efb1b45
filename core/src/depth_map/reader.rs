//! Reading a map in rectangles, however large it is; by several threads too.

use std::sync::{Mutex, MutexGuard, PoisonError};

use super::{MapGeometry, SurfaceMap, TILE_SIDE_PX};
use crate::error::Result;

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

    /// What the depths of a rectangle weigh, row by row: the sum of the confidences of the profiles that reached a pixel,
    /// 0 where nothing was measured. `height_px * width_px` values. A map that does not know takes each depth for sure: 1.
    fn weights(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<Vec<f32>> {
        let window = self.window(column_px, row_px, width_px, height_px)?;
        Ok(window.depth_mm.iter().map(|z| f32::from(u8::from(z.is_finite()))).collect())
    }
}

/// A map in which something was measured, for reading.
pub struct FinishedMap<'a> {
    pub(super) map: &'a mut SurfaceMap,
    pub(super) geometry: MapGeometry,
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

    fn weights(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<Vec<f32>> {
        self.map.weights(column_px, row_px, width_px, height_px)
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

    fn weights(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<Vec<f32>> {
        self.shared.lock().weights(column_px, row_px, width_px, height_px)
    }
}

/// Rectangles that cover an area of `size_px` once, each at most `largest_px` (columns, rows) large: first column, first
/// row, columns, rows; column by column along the travel.
pub fn rectangles(size_px: [usize; 2], largest_px: [usize; 2]) -> impl Iterator<Item = [usize; 4]> {
    let [all_columns, all_rows] = size_px;
    (0..all_columns).step_by(largest_px[0]).flat_map(move |column| {
        let columns = largest_px[0].min(all_columns - column);
        (0..all_rows).step_by(largest_px[1]).map(move |row| [column, row, columns, largest_px[1].min(all_rows - row)])
    })
}

/// Rows that [`band`] gives at once: of the widest part of a map, two megabytes a byte of a pixel.
pub const BAND_ROWS: usize = 64;

/// Reads some columns of [`BAND_ROWS`] rows from `first_row_px` on, fewer at the map's end, and turns each pixel into
/// what a picture shows there, row by row. The map itself is never held at more than a tile's width: a wide band of it
/// would take three to four times what is made of it.
///
/// # Errors
/// What the reading of the map says.
pub fn band<T: Copy>(
    map: &mut dyn MapReader,
    columns: std::ops::Range<usize>,
    first_row_px: usize,
    empty: T,
    shown: impl Fn(f32, Option<[u8; 3]>) -> T,
) -> Result<Vec<T>> {
    let rows = BAND_ROWS.min(map.geometry().height_px.saturating_sub(first_row_px));
    let width = columns.len();
    let mut pixels = vec![empty; rows * width];
    for [left, _, piece_px, _] in rectangles([width, rows], [TILE_SIDE_PX, rows.max(1)]) {
        let window = map.window(columns.start + left, first_row_px, piece_px, rows)?;
        for (row, line) in pixels.chunks_exact_mut(width).enumerate() {
            let from = row * piece_px..(row + 1) * piece_px;
            let read = window.depth_mm[from.clone()].iter().zip(&window.texture[from]);
            for (pixel, (z_mm, colour)) in line[left..left + piece_px].iter_mut().zip(read) {
                *pixel = shown(*z_mm, *colour);
            }
        }
    }
    Ok(pixels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth_map::GridMap;

    #[test]
    fn a_band_is_what_the_map_holds_there() {
        let geometry = MapGeometry { x0_mm: 0.0, y0_mm: 0.0, mm_per_px: 1.0, width_px: 700, height_px: 300 };
        let mut map = GridMap::from_fn(geometry, |column, row| (column as f32, Some([row as u8, 1, 2])));
        let shown = |z_mm: f32, colour: Option<[u8; 3]>| (z_mm as usize, colour.map_or(9, |c| c[0]));
        for first_row in [0, BAND_ROWS] {
            let pixels = band(&mut map, 10..690, first_row, (0, 0), shown).expect("band");
            assert_eq!(pixels.len(), 680 * BAND_ROWS.min(300 - first_row));
            for (at, pixel) in pixels.iter().enumerate() {
                assert_eq!(*pixel, (10 + at % 680, (first_row + at / 680) as u8));
            }
        }
        assert!(band(&mut map, 0..700, 300, (0, 0), shown).expect("band").is_empty());
    }

    #[test]
    fn rectangles_cover_an_area_once() {
        let pieces: Vec<_> = rectangles([10, 7], [4, 5]).collect();
        assert_eq!(pieces[..3], [[0, 0, 4, 5], [0, 5, 4, 2], [4, 0, 4, 5]]);
        assert_eq!(pieces.iter().map(|p| p[2] * p[3]).sum::<usize>(), 70);
        assert_eq!(rectangles([0, 7], [4, 5]).count(), 0);
    }
}
