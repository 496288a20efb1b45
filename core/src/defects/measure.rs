//! One region → its figures.

use std::collections::HashSet;

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::cells::{CellGrid, Field};
use super::form::Blur;
use super::list::least_radius_mm;
use super::reference::{Reference, Shape};
use super::regions::Region;
use super::{Bounds, Defect, DefectKind, SMOOTHING_CELLS};
use crate::recipe::DefectOptions;

/// Levels of a region's height at which its area is taken.
const LEVELS: usize = 11;
const LOWEST_LEVEL: f32 = 0.25;
const HIGHEST_LEVEL: f32 = 0.75;
/// Share of the radius at half height in which the summit is fitted.
const SUMMIT_SHARE: f64 = 0.7;
/// A top or bottom that holds this share of the region's area is flat: its sides are steep.
const FLAT_SHARE: f64 = 0.5;
const LEAST_FLAT_CELLS: usize = 30;
/// Share of a region's upper half that must be measured, and not beside a gap, for it to be believed; or so large a disc
/// of it must reach the threshold there, in least radii.
const LEAST_SUPPORT: f64 = 0.5;
const LEAST_DISC: f64 = 1.5;
/// What lies across more than this share of the map's height at once may be a wrong pose of the camera: it must reach this
/// many thresholds.
const WHOLE_SECTION: f64 = 0.6;
const WHOLE_SECTION_FACTOR: f32 = 2.0;
/// The rim in extents at half height, a little beyond; how much wider the ring about it is, and by how many cells.
const RIM: f64 = 1.15;
const RING: f64 = 1.3;
const RING_CELLS: f64 = 4.0;
/// Cells that the smoothing adds to a round dent's area, in discs of its standard deviation; from raised cosines.
const WIDENING: f64 = 5.0;
/// Extents at half height within which the rim of any dent lies.
const REACH: f64 = 1.2;
/// Level down to which a region must hang together.
const BODY_LEVEL: f32 = 0.2;
/// Level down to which the volume is summed: below it lies the surroundings' own scatter.
const VOLUME_LEVEL: f32 = 0.05;
/// Share of a depth that is unsure where no form was fitted: the summit of what is neither round nor flat.
const ROUGH_SD: f64 = 0.05;
/// Level that gives the extents.
const EXTENT_LEVEL: f32 = 0.3;

/// A stretch of the surface with its deviation from the undamaged shape.
#[derive(Clone, Copy)]
pub(super) struct Stretch<'a> {
    pub grid: &'a CellGrid,
    /// The stretch's first column on the grid.
    pub first_column: usize,
    pub reference: &'a Reference,
    /// mm; NaN where not measured.
    pub deviation: &'a Field,
    /// Smoothed, and continued over narrow gaps.
    pub smooth: &'a Field,
    /// Cells on which alone no defect is believed: beside what was not measured, or doubtful.
    pub frail: &'a [bool],
    /// Threshold of each row, mm.
    pub thresholds_mm: &'a [f32],
    /// Scatter of each row, mm.
    pub noise_mm: &'a [f32],
    /// Cells that belong to a region.
    pub taken: &'a [bool],
    /// Waves longer than this are in the background already, mm.
    pub wave_mm: f64,
    /// How many times higher than its row's a cell's threshold is, where cells differ.
    pub slack: Option<&'a [f32]>,
    /// What blurred the surface when it was measured.
    pub blur: Blur,
    /// Travel from one profile to the next, mm; 0 where it is not known.
    pub profile_step_mm: f64,
}

impl Stretch<'_> {
    pub(super) fn slack(&self, cell: usize) -> f32 {
        self.slack.map_or(1.0, |slack| slack[cell])
    }

    fn threshold_mm(&self, cell: usize) -> f32 {
        self.thresholds_mm[cell / self.smooth.columns] * self.slack(cell)
    }
}

