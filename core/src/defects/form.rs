//! A rounded dent or bulge as a form, fitted to the measured cells.
//!
//! The highest of many noisy cells is too high, the highest of smoothed ones too low. So a dent with sloping sides is
//! measured as a whole: a raised cosine over an ellipse, on a sloping ground and blurred as the measurement blurs it, is
//! laid through the cells by least squares. Depth, place and area come from all cells together, with their uncertainty.

use std::f64::consts::{FRAC_PI_2, PI};
use std::sync::LazyLock;

use nalgebra::{SMatrix, SVector};

use super::cells::Field;

/// How far beyond its rim a form is fitted, in half axes: the ground about it.
const REACH: f64 = 1.3;
/// About so many cells are used; neighbours say nearly the same.
const SAMPLES: f64 = 500.0;
const LEAST_SAMPLES: usize = 24;
/// Gauss and Newton's steps, and the change at which they end.
const STEPS: usize = 12;
const ENOUGH: f64 = 2e-3;
/// A cell further off than this many of the scatter pulls no harder.
const HUBER: f64 = 3.0;
/// Least scatter that is believed, mm.
const LEAST_SCATTER_MM: f64 = 1e-3;
/// An ellipse is believed where it leaves less than this share of the circle's squares, and so much of it was measured: of
/// what is seen in part, beside a highlight, the other half axis is a guess.
const ELLIPSE_GAIN: f64 = 0.8;
const ELLIPSE_MEASURED: f64 = 0.9;
/// A Gaussian's three nodes (in standard deviations) with their weights.
const NODES: [(f64, f64); 3] =
    [(-1.732_050_807_568_877_2, 1.0 / 6.0), (0.0, 2.0 / 3.0), (1.732_050_807_568_877_2, 1.0 / 6.0)];
/// Unknowns: ground (value and two slopes), height, place (2), half axes (2), lean.
const UNKNOWNS: usize = 9;

/// Standard deviations of what blurs the surface along the columns and the rows, cells.
pub(super) type Blur = (f64, f64);

/// The raised cosine as a table: sines of every cell would take most of the search's time.
static PROFILE: LazyLock<Profile> = LazyLock::new(Profile::new);

/// cos²(π/2·ρ), and its fall −d/dρ / ρ, at ρ²: both are smooth in it.
struct Profile {
    table: Vec<(f64, f64)>,
}

impl Profile {
    const STEPS: usize = 2048;

    fn new() -> Profile {
        let entry = |i: usize| {
            let rho = (i as f64 / Profile::STEPS as f64).sqrt();
            let fall = if i == 0 { PI } else { (PI * rho).sin() / rho };
            (0.5 + 0.5 * (PI * rho).cos(), FRAC_PI_2 * fall)
        };
        Profile { table: (0..=Profile::STEPS).map(entry).collect() }
    }

    /// Height and fall at ρ²; beyond the rim there is neither.
    fn at(&self, square: f64) -> (f64, f64) {
        let place = square * Profile::STEPS as f64;
        let low = place as usize;
        let (Some(a), Some(b)) = (self.table.get(low), self.table.get(low + 1)) else { return (0.0, 0.0) };
        let share = place - low as f64;
        (a.0 + share * (b.0 - a.0), a.1 + share * (b.1 - a.1))
    }
}

/// A raised cosine over an ellipse: height·cos²(π/2·ρ), ρ from 0 at the middle to 1 at the rim. Lengths are cells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Form {
    /// Its middle.
    pub column: f64,
    /// See `column`.
    pub row: f64,
    /// Half axes: along the columns, and along the rows where it does not lean.
    pub along: f64,
    /// See `along`.
    pub across: f64,
    /// Rows that its middle line moves on a column: an ellipse askew.
    pub lean: f64,
    /// Deviation at its middle, mm.
    pub height_mm: f64,
}

/// A form laid through the cells.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fit {
    pub form: Form,
    /// Standard deviation of the height from the cells' scatter about the form, mm.
    pub height_sd_mm: f64,
    /// Share of the cells' variance that the form explains.
    pub explained: f64,
    /// Share of its ellipse that was measured.
    pub measured_share: f64,
}

