//! The map in larger cells, a stretch at a time.

use std::ops::Range;

use crate::depth_map::{MapGeometry, MapReader, rectangles, written};
use crate::error::Result;

/// Columns and rows of the map that are read at once, px.
const READ_PX: usize = 256;
const READ_ROWS_PX: usize = 1024;
/// Rows of cells, at most: a map so high has parts that lie far from each other, and is searched in larger cells.
const MOST_ROWS: usize = 2048;
/// Cells that are examined at once, about (a dozen values of each are at hand), and the fewest columns of them that a
/// stretch answers for.
const CELLS_AT_ONCE: usize = 1_200_000;
const FEWEST_CORE_COLUMNS: usize = 512;
/// Columns of cells that a stretch answers for at most, and that it reads on each side besides.
const CORE_COLUMNS: usize = 2048;
const MARGIN_COLUMNS: usize = 384;
/// Share of a cell's pixels that must be measured.
const LEAST_SHARE: f32 = 0.4;
/// Distance of the wall that gives a cell of 1 mm, mm: at it, two image rows are half a millimetre or so apart.
const DISTANCE_PER_CELL: f64 = 425.0;

/// The cells of a whole map: cell (0, 0) begins at the map's first pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct CellGrid {
    /// World x of the first column's centre, mm.
    pub x0_mm: f64,
    /// World y of the first row's centre, mm.
    pub y0_mm: f64,
    /// Size of a cell, mm.
    pub cell_mm: f64,
    /// Columns of the whole map.
    pub columns: usize,
    /// Rows of the whole map.
    pub rows: usize,
    /// Map pixels on a cell's side.
    factor: usize,
}

impl CellGrid {
    /// Cells for a map of a wall at a distance; `cell_mm` above 0 asks for a size.
    pub(super) fn new(map: &MapGeometry, distance_mm: f64, cell_mm: f64) -> CellGrid {
        let wanted_mm = if cell_mm > 0.0 { cell_mm } else { distance_mm / DISTANCE_PER_CELL };
        let factor = ((wanted_mm / map.mm_per_px).round() as usize).max(map.height_px.div_ceil(MOST_ROWS)).max(1);
        let shift_mm = (factor - 1) as f64 / 2.0 * map.mm_per_px;
        CellGrid {
            x0_mm: map.x0_mm + shift_mm,
            y0_mm: map.y0_mm + shift_mm,
            cell_mm: factor as f64 * map.mm_per_px,
            columns: map.width_px / factor,
            rows: map.height_px / factor,
            factor,
        }
    }

    /// A map whose pixels are the cells already.
    pub(super) fn of_cells(map: &MapGeometry) -> CellGrid {
        CellGrid {
            x0_mm: map.x0_mm,
            y0_mm: map.y0_mm,
            cell_mm: map.mm_per_px,
            columns: map.width_px,
            rows: map.height_px,
            factor: 1,
        }
    }

    /// The stretches that are examined one after the other: the columns that each answers for, and those that it reads.
    pub(super) fn stretches(&self) -> impl Iterator<Item = (Range<usize>, Range<usize>)> {
        let room = (CELLS_AT_ONCE / self.rows.max(1)).saturating_sub(2 * MARGIN_COLUMNS);
        let (columns, step) = (self.columns, room.clamp(FEWEST_CORE_COLUMNS, CORE_COLUMNS));
        (0..columns).step_by(step).map(move |start| {
            let core = start..(start + step).min(columns);
            let read = start.saturating_sub(MARGIN_COLUMNS)..(core.end + MARGIN_COLUMNS).min(columns);
            (core, read)
        })
    }

    /// World x of a column's centre, mm.
    pub(super) fn x_mm(&self, column: f64) -> f64 {
        self.x0_mm + column * self.cell_mm
    }

    /// World y of a row's centre, mm.
    pub(super) fn y_mm(&self, row: f64) -> f64 {
        self.y0_mm + row * self.cell_mm
    }

