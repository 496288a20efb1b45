//! Two runs along the same asset → what has changed between them.
//!
//! Both runs give their residual maps ([`super::find`]): what lies between each surface and its undamaged shape, so that
//! different poses do not matter. They are registered by chainage first, then by the surfaces' own relief, window by
//! window. A change is claimed only where the difference exceeds what both runs scatter and what the registration leaves
//! on slopes (in the manner of M3C2, Lague and others 2013, with the scatter measured on the difference itself).

use serde::{Deserialize, Serialize};

use super::background::{plate, refined, robust_plate, stiffness};
use super::cells::Field;
use super::joint::measure_together;
use super::measure::Stretch;
use super::noise::Noise;
use super::reference::Reference;
use super::regions;
use super::register::{Registration, register};
use super::stretch::{self, COARSE, FIRST_LENGTH};
use super::{CellGrid, Defect, DefectList, ResidualStrip, SMOOTHING_CELLS, Sampling, turned};
use crate::depth_map::MapReader;
use crate::error::Result;
use crate::recipe::DefectOptions;

/// Version of the shape of `change.json`.
pub const SCHEMA_VERSION: u32 = 1;

/// Smoothing of the difference before the search, cells: what two runs do not share is mostly fine.
const CHANGE_SMOOTHING_CELLS: f32 = 1.8;
/// Standard deviations of the level of detection: 95 % of what does not change stays below.
const LEVEL_SIGMAS: f64 = 1.96;

/// One of two runs: its residual map and its list.
pub struct Run<'a> {
    /// The residual map, as `residual.tif` holds it.
    pub residual: &'a mut dyn MapReader,
    /// Its defects.
    pub list: &'a DefectList,
}

/// What became of a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ChangeState {
    /// A defect that the earlier run did not have.
    New,
    /// A defect that became deeper or higher.
    Grown,
    /// A defect that became shallower or lower.
    Shrunk,
    /// A defect that the later run does not have.
    Vanished,
    /// The surface changed where neither run lists a defect.
    Changed,
}

/// One place that changed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Change {
    /// From 1, in the order of the earlier run's chainage.
    pub id: u32,
    /// What became of it.
    pub state: ChangeState,
    /// Chainage of its middle by the earlier run, mm.
    pub chainage_mm: f64,
    /// World x and y of its middle in the earlier run, mm.
    pub x_mm: f64,
    /// See `x_mm`.
    pub y_mm: f64,
    /// Clock position, on a pipe, h.
    pub clock_h: Option<f64>,
    /// Height, on a wall, mm.
    pub height_mm: Option<f64>,
    /// Greatest change along z, mm: above 0 away from the camera.
    pub delta_depth_mm: f64,
    /// Its standard deviation, mm.
    #[serde(default)]
    pub delta_sd_mm: f64,
    /// Area of the change, mm².
    pub area_mm2: f64,
    /// Volume of the change, mm³.
    pub volume_mm3: f64,
    /// How sure it is, 0 to 1.
    pub confidence: f64,
    /// The defect in the earlier run's list, and its depth there, mm.
    pub before_id: Option<u32>,
    /// See `before_id`.
    pub before_depth_mm: Option<f64>,
    /// The defect in the later run's list, and its depth there, mm.
    pub after_id: Option<u32>,
    /// See `after_id`.
    pub after_depth_mm: Option<f64>,
}

/// The same defect in both runs, without a change that could be told.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SameDefect {
    /// In the earlier run's list.
    pub before_id: u32,
    /// In the later run's list.
    pub after_id: u32,
    /// Difference of the two lists' depths, mm; below what could be told.
    pub delta_depth_mm: f64,
}

/// How the two runs were laid on each other.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RegistrationReport {
    /// Later run's x less the earlier run's at the same place, beyond what the chainages say: median, mm.
    pub offset_x_mm: f64,
    /// The same for y, mm.
    pub offset_y_mm: f64,
    /// Standard deviation of what is left between neighbouring windows along x, mm.
    pub sd_x_mm: f64,
    /// The same along y, mm.
    pub sd_y_mm: f64,
    /// Windows that were tried.
    pub windows: usize,
    /// Windows whose relief agreed.
    pub windows_agreeing: usize,
}

/// `change.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChangeList {
    /// [`SCHEMA_VERSION`].
    pub schema_version: u32,
    /// How the runs were laid on each other.
    pub registration: RegistrationReport,
    /// 95 % of an unchanged, even surface differs by less, mm.
    pub level_of_detection_mm: f64,
    /// Changes are claimed from this difference on, on an even surface in a typical row, mm.
    pub claimed_from_mm: f64,
    /// Area that both runs measured, mm².
    pub compared_area_mm2: f64,
    /// What changed.
    pub changes: Vec<Change>,
    /// Defects of both runs that did not.
    pub unchanged: Vec<SameDefect>,
    /// Defects of the earlier run's list without a partner and without a change that could be told: near the limit of
    /// what can be seen, or where the later run measured nothing.
    pub unsure_before: Vec<u32>,
    /// The same of the later run's list.
    pub unsure_after: Vec<u32>,
}

