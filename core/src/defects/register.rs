//! Two residual maps of one asset → how one lies on the other, window by window along the travel.

use std::ops::Range;

use super::cells::{CellGrid, Field};
use super::change::RegistrationReport;
use super::reference::median;
use crate::depth_map::MapReader;
use crate::error::{Error, Result};

/// Length of a window, and the way from one to the next, cells.
const WINDOW_CELLS: usize = 128;
const STEP_CELLS: usize = 64;
/// How far two runs may lie apart beside what their chainages say, mm.
const SEARCH_X_MM: f64 = 120.0;
const SEARCH_Y_MM: f64 = 60.0;
/// Cells to one in the first search.
const COARSE: usize = 4;
/// Relief beyond this many of the scatter counts no more: one large defect is not all there is.
const CLIP: f32 = 6.0;
/// Correlation from which two windows agree.
const AGREE: f64 = 0.3;
/// Windows on each side over which the median is taken.
const NEIGHBOURS: usize = 2;
/// A window further than this from its neighbours' median, mm, does not count.
const ASTRAY_MM: f64 = 6.0;

/// Offsets along the earlier run's x.
pub(super) struct Registration {
    /// (x, dx, dy) of the windows that agree, smoothed, in the order of x, mm.
    knots: Vec<(f64, f64, f64)>,
    sd_mm: (f64, f64),
    windows: usize,
}

/// Registers `later` on `earlier`; `shift_mm` is the later run's x less the earlier run's by their chainages.
pub(super) fn register(
    grid: &CellGrid,
    earlier: &mut dyn MapReader,
    other: &CellGrid,
    later: &mut dyn MapReader,
    shift_mm: f64,
    noise_mm: f32,
) -> Result<Registration> {
    let mut matched: Vec<(f64, f64, f64)> = Vec::new();
    let mut windows = 0;
    let length = WINDOW_CELLS.min(grid.columns);
    for first in (0..=grid.columns - length).step_by(STEP_CELLS) {
        // The last window's agreement tells where to look first.
        let guess = matched.last().map_or((shift_mm, 0.0), |last| (last.1, last.2));
        let window = relief(grid.read(earlier, first, length)?, noise_mm);
        let x_mm = grid.x_mm(first as f64 + (length - 1) as f64 / 2.0);
        windows += 1;
        let from_mm = grid.x_mm(first as f64) + guess.0 - SEARCH_X_MM;
        let to_mm = grid.x_mm((first + length) as f64) + guess.0 + SEARCH_X_MM;
        let at = |x_mm: f64| ((x_mm - other.x0_mm) / other.cell_mm).clamp(0.0, other.columns as f64) as usize;
        let columns = at(from_mm)..at(to_mm);
        if columns.len() < length / 2 {
            continue;
        }
        let scene = relief(other.read(later, columns.start, columns.len())?, noise_mm);
        let pair = Pair { grid, first, window: &window, other, columns, scene: &scene };
        if let Some((dx, dy)) = pair.offset_mm(guess) {
            matched.push((x_mm, dx, dy));
        }
    }
    let knots = smoothed(&matched);
    if knots.is_empty() {
        return Err(Error::input(
            "the two runs",
            format!("surfaces whose relief agrees in none of {windows} windows about their common chainage"),
            "two runs along the same stretch of the asset, with their chainages right to a decimetre",
        ));
    }
    let spread = |pick: &dyn Fn(&(f64, f64, f64)) -> f64| {
        let off = matched.iter().filter_map(|m| {
            let knot = knots.iter().find(|k| k.0 == m.0)?;
            Some((pick(m) - pick(knot)).abs())
        });
        1.4826 * median(off.collect()).unwrap_or(0.0)
    };
    // Even the best windows are not surer than a tenth of a cell.
    let sd = |pick: &dyn Fn(&(f64, f64, f64)) -> f64| spread(pick).max(0.1 * grid.cell_mm);
    let sd_mm = (sd(&|m| m.1), sd(&|m| m.2));
    Ok(Registration { knots, sd_mm, windows })
}

/// Smoothed and clipped: what is compared.
fn relief(field: Field, noise_mm: f32) -> Field {
    let mut smooth = field.smoothed(super::SMOOTHING_CELLS, 0.3);
    let most = CLIP * noise_mm.max(0.02);
    smooth.values.iter_mut().for_each(|v| *v = v.clamp(-most, most));
    smooth
}