/// A region of no more cells is too small to be listed.
pub(super) fn least_cells(options: &DefectOptions, cell_mm: f64) -> usize {
    (std::f64::consts::PI * (0.5 * options.radius_min_mm / cell_mm).powi(2)) as usize
}

/// A region above the surface about it: what the background left of a wave is taken off.
struct Relief<'a> {
    stretch: &'a Stretch<'a>,
    region: &'a Region,
    columns: usize,
    /// The surface about it: value at the summit, slope along columns and rows, mm and mm a cell.
    level: [f64; 3],
}

impl Relief<'_> {
    fn ground(&self, cell: usize) -> f32 {
        let (x, y) = self.beside_summit(cell);
        (self.level[0] + self.level[1] * x + self.level[2] * y) as f32
    }

    fn beside_summit(&self, cell: usize) -> (f64, f64) {
        let summit = self.region.summit;
        let apart = |a: usize, b: usize| a as f64 - b as f64;
        (apart(cell % self.columns, summit % self.columns), apart(cell / self.columns, summit / self.columns))
    }

    /// Height of the smoothed surface, mm; above 0 on the region's own side.
    fn height(&self, cell: usize) -> f32 {
        self.region.sign * (self.stretch.smooth.values[cell] - self.ground(cell))
    }

    /// Height of the surface as measured, mm.
    fn measured(&self, cell: usize) -> f32 {
        self.region.sign * (self.stretch.deviation.values[cell] - self.ground(cell))
    }

    fn above(&self, level: f32) -> impl Iterator<Item = usize> + '_ {
        self.region.cells.iter().copied().filter(move |cell| self.height(*cell) > level)
    }
}

