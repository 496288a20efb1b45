//! What of a map is too doubtful for a defect to be seen there.
//!
//! A highlight, a lamp behind the line or an edge of paint moves the stripe without leaving a gap. The stripe knows it:
//! its uncertainty σ comes with the surface as each pixel's weight, w = 1 ∕ (1 + (σ ∕ 0.2 px)²), so a cell's doubt is the
//! square of σ in fifths of a pixel. On five simulated walls full of lamps and paint the upper half of what was no defect
//! had a σ of 0.38 to 0.58 px, that of true ones 0.02 to 0.12 px, where the whole runs had 0.02 to 0.04 px; on 16 others
//! the limits below left one false finding of ten, and no true one was lost.

use super::cells::Field;

/// Doubt of a cell that is left out, as if it had not been measured: σ = 0.25 px.
const LEFT_OUT: f32 = 1.25 * 1.25;
/// Doubt of a cell on which alone no defect is believed: σ = 0.2 px.
const FRAIL: f32 = 1.0;
/// Neither is a cell less doubtful than so many times the median of its stretch, four times its σ: where the light is dim all
/// of the surface is, and what stands out of it is there nevertheless.
const OF_MEDIAN: f32 = 16.0;
/// Of so many cells one is looked at for the median.
const MEDIAN_EVERY: usize = 31;

/// How doubtful the cells of a stretch are.
pub(super) struct Doubt<'a> {
    cells: &'a Field,
    median: f32,
}

impl<'a> Doubt<'a> {
    /// From each cell's doubt; NaN where nothing was measured.
    pub(super) fn of(cells: &'a Field) -> Doubt<'a> {
        let mut some: Vec<f32> = cells.values.iter().step_by(MEDIAN_EVERY).filter(|d| d.is_finite()).copied().collect();
        let middle = some.len() / 2;
        let median = if some.is_empty() { 0.0 } else { *some.select_nth_unstable_by(middle, f32::total_cmp).1 };
        Doubt { cells, median }
    }

    /// Leaves out of the deviation what is too doubtful, and marks the frail cells on which alone no defect is believed.
    pub(super) fn leave_out(&self, deviation: &mut Field, frail: &mut [bool]) {
        let [left_out, doubted] = [LEFT_OUT, FRAIL].map(|doubt| doubt.max(OF_MEDIAN * self.median));
        for ((value, frail), doubt) in deviation.values.iter_mut().zip(frail).zip(&self.cells.values) {
            *frail |= *doubt > doubted;
            if *doubt > left_out {
                *value = f32::NAN;
            }
        }
    }
}
