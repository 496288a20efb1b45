//! A map cut into tiles at full size and at every half of it, in one pass and in bounded memory.
//!
//! The map is read in columns of tiles from left to right. Each column is halved and waits for its
//! neighbour; two halves make a column of the next level, and so on. At any time each level holds at most
//! one column, so the memory depends on the map's height, not on its length.

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

/// Gives every tile of every level once: columns from left to right, in each column from top to bottom; a tile
/// of level n + 1 after those that it is made of. Pixels of the upper levels are the mean of what was measured.
pub(super) fn for_each_tile(
    map: &mut dyn MapReader,
    layout: &Layout,
    take: &mut dyn FnMut(TileAddress, MapWindow) -> Result<()>,
) -> Result<()> {
    let geometry = map.geometry();
    let mut cascade = Cascade { layout, take, waiting: (0..layout.levels).map(|_| None).collect() };
    for tile_column in tile_range(layout.first_column_px, geometry.width_px, layout.side_px) {
        let column = read_column(map, layout, tile_column)?;
        cascade.give(0, column)?;
    }
    cascade.finish()
}

/// The tiles that `length_px` pixels from `first_px` on touch.
pub(super) fn tile_range(first_px: i64, length_px: usize, side_px: usize) -> Range<i64> {
    let side = side_px as i64;
    first_px.div_euclid(side)..(first_px + length_px as i64 - 1).div_euclid(side) + 1
}

/// A column of tiles of one level, one pixel array.
struct Column {
    tile_column: i64,
    tile_rows: Range<i64>,
    pixels: MapWindow,
}

struct Cascade<'a> {
    layout: &'a Layout,
    take: &'a mut dyn FnMut(TileAddress, MapWindow) -> Result<()>,
    /// Per level a column of which the left half is there.
    waiting: Vec<Option<Column>>,
}

impl Cascade<'_> {
    fn give(&mut self, level: u32, column: Column) -> Result<()> {
        let side_px = self.layout.side_px;
        for (index, row) in column.tile_rows.clone().enumerate() {
            let tile = rows_of(&column.pixels, index * side_px, side_px);
            (self.take)(TileAddress { level, column: column.tile_column, row }, tile)?;
        }
        if level + 1 >= self.layout.levels {
            return Ok(());
        }
        let parent_rows = column.tile_rows.start.div_euclid(2)..(column.tile_rows.end - 1).div_euclid(2) + 1;
        let parent = self.waiting[level as usize + 1].get_or_insert_with(|| Column {
            tile_column: column.tile_column.div_euclid(2),
            pixels: MapWindow::empty(side_px, side_px * (parent_rows.end - parent_rows.start) as usize),
            tile_rows: parent_rows.clone(),
        });
        let right = column.tile_column.rem_euclid(2) == 1;
        let half = halved(&column.pixels);
        let first_row = (column.tile_rows.start - 2 * parent_rows.start) as usize * side_px / 2;
        paste(&mut parent.pixels, &half, if right { side_px / 2 } else { 0 }, first_row);
        if right { self.hand_on(level + 1) } else { Ok(()) }
    }

    fn hand_on(&mut self, level: u32) -> Result<()> {
        match self.waiting[level as usize].take() {
            Some(column) => self.give(level, column),
            None => Ok(()),
        }
    }

    /// The right neighbours that never came stay empty.
    fn finish(mut self) -> Result<()> {
        (1..self.layout.levels).try_for_each(|level| self.hand_on(level))
    }
}

fn read_column(map: &mut dyn MapReader, layout: &Layout, tile_column: i64) -> Result<Column> {
    let geometry = map.geometry();
    let side = layout.side_px as i64;
    let tile_rows = tile_range(layout.first_row_px, geometry.height_px, layout.side_px);
    let mut pixels = MapWindow::empty(layout.side_px, layout.side_px * (tile_rows.end - tile_rows.start) as usize);
    let start = (tile_column * side - layout.first_column_px).max(0);
    let end = ((tile_column + 1) * side - layout.first_column_px).min(geometry.width_px as i64);
    let window = map.window(start as usize, 0, (end - start) as usize, geometry.height_px)?;
    let to_column = start + layout.first_column_px - tile_column * side;
    let to_row = layout.first_row_px - tile_rows.start * side;
    paste(&mut pixels, &window, to_column as usize, to_row as usize);
    Ok(Column { tile_column, tile_rows, pixels })
}

fn paste(into: &mut MapWindow, from: &MapWindow, column_px: usize, row_px: usize) {
    for row in 0..from.height_px {
        let source = row * from.width_px..(row + 1) * from.width_px;
        let start = (row_px + row) * into.width_px + column_px;
        into.depth_mm[start..start + from.width_px].copy_from_slice(&from.depth_mm[source.clone()]);
        into.texture[start..start + from.width_px].copy_from_slice(&from.texture[source]);
    }
}

fn rows_of(pixels: &MapWindow, first_row_px: usize, height_px: usize) -> MapWindow {
    let range = first_row_px * pixels.width_px..(first_row_px + height_px) * pixels.width_px;
    MapWindow {
        width_px: pixels.width_px,
        height_px,
        depth_mm: pixels.depth_mm[range.clone()].to_vec(),
        texture: pixels.texture[range].to_vec(),
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
            assert!(tiles.insert(address, tile).is_none(), "{address:?} came twice");
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