/// The region's figures; `None` where too little of it was measured to believe it.
pub(super) fn measure(stretch: &Stretch, region: &Region, options: &DefectOptions) -> Option<Defect> {
    let columns = stretch.smooth.columns;
    let mut relief = Relief { stretch, region, columns, level: [0.0; 3] };
    let cell_mm = stretch.grid.cell_mm;
    if !believed(&relief, options) {
        return None;
    }
    let half = extents(relief.above(0.5 * relief.height(region.summit)), columns)?;
    if cell_mm * half.0.min(half.1) as f64 * 4.0 < stretch.wave_mm {
        relief.level = surroundings(&relief, half);
    }
    let rough = relief.height(region.summit);
    let threshold = stretch.threshold_mm(region.summit);
    if rough < 0.8 * threshold {
        return None;
    }
    let top = summit_mm(&relief, rough);
    // A wave beside it is no part of it, though the two touch.
    let whole = region;
    let region = &Region { sign: region.sign, summit: region.summit, cells: body(&relief, top) };
    let relief = Relief { stretch, region, columns, level: relief.level };
    let flank: Vec<(f32, f32)> =
        region.cells.iter().map(|c| (relief.height(*c), rise(stretch.smooth, *c).max(1e-6))).collect();
    // A cell that the level runs through counts by its part above it.
    let part = |(height, rise): &(f32, f32), level: f32| f64::from((0.5 + (height - level) / rise).clamp(0.0, 1.0));
    let parts_above = |height: f32| flank.iter().map(|cell| part(cell, height)).sum::<f64>();
    let flat =
        parts_above(0.8 * top) > FLAT_SHARE * parts_above(LOWEST_LEVEL * top) && region.cells.len() > LEAST_FLAT_CELLS;
    // A flat bottom is as deep as most of it: its summit is the worst of its noise.
    let depth = if flat { middle_mm(&relief, 0.5 * top).unwrap_or(top) } else { top };
    let cells_above = |level: f32| parts_above(level * depth);
    let noise_mm = stretch.noise_mm[region.summit / columns];
    // A steep side is where half of the height is.
    let area_cells = if flat { cells_above(0.5) } else { area_cells(depth, noise_mm, &cells_above) };
    let body_level = if flat { 0.5 } else { EXTENT_LEVEL } * depth;
    let centre = centre(&relief, body_level);
    let place =
        |column: f64, row: f64| (stretch.grid.x_mm(stretch.first_column as f64 + column), stretch.grid.y_mm(row));
    let (x_mm, y_mm) = place(centre.0, centre.1);
    let summit = place((region.summit % columns) as f64, (region.summit / columns) as f64);
    let body: Vec<usize> = relief.above(body_level).collect();
    let across = extents(body.iter().copied(), columns)?;
    let grown = if flat { 1.0 } else { (area_cells / body.len().max(1) as f64).sqrt().clamp(1.0, 2.0) };
    let [length_mm, width_mm] = [across.0, across.1].map(|cells| cells as f64 * grown * cell_mm);
    let measured = region.cells.iter().filter(|c| stretch.deviation.values[**c].is_finite()).count() as f64;
    let measured = measured / region.cells.len().max(1) as f64;
    let steepest = f64::from(flank.iter().map(|cell| cell.1).fold(0.0, f32::max)) / cell_mm;
    let facing = stretch.reference.facing(summit.1, summit.0);
    let area_mm2 = area_cells * cell_mm * cell_mm;
    let near = |cell: &usize| {
        let (x, y) = ((cell % columns) as f64 - centre.0, (cell / columns) as f64 - centre.1);
        2.0 * x.abs() * cell_mm <= length_mm && 2.0 * y.abs() * cell_mm <= width_mm
    };
    let heights =
        whole.cells.iter().filter(|c| near(c)).map(|c| relief.height(*c)).filter(|h| *h > VOLUME_LEVEL * depth);
    let volume: f64 = heights.map(f64::from).sum();
    let signed = f64::from(region.sign * depth);
    Some(Defect {
        id: 0,
        kind: kind(signed, flat, options),
        severity: String::new(),
        code: None,
        chainage_mm: 0.0,
        x_mm,
        y_mm,
        z_mm: stretch.reference.z_mm(summit.0, summit.1) + signed,
        clock_h: None,
        height_mm: None,
        depth_mm: signed,
        depth_sd_mm: f64::from(noise_mm).hypot(ROUGH_SD * signed),
        depth_normal_mm: signed * facing,
        length_mm,
        width_mm,
        area_mm2,
        surface_area_mm2: area_mm2 / facing.max(0.1),
        volume_mm3: volume * cell_mm * cell_mm,
        steepest_slope_deg: steepest.atan().to_degrees(),
        confidence: measured / (1.0 + (-3.0 * (f64::from(depth / threshold) - 1.0)).exp()),
        noise_mm: f64::from(noise_mm),
        measured_share: measured,
        at_edge: at_edge(stretch, &body),
        deepest_x_mm: summit.0,
        deepest_y_mm: summit.1,
        bounds: Bounds {
            x_min_mm: x_mm - 0.5 * length_mm,
            x_max_mm: x_mm + 0.5 * length_mm,
            y_min_mm: y_mm - 0.5 * width_mm,
            y_max_mm: y_mm + 0.5 * width_mm,
        },
    })
}

/// Whether the region is more than what a gap does to its neighbours, a single profile, or a wrong pose.
fn believed(relief: &Relief, options: &DefectOptions) -> bool {
    let stretch = relief.stretch;
    let rough = relief.height(relief.region.summit);
    let upper: Vec<usize> = relief.above(0.5 * rough).collect();
    let firm = |cell: &&usize| stretch.deviation.values[**cell].is_finite() && !stretch.frail[**cell];
    let firm: Vec<usize> = upper.iter().filter(firm).copied().collect();
    let threshold = stretch.threshold_mm(relief.region.summit);
    let alone = firm.iter().filter(|c| relief.height(**c) > threshold).count() as f64;
    let cell_mm = stretch.grid.cell_mm;
    let disc_cells = std::f64::consts::PI * (LEAST_DISC * options.radius_min_mm / cell_mm).powi(2);
    let supported = firm.len() as f64 >= LEAST_SUPPORT * upper.len() as f64 || alone >= disc_cells;
    let length = extents(upper.iter().copied(), relief.columns).map_or(0.0, |across| across.0 as f64 * cell_mm);
    let rows = extents(relief.region.cells.iter().copied(), relief.columns).map_or(0, |across| across.1);
    let whole_section = rows as f64 > WHOLE_SECTION * stretch.smooth.rows as f64;
    let clear = !whole_section || rough > WHOLE_SECTION_FACTOR * threshold;
    supported && clear && length > least_radius_mm(stretch.profile_step_mm)
}