/// Compares two runs, also such as went opposite ways; `take` gets the difference map (later less earlier, in the earlier run's cells) strip by strip.
///
/// # Errors
/// Runs whose relief does not agree anywhere; what reading the maps or `take` says.
pub fn compare(
    before: &mut Run,
    after: &mut Run,
    options: &DefectOptions,
    take: &mut dyn FnMut(&ResidualStrip) -> Result<()>,
) -> Result<ChangeList> {
    if before.list.chainage_falls != after.list.chainage_falls {
        let list = turned::turned(after.list);
        let mut residual = turned::TurnedMap { map: after.residual };
        return compare(before, &mut Run { residual: &mut residual, list: &list }, options, take);
    }
    let shift_mm = match before.list.chainage_falls {
        false => before.list.start_chainage_mm - after.list.start_chainage_mm,
        true => after.list.start_chainage_mm - before.list.start_chainage_mm,
    };
    let (grid, other) =
        (CellGrid::of_cells(&before.residual.geometry()), CellGrid::of_cells(&after.residual.geometry()));
    let noise_mm = before.list.noise_mm.max(after.list.noise_mm) as f32;
    let registration = register(&grid, before.residual, &other, after.residual, shift_mm, noise_mm)?;
    let mut found = Vec::new();
    let mut thresholds = Vec::new();
    let mut compared = 0_usize;
    let sampling = Sampling {
        profile_step_mm: before.list.profile_step_mm.max(after.list.profile_step_mm),
        line_step_mm: before.list.line_step_mm.max(after.list.line_step_mm),
        line_width_mm: before.list.line_width_mm.max(after.list.line_width_mm),
    };
    for (core, columns) in grid.stretches() {
        let earlier = grid.read(before.residual, columns.start, columns.len())?;
        let later = registration.read(&grid, &columns, &other, after.residual)?;
        let stretch =
            Difference::new(&grid, columns, (&earlier, &later), before.list, sampling, registration.sd_mm(), options);
        take(&ResidualStrip {
            origin_mm: (grid.x0_mm, grid.y0_mm),
            cell_mm: grid.cell_mm,
            first_column: core.start,
            columns: core.len(),
            values_mm: &stretch.core(&core),
        })?;
        compared += stretch.core(&core).iter().filter(|v| v.is_finite()).count();
        thresholds.push((stretch.typical_mm(), stretch.search.noise.quantile_mm(0.5)));
        found.extend(stretch.changes(&grid, &core, options));
    }
    thresholds.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (claimed, noise) = thresholds.last().copied().unwrap_or_default();
    let mut list = ChangeList {
        schema_version: SCHEMA_VERSION,
        registration: registration.report(shift_mm),
        level_of_detection_mm: LEVEL_SIGMAS * f64::from(noise),
        claimed_from_mm: f64::from(claimed),
        compared_area_mm2: compared as f64 * grid.cell_mm * grid.cell_mm,
        changes: Vec::new(),
        unchanged: Vec::new(),
        unsure_before: Vec::new(),
        unsure_after: Vec::new(),
    };
    identify(&mut list, &found, before.list, after.list, &registration);
    Ok(list)
}

/// The difference of a stretch.
struct Difference {
    columns: std::ops::Range<usize>,
    search: Search,
    frail: Vec<bool>,
    wave_mm: f64,
    /// The sparser of both runs'.
    sampling: Sampling,
}

/// The difference from a background, and what stands out of it.
struct Search {
    /// Later less earlier, without the slow part, mm.
    off: Field,
    smooth: Field,
    /// How much more uncertain a cell is than an even one, for the registration's sake.
    slack: Vec<f32>,
    noise: Noise,
    thresholds_mm: Vec<f32>,
    regions: Vec<regions::Region>,
}

