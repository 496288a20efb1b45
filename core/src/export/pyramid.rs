//! A map cut into tiles at full size and at every half of it, in one pass and in bounded memory.
//!
//! A tile of a level is made of the four below it, and these one after the other: at any time each level holds one tile,
//! so the memory depends neither on the map's length nor on its height.

use std::ops::Range;

use crate::depth_map::{MapReader, MapWindow};
use crate::error::Result;

/// How to cut.
#[derive(Clone, Copy, Debug)]
pub(super) struct Layout {
    /// Side of a tile, px; even.
    pub side_px: usize,
    /// Number of levels: level 0 is full size, each further one half of the one before.
    pub levels: u32,
    /// Where the map's first column lies on the tiles' own grid, px of level 0; may be negative.
    pub first_column_px: i64,
    /// Where the map's first row lies on the tiles' own grid, px of level 0; may be negative.
    pub first_row_px: i64,
}

/// Which tile: it covers the grid's columns from `column · side`, its rows from `row · side`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct TileAddress {
    /// 0 is full size.
    pub level: u32,
    /// From left to right.
    pub column: i64,
    /// From top to bottom.
    pub row: i64,
}

/// Gives every tile of every level once, a tile of level n + 1 after those that it is made of. Pixels of the upper levels
/// are the mean of what was measured.
pub(super) fn for_each_tile(
    map: &mut dyn MapReader,
    layout: &Layout,
    take: &mut dyn FnMut(TileAddress, &MapWindow) -> Result<()>,
) -> Result<()> {
    let geometry = map.geometry();
    let columns = tile_range(layout.first_column_px, geometry.width_px, layout.side_px);
    let rows = tile_range(layout.first_row_px, geometry.height_px, layout.side_px);
    let mut cutter = Cutter { map, layout, columns, rows, take };
    let top = layout.levels.saturating_sub(1);
    for column in cutter.columns_of(top) {
        for row in cutter.rows_of(top) {
            cutter.tile(TileAddress { level: top, column, row })?;
        }
    }
    Ok(())
}

/// The tiles that `length_px` pixels from `first_px` on touch.
pub(super) fn tile_range(first_px: i64, length_px: usize, side_px: usize) -> Range<i64> {
    let side = side_px as i64;
    first_px.div_euclid(side)..(first_px + length_px as i64 - 1).div_euclid(side) + 1
}

struct Cutter<'a> {
    map: &'a mut dyn MapReader,
    layout: &'a Layout,
    /// The tiles of level 0.
    columns: Range<i64>,
    rows: Range<i64>,
    take: &'a mut dyn FnMut(TileAddress, &MapWindow) -> Result<()>,
}

impl Cutter<'_> {
    fn columns_of(&self, level: u32) -> Range<i64> {
        above(&self.columns, level)
    }

    fn rows_of(&self, level: u32) -> Range<i64> {
        above(&self.rows, level)
    }

    /// Gives the tiles that a tile is made of, and then the tile.
    fn tile(&mut self, address: TileAddress) -> Result<MapWindow> {
        let tile = match address.level {
            0 => self.read(address.column, address.row)?,
            _ => self.joined(address)?,
        };
        (self.take)(address, &tile)?;
        Ok(tile)
    }

    fn joined(&mut self, address: TileAddress) -> Result<MapWindow> {
        let (side_px, level) = (self.layout.side_px, address.level - 1);
        let (columns, rows) = (self.columns_of(level), self.rows_of(level));
        let mut tile = MapWindow::empty(side_px, side_px);
        for (right, down) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            let (column, row) = (2 * address.column + right, 2 * address.row + down);
            if columns.contains(&column) && rows.contains(&row) {
                let quarter = halved(&self.tile(TileAddress { level, column, row })?);
                paste(&mut tile, &quarter, right as usize * side_px / 2, down as usize * side_px / 2);
            }
        }
        Ok(tile)
    }

    fn read(&mut self, tile_column: i64, tile_row: i64) -> Result<MapWindow> {
        let (geometry, layout) = (self.map.geometry(), self.layout);
        let side = layout.side_px as i64;
        // The map's pixels that lie in the tile: the first, the one after the last, and where the first lies in it.
        let within = |tile: i64, first_px: i64, length_px: usize| {
            let start = (tile * side - first_px).max(0);
            let end = ((tile + 1) * side - first_px).min(length_px as i64);
            (start as usize, (end - start) as usize, (start + first_px - tile * side) as usize)
        };
        let (column, width, left) = within(tile_column, layout.first_column_px, geometry.width_px);
        let (row, height, top) = within(tile_row, layout.first_row_px, geometry.height_px);
        let window = self.map.window(column, row, width, height)?;
        if (width, height) == (layout.side_px, layout.side_px) {
            return Ok(window);
        }
        let mut tile = MapWindow::empty(layout.side_px, layout.side_px);
        paste(&mut tile, &window, left, top);
        Ok(tile)
    }
}

/// A range of tiles of level 0 as one of a higher level.
fn above(range: &Range<i64>, level: u32) -> Range<i64> {
    // A shift of a negative number rounds down: the tile that holds it.
    range.start >> level..((range.end - 1) >> level) + 1
}