/// The plane of what lies about a region and belongs to none: its value at the summit and its slopes.
fn surroundings(relief: &Relief, half: (usize, usize)) -> [f64; 3] {
    let (columns, rows) = (relief.columns, relief.stretch.smooth.rows);
    let (summit_column, summit_row) = (relief.region.summit % columns, relief.region.summit / columns);
    // The rim of a raised cosine lies at twice the distance of half its height.
    let inner = (half.0 as f64 * RIM, half.1 as f64 * RIM);
    let (wide, high) = (RING * inner.0 + RING_CELLS, RING * inner.1 + RING_CELLS);
    let mut normal = SMatrix::<f64, 3, 3>::zeros();
    let mut right = SVector::<f64, 3>::zeros();
    let mut count = 0;
    for row in summit_row.saturating_sub(high as usize)..(summit_row + high as usize + 1).min(rows) {
        for column in summit_column.saturating_sub(wide as usize)..(summit_column + wide as usize + 1).min(columns) {
            let cell = row * columns + column;
            let (x, y) = relief.beside_summit(cell);
            let value = relief.stretch.smooth.values[cell];
            let outside = (x / inner.0).powi(2) + (y / inner.1).powi(2) > 1.0;
            if outside && value.is_finite() && !relief.stretch.taken[cell] {
                let line = SVector::<f64, 3>::new(1.0, x, y);
                normal += line * line.transpose();
                right += f64::from(value) * line;
                count += 1;
            }
        }
    }
    let most = (2.0 * wide + 1.0) * (2.0 * high + 1.0);
    if f64::from(count) < 0.2 * most {
        return [0.0; 3];
    }
    normal.try_inverse().map_or([0.0; 3], |inverse| (inverse * right).into())
}

/// How deep it is: the summit of a paraboloid through the unsmoothed cells about the highest one.
fn summit_mm(relief: &Relief, rough: f32) -> f32 {
    let mut depth = rough;
    for _ in 0..3 {
        let half: Vec<usize> = relief.above(0.5 * depth).collect();
        let disc = (half.len() as f64 / std::f64::consts::PI).sqrt();
        let narrow =
            extents(half.into_iter(), relief.columns).map_or(disc, |across| 0.5 * across.0.min(across.1) as f64);
        let reach = (SUMMIT_SHARE * disc.min(narrow)).max(2.0);
        let near = relief.region.cells.iter().filter_map(|cell| {
            let (dx, dy) = relief.beside_summit(*cell);
            let value = f64::from(relief.measured(*cell));
            (dx * dx + dy * dy <= reach * reach && value.is_finite()).then_some((dx, dy, value))
        });
        match paraboloid_top(near, reach) {
            Some(top) => depth = top as f32,
            None => break,
        }
    }
    // A paraboloid through odd edges may fly off: it stays near what was measured.
    depth.clamp(0.8 * rough, 1.4 * rough)
}

/// The highest value of the best paraboloid within `reach`; its middle's where it has no top there.
fn paraboloid_top(places: impl Iterator<Item = (f64, f64, f64)>, reach: f64) -> Option<f64> {
    let mut normal = SMatrix::<f64, 6, 6>::zeros();
    let mut right = SVector::<f64, 6>::zeros();
    let mut count = 0;
    for (x, y, value) in places {
        let row = SVector::<f64, 6>::from([1.0, x, y, x * x, x * y, y * y]);
        normal += row * row.transpose();
        right += value * row;
        count += 1;
    }
    if count < 9 {
        return None;
    }
    let p = normal.try_inverse()? * right;
    let bend = Matrix2::new(2.0 * p[3], p[4], p[4], 2.0 * p[5]);
    let slope = Vector2::new(p[1], p[2]);
    let top = bend.try_inverse().map(|inverse| -(inverse * slope));
    let falls = bend.trace() < 0.0 && bend.determinant() > 0.0;
    Some(match top {
        Some(top) if falls && top.norm() < reach => p[0] + 0.5 * slope.dot(&top),
        _ => p[0],
    })
}

