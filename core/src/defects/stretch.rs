//! One stretch of the map: deviation from the undamaged shape, its regions, its sections.
//!
//! What is undamaged is not known before the defects are, and the other way round: a robust background shows the first
//! regions, a background that leaves these out shows them better, and once more.

use super::background::{plate, refined, robust_plate, stiffness};
use super::cells::{CellGrid, Field};
use super::doubt::Doubt;
use super::form::Blur;
use super::joint::{Measured, measure_together};
use super::measure::{Stretch, least_cells};
use super::noise::Noise;
use super::reference::{Place, Reference, Shape, fit};
use super::regions::{self, Region};
use super::section::Station;
use super::{Defect, SMOOTHING_CELLS, Sampling, SectionRow};
use crate::recipe::DefectOptions;

/// Fine cells to a side of a coarse one, on which the background is fitted.
pub(super) const COARSE: usize = 10;
/// Share of a coarse cell's fine ones that must be measured.
pub(super) const COARSE_SHARE: f32 = 0.3;
/// How much longer waves the first, robust background follows than the later ones.
pub(super) const FIRST_LENGTH: f64 = 4.0;
/// Searches with a background that leaves the regions out.
pub(super) const ROUNDS: usize = 2;
/// Widest gap that a region may continue over, mm.
const BRIDGE_MM: f64 = 25.0;
/// Cells beside a gap that are not searched, and as many image rows at least: what makes a gap, such as a highlight,
/// disturbs its neighbours; and further ones on which alone no defect is believed.
const GAP_CELLS: usize = 2;
const GAP_ROWS: f64 = 4.0;
const DOUBT_CELLS: usize = 3;
const DOUBT_ROWS: f64 = 6.0;
/// Least of the smoothing's weight that must be measured.
pub(super) const SMOOTH_SHARE: f32 = 0.3;
/// A spot's place is told by the line's two flanks, as far as this share of its width from the middle, and by samples a
/// pixel apart: a surface that bends shows the mean of them. Measured against the true second derivatives of 200
/// simulated dents at five distances and image sizes, as the share of a profile's distance below.
const FLANK_WIDTHS: f64 = 0.35;
const FLANK_PIXELS: f64 = 1.45;
/// Standard deviation of the smoothing along the line where it bends, in rows: with it the depths of 250 simulated dents of 20
/// to 45 mm radius are right in the mean to half a percent; at 640 × 360 those of less than 28 mm to 2 %.
const LINE_SMOOTHING_ROWS: f64 = 2.1;
/// Between two profiles the surface is nearly straight: this share of the square of their distance.
const STRAIGHT_SHARE: f64 = 1.0 / 7.0;
/// Least scatter of coarse cells that is believed, mm.
pub(super) const LEAST_SCATTER_MM: f32 = 0.03;

/// Where and with what a stretch is examined.
pub(super) struct Task<'a> {
    pub grid: &'a CellGrid,
    pub options: &'a DefectOptions,
    pub shape: Shape,
    /// Length of the waves that belong to the undamaged surface, mm.
    pub wave_mm: f64,
    pub sampling: Sampling,
    /// The columns that are read, and the part of them that this stretch answers for.
    pub columns: std::ops::Range<usize>,
    pub core: std::ops::Range<usize>,
}

/// Least height that a search lists.
#[derive(Clone, Copy, Debug)]
pub(super) struct Threshold {
    /// In the median row, mm.
    pub typical_mm: f64,
    /// In a row that nine of ten do not exceed, mm.
    pub bad_mm: f64,
}

impl Threshold {
    fn of(rows_mm: &[f32]) -> Threshold {
        Threshold { typical_mm: quantile(rows_mm, 0.5), bad_mm: quantile(rows_mm, 0.9) }
    }
}

/// What a stretch shows.
pub(super) struct Examined {
    /// Defects whose middle lies in the core, and those of the whole stretch that were too little seen.
    pub defects: Vec<Defect>,
    pub doubtful: usize,
    pub sections: Vec<SectionRow>,
    /// Deviation from the undamaged shape in the core's columns, mm.
    pub residual: Field,
    pub inspected_cells: usize,
    /// What the first and the last search listed.
    pub first: Threshold,
    pub last: Threshold,
    pub noise_mm: f64,
}