impl Search {
    /// The difference from a background, and its regions on the scale of an even surface.
    fn against(
        raw: &Field,
        background: &Field,
        slopes: &[f32],
        sd_mm: f64,
        options: &DefectOptions,
        masked: Option<&[bool]>,
    ) -> Search {
        let fine = refined(background, COARSE, raw.columns, raw.rows);
        let mut off = raw.clone();
        off.values.iter_mut().zip(&fine.values).for_each(|(v, b)| *v -= b);
        let smooth = off.smoothed(CHANGE_SMOOTHING_CELLS, stretch::SMOOTH_SHARE);
        let free = stretch::free(&off, masked);
        // The even surface's own scatter first: slopes are not it.
        let even: Vec<bool> = free.iter().zip(slopes).map(|(free, slope)| *free && *slope < EVEN_SLOPE).collect();
        let typical = Noise::of(&smooth, &even, false).all_mm;
        let slack: Vec<f32> = slopes.iter().map(|slope| 1.0_f32.hypot(slope * sd_mm as f32 / typical)).collect();
        let mut even = smooth.clone();
        even.values.iter_mut().zip(&slack).for_each(|(v, s)| *v /= s);
        let noise = Noise::of(&even, &free, masked.is_some());
        let threshold = |sigma: &f32| (options.noise_factor as f32 * sigma).max(options.depth_min_mm as f32);
        let thresholds_mm: Vec<f32> = noise.rows_mm.iter().map(threshold).collect();
        let regions = regions::find(&even, &thresholds_mm);
        Search { off, smooth, slack, noise, thresholds_mm, regions }
    }
}

impl Difference {
    fn new(
        grid: &CellGrid,
        columns: std::ops::Range<usize>,
        (earlier, later): (&Field, &Field),
        list: &DefectList,
        sampling: Sampling,
        sd_mm: f64,
        options: &DefectOptions,
    ) -> Difference {
        let mut raw = later.clone();
        raw.values.iter_mut().zip(&earlier.values).for_each(|(l, e)| *l -= e);
        let (gap, doubted) = stretch::gap_cells(&sampling, grid.cell_mm);
        let untouched = stretch::near_gaps(&raw, gap);
        raw.values.iter_mut().zip(untouched).filter(|(_, near)| *near).for_each(|(v, _)| *v = f32::NAN);
        let frail = stretch::near_gaps(&raw, doubted);
        let coarse = raw.shrunk(COARSE, stretch::COARSE_SHARE);
        let wave_mm = list.reference.wave_mm;
        let wave_cells = wave_mm / (grid.cell_mm * COARSE as f64);
        let slopes = steepness(earlier, later, grid.cell_mm as f32);
        let mut background = robust_plate(&coarse, stiffness(FIRST_LENGTH * wave_cells), stretch::LEAST_SCATTER_MM);
        let mut search = Search::against(&raw, &background, &slopes, sd_mm, options, None);
        for _ in 0..stretch::ROUNDS {
            let masked = stretch::masked(&coarse, &search.regions, &search.smooth);
            let weights: Vec<f32> =
                coarse.values.iter().zip(&masked).map(|(v, m)| if v.is_finite() && !m { 1.0 } else { 0.0 }).collect();
            background = plate(&coarse, &weights, stiffness(wave_cells));
            search = Search::against(&raw, &background, &slopes, sd_mm, options, Some(&masked));
        }
        Difference { columns, search, frail, wave_mm, sampling }
    }

    fn core(&self, core: &std::ops::Range<usize>) -> Vec<f32> {
        let (from, columns) = (core.start - self.columns.start, core.len());
        self.search
            .off
            .values
            .chunks_exact(self.search.off.columns)
            .flat_map(|line| &line[from..from + columns])
            .copied()
            .collect()
    }

    fn typical_mm(&self) -> f32 {
        let mut rows = self.search.thresholds_mm.clone();
        let middle = rows.len() / 2;
        *rows.select_nth_unstable_by(middle, f32::total_cmp).1
    }

    /// The changes whose middle lies in the core's columns.
    fn changes(&self, grid: &CellGrid, core: &std::ops::Range<usize>, options: &DefectOptions) -> Vec<Defect> {
        let mut taken = vec![false; self.search.smooth.values.len()];
        self.search.regions.iter().flat_map(|region| &region.cells).for_each(|cell| taken[*cell] = true);
        let reference = Reference::flat();
        let (x_from, x_to) = (grid.x_mm(core.start as f64 - 0.5), grid.x_mm(core.end as f64 - 0.5));
        let stretch = Stretch {
            grid,
            first_column: self.columns.start,
            reference: &reference,
            deviation: &self.search.off,
            smooth: &self.search.smooth,
            frail: &self.frail,
            thresholds_mm: &self.search.thresholds_mm,
            noise_mm: &self.search.noise.rows_mm,
            taken: &taken,
            wave_mm: self.wave_mm,
            // On a slope the threshold is higher.
            slack: Some(&self.search.slack),
            blur: stretch::blur(&self.sampling, grid.cell_mm),
            profile_step_mm: self.sampling.profile_step_mm,
        };
        let found = measure_together(&stretch, &self.search.regions, options, false).defects.into_iter();
        found.filter(|d| d.x_mm >= x_from && d.x_mm < x_to).collect()
    }
}