/// The area down to the rim, in cells. The rim itself drowns in the noise: the radius at several levels is continued to
/// level 0, along the flank of a raised cosine where there is a flank, and not at all where the sides are steep.
fn area_cells(depth: f32, noise_mm: f32, cells_above: &impl Fn(f32) -> f64) -> f64 {
    let lowest = (2.0 * noise_mm / depth).clamp(LOWEST_LEVEL, 0.6);
    let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for i in 0..LEVELS {
        let level = lowest + (HIGHEST_LEVEL - lowest) * i as f32 / (LEVELS - 1) as f32;
        let x = f64::from(level.sqrt().acos()) / std::f64::consts::FRAC_PI_2;
        let y = cells_above(level).sqrt();
        n += 1.0;
        sx += x;
        sy += y;
        sxx += x * x;
        sxy += x * y;
    }
    let slope = (n * sxy - sx * sy) / (n * sxx - sx * sx);
    let rim = (sy - slope * sx) / n + slope;
    // The smoothing before the search widens the flank.
    let widened = WIDENING * std::f64::consts::PI * f64::from(SMOOTHING_CELLS).powi(2);
    (rim.powi(2) - if slope > 0.0 { widened } else { 0.0 }).max(cells_above(lowest))
}

/// How much the smoothed deviation changes over a cell.
pub(super) fn rise(smooth: &Field, cell: usize) -> f32 {
    let (columns, rows) = (smooth.columns, smooth.rows);
    let (column, row) = (cell % columns, cell / columns);
    if column == 0 || row == 0 || column + 1 == columns || row + 1 == rows {
        return 0.0;
    }
    let values = &smooth.values;
    let rise = (values[cell + 1] - values[cell - 1]).hypot(values[cell + columns] - values[cell - columns]) / 2.0;
    if rise.is_finite() { rise } else { 0.0 }
}

/// The median height of what rises above a level and was measured, mm.
fn middle_mm(relief: &Relief, level: f32) -> Option<f32> {
    let mut heights: Vec<f32> = relief.above(level).map(|c| relief.measured(c)).filter(|h| h.is_finite()).collect();
    let middle = heights.len() / 2;
    (!heights.is_empty()).then(|| *heights.select_nth_unstable_by(middle, f32::total_cmp).1)
}

/// The middle of what rises above a level, weighted by its height: column and row.
fn centre(relief: &Relief, level: f32) -> (f64, f64) {
    let (mut sum, mut x, mut y) = (1e-12, 0.0, 0.0);
    for cell in relief.above(level) {
        let weight = f64::from(relief.height(cell));
        sum += weight;
        x += weight * (cell % relief.columns) as f64;
        y += weight * (cell / relief.columns) as f64;
    }
    (x / sum, y / sum)
}

/// The cells that make a region's figures: what hangs together with the summit and lies no farther from the upper half's
/// middle than its rim would.
fn body(relief: &Relief, top: f32) -> Vec<usize> {
    let upper = connected(relief, 0.5 * top);
    let count = upper.len() as f64;
    let (x, y) =
        upper.iter().map(|c| relief.beside_summit(*c)).fold((0.0, 0.0), |sum, at| (sum.0 + at.0, sum.1 + at.1));
    let Some((wide, high)) = extents(upper.into_iter(), relief.columns) else { return Vec::new() };
    let (reach_x, reach_y) = (REACH * wide as f64 + 1.0, REACH * high as f64 + 1.0);
    let mut cells = connected(relief, BODY_LEVEL * top);
    cells.retain(|cell| {
        let at = relief.beside_summit(*cell);
        (at.0 - x / count).abs() <= reach_x && (at.1 - y / count).abs() <= reach_y
    });
    cells
}