/// Examines a stretch; `depth` is its world z in cells. `None` where too little was measured.
pub(super) fn examine(task: &Task, depth: &Field, doubt: &Doubt) -> Option<Examined> {
    let (grid, options) = (task.grid, task.options);
    let reference = fit(task.shape, &places(task, depth))?;
    let mut deviation = deviation(task, &reference, depth);
    let (gap, doubted) = gap_cells(&task.sampling, grid.cell_mm);
    let untouched = near_gaps(&deviation, gap);
    deviation.values.iter_mut().zip(untouched).filter(|(_, near)| *near).for_each(|(v, _)| *v = f32::NAN);
    let mut frail = near_gaps(&deviation, gap + doubted);
    // What was left out for doubt is no gap: its neighbours have doubts of their own, or none.
    doubt.leave_out(&mut deviation, &mut frail);
    let coarse = deviation.shrunk(COARSE, COARSE_SHARE);
    let wave_cells = task.wave_mm / (grid.cell_mm * COARSE as f64);
    let mut background = robust_plate(&coarse, stiffness(FIRST_LENGTH * wave_cells), LEAST_SCATTER_MM);
    let mut search = Search::of(task, &deviation, &background, None);
    let first = Threshold::of(&search.thresholds_mm);
    for _ in 0..ROUNDS {
        let masked = masked(&coarse, &search.regions, &search.smooth);
        // What it found is no longer needed, and takes as much as what follows.
        drop(search);
        let weights: Vec<f32> =
            coarse.values.iter().zip(&masked).map(|(v, m)| if v.is_finite() && !m { 1.0 } else { 0.0 }).collect();
        background = plate(&coarse, &weights, stiffness(wave_cells));
        search = Search::of(task, &deviation, &background, Some(&masked));
    }
    let Search { off, smooth, noise, thresholds_mm, regions, free } = search;
    let mut taken = vec![false; smooth.values.len()];
    regions.iter().flat_map(|region| &region.cells).for_each(|cell| taken[*cell] = true);
    let stretch = Stretch {
        grid,
        first_column: task.columns.start,
        reference: &reference,
        deviation: &off,
        smooth: &smooth,
        frail: &frail,
        thresholds_mm: &thresholds_mm,
        noise_mm: &noise.rows_mm,
        taken: &taken,
        wave_mm: task.wave_mm,
        slack: None,
        blur: blur(&task.sampling, grid.cell_mm),
        profile_step_mm: task.sampling.profile_step_mm,
    };
    let Measured { defects, doubtful } = measure_together(&stretch, &regions, options, true);
    let (x_from, x_to) = (grid.x_mm(task.core.start as f64 - 0.5), grid.x_mm(task.core.end as f64 - 0.5));
    let slack_mm = 3.0 * grid.cell_mm;
    let mine = |d: &Defect| d.x_mm >= x_from - slack_mm && d.x_mm <= x_to + slack_mm;
    let last = Threshold::of(&thresholds_mm);
    let residual = core_of(task, &off);
    Some(Examined {
        defects: defects.into_iter().filter(mine).map(|d| placed(d, &reference, options)).collect(),
        doubtful,
        sections: sections(task, depth, &off, &smooth, &free, &reference),
        inspected_cells: residual.values.iter().filter(|z| z.is_finite()).count(),
        residual,
        first,
        last,
        noise_mm: f64::from(noise.quantile_mm(0.5)),
    })
}

/// One search: the deviation from a background, and its regions.
struct Search {
    off: Field,
    smooth: Field,
    noise: Noise,
    thresholds_mm: Vec<f32>,
    regions: Vec<Region>,
    free: Vec<bool>,
}

impl Search {
    fn of(task: &Task, deviation: &Field, background: &Field, masked: Option<&[bool]>) -> Search {
        let mut off = refined(background, COARSE, deviation.columns, deviation.rows);
        off.values.iter_mut().zip(&deviation.values).for_each(|(b, v)| *b = v - *b);
        let mut smooth = off.smoothed(SMOOTHING_CELLS, SMOOTH_SHARE);
        let free = free(&off, masked);
        let noise = Noise::of(&smooth, &free, masked.is_some());
        let options = task.options;
        let threshold = |sigma: &f32| (options.noise_factor as f32 * sigma).max(options.depth_min_mm as f32);
        let thresholds_mm: Vec<f32> = noise.rows_mm.iter().map(threshold).collect();
        bridge(&mut smooth, (BRIDGE_MM / task.grid.cell_mm) as usize);
        let least = least_cells(options, task.grid.cell_mm);
        let mut regions = regions::find(&smooth, &thresholds_mm);
        regions.retain(|region| region.cells.len() > least);
        Search { off, smooth, noise, thresholds_mm, regions, free }
    }
}