struct Pair<'a> {
    grid: &'a CellGrid,
    first: usize,
    window: &'a Field,
    other: &'a CellGrid,
    columns: Range<usize>,
    scene: &'a Field,
}

impl Pair<'_> {
    /// The best offset, mm; `None` where nothing agrees.
    fn offset_mm(&self, guess: (f64, f64)) -> Option<(f64, f64)> {
        let cell_mm = self.grid.cell_mm;
        // Few cells, all offsets; then all cells, few offsets.
        let (steps_x, steps_y) =
            ((SEARCH_X_MM / cell_mm) as i64 / COARSE as i64, (SEARCH_Y_MM / cell_mm) as i64 / COARSE as i64);
        let coarse = self.best(guess, (steps_x, steps_y), COARSE as f64 * cell_mm, COARSE)?;
        let (offset, score) = self.best(coarse.0, (COARSE as i64, COARSE as i64), cell_mm, 2)?;
        if score < AGREE {
            return None;
        }
        let at = |dx: f64, dy: f64| self.agreement((offset.0 + dx, offset.1 + dy), 2).unwrap_or(-1.0);
        // Between the cells: the top of a parabola.
        let top = |low: f64, high: f64| {
            let bend = low - 2.0 * score + high;
            if bend < -1e-9 { (0.5 * (low - high) / bend).clamp(-0.6, 0.6) } else { 0.0 }
        };
        let x = top(at(-cell_mm, 0.0), at(cell_mm, 0.0));
        let y = top(at(0.0, -cell_mm), at(0.0, cell_mm));
        Some((offset.0 + x * cell_mm, offset.1 + y * cell_mm))
    }

    fn best(&self, about: (f64, f64), steps: (i64, i64), step_mm: f64, every: usize) -> Option<((f64, f64), f64)> {
        let mut best: Option<((f64, f64), f64)> = None;
        for i in -steps.0..=steps.0 {
            for j in -steps.1..=steps.1 {
                let offset = (about.0 + i as f64 * step_mm, about.1 + j as f64 * step_mm);
                if let Some(score) = self.agreement(offset, every)
                    && best.is_none_or(|(_, known)| score > known)
                {
                    best = Some((offset, score));
                }
            }
        }
        best
    }

    /// Correlation of the window with the scene at an offset, over every n-th cell; `None` where they hardly meet.
    fn agreement(&self, (dx_mm, dy_mm): (f64, f64), every: usize) -> Option<f64> {
        let column_of = |column: usize| {
            let x_mm = self.grid.x_mm((self.first + column) as f64) + dx_mm;
            ((x_mm - self.other.x0_mm) / self.other.cell_mm - self.columns.start as f64).round()
        };
        let row_of =
            |row: usize| ((self.grid.y_mm(row as f64) + dy_mm - self.other.y0_mm) / self.other.cell_mm).round();
        let (mut n, mut sa, mut sb, mut saa, mut sbb, mut sab) = (0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64);
        let mut all = 0.0_f64;
        for row in (0..self.window.rows).step_by(every) {
            let to = row_of(row);
            let inside = to >= 0.0 && to < self.scene.rows as f64;
            let (mut rn, mut ra, mut rb, mut raa, mut rbb, mut rab) =
                (0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32);
            for column in (0..self.window.columns).step_by(every) {
                let a = self.window.values[row * self.window.columns + column];
                if a.is_nan() {
                    continue;
                }
                all += 1.0;
                let beside = column_of(column);
                if !inside || beside < 0.0 || beside >= self.scene.columns as f64 {
                    continue;
                }
                let b = self.scene.values[to as usize * self.scene.columns + beside as usize];
                if b.is_finite() {
                    rn += 1.0;
                    ra += a;
                    rb += b;
                    raa += a * a;
                    rbb += b * b;
                    rab += a * b;
                }
            }
            n += f64::from(rn);
            sa += f64::from(ra);
            sb += f64::from(rb);
            saa += f64::from(raa);
            sbb += f64::from(rbb);
            sab += f64::from(rab);
        }
        if n < 100.0 || n < 0.5 * all {
            return None;
        }
        let (va, vb) = (saa - sa * sa / n, sbb - sb * sb / n);
        (va > 0.0 && vb > 0.0).then(|| (sab - sa * sb / n) / (va * vb).sqrt())
    }
}