fn paste(into: &mut MapWindow, from: &MapWindow, column_px: usize, row_px: usize) {
    for row in 0..from.height_px {
        let source = row * from.width_px..(row + 1) * from.width_px;
        let start = (row_px + row) * into.width_px + column_px;
        into.depth_mm[start..start + from.width_px].copy_from_slice(&from.depth_mm[source.clone()]);
        into.texture[start..start + from.width_px].copy_from_slice(&from.texture[source]);
    }
}

/// Half the size; each pixel is the mean of those of its four that were measured.
pub(super) fn halved(pixels: &MapWindow) -> MapWindow {
    let mut half = MapWindow::empty(pixels.width_px / 2, pixels.height_px / 2);
    for row in 0..half.height_px {
        for column in 0..half.width_px {
            let first = 2 * row * pixels.width_px + 2 * column;
            let four = [first, first + 1, first + pixels.width_px, first + pixels.width_px + 1];
            let at = row * half.width_px + column;
            half.depth_mm[at] = mean_depth(four.map(|i| pixels.depth_mm[i]));
            half.texture[at] = mean_colour(four.map(|i| pixels.texture[i]));
        }
    }
    half
}

fn mean_depth(four_mm: [f32; 4]) -> f32 {
    let (mut sum_mm, mut count) = (0.0, 0.0);
    for z_mm in four_mm {
        if z_mm.is_finite() {
            sum_mm += f64::from(z_mm);
            count += 1.0;
        }
    }
    // 0 / 0 is NaN: nothing measured.
    (sum_mm / count) as f32
}

fn mean_colour(four: [Option<[u8; 3]>; 4]) -> Option<[u8; 3]> {
    let count = four.iter().flatten().count() as u32;
    (count > 0).then(|| {
        [0, 1, 2].map(|channel| {
            let sum: u32 = four.iter().flatten().map(|rgb| u32::from(rgb[channel])).sum();
            ((sum + count / 2) / count) as u8
        })
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::depth_map::{GridMap, MapGeometry};

    fn pyramid(map: &mut GridMap, layout: Layout) -> BTreeMap<TileAddress, MapWindow> {
        let mut tiles = BTreeMap::new();
        for_each_tile(map, &layout, &mut |address, tile| {
            assert!(tiles.insert(address, tile.clone()).is_none(), "{address:?} came twice");
            Ok(())
        })
        .expect("pyramid");
        tiles
    }

    #[test]
    fn every_level_is_the_mean_of_what_was_measured_below_it() {
        let geometry = MapGeometry { x0_mm: 0.0, y0_mm: 0.0, mm_per_px: 1.0, width_px: 21, height_px: 13 };
        let value = |column: usize, row: usize| {
            if (column * 7 + row * 3).is_multiple_of(5) { f32::NAN } else { (column * 100 + row) as f32 }
        };
        let mut map = GridMap::from_fn(geometry, |c, r| (value(c, r), Some([c as u8, r as u8, 7])));
        // The map starts left of and above the grid's origin, as after travel backwards.
        let layout = Layout { side_px: 4, levels: 3, first_column_px: -6, first_row_px: -3 };
        let tiles = pyramid(&mut map, layout);
        for level in 0..3 {
            let columns: Vec<i64> = tiles.keys().filter(|a| a.level == level).map(|a| a.column).collect();
            let expected = [(-2, 3), (-1, 1), (-1, 0)][level as usize];
            assert_eq!((columns.iter().min(), columns.iter().max()), (Some(&expected.0), Some(&expected.1)));
        }
        // A level-1 pixel, worked out by hand from the map: grid pixels (-6, -3) to (-5, -2) are tile (-1, -1)'s
        // second column and third row at level 1.
        let tile = &tiles[&TileAddress { level: 1, column: -1, row: -1 }];
        // Grid row -4 lies above the map, so level-1 row -2 (grid rows -4, -3) holds only the map's row 0.
        let expected: Vec<f32> = [(0, 0), (1, 0)].iter().map(|&(c, r)| value(c, r)).filter(|z| z.is_finite()).collect();
        let mean = expected.iter().sum::<f32>() / expected.len() as f32;
        assert_eq!(tile.depth_mm[2 * 4 + 1], mean);
        assert_eq!(tile.texture[2 * 4 + 1], Some([1, 0, 7]));
        assert!(tile.depth_mm[0].is_nan() && tile.texture[0].is_none());
    }

    #[test]
    fn a_level_has_as_many_tiles_as_its_size_needs() {
        let geometry = MapGeometry { x0_mm: 0.0, y0_mm: 0.0, mm_per_px: 1.0, width_px: 33, height_px: 9 };
        let mut map = GridMap::from_fn(geometry, |_, _| (5.0, None));
        let tiles = pyramid(&mut map, Layout { side_px: 8, levels: 4, first_column_px: 0, first_row_px: 0 });
        let counts: Vec<usize> = (0..4).map(|level| tiles.keys().filter(|a| a.level == level).count()).collect();
        assert_eq!(counts, [5 * 2, 3, 2, 1]);
        let top = &tiles[&TileAddress { level: 3, column: 0, row: 0 }];
        assert_eq!(top.depth_mm.iter().filter(|z| **z == 5.0).count(), 5 * 2);
    }
}