/// Cells beside a gap that are not searched, and that are doubted.
pub(super) fn gap_cells(sampling: &Sampling, cell_mm: f64) -> (usize, usize) {
    let rows = |rows: f64| (rows * sampling.line_step_mm / cell_mm).round() as usize;
    (GAP_CELLS.max(rows(GAP_ROWS)), DOUBT_CELLS.max(rows(DOUBT_ROWS)))
}

/// What blurs the surface on its way into the map, in cells along columns and rows.
pub(super) fn blur(sampling: &Sampling, cell_mm: f64) -> Blur {
    // The mean over a cell.
    let cell = cell_mm * cell_mm / 12.0;
    let flanks = (FLANK_WIDTHS * sampling.line_width_mm).powi(2) + (FLANK_PIXELS * sampling.line_step_mm).powi(2);
    let along = STRAIGHT_SHARE * sampling.profile_step_mm.powi(2) + flanks + cell;
    let across = (LINE_SMOOTHING_ROWS * sampling.line_step_mm).powi(2) + cell;
    (along.sqrt() / cell_mm, across.sqrt() / cell_mm)
}

/// Cells that were measured and lie in no masked coarse cell.
pub(super) fn free(field: &Field, masked: Option<&[bool]>) -> Vec<bool> {
    let coarse_columns = field.columns.div_ceil(COARSE);
    let mut free: Vec<bool> = field.values.iter().map(|v| v.is_finite()).collect();
    let Some(masked) = masked else { return free };
    for (row, line) in free.chunks_exact_mut(field.columns).enumerate() {
        let coarse = &masked[row / COARSE * coarse_columns..][..coarse_columns];
        for (cells, masked) in line.chunks_mut(COARSE).zip(coarse) {
            cells.iter_mut().for_each(|free| *free &= !masked);
        }
    }
    free
}

fn quantile(values: &[f32], share: f64) -> f64 {
    let mut values = values.to_vec();
    let at = ((values.len().max(1) - 1) as f64 * share) as usize;
    if values.is_empty() { 0.0 } else { f64::from(*values.select_nth_unstable_by(at, f32::total_cmp).1) }
}

/// Coarse places for the fit of the shape.
fn places(task: &Task, depth: &Field) -> Vec<Place> {
    let coarse = depth.shrunk(COARSE, COARSE_SHARE);
    let middle = (COARSE - 1) as f64 / 2.0;
    let place = |(i, z): (usize, &f32)| {
        let (column, row) =
            ((i % coarse.columns * COARSE) as f64 + middle, (i / coarse.columns * COARSE) as f64 + middle);
        Place {
            x_mm: task.grid.x_mm(task.columns.start as f64 + column),
            y_mm: task.grid.y_mm(row),
            z_mm: f64::from(*z),
        }
    };
    coarse.values.iter().enumerate().filter(|(_, z)| z.is_finite()).map(place).collect()
}

fn deviation(task: &Task, reference: &Reference, depth: &Field) -> Field {
    let mut deviation = depth.clone();
    let columns = deviation.columns;
    for (row, line) in deviation.values.chunks_exact_mut(columns).enumerate() {
        let y_mm = task.grid.y_mm(row as f64);
        for (column, value) in line.iter_mut().enumerate().filter(|(_, v)| v.is_finite()) {
            let x_mm = task.grid.x_mm((task.columns.start + column) as f64);
            *value = (f64::from(*value) - reference.z_mm(x_mm, y_mm)) as f32;
        }
    }
    deviation
}

