//! Measures of the cross-section along the chainage: a pipe's radius and ovality, a wall's flatness.

use nalgebra::{SMatrix, SVector};

use super::SectionRow;
use super::cells::{CellGrid, Field};
use super::reference::{Place, Reference, Shape, fit, free_cylinder, median};

/// Coarse cells of a section, at least.
const LEAST_PLACES: usize = 60;
/// Neighbouring cells err alike: their number counts this much less.
const ALIKE: f64 = 4.0;

/// What a station's section is measured on: `from..to` are columns of the stretch.
pub(super) struct Station<'a> {
    pub grid: &'a CellGrid,
    pub first_column: usize,
    pub from: usize,
    pub to: usize,
    /// World z, mm.
    pub depth: &'a Field,
    /// Deviation from the undamaged shape and its smoothed form, mm.
    pub deviation: &'a Field,
    pub smooth: &'a Field,
    /// Cells free of defects.
    pub free: &'a [bool],
    pub reference: &'a Reference,
    /// Cells to a side of a coarse cell.
    pub factor: usize,
    /// A pipe's radius as built, mm; 0 where it is not known.
    pub nominal_radius_mm: f64,
}

impl Station<'_> {
    /// The section's measures; `None` where next to nothing was measured.
    pub(super) fn measure(&self) -> Option<SectionRow> {
        let undamaged = self.places(true);
        if undamaged.len() < LEAST_PLACES {
            return None;
        }
        let middle = (self.first_column as f64) + (self.from + self.to - 1) as f64 / 2.0;
        let mut row = SectionRow { x_mm: self.grid.x_mm(middle), ..SectionRow::default() };
        self.spread(&mut row);
        match self.reference.shape {
            Shape::Plane => self.wall(&undamaged, &mut row),
            Shape::Cylinder { radius_mm, .. } => self.pipe(&undamaged, radius_mm, &mut row),
        }
        Some(row)
    }

    /// Coarse cells as places; only the undamaged ones, or all.
    fn places(&self, undamaged: bool) -> Vec<Place> {
        let k = self.factor;
        let mut places = Vec::new();
        for row in (0..self.depth.rows).step_by(k) {
            for column in (self.from..self.to).step_by(k) {
                let (mut sum, mut sum_x, mut sum_y, mut count) = (0.0, 0.0, 0.0, 0.0);
                for r in row..(row + k).min(self.depth.rows) {
                    for c in column..(column + k).min(self.to) {
                        let cell = r * self.depth.columns + c;
                        let z = self.depth.values[cell];
                        if z.is_finite() && (!undamaged || self.free[cell]) {
                            (sum, sum_x, sum_y) = (sum + f64::from(z), sum_x + c as f64, sum_y + r as f64);
                            count += 1.0;
                        }
                    }
                }
                if count * 3.0 >= (k * k) as f64 {
                    places.push(Place {
                        x_mm: self.grid.x_mm(self.first_column as f64 + sum_x / count),
                        y_mm: self.grid.y_mm(sum_y / count),
                        z_mm: sum / count,
                    });
                }
            }
        }
        places
    }

    /// Coverage, roughness and the extremes of the deviation.
    fn spread(&self, row: &mut SectionRow) {
        let (mut measured, mut rough, mut rough_count) = (0_usize, 0.0, 0.0);
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        for line in 0..self.depth.rows {
            for cell in line * self.depth.columns + self.from..line * self.depth.columns + self.to {
                let (value, smooth) = (self.deviation.values[cell], self.smooth.values[cell]);
                measured += usize::from(value.is_finite());
                if smooth.is_finite() {
                    (low, high) = (low.min(smooth), high.max(smooth));
                }
                if self.free[cell] && value.is_finite() && smooth.is_finite() {
                    rough += f64::from(value - smooth).powi(2);
                    rough_count += 1.0;
                }
            }
        }
        row.measured_share = measured as f64 / (self.depth.rows * (self.to - self.from)) as f64;
        row.roughness_mm = (rough / f64::max(rough_count, 1.0)).sqrt();
        row.deviation_min_mm = f64::from(low);
        row.deviation_max_mm = f64::from(high);
    }

    fn wall(&self, undamaged: &[Place], row: &mut SectionRow) {
        let Some(plane) = fit(Shape::Plane, undamaged) else { return };
        let off: Vec<f64> = self.places(false).iter().map(|p| p.z_mm - plane.z_mm(p.x_mm, p.y_mm)).collect();
        let (low, high) = off.iter().fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(*v), b.max(*v)));
        row.flatness_mm = Some(high - low);
        row.flatness_rms_mm = Some((off.iter().map(|v| v * v).sum::<f64>() / off.len() as f64).sqrt());
    }

    fn pipe(&self, undamaged: &[Place], run_radius_mm: f64, row: &mut SectionRow) {
        let Some(circle) = free_cylinder(undamaged) else { return };
        let Shape::Cylinder { radius_mm, from_outside } = circle.shape else { return };
        let polar = |p: &Place| {
            let towards = p.z_mm - circle.axis_z_mm(p.x_mm);
            let up = if from_outside { -towards } else { towards };
            let beside = p.y_mm - circle.axis_y_mm(p.x_mm);
            (beside.atan2(up), beside.hypot(up))
        };
        row.radius_mm = Some(radius_mm);
        row.diameter_mm = Some(2.0 * radius_mm);
        let seen: Vec<(f64, f64)> = undamaged.iter().map(polar).collect();
        if let Some((ovality, sd, mean_mm)) = ovality(&seen, radius_mm, self.nominal_radius_mm, 4.0 * circle.scatter_mm)
        {
            row.mean_radius_mm = Some(mean_mm);
            row.ovality_percent = Some(ovality);
            row.ovality_sd_percent = Some(sd);
        }
        let angles = seen.iter().map(|s| s.0);
        row.arc_deg = Some((angles.clone().fold(f64::MIN, f64::max) - angles.fold(f64::MAX, f64::min)).to_degrees());
        let least = self.places(false).iter().map(|p| polar(p).1).fold(f64::INFINITY, f64::min);
        row.radius_loss_mm = Some((run_radius_mm - least).max(0.0));
    }
}

