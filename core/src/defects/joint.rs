//! The regions of a stretch → their figures, the rounded ones together.
//!
//! A dent's flank is its neighbour's ground. So the rounded ones are fitted in turn, each to what the others leave, until
//! they agree; what then still stands out is a dent within another's footprint.

use super::cells::Field;
use super::form::{Blur, Fit, Form};
use super::measure::{Stretch, least_cells, measure};
use super::regions::{self, Region};
use super::stretch::{SMOOTH_SHARE, near_gaps};
use super::{Bounds, Defect, DefectKind, SMOOTHING_CELLS};
use crate::recipe::DefectOptions;

/// Turns in which forms are fitted to what the others leave, at most; one whose neighbours moved by less than this share of
/// its size and height has settled.
const TURNS: usize = 5;
const MOVED: f64 = 0.02;
/// Neighbours are those whose rims come so near, in half axes.
const NEIGHBOUR: f64 = 1.6;
/// A form is believed where it explains this share of what it covers, was measured over this share of it, and stays near
/// the region it began with: in half axes, in their ratio, and in the ratio of heights.
const LEAST_EXPLAINED: f64 = 0.6;
const LEAST_MEASURED: f64 = 0.5;
const ASTRAY: f64 = 0.7;
/// One that was measured in part only, or reaches beyond the map, may still be taken off for its neighbours' sake.
const TAKEN_OFF_EXPLAINED: f64 = 0.9;
const TAKEN_OFF_MEASURED: f64 = 0.15;
const LARGER: f64 = 1.6;
/// One that explains this share may be so many times smaller than the region.
const CLEARLY_EXPLAINED: f64 = 0.75;
const SMALLER: f64 = 2.4;
const HIGHER: (f64, f64) = (0.5, 1.7);
/// Cells within another's footprint show a part of a dent's height only: its form may be so many times as high.
const HIGHER_IN_ANOTHER: f64 = 2.2;
/// What it shows of itself, blurred, is at most so many times as high as the cells: a block's flat top lies far below the
/// summit of a raised cosine over it.
const ABOVE_CELLS: f64 = 1.2;
/// Real dents are no raised cosines: this share of a form's own height is no dent within it.
const UNLIKE: f32 = 0.15;
/// How many times more cells than any region one within another's footprint must have.
const HIDDEN_CELLS: usize = 4;
/// Cells about a region without a form that its neighbours do not look at.
const APART_CELLS: usize = 2;
/// Share of a form's height that the scale leaves unsure besides the scatter, and share of what the blur takes from it.
const SCALE_SD: f64 = 0.02;
const BLUR_SD: f64 = 0.3;

/// The defects of a stretch.
pub(super) struct Measured {
    pub defects: Vec<Defect>,
    /// Regions that were too little seen to be believed.
    pub doubtful: usize,
}

/// Measures all regions; with `hidden`, also what stands out within their footprints.
pub(super) fn measure_together(
    stretch: &Stretch,
    regions: &[Region],
    options: &DefectOptions,
    hidden: bool,
) -> Measured {
    let mut known: Vec<Known> = regions.iter().map(|region| Known::of(stretch, region, options)).collect();
    let mut rest = stretch.deviation.clone();
    known.iter().filter(|k| k.form.is_none()).for_each(|k| leave_out(&mut rest, k.region));
    settle(&mut known, &mut rest, stretch.blur);
    let doubtful = known.iter().filter(|k| k.defect.is_none()).count();
    let found = if hidden { within_others(stretch, &known, &mut rest, options) } else { Vec::new() };
    if !found.is_empty() {
        known.extend(found.iter().map(|(region, defect, form)| Known {
            region,
            defect: Some(defect.clone()),
            form: Some(*form),
            fit: None,
            taken_off: false,
        }));
        settle(&mut known, &mut rest, stretch.blur);
        // What only stood out has no other figures than its form's.
        let mut at = 0;
        known.retain(|k| {
            at += 1;
            at <= regions.len() || k.fit.is_some()
        });
    }
    let defects = known.into_iter().filter_map(|k| {
        let mut defect = k.defect?;
        if let Some(fit) = k.fit {
            describe(&mut defect, &fit, stretch);
        }
        Some(defect)
    });
    Measured { defects: defects.collect(), doubtful }
}

/// A region with what is known of it.
struct Known<'a> {
    region: &'a Region,
    defect: Option<Defect>,
    /// Where it is rounded: the form that is taken off when its neighbours are fitted.
    form: Option<Form>,
    /// Once it is believed.
    fit: Option<Fit>,
    /// The form is good enough for the neighbours' sake.
    taken_off: bool,
}