/// The running median, without the windows that are astray.
fn smoothed(matched: &[(f64, f64, f64)]) -> Vec<(f64, f64, f64)> {
    let about = |i: usize| &matched[i.saturating_sub(NEIGHBOURS)..(i + NEIGHBOURS + 1).min(matched.len())];
    let mut knots = Vec::new();
    for (i, (x, dx, dy)) in matched.iter().enumerate() {
        let near = about(i);
        let middle = |pick: &dyn Fn(&(f64, f64, f64)) -> f64| median(near.iter().map(pick).collect()).unwrap_or(0.0);
        let (mx, my) = (middle(&|m| m.1), middle(&|m| m.2));
        if (dx - mx).abs() < ASTRAY_MM && (dy - my).abs() < ASTRAY_MM {
            knots.push((*x, mx, my));
        }
    }
    knots
}

impl Registration {
    /// Later run's place less the earlier run's, at the earlier run's x, mm.
    pub(super) fn offset_mm(&self, x_mm: f64) -> (f64, f64) {
        let after = self.knots.partition_point(|knot| knot.0 < x_mm);
        match (after.checked_sub(1).and_then(|i| self.knots.get(i)), self.knots.get(after)) {
            (Some(a), Some(b)) => {
                let share = (x_mm - a.0) / (b.0 - a.0).max(1e-9);
                (a.1 + share * (b.1 - a.1), a.2 + share * (b.2 - a.2))
            }
            (Some(knot), None) | (None, Some(knot)) => (knot.1, knot.2),
            (None, None) => (0.0, 0.0),
        }
    }

    /// The median offset, mm.
    pub(super) fn typical_mm(&self) -> (f64, f64) {
        let middle =
            |pick: &dyn Fn(&(f64, f64, f64)) -> f64| median(self.knots.iter().map(pick).collect()).unwrap_or(0.0);
        (middle(&|k| k.1), middle(&|k| k.2))
    }

    /// What the registration leaves, mm.
    pub(super) fn sd_mm(&self) -> f64 {
        self.sd_mm.0.hypot(self.sd_mm.1)
    }

    pub(super) fn report(&self, shift_mm: f64) -> RegistrationReport {
        let (x, y) = self.typical_mm();
        RegistrationReport {
            offset_x_mm: x - shift_mm,
            offset_y_mm: y,
            sd_x_mm: self.sd_mm.0,
            sd_y_mm: self.sd_mm.1,
            windows: self.windows,
            windows_agreeing: self.knots.len(),
        }
    }

    /// The later run's residual at the earlier run's cells; NaN where it has none.
    pub(super) fn read(
        &self,
        grid: &CellGrid,
        columns: &Range<usize>,
        other: &CellGrid,
        later: &mut dyn MapReader,
    ) -> Result<Field> {
        let places: Vec<(f64, f64)> = columns
            .clone()
            .map(|column| {
                let x_mm = grid.x_mm(column as f64);
                let (dx, dy) = self.offset_mm(x_mm);
                ((x_mm + dx - other.x0_mm) / other.cell_mm, dy)
            })
            .collect();
        let low = places.iter().map(|p| p.0).fold(f64::INFINITY, f64::min).floor().max(0.0) as usize;
        let high = (places.iter().map(|p| p.0).fold(0.0, f64::max).ceil() as usize + 1).min(other.columns);
        let mut out = Field::new(columns.len(), grid.rows, f32::NAN);
        if high <= low + 1 {
            return Ok(out);
        }
        let scene = other.read(later, low, high - low)?;
        for row in 0..grid.rows {
            for (column, (at, dy)) in places.iter().enumerate() {
                let x = at - low as f64;
                let y = (grid.y_mm(row as f64) + dy - other.y0_mm) / other.cell_mm;
                out.values[row * columns.len() + column] = between(&scene, x, y);
            }
        }
        Ok(out)
    }
}

/// The value between four cells; NaN where one of them has none.
fn between(field: &Field, x: f64, y: f64) -> f32 {
    let (left, top) = (x.floor(), y.floor());
    if left < 0.0 || top < 0.0 || left + 1.0 >= field.columns as f64 || top + 1.0 >= field.rows as f64 {
        return f32::NAN;
    }
    let (u, v) = ((x - left) as f32, (y - top) as f32);
    let at = |c: usize, r: usize| field.values[r * field.columns + c];
    let (c, r) = (left as usize, top as usize);
    (at(c, r) * (1.0 - u) + at(c + 1, r) * u) * (1.0 - v) + (at(c, r + 1) * (1.0 - u) + at(c + 1, r + 1) * u) * v
}