/// Ovality in per cent, (largest − smallest diameter) / mean, with its standard deviation, and the mean radius in mm: r(θ) = r₀ + a·cos θ + b·sin θ +
/// c·cos 2θ, 2·c/r₀: above 0 where the section is longest along the view. The view's axis is taken to be one of the
/// ellipse's. r₀ is the radius as built where that is known (above 0). Places are (θ, r).
fn ovality(places: &[(f64, f64)], radius_mm: f64, nominal_mm: f64, reach_mm: f64) -> Option<(f64, f64, f64)> {
    let known = nominal_mm > 0.0;
    let start_mm = if known { nominal_mm } else { radius_mm };
    let mut solution = SVector::<f64, 4>::from([start_mm, 0.0, 0.0, 0.0]);
    let mut reach_mm = reach_mm.max(0.2) + (start_mm - radius_mm).abs();
    let row = |theta: f64| SVector::<f64, 4>::from([1.0, theta.cos(), theta.sin(), (2.0 * theta).cos()]);
    let mut sd = f64::INFINITY;
    for _ in 0..6 {
        let mut normal = SMatrix::<f64, 4, 4>::zeros();
        let mut right = SVector::<f64, 4>::zeros();
        let (mut squares, mut count) = (0.0, 0.0);
        for (theta, r) in places {
            let row = row(*theta);
            let off = r - row.dot(&solution);
            if off.abs() < reach_mm {
                normal += row * row.transpose();
                right += off * row;
                squares += off * off;
                count += 1.0;
            }
        }
        if count < 20.0 {
            return None;
        }
        if known {
            // A known radius does not move.
            normal[(0, 0)] += 1e9 * count;
        }
        let inverse = normal.try_inverse()?;
        solution += inverse * right;
        reach_mm = 0.2_f64.max(4.0 * (squares / count).sqrt());
        sd = (squares / count * inverse[(3, 3)]).sqrt() * ALIKE;
    }
    let mean_mm = solution[0];
    Some((200.0 * solution[3] / mean_mm, 200.0 * sd / mean_mm, mean_mm))
}

/// Median and spread of what the stations say: (value, standard deviation of the median).
pub(super) fn pooled(values: Vec<f64>) -> Option<(f64, f64)> {
    let count = values.len();
    let middle = median(values.clone())?;
    let spread = 1.4826 * median(values.iter().map(|v| (v - middle).abs()).collect())?;
    Some((middle, 1.25 * spread / (count as f64).sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_per_cent_of_ovality_is_found() {
        let places: Vec<(f64, f64)> = (-100..=100)
            .map(|i| {
                let theta = 0.01 * f64::from(i);
                let noise = 0.02 * f64::from((i * 37_i32).rem_euclid(11) - 5) / 5.0;
                (theta, 300.0 + 2.0 * theta.cos() + 1.5 * (2.0 * theta).cos() + noise)
            })
            .collect();
        let (percent, sd, _) = ovality(&places, 300.0, 0.0, 5.0).expect("a fit");
        assert!((percent - 1.0).abs() < 0.2 && sd < 0.5, "{percent} ± {sd}");
        // A quarter of the arc is enough where the radius is known.
        let few: Vec<(f64, f64)> = places.into_iter().filter(|place| place.0.abs() < 0.5).collect();
        let (percent, sd, mean_mm) = ovality(&few, 296.0, 300.0, 5.0).expect("a fit");
        assert!((percent - 1.0).abs() < 0.03 && sd < 0.05 && mean_mm == 300.0, "{percent} ± {sd}");
    }
}