/// A cell that has a say: place, and deviation in mm.
#[derive(Clone, Copy)]
struct Sample {
    column: f64,
    row: f64,
    value_mm: f64,
}

struct Samples {
    cells: Vec<Sample>,
    /// Cells to one sample along each side.
    every: usize,
}

impl Form {
    /// A round one.
    pub(super) fn round(column: f64, row: f64, radius: f64, height_mm: f64) -> Form {
        Form { column, row, along: radius, across: radius, lean: 0.0, height_mm }
    }

    /// Half of its extent along columns and rows.
    pub(super) fn extents(&self) -> (f64, f64) {
        (self.along, self.across.hypot(self.lean * self.along))
    }

    /// What its middle shows once it is blurred, mm.
    pub(super) fn summit_mm(&self, blur: Blur) -> f64 {
        self.height_mm * self.height(self.column, self.row, blur)
    }

    /// Area of its ellipse, in cells.
    pub(super) fn area_cells(&self) -> f64 {
        PI * self.along * self.across
    }

    /// Volume between it and the ground, mm cells²: of a raised cosine h·π·a·b·(1/2 − 2/π²).
    pub(super) fn volume(&self) -> f64 {
        self.height_mm.abs() * self.area_cells() * (0.5 - 2.0 / (PI * PI))
    }

    /// Its steepest rise, mm a cell.
    pub(super) fn steepest(&self) -> f64 {
        let (a, b) = (self.along.powi(-2), self.across.powi(-2));
        // The larger eigenvalue of ρ²'s matrix is the inverse square of the shorter half axis.
        let (xx, xy, yy) = (a + self.lean.powi(2) * b, -self.lean * b, b);
        let shorter = 0.5 * (xx + yy) + (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
        self.height_mm.abs() * FRAC_PI_2 * shorter.sqrt()
    }

    /// ρ² of a place.
    fn square(&self, dx: f64, dy: f64) -> f64 {
        (dx / self.along).powi(2) + ((dy - self.lean * dx) / self.across).powi(2)
    }

    /// Height of the blurred form over its own.
    fn height(&self, column: f64, row: f64, blur: Blur) -> f64 {
        let profile = &*PROFILE;
        let mut sum = 0.0;
        for (x, weight_x) in NODES {
            let dx = column - self.column - x * blur.0;
            for (y, weight_y) in NODES {
                let dy = row - self.row - y * blur.1;
                sum += weight_x * weight_y * profile.at(self.square(dx, dy)).0;
            }
        }
        sum
    }

    /// The same, and its change with column, row, ln of each half axis, and lean.
    fn unit(&self, column: f64, row: f64, blur: Blur) -> [f64; 6] {
        let profile = &*PROFILE;
        let (along_2, across_2) = (self.along.powi(-2), self.across.powi(-2));
        let mut sum = [0.0; 6];
        for (x, weight_x) in NODES {
            let dx = column - self.column - x * blur.0;
            for (y, weight_y) in NODES {
                let away = row - self.row - y * blur.1 - self.lean * dx;
                let (along, across) = (dx * along_2, away * across_2);
                let square = dx * along + away * across;
                if square >= 1.0 {
                    continue;
                }
                let weight = weight_x * weight_y;
                let (height, fall) = profile.at(square);
                let fall = fall * weight;
                sum[0] += weight * height;
                sum[1] += fall * (along - self.lean * across);
                sum[2] += fall * across;
                sum[3] += fall * along * dx;
                sum[4] += fall * across * away;
                sum[5] += fall * across * dx;
            }
        }
        sum
    }

    /// Adds `share` of the blurred form to a field.
    pub(super) fn add_to(&self, field: &mut Field, share: f64, blur: Blur) {
        let (wide, high) = self.extents();
        let columns = within(self.column, wide + 2.0 * blur.0, field.columns);
        for row in within(self.row, high + 2.0 * blur.1, field.rows) {
            for column in columns.clone() {
                let value = &mut field.values[row * field.columns + column];
                if value.is_finite() {
                    *value += (share * self.height_mm * self.height(column as f64, row as f64, blur)) as f32;
                }
            }
        }
    }

    /// Lays the form anew through what `rest` shows; `rest` holds the deviation without this form. `None` where too little
    /// was measured, or it does not settle. With `askew` a circle may become an ellipse; an ellipse stays one.
    pub(super) fn fitted(&self, rest: &Field, blur: Blur, askew: bool) -> Option<Fit> {
        let samples = self.samples(rest, blur);
        let is_round = self.along == self.across && self.lean == 0.0;
        let first = Adjustment { samples: &samples, blur, round: is_round }.settled(*self)?;
        let best = match askew && is_round && first.form.measured_share(rest) > ELLIPSE_MEASURED {
            true => {
                let askew = Adjustment { samples: &samples, blur, round: false }.settled(first.form);
                askew.filter(|askew| askew.squares < ELLIPSE_GAIN * first.squares).unwrap_or(first)
            }
            false => first,
        };
        Some(Fit {
            form: best.form,
            height_sd_mm: best.height_sd_mm,
            explained: best.explained,
            measured_share: best.form.measured_share(rest),
        })
    }

    fn samples(&self, rest: &Field, blur: Blur) -> Samples {
        let (wide, high) = self.extents();
        let (wide, high) = (REACH * wide + 2.0 * blur.0, REACH * high + 2.0 * blur.1);
        let every = ((PI * wide * high / SAMPLES).sqrt().floor() as usize).max(1);
        let mut cells = Vec::new();
        for row in within(self.row, high, rest.rows).step_by(every) {
            for column in within(self.column, wide, rest.columns).step_by(every) {
                let value = rest.values[row * rest.columns + column];
                let (x, y) = (column as f64, row as f64);
                let inside = ((x - self.column) / wide).powi(2) + ((y - self.row) / high).powi(2) < 1.0;
                if inside && value.is_finite() {
                    let own_mm = self.height_mm * self.height(x, y, blur);
                    cells.push(Sample { column: x, row: y, value_mm: f64::from(value) + own_mm });
                }
            }
        }
        Samples { cells, every }
    }

    /// The share of its ellipse that was measured; what lies outside the field was not.
    fn measured_share(&self, rest: &Field) -> f64 {
        let (wide, high) = self.extents();
        let inside = |column: usize, row: usize| self.square(column as f64 - self.column, row as f64 - self.row) < 1.0;
        let mut measured = 0;
        for row in within(self.row, high, rest.rows) {
            for column in within(self.column, wide, rest.columns) {
                measured += usize::from(inside(column, row) && rest.values[row * rest.columns + column].is_finite());
            }
        }
        (measured as f64 / self.area_cells().max(1.0)).min(1.0)
    }
}

/// The places of a line of `count` cells within `reach` of one.
fn within(middle: f64, reach: f64, count: usize) -> std::ops::Range<usize> {
    let place = |at: f64| at.clamp(0.0, count as f64) as usize;
    place((middle - reach).ceil())..place((middle + reach).floor() + 1.0)
}

/// A least-squares adjustment of a form to samples.
struct Adjustment<'a> {
    samples: &'a Samples,
    blur: Blur,
    /// The half axes stay equal.
    round: bool,
}

