//! Reading rectangles of a map, one kind of value at a time: of large parts of tiles that were put aside, only what is asked
//! for is read, past the tiles in memory.

use std::ops::Range;
use std::os::unix::fs::FileExt;

use super::{LAYER_BYTES, MapWindow, SurfaceMap, TILE_BYTES, TILE_SIDE_PX, Tile, TileIndex};
use crate::error::{Error, Result};

/// A rectangle with so many columns of a tile, or more, is read past the tiles in memory.
const READ_PAST_PX: i64 = TILE_SIDE_PX as i64 / 2;

/// One value of each pixel.
struct Layer<T> {
    of: fn(&Tile) -> &[T],
    /// Where it begins in a tile on disk, and what four bytes mean there.
    starts_at: usize,
    value: fn([u8; 4]) -> T,
}

const DEPTH: Layer<f32> = Layer { of: |tile| &tile.depth_mm, starts_at: 0, value: f32::from_le_bytes };
const WEIGHT: Layer<f32> = Layer { of: |tile| &tile.weight, starts_at: LAYER_BYTES, value: f32::from_le_bytes };
const TEXTURE: Layer<[u8; 4]> = Layer { of: |tile| &tile.texture, starts_at: 2 * LAYER_BYTES, value: |rgb| rgb };

/// Columns and rows of the grid.
struct Rectangle {
    left: i64,
    top: i64,
    width: i64,
    height: i64,
}

impl SurfaceMap {
    /// A whole tile of the grid.
    pub fn tile_window(&mut self, (column, row): TileIndex) -> Result<MapWindow> {
        let side = TILE_SIDE_PX as i64;
        self.read(&Rectangle { left: column * side, top: row * side, width: side, height: side })
    }

    /// Reads a rectangle of [`SurfaceMap::geometry`]; what lies outside the measured tiles is empty.
    pub(super) fn window(
        &mut self,
        column_px: usize,
        row_px: usize,
        width_px: usize,
        height_px: usize,
    ) -> Result<MapWindow> {
        match self.rectangle(column_px, row_px, width_px, height_px) {
            Some(rectangle) => self.read(&rectangle),
            None => Ok(MapWindow::empty(width_px, height_px)),
        }
    }

    /// What the depths of a rectangle weigh, row by row; 0 where nothing was measured.
    pub(super) fn weights(
        &mut self,
        column_px: usize,
        row_px: usize,
        width_px: usize,
        height_px: usize,
    ) -> Result<Vec<f32>> {
        let mut weights = vec![0.0; width_px * height_px];
        if let Some(rectangle) = self.rectangle(column_px, row_px, width_px, height_px) {
            self.copy(&WEIGHT, &rectangle, |to, values| weights[to..to + values.len()].copy_from_slice(values))?;
        }
        Ok(weights)
    }

    fn rectangle(&self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Option<Rectangle> {
        let (columns, rows) = self.bounds?;
        let (left, top) = (columns[0] + column_px as i64, rows[0] + row_px as i64);
        Some(Rectangle { left, top, width: width_px as i64, height: height_px as i64 })
    }

    fn read(&mut self, rectangle: &Rectangle) -> Result<MapWindow> {
        let mut window = MapWindow::empty(rectangle.width as usize, rectangle.height as usize);
        let (depth_mm, texture) = (&mut window.depth_mm, &mut window.texture);
        self.copy(&DEPTH, rectangle, |to, values| depth_mm[to..to + values.len()].copy_from_slice(values))?;
        self.copy(&TEXTURE, rectangle, |to, values| {
            for (colour, [red, green, blue, there]) in texture[to..].iter_mut().zip(values) {
                *colour = (*there != 0).then_some([*red, *green, *blue]);
            }
        })?;
        Ok(window)
    }

    /// Gives `put` the measured tiles' values in a rectangle: a piece of a row, and its place in the rectangle.
    fn copy<T: Copy>(
        &mut self,
        layer: &Layer<T>,
        &Rectangle { left, top, width, height }: &Rectangle,
        mut put: impl FnMut(usize, &[T]),
    ) -> Result<()> {
        let side = TILE_SIDE_PX as i64;
        for tile_row in top.div_euclid(side)..=(top + height - 1).div_euclid(side) {
            for tile_column in left.div_euclid(side)..=(left + width - 1).div_euclid(side) {
                let index = (tile_column, tile_row);
                // The tile's corner in the rectangle, and the part of the tile that lies there.
                let (x, y) = (tile_column * side - left, tile_row * side - top);
                let columns = (-x).max(0) as usize..side.min(width - x) as usize;
                let rows = (-y).max(0) as usize..side.min(height - y) as usize;
                let mut put_rows = |values: &[T], first_row: usize| {
                    for row in rows.clone() {
                        let from = (row - first_row) * TILE_SIDE_PX;
                        let to = (y + row as i64) * width + x + columns.start as i64;
                        put(to as usize, &values[from + columns.start..from + columns.end]);
                    }
                };
                match self.slots.get(&index) {
                    Some(slot) if columns.len() as i64 >= READ_PAST_PX && !self.places.contains_key(&index) => {
                        put_rows(&self.read_rows(layer, *slot, rows.clone())?, rows.start);
                    }
                    None if !self.places.contains_key(&index) => {}
                    _ => put_rows((layer.of)(self.tile(index)?), 0),
                }
            }
        }
        Ok(())
    }

    /// Some rows of a tile in the scratch file.
    fn read_rows<T>(&self, layer: &Layer<T>, slot: u64, rows: Range<usize>) -> Result<Vec<T>> {
        let mut bytes = vec![0; rows.len() * TILE_SIDE_PX * 4];
        let start = slot * TILE_BYTES as u64 + (layer.starts_at + rows.start * TILE_SIDE_PX * 4) as u64;
        self.scratch.read_exact_at(&mut bytes, start).map_err(|e| Error::io(&self.scratch_path, e))?;
        Ok(bytes.chunks_exact(4).map(|b| (layer.value)([b[0], b[1], b[2], b[3]])).collect())
    }
}