    /// Reads `columns` columns of cells from `first` on, both within the grid: depth, mm.
    pub(super) fn read(&self, map: &mut dyn MapReader, first: usize, columns: usize) -> Result<Field> {
        self.means(first, columns, |[left, top, width, height]| Ok(map.window(left, top, width, height)?.depth_mm))
    }

    /// How doubtful the depths of [`CellGrid::read`] are: of pixels that weigh w, the mean of 1 ∕ w − 1, at least 0.
    pub(super) fn read_doubt(&self, map: &mut dyn MapReader, first: usize, columns: usize) -> Result<Field> {
        self.means(first, columns, |[left, top, width, height]| {
            let mut doubts = map.weights(left, top, width, height)?;
            doubts.iter_mut().for_each(|weight| *weight = (1.0 / *weight - 1.0).max(0.0));
            Ok(doubts)
        })
    }

    /// The mean of the finite values of each cell's pixels, NaN where they are too few; `read` gives a rectangle of the map.
    fn means(
        &self,
        first: usize,
        columns: usize,
        mut read: impl FnMut([usize; 4]) -> Result<Vec<f32>>,
    ) -> Result<Field> {
        let k = self.factor;
        let mut sums = Field::new(columns, self.rows, 0.0);
        let mut counts = written(0_u16, columns * self.rows);
        // Whole cells at once.
        let at_once = [READ_PX, READ_ROWS_PX].map(|px| (px / k).max(1) * k);
        for [left, top, width, height] in rectangles([columns * k, self.rows * k], at_once) {
            let values = read([first * k + left, top, width, height])?;
            for (row, line) in (top..).zip(values.chunks_exact(width)) {
                let start = row / k * columns + left / k;
                for (column, pixels) in line.chunks_exact(k).enumerate() {
                    for value in pixels.iter().filter(|value| value.is_finite()) {
                        sums.values[start + column] += value;
                        counts[start + column] += 1;
                    }
                }
            }
        }
        let least = (LEAST_SHARE * (k * k) as f32).ceil().max(1.0) as u16;
        for (sum, count) in sums.values.iter_mut().zip(counts) {
            *sum = if count >= least { *sum / f32::from(count) } else { f32::NAN };
        }
        Ok(sums)
    }
}

/// Values on a rectangle of cells, row by row.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Field {
    pub columns: usize,
    pub rows: usize,
    pub values: Vec<f32>,
}

impl Field {
    pub(super) fn new(columns: usize, rows: usize, value: f32) -> Field {
        Field { columns, rows, values: written(value, columns * rows) }
    }

    /// The mean of what is finite in squares of `factor` cells; NaN where less than a share `least` is.
    pub(super) fn shrunk(&self, factor: usize, least: f32) -> Field {
        let (columns, rows) = (self.columns.div_ceil(factor), self.rows.div_ceil(factor));
        let mut sums = Field::new(columns, rows, 0.0);
        let mut counts = vec![0_u32; columns * rows];
        for (row, line) in self.values.chunks_exact(self.columns).enumerate() {
            let start = row / factor * columns;
            for (column, values) in line.chunks(factor).enumerate() {
                for value in values.iter().filter(|v| v.is_finite()) {
                    sums.values[start + column] += value;
                    counts[start + column] += 1;
                }
            }
        }
        let least = (least * (factor * factor) as f32).max(1.0) as u32;
        for (sum, count) in sums.values.iter_mut().zip(counts) {
            *sum = if count >= least { *sum / count as f32 } else { f32::NAN };
        }
        sums
    }

    /// Smoothed by a Gaussian of `sigma` cells over what is finite; NaN where that is less than `least` of the weight.
    pub(super) fn smoothed(&self, sigma: f32, least: f32) -> Field {
        let filled = self.values.iter().map(|v| if v.is_finite() { *v } else { 0.0 }).collect();
        let mut values = self.convolved(filled, sigma);
        for (value, weight) in values.iter_mut().zip(self.known_weight(sigma)) {
            *value = if weight >= least { *value / weight } else { f32::NAN };
        }
        Field { columns: self.columns, rows: self.rows, values }
    }