struct Settled {
    form: Form,
    height_sd_mm: f64,
    /// Sum of the squares that are left, mm².
    squares: f64,
    explained: f64,
}

impl Adjustment<'_> {
    fn settled(&self, start: Form) -> Option<Settled> {
        let cells = &self.samples.cells;
        if cells.len() < LEAST_SAMPLES {
            return None;
        }
        let mut form = start;
        let mut ground = [0.0; 3];
        let mut scatter_mm = f64::INFINITY;
        for step in 0..STEPS {
            let (normal, right, off) = self.equations(&form, &ground, scatter_mm);
            let delta = normal.cholesky()?.solve(&right);
            scatter_mm = median_size(off)?;
            (0..3).for_each(|i| ground[i] += delta[i]);
            form = self.moved(form, &delta)?;
            if step > 2 && delta.rows(4, 5).amax() < ENOUGH {
                break;
            }
        }
        let (normal, _, off) = self.equations(&form, &ground, f64::INFINITY);
        let inverse = normal.try_inverse()?;
        let squares: f64 = off.iter().map(|v| v * v).sum();
        let ground_mm = |s: &Sample| ground_row(&form, s).iter().zip(&ground).map(|(r, g)| r * g).sum::<f64>();
        let whole: f64 = cells.iter().map(|s| (s.value_mm - ground_mm(s)).powi(2)).sum();
        // Neighbouring cells err alike, as far as the blur reaches.
        let alike = (4.0 * PI * self.blur.0 * self.blur.1 / (self.samples.every as f64).powi(2)).max(1.0);
        Some(Settled {
            form,
            height_sd_mm: (inverse[(3, 3)] * squares / cells.len() as f64 * alike).max(0.0).sqrt(),
            squares,
            explained: 1.0 - squares / whole.max(1e-12),
        })
    }

    /// Normal equations about a form, and what is left of each sample, mm.
    fn equations(
        &self,
        form: &Form,
        ground: &[f64; 3],
        scatter_mm: f64,
    ) -> (SMatrix<f64, UNKNOWNS, UNKNOWNS>, SVector<f64, UNKNOWNS>, Vec<f64>) {
        let mut normal = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
        let mut right = SVector::<f64, UNKNOWNS>::zeros();
        let mut left = Vec::with_capacity(self.samples.cells.len());
        for sample in &self.samples.cells {
            let unit = form.unit(sample.column, sample.row, self.blur);
            let plane = ground_row(form, sample);
            let h = form.height_mm;
            let axes = match self.round {
                true => [h * (unit[3] + unit[4]), 0.0, 0.0],
                false => [h * unit[3], h * unit[4], h * unit[5]],
            };
            // Places in half axes: every unknown is of a like size.
            let row = SVector::<f64, UNKNOWNS>::from([
                plane[0],
                plane[1],
                plane[2],
                unit[0],
                h * unit[1] * form.along,
                h * unit[2] * form.across,
                axes[0],
                axes[1],
                axes[2],
            ]);
            let off = sample.value_mm - h * unit[0] - plane.iter().zip(ground).map(|(r, g)| r * g).sum::<f64>();
            let weight = 1.0 / (off.abs() / (HUBER * scatter_mm)).max(1.0);
            normal += weight * row * row.transpose();
            right += weight * off * row;
            left.push(off);
        }
        // A trace of weight holds what the samples do not tell, and what is not free.
        let trace = 1e-7 * normal[(0, 0)].max(1.0);
        (0..UNKNOWNS).for_each(|i| normal[(i, i)] += trace);
        (normal, right, left)
    }

    fn moved(&self, form: Form, delta: &SVector<f64, UNKNOWNS>) -> Option<Form> {
        let grown = |i: usize| delta[i].clamp(-0.25, 0.25).exp();
        let (along, across) = if self.round { (grown(6), grown(6)) } else { (grown(6), grown(7)) };
        let next = Form {
            column: form.column + delta[4].clamp(-0.3, 0.3) * form.along,
            row: form.row + delta[5].clamp(-0.3, 0.3) * form.across,
            along: form.along * along,
            across: form.across * across,
            lean: if self.round { form.lean } else { form.lean + delta[8].clamp(-0.2, 0.2) },
            height_mm: form.height_mm + delta[3],
        };
        let sound = next.height_mm.is_finite() && next.along > 1.0 && next.across > 1.0 && next.along < 1e5;
        sound.then_some(next)
    }
}