/// A surface is even where it rises by less.
const EVEN_SLOPE: f32 = 0.05;

/// The steeper of two surfaces at each cell, as a slope.
fn steepness(earlier: &Field, later: &Field, cell_mm: f32) -> Vec<f32> {
    let (a, b) = (earlier.smoothed(SMOOTHING_CELLS, 0.3), later.smoothed(SMOOTHING_CELLS, 0.3));
    let slope = |field: &Field, cell: usize| super::measure::rise(field, cell) / cell_mm;
    (0..a.values.len()).map(|cell| slope(&a, cell).max(slope(&b, cell))).collect()
}

/// Joins changes and the two lists: which defect it is that changed.
fn identify(
    list: &mut ChangeList,
    found: &[Defect],
    before: &DefectList,
    after: &DefectList,
    registration: &Registration,
) {
    // The later run's defects in the earlier run's world.
    let moved: Vec<Defect> = after
        .defects
        .iter()
        .map(|defect| {
            let (dx, dy) = registration.offset_mm(defect.x_mm - registration.typical_mm().0);
            Defect { x_mm: defect.x_mm - dx, y_mm: defect.y_mm - dy, ..defect.clone() }
        })
        .collect();
    let partner = |place: &Defect, among: &[Defect]| -> Option<usize> {
        let near = among.iter().enumerate().map(|(i, d)| {
            let reach = 0.5 * f64::max(0.5 * (d.length_mm + d.width_mm), 0.5 * (place.length_mm + place.width_mm));
            (i, (d.x_mm - place.x_mm).hypot(d.y_mm - place.y_mm) / reach)
        });
        near.filter(|(_, share)| *share < 1.0).min_by(|a, b| a.1.total_cmp(&b.1)).map(|(i, _)| i)
    };
    let mut changed_before = vec![false; before.defects.len()];
    let mut changed_after = vec![false; after.defects.len()];
    let mut changes: Vec<Change> = found
        .iter()
        .map(|change| {
            let (a, b) = (partner(change, &before.defects), partner(change, &moved));
            a.into_iter().for_each(|i| changed_before[i] = true);
            b.into_iter().for_each(|i| changed_after[i] = true);
            let (a, b) = (a.map(|i| &before.defects[i]), b.map(|i| &after.defects[i]));
            let state = match (a, b) {
                (Some(a), Some(_)) if (a.depth_mm > 0.0) == (change.depth_mm > 0.0) => ChangeState::Grown,
                (Some(_), Some(_)) => ChangeState::Shrunk,
                (None, Some(_)) => ChangeState::New,
                (Some(_), None) => ChangeState::Vanished,
                (None, None) => ChangeState::Changed,
            };
            let falls = before.chainage_falls;
            let named = a.or(b);
            Change {
                id: 0,
                state,
                chainage_mm: before.start_chainage_mm + if falls { -change.x_mm } else { change.x_mm },
                x_mm: change.x_mm,
                y_mm: change.y_mm,
                clock_h: named.and_then(|d| d.clock_h),
                height_mm: (before.reference.radius_mm.is_none()).then_some(-change.y_mm),
                delta_depth_mm: change.depth_mm,
                delta_sd_mm: change.depth_sd_mm,
                area_mm2: change.area_mm2,
                volume_mm3: change.volume_mm3,
                confidence: change.confidence,
                before_id: a.map(|d| d.id),
                before_depth_mm: a.map(|d| d.depth_mm),
                after_id: b.map(|d| d.id),
                after_depth_mm: b.map(|d| d.depth_mm),
            }
        })
        .collect();
    changes.sort_by(|a, b| a.chainage_mm.total_cmp(&b.chainage_mm));
    (1..).zip(&mut changes).for_each(|(id, change)| change.id = id);
    list.changes = changes;
    let mut met = vec![false; after.defects.len()];
    for (i, defect) in before.defects.iter().enumerate().filter(|(i, _)| !changed_before[*i]) {
        let same = partner(defect, &moved).filter(|j| (moved[*j].depth_mm > 0.0) == (defect.depth_mm > 0.0));
        match same.filter(|j| !changed_after[*j] && !met[*j]) {
            Some(j) => {
                met[j] = true;
                let delta_depth_mm = moved[j].depth_mm - before.defects[i].depth_mm;
                list.unchanged.push(SameDefect { before_id: defect.id, after_id: moved[j].id, delta_depth_mm });
            }
            None => list.unsure_before.push(defect.id),
        }
    }
    let alone = after.defects.iter().enumerate().filter(|(j, _)| !changed_after[*j] && !met[*j]);
    list.unsure_after = alone.map(|(_, d)| d.id).collect();
}