    /// The share of the smoothing's weight that is finite, about each cell: where it is less than the least share,
    /// [`Field::smoothed`] has NaN.
    pub(super) fn known_weight(&self, sigma: f32) -> Vec<f32> {
        self.convolved(self.values.iter().map(|v| if v.is_finite() { 1.0 } else { 0.0 }).collect(), sigma)
    }

    fn convolved(&self, values: Vec<f32>, sigma: f32) -> Vec<f32> {
        convolved(values, self.columns, self.rows, &gaussian(sigma))
    }

    /// The median of the finite values' distances from 0, as a standard deviation; `None` where there are too few.
    pub(super) fn scatter(values: &mut Vec<f32>) -> Option<f32> {
        values.retain(|v| v.is_finite());
        values.iter_mut().for_each(|v| *v = v.abs());
        let middle = values.len() / 2;
        (values.len() >= 8).then(|| 1.4826 * *values.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}

/// Half of a Gaussian's weights, from its middle on; the whole sums to 1.
fn gaussian(sigma: f32) -> Vec<f32> {
    let reach = (3.0 * sigma).ceil() as usize;
    let half: Vec<f32> = (0..=reach).map(|i| (-0.5 * (i as f32 / sigma).powi(2)).exp()).collect();
    let sum = 2.0 * half.iter().sum::<f32>() - half[0];
    half.iter().map(|w| w / sum).collect()
}

/// Along the rows, then along the columns; beyond the edges lies nothing.
fn convolved(mut values: Vec<f32>, columns: usize, rows: usize, kernel: &[f32]) -> Vec<f32> {
    let mut along = written(0.0_f32, values.len());
    for (line, out) in values.chunks_exact(columns).zip(along.chunks_exact_mut(columns)) {
        out.iter_mut().zip(line).for_each(|(o, v)| *o = kernel[0] * v);
        for (shift, weight) in kernel.iter().enumerate().skip(1).take_while(|(shift, _)| *shift < columns) {
            out[shift..].iter_mut().zip(line).for_each(|(o, v)| *o += weight * v);
            out.iter_mut().zip(&line[shift..]).for_each(|(o, v)| *o += weight * v);
        }
    }
    for (row, out) in values.chunks_exact_mut(columns).enumerate() {
        let line = |row: usize| &along[row * columns..(row + 1) * columns];
        out.iter_mut().zip(line(row)).for_each(|(o, v)| *o = kernel[0] * v);
        for (shift, weight) in kernel.iter().enumerate().skip(1) {
            if row >= shift {
                out.iter_mut().zip(line(row - shift)).for_each(|(o, v)| *o += weight * v);
            }
            if row + shift < rows {
                out.iter_mut().zip(line(row + shift)).for_each(|(o, v)| *o += weight * v);
            }
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth_map::GridMap;

    #[test]
    fn cells_are_the_means_of_their_pixels() {
        let geometry = MapGeometry { x0_mm: 10.0, y0_mm: -5.0, mm_per_px: 0.5, width_px: 9, height_px: 6 };
        let hole = |column: usize, row: usize| (4..6).contains(&column) && row < 2;
        let mut map = GridMap::from_fn(geometry, |column, row| {
            (if hole(column, row) { f32::NAN } else { (column + 10 * row) as f32 }, None)
        });
        let grid = CellGrid::new(&geometry, 425.0, 0.0);
        assert_eq!((grid.columns, grid.rows, grid.cell_mm), (4, 3, 1.0));
        assert_eq!((grid.x_mm(0.0), grid.y_mm(0.0)), (10.25, -4.75));
        let field = grid.read(&mut map, 1, 3).expect("read");
        assert_eq!(field.values[0], 2.5 + 5.0);
        assert!(field.values[1].is_nan());
        assert_eq!(field.values[3], 2.5 + 25.0);
    }

    #[test]
    fn smoothing_keeps_a_plane_beside_a_hole() {
        let mut field = Field::new(40, 30, 3.0);
        field.values[15 * 40 + 20] = f32::NAN;
        let smooth = field.smoothed(1.5, 0.2);
        assert!(smooth.values.iter().all(|v| (v - 3.0).abs() < 1e-5));
    }
}