/// The cells above a level that hang together with the summit.
fn connected(relief: &Relief, level: f32) -> Vec<usize> {
    let columns = relief.columns;
    let mut waiting: HashSet<usize> = relief.above(level).collect();
    let mut found = vec![relief.region.summit];
    waiting.remove(&relief.region.summit);
    let mut done = 0;
    while let Some(cell) = found.get(done).copied() {
        done += 1;
        let (left, right) = (cell % columns > 0, cell % columns + 1 < columns);
        let beside = [
            (cell >= columns).then(|| cell - columns),
            Some(cell + columns),
            left.then(|| cell - 1),
            right.then(|| cell + 1),
        ];
        found.extend(beside.into_iter().flatten().filter(|next| waiting.remove(next)));
    }
    found
}

/// Columns and rows that the cells span.
fn extents(cells: impl Iterator<Item = usize>, columns: usize) -> Option<(usize, usize)> {
    let mut spans: Option<[usize; 4]> = None;
    for (column, row) in cells.map(|cell| (cell % columns, cell / columns)) {
        let [left, right, top, bottom] = spans.unwrap_or([column, column, row, row]);
        spans = Some([left.min(column), right.max(column), top.min(row), bottom.max(row)]);
    }
    spans.map(|[left, right, top, bottom]| (right - left + 1, bottom - top + 1))
}

/// Whether the region's body reaches the edge of what was seen.
fn at_edge(stretch: &Stretch, body: &[usize]) -> bool {
    let reach = SMOOTHING_CELLS.ceil() as usize + 1;
    let (columns, rows) = (stretch.smooth.columns, stretch.smooth.rows);
    body.iter().any(|cell| {
        let (column, row) = (cell % columns, cell / columns);
        let outside = |column: Option<usize>, row: Option<usize>| match (column, row) {
            (Some(c), Some(r)) if c < columns && r < rows => stretch.smooth.values[r * columns + c].is_nan(),
            _ => true,
        };
        outside(column.checked_sub(reach), Some(row))
            || outside(Some(column + reach), Some(row))
            || outside(Some(column), row.checked_sub(reach))
            || outside(Some(column), Some(row + reach))
    })
}

fn kind(depth_mm: f64, flat: bool, options: &DefectOptions) -> DefectKind {
    match (depth_mm > 0.0, flat) {
        (true, _) if depth_mm >= options.hole_depth_mm && flat => DefectKind::Hole,
        (true, true) => DefectKind::MissingMaterial,
        (true, false) => DefectKind::Dent,
        (false, true) => DefectKind::Step,
        (false, false) => DefectKind::Bulge,
    }
}

/// Clock position of a place on a pipe, hours; `view_clock_h` 0 takes the camera to look level.
pub(super) fn clock_h(reference: &Reference, x_mm: f64, y_mm: f64, falls: bool, view_clock_h: f64) -> Option<f64> {
    let Shape::Cylinder { radius_mm, from_outside } = reference.shape else { return None };
    // Seen along the rising chainage: a level camera that looks to the left sees the wall at 9 o'clock from inside, the
    // pipe's own 3 o'clock from outside.
    let left = from_outside == falls;
    let view = match view_clock_h {
        hour if hour > 0.0 => hour,
        _ if left => 9.0,
        _ => 3.0,
    };
    let share = ((y_mm - reference.axis_y_mm(x_mm)) / radius_mm).clamp(-1.0, 1.0);
    let below_h = share.asin().to_degrees() / 30.0;
    let hour = (view + if left { -below_h } else { below_h }).rem_euclid(12.0);
    Some(if hour <= 0.0 { 12.0 } else { hour })
}