impl<'a> Known<'a> {
    fn of(stretch: &Stretch, region: &'a Region, options: &DefectOptions) -> Known<'a> {
        let defect = measure(stretch, region, options);
        let form = defect.as_ref().and_then(|d| start(stretch, d));
        Known { region, defect, form, fit: None, taken_off: false }
    }
}

/// The round form of what was measured cell by cell; `None` for what has steep sides.
fn start(stretch: &Stretch, defect: &Defect) -> Option<Form> {
    if !matches!(defect.kind, DefectKind::Dent | DefectKind::Bulge) {
        return None;
    }
    let (grid, cell_mm) = (stretch.grid, stretch.grid.cell_mm);
    let column = (defect.x_mm - grid.x0_mm) / cell_mm - stretch.first_column as f64;
    let row = (defect.y_mm - grid.y0_mm) / cell_mm;
    let radius = (defect.area_mm2 / std::f64::consts::PI).sqrt() / cell_mm;
    Some(Form::round(column, row, radius.max(2.0), defect.depth_mm))
}

/// Fits the forms in turn, the highest first; `rest` becomes what they leave.
fn settle(known: &mut [Known], rest: &mut Field, blur: Blur) {
    let height = |k: &Known| k.form.map_or(0.0, |f| f.height_mm.abs());
    let mut order: Vec<usize> = (0..known.len()).filter(|i| known[*i].form.is_some()).collect();
    order.sort_by(|a, b| height(&known[*b]).total_cmp(&height(&known[*a])));
    for k in known.iter().filter(|k| !k.taken_off) {
        k.form.iter().for_each(|form| form.add_to(rest, -1.0, blur));
    }
    let starts: Vec<Option<Form>> = known.iter().map(|k| k.form).collect();
    let mut moved: Vec<bool> = known.iter().map(|k| k.form.is_some()).collect();
    for turn in 0..TURNS {
        let before: Vec<bool> = std::mem::replace(&mut moved, vec![false; known.len()]);
        for i in &order {
            let (Some(form), Some(start)) = (known[*i].form, starts[*i]) else { continue };
            let near = |j: usize| known[j].form.is_some_and(|other| touch(&form, &other));
            let disturbed = (0..known.len()).any(|j| (before[j] || moved[j]) && near(j));
            if !disturbed {
                continue;
            }
            // An ellipse is looked for once the neighbours are about right.
            let Some(fit) = form.fitted(rest, blur, turn == 1) else { continue };
            let in_another = |j: usize| j != *i && known[j].form.is_some_and(|other| covers(&other, &start));
            let sure = believed(&start, &fit, blur, (0..known.len()).any(in_another));
            let partly = fit.measured_share < LEAST_MEASURED;
            let good_enough = fit.explained >= TAKEN_OFF_EXPLAINED && fit.measured_share >= TAKEN_OFF_MEASURED;
            if !(sure || partly && good_enough) {
                continue;
            }
            form.add_to(rest, 1.0, blur);
            fit.form.add_to(rest, -1.0, blur);
            // The first two turns are for all: the samples follow the form.
            moved[*i] = turn == 0 || away(&form, &fit.form) > MOVED;
            known[*i].form = Some(fit.form);
            known[*i].fit = Some(fit).filter(|_| sure);
            known[*i].taken_off = true;
        }
    }
    // Where no form is good enough, the cells stay as they were.
    for k in known.iter().filter(|k| !k.taken_off) {
        k.form.iter().for_each(|form| form.add_to(rest, 1.0, blur));
    }
}

/// Whether one's rim comes near the other's.
fn touch(a: &Form, b: &Form) -> bool {
    let ((wide_a, high_a), (wide_b, high_b)) = (a.extents(), b.extents());
    (a.column - b.column).abs() < NEIGHBOUR * (wide_a + wide_b) && (a.row - b.row).abs() < NEIGHBOUR * (high_a + high_b)
}

/// Whether the middle of one lies within another's footprint.
fn covers(other: &Form, form: &Form) -> bool {
    let (wide, high) = other.extents();
    ((form.column - other.column) / wide).hypot((form.row - other.row) / high) < 1.0
}

/// How far a form moved, as a share of its size and height.
fn away(from: &Form, to: &Form) -> f64 {
    let (wide, high) = to.extents();
    let share = |a: f64, b: f64| (a / b - 1.0).abs();
    ((to.column - from.column) / wide)
        .abs()
        .max(((to.row - from.row) / high).abs())
        .max(share(from.along, to.along))
        .max(share(from.height_mm, to.height_mm))
}

fn believed(start: &Form, fit: &Fit, blur: Blur, in_another: bool) -> bool {
    let form = &fit.form;
    let away = (form.column - start.column).hypot(form.row - start.row);
    let radius = |form: &Form| (form.area_cells() / std::f64::consts::PI).sqrt();
    let (was, is) = (radius(start), radius(form));
    let higher = form.height_mm / start.height_mm;
    // Counted cell by cell, a low one may have a wave beside it for a part of itself: a form that leaves it out is smaller.
    let smaller = if fit.explained >= CLEARLY_EXPLAINED { SMALLER } else { LARGER };
    fit.explained >= LEAST_EXPLAINED
        && fit.measured_share >= LEAST_MEASURED
        && away <= ASTRAY * was
        && is <= LARGER * was
        && was <= smaller * is
        && higher >= HIGHER.0
        && higher <= if in_another { HIGHER_IN_ANOTHER } else { HIGHER.1 }
        && (in_another || form.summit_mm(blur) / start.height_mm <= ABOVE_CELLS)
}

/// The cells of a region, and those next to it, belong to no form.
fn leave_out(rest: &mut Field, region: &Region) {
    let (columns, rows) = (rest.columns, rest.rows);
    for cell in &region.cells {
        let (column, row) = (cell % columns, cell / columns);
        for r in row.saturating_sub(APART_CELLS)..(row + APART_CELLS + 1).min(rows) {
            let (from, to) = (column.saturating_sub(APART_CELLS), (column + APART_CELLS + 1).min(columns));
            rest.values[r * columns + from..r * columns + to].fill(f32::NAN);
        }
    }
}

/// What stands out of what the forms leave.
fn within_others(
    stretch: &Stretch,
    known: &[Known],
    rest: &mut Field,
    options: &DefectOptions,
) -> Vec<(Region, Defect, Form)> {
    // Where no form was believed, what is left is no surface.
    known.iter().filter(|k| !k.taken_off).for_each(|k| leave_out(rest, k.region));
    let smooth = rest.smoothed(SMOOTHING_CELLS, SMOOTH_SHARE);
    let columns = smooth.columns;
    let slack: Vec<f32> = (0..smooth.values.len())
        .map(|cell| {
            let form_mm = (stretch.deviation.values[cell] - rest.values[cell]).abs();
            let form_mm = if form_mm.is_finite() { form_mm } else { 0.0 };
            stretch.slack(cell) + UNLIKE * form_mm / stretch.thresholds_mm[cell / columns]
        })
        .collect();
    // It must be a place of its own, not a rim that is no raised cosine's.
    let least = HIDDEN_CELLS * least_cells(options, stretch.grid.cell_mm);
    let mut even = smooth.clone();
    even.values.iter_mut().zip(&slack).for_each(|(v, s)| *v /= s);
    let mut regions = regions::find(&even, stretch.thresholds_mm);
    drop(even);
    // One beside all others was looked at before: it was not believed, or lies in the scatter of its own row.
    let covered = |region: &Region| {
        let summit = region.summit;
        (stretch.deviation.values[summit] - rest.values[summit]).abs() > 0.0
    };
    regions.retain(|region| region.cells.len() > least && covered(region));
    if regions.is_empty() {
        return Vec::new();
    }
    let mut taken = vec![false; smooth.values.len()];
    regions.iter().flat_map(|region| &region.cells).for_each(|cell| taken[*cell] = true);
    let frail: Vec<bool> =
        near_gaps(rest, APART_CELLS).iter().zip(stretch.frail).map(|(own, before)| *own || *before).collect();
    let left =
        Stretch { deviation: rest, smooth: &smooth, frail: &frail, slack: Some(&slack), taken: &taken, ..*stretch };
    let found = regions.into_iter().filter_map(|region| {
        let defect = measure(&left, &region, options)?;
        let form = start(stretch, &defect)?;
        Some((region, defect, form))
    });
    found.collect()
}

/// The figures of a form take the place of those counted cell by cell.
fn describe(defect: &mut Defect, fit: &Fit, stretch: &Stretch) {
    let (form, grid) = (&fit.form, stretch.grid);
    let cell_mm = grid.cell_mm;
    let (x_mm, y_mm) = (grid.x_mm(stretch.first_column as f64 + form.column), grid.y_mm(form.row));
    let facing = stretch.reference.facing(y_mm, x_mm);
    let (wide, high) = form.extents();
    let (length_mm, width_mm) = (2.0 * wide * cell_mm, 2.0 * high * cell_mm);
    defect.x_mm = x_mm;
    defect.y_mm = y_mm;
    defect.deepest_x_mm = x_mm;
    defect.deepest_y_mm = y_mm;
    defect.z_mm = stretch.reference.z_mm(x_mm, y_mm) + form.height_mm;
    defect.depth_mm = form.height_mm;
    defect.depth_normal_mm = form.height_mm * facing;
    let blurred_mm = form.height_mm - form.summit_mm(stretch.blur);
    let formal_mm = fit.height_sd_mm.hypot(defect.noise_mm);
    defect.depth_sd_mm = formal_mm.hypot(SCALE_SD * form.height_mm).hypot(BLUR_SD * blurred_mm);
    defect.length_mm = length_mm;
    defect.width_mm = width_mm;
    defect.area_mm2 = form.area_cells() * cell_mm * cell_mm;
    defect.surface_area_mm2 = defect.area_mm2 / facing.max(0.1);
    defect.volume_mm3 = form.volume() * cell_mm * cell_mm;
    defect.steepest_slope_deg = (form.steepest() / cell_mm).atan().to_degrees();
    defect.confidence *= (fit.measured_share / defect.measured_share.max(1e-3)).min(1.0);
    defect.measured_share = fit.measured_share;
    defect.bounds = Bounds {
        x_min_mm: x_mm - 0.5 * length_mm,
        x_max_mm: x_mm + 0.5 * length_mm,
        y_min_mm: y_mm - 0.5 * width_mm,
        y_max_mm: y_mm + 0.5 * width_mm,
    };
}