/// Coarse cells that a region covers, out to its rim.
pub(super) fn masked(coarse: &Field, regions: &[Region], smooth: &Field) -> Vec<bool> {
    let mut masked = vec![false; coarse.values.len()];
    for region in regions {
        let height = |cell: usize| region.sign * smooth.values[cell];
        let foot = region.cells.iter().map(|c| height(*c)).fold(f32::INFINITY, f32::min).max(0.0);
        let share = (foot / height(region.summit)).clamp(0.0, 0.9);
        // The flank of a raised cosine: how far the rim lies beyond the lowest cell, in radii of what is there.
        let reached = share.sqrt().acos() / std::f32::consts::FRAC_PI_2;
        let radius = (region.cells.len() as f32 / std::f32::consts::PI).sqrt();
        let grow = ((radius * (1.0 / reached - 1.0)) / COARSE as f32).round().clamp(0.0, 3.0) as usize;
        for cell in &region.cells {
            let (column, row) = (cell % smooth.columns / COARSE, cell / smooth.columns / COARSE);
            for r in row.saturating_sub(grow)..(row + grow + 1).min(coarse.rows) {
                let line = r * coarse.columns;
                let (from, to) = (column.saturating_sub(grow), (column + grow + 1).min(coarse.columns));
                masked[line + from..line + to].fill(true);
            }
        }
    }
    masked
}

/// Cells within `cells` of a place that was not measured.
pub(super) fn near_gaps(deviation: &Field, cells: usize) -> Vec<bool> {
    let weights = deviation.known_weight(SMOOTHING_CELLS);
    let (columns, rows) = (deviation.columns, deviation.rows);
    let mut along = vec![false; weights.len()];
    // The smoothing reaches a cell into the gap.
    let reach = cells + SMOOTHING_CELLS as usize;
    for row in 0..rows {
        let line = &weights[row * columns..(row + 1) * columns];
        for column in (0..columns).filter(|c| line[*c] < SMOOTH_SHARE) {
            let (from, to) = (column.saturating_sub(reach), (column + reach + 1).min(columns));
            along[row * columns + from..row * columns + to].fill(true);
        }
    }
    let mut near = along.clone();
    for row in 0..rows {
        for other in row.saturating_sub(reach)..(row + reach + 1).min(rows) {
            if other != row {
                for column in 0..columns {
                    near[row * columns + column] |= along[other * columns + column];
                }
            }
        }
    }
    near
}

/// Continues the surface straight across narrow gaps along each column: a highlight does not cut a defect in two.
pub(super) fn bridge(smooth: &mut Field, widest: usize) {
    let (columns, rows) = (smooth.columns, smooth.rows);
    for column in 0..columns {
        let mut last: Option<usize> = None;
        for row in 0..rows {
            let value = smooth.values[row * columns + column];
            if value.is_nan() {
                continue;
            }
            if let Some(before) = last.filter(|before| row - before > 1 && row - before <= widest) {
                let start = smooth.values[before * columns + column];
                for between in before + 1..row {
                    let share = (between - before) as f32 / (row - before) as f32;
                    smooth.values[between * columns + column] = start + share * (value - start);
                }
            }
            last = Some(row);
        }
    }
}

/// The core's columns of a field over the whole stretch.
fn core_of(task: &Task, field: &Field) -> Field {
    let (from, columns) = (task.core.start - task.columns.start, task.core.len());
    let values =
        field.values.chunks_exact(field.columns).flat_map(|line| &line[from..from + columns]).copied().collect();
    Field { columns, rows: field.rows, values }
}

fn placed(mut defect: Defect, reference: &Reference, options: &DefectOptions) -> Defect {
    // The direction of the chainage is the caller's to say: clocks are turned there.
    defect.clock_h = super::measure::clock_h(reference, defect.x_mm, defect.y_mm, false, options.view_clock_h);
    if defect.clock_h.is_none() {
        defect.height_mm = Some(-defect.y_mm);
    }
    defect
}

fn sections(
    task: &Task,
    depth: &Field,
    deviation: &Field,
    smooth: &Field,
    free: &[bool],
    reference: &Reference,
) -> Vec<SectionRow> {
    let step = ((task.options.section_step_mm / task.grid.cell_mm).round() as usize).max(COARSE);
    let stations = task.core.start.div_ceil(step)..task.core.end.div_ceil(step);
    stations
        .filter_map(|station| {
            let from = station * step - task.columns.start;
            let to = (from + step).min(depth.columns);
            (to > from + step / 2).then_some((from, to))
        })
        .filter_map(|(from, to)| {
            let station = Station {
                grid: task.grid,
                first_column: task.columns.start,
                from,
                to,
                depth,
                deviation,
                smooth,
                free,
                reference,
                factor: COARSE / 2,
                nominal_radius_mm: task.options.nominal_radius_mm,
            };
            station.measure()
        })
        .collect()
}