/// What the ground's unknowns count for at a sample: 1, and its place in half axes.
fn ground_row(form: &Form, sample: &Sample) -> [f64; 3] {
    [1.0, (sample.column - form.column) / form.along, (sample.row - form.row) / form.across]
}

/// The scatter of what is left, from the median of its size, mm.
fn median_size(mut off: Vec<f64>) -> Option<f64> {
    let middle = off.len() / 2;
    off.iter_mut().for_each(|v| *v = v.abs());
    let size = 1.4826 * *off.select_nth_unstable_by(middle, f64::total_cmp).1;
    size.is_finite().then_some(size.max(LEAST_SCATTER_MM))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(i: usize) -> f32 {
        (((i * 7919 + i / 13) % 1009) as f32 / 504.5 - 1.0) * 0.2
    }

    fn field_with(forms: &[Form], blur: Blur) -> Field {
        let mut field = Field::new(140, 110, 0.0);
        for (i, value) in field.values.iter_mut().enumerate() {
            *value = 0.3 + 0.01 * (i % 140) as f32 + noise(i);
        }
        forms.iter().for_each(|form| form.add_to(&mut field, 1.0, blur));
        field
    }

    #[test]
    fn depth_place_and_size_come_back_in_spite_of_noise_slope_and_blur() {
        for blur in [(0.5, 0.5), (1.5, 2.0)] {
            let dent = Form::round(70.3, 52.8, 11.0, 3.0);
            let start = Form::round(73.0, 50.0, 14.0, 2.0);
            // What is handed over is the deviation without the start's own share.
            let mut rest = field_with(&[dent], blur);
            start.add_to(&mut rest, -1.0, blur);
            let fit = start.fitted(&rest, blur, true).expect("a fit");
            let found = fit.form;
            assert!((found.height_mm - 3.0).abs() < 0.1 && fit.height_sd_mm < 0.2, "{fit:?}");
            assert!((found.column - 70.3).abs() < 0.3 && (found.row - 52.8).abs() < 0.3, "{found:?}");
            assert!((found.area_cells() / dent.area_cells() - 1.0).abs() < 0.07, "{found:?}");
            assert!(found.along == found.across, "round is told as round: {found:?}");
            assert!(fit.explained > 0.9 && fit.measured_share > 0.97, "{fit:?}");
        }
    }

    #[test]
    fn an_ellipse_askew_is_told_from_a_circle() {
        let bulge = Form { along: 22.0, across: 9.0, lean: 0.5, ..Form::round(70.0, 55.0, 1.0, -4.0) };
        let blur = (1.0, 1.0);
        let start = Form::round(69.0, 56.0, 14.0, -3.0);
        let mut rest = field_with(&[bulge], blur);
        start.add_to(&mut rest, -1.0, blur);
        let found = start.fitted(&rest, blur, true).expect("a fit").form;
        assert!((found.height_mm + 4.0).abs() < 0.15 && (found.lean - 0.5).abs() < 0.05, "{found:?}");
        assert!((found.area_cells() / bulge.area_cells() - 1.0).abs() < 0.06, "{found:?}");
        assert!((found.extents().1 / bulge.extents().1 - 1.0).abs() < 0.05, "{found:?}");
    }

    #[test]
    fn of_what_is_seen_in_part_no_second_half_axis_is_guessed() {
        let bulge = Form { along: 22.0, across: 11.0, ..Form::round(70.0, 55.0, 1.0, -4.0) };
        let blur = (1.0, 1.0);
        let start = Form::round(70.0, 55.0, 15.0, -4.0);
        let mut rest = field_with(&[bulge], blur);
        start.add_to(&mut rest, -1.0, blur);
        let is_round = |rest: &Field| {
            let form = start.fitted(rest, blur, true).expect("a fit").form;
            form.along == form.across
        };
        assert!(!is_round(&rest), "seen whole it is an ellipse");
        rest.values[58 * 140..63 * 140].fill(f32::NAN);
        assert!(is_round(&rest));
    }

    #[test]
    fn a_band_without_measurements_takes_nothing_from_the_depth() {
        let dent = Form::round(70.0, 55.0, 14.0, 3.0);
        let blur = (1.0, 1.0);
        let mut rest = field_with(&[dent], blur);
        rest.values[50 * 140..59 * 140].fill(f32::NAN);
        let start = Form::round(71.0, 52.0, 12.0, 2.5);
        start.add_to(&mut rest, -1.0, blur);
        let fit = start.fitted(&rest, blur, true).expect("a fit");
        assert!((fit.form.height_mm - 3.0).abs() < 0.25 && fit.measured_share < 0.8, "{fit:?}");
    }

    #[test]
    fn volume_and_slope_are_those_of_a_raised_cosine() {
        let dent = Form::round(70.0, 55.0, 20.0, 3.0);
        let mut field = Field::new(140, 110, 0.0);
        dent.add_to(&mut field, 1.0, (0.0, 0.0));
        let volume: f32 = field.values.iter().sum();
        assert!((f64::from(volume) / dent.volume() - 1.0).abs() < 0.01);
        let steepest =
            (71..95).map(|c| field.values[55 * 140 + c - 1] - field.values[55 * 140 + c]).fold(0.0, f32::max);
        assert!((f64::from(steepest) / dent.steepest() - 1.0).abs() < 0.01);
    }
}
