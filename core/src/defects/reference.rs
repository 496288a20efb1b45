//! The undamaged shape: a plane, or a cylinder along the travel, chosen by evidence.
//!
//! Both are fitted robustly: a place far from the shape has no say, so a dent does not bend it. The poses drift over a
//! long run, so each stretch has its own place and tilt; a pipe's radius is the whole run's.

use nalgebra::{SMatrix, SVector};

/// Rounds of a fit.
const ROUNDS: usize = 25;
/// A place further from the shape than this many of the scatter has no say; the first rounds are more patient.
const TUKEY: f64 = 4.5;
const TUKEY_FIRST: f64 = 7.0;
/// Least scatter that is believed, mm.
const LEAST_SCATTER_MM: f64 = 0.03;
/// A cylinder is chosen where it leaves less than this share of the plane's scatter.
const CYLINDER_GAIN: f64 = 0.7;
/// Share of the radius beyond which a cylinder is continued as its tangent: too steep to be seen.
const STEEP: f64 = 0.985;

/// A place on the measured surface, mm.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    pub x_mm: f64,
    pub y_mm: f64,
    pub z_mm: f64,
}

/// The undamaged shape of a whole run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Shape {
    /// A wall.
    Plane,
    /// A pipe along the travel.
    Cylinder {
        /// Its radius, mm.
        radius_mm: f64,
        /// True: seen from outside, its sides lie farther away than its crown.
        from_outside: bool,
    },
}

/// The undamaged shape of a stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Reference {
    pub shape: Shape,
    /// World x that the other figures belong to, mm.
    x_mm: f64,
    /// z there (of a pipe: of its axis), mm.
    z_mm: f64,
    /// Change of z along the travel.
    slope_x: f64,
    /// A wall's change of z across the travel; the drift of a pipe's axis across, per mm of travel.
    slope_y: f64,
    /// Where a pipe's axis lies across the travel, mm.
    axis_y_mm: f64,
    /// What is left, mm.
    pub scatter_mm: f64,
}

impl Reference {
    /// The plane z = 0: what a difference is compared with.
    pub(super) fn flat() -> Reference {
        Reference {
            shape: Shape::Plane,
            x_mm: 0.0,
            z_mm: 0.0,
            slope_x: 0.0,
            slope_y: 0.0,
            axis_y_mm: 0.0,
            scatter_mm: 0.0,
        }
    }

    /// The undamaged z at a place, mm.
    pub(super) fn z_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        let along = self.z_mm + self.slope_x * (x_mm - self.x_mm);
        match self.shape {
            Shape::Plane => along + self.slope_y * y_mm,
            Shape::Cylinder { radius_mm, from_outside } => {
                let (away, drop) = self.drop_mm(x_mm, y_mm, radius_mm);
                let inside = away.abs().min(STEEP * radius_mm);
                let drop = drop - (away.abs() - inside) * inside / drop;
                if from_outside { along - drop } else { along + drop }
            }
        }
    }

    /// How far a place lies beside a pipe's axis, and the axis' distance from the surface there, mm.
    fn drop_mm(&self, x_mm: f64, y_mm: f64, radius_mm: f64) -> (f64, f64) {
        let away = y_mm - self.axis_y_mm(x_mm);
        let inside = away.abs().min(STEEP * radius_mm);
        (away, (radius_mm * radius_mm - inside * inside).sqrt())
    }

    /// Where a pipe's axis lies across the travel, mm.
    pub(super) fn axis_y_mm(&self, x_mm: f64) -> f64 {
        self.axis_y_mm + self.slope_y * (x_mm - self.x_mm)
    }

    /// Distance along z of a pipe's axis, mm; a wall's own z.
    pub(super) fn axis_z_mm(&self, x_mm: f64) -> f64 {
        self.z_mm + self.slope_x * (x_mm - self.x_mm)
    }

    /// The cosine of the angle between z and the surface's normal: 1 where the camera looks square at it.
    pub(super) fn facing(&self, y_mm: f64, x_mm: f64) -> f64 {
        match self.shape {
            Shape::Plane => 1.0 / (1.0 + self.slope_x.powi(2) + self.slope_y.powi(2)).sqrt(),
            Shape::Cylinder { radius_mm, .. } => self.drop_mm(x_mm, y_mm, radius_mm).1 / radius_mm,
        }
    }
}

/// Fits a shape of a known kind and size to a stretch; `None` where there are too few places.
pub(super) fn fit(shape: Shape, places: &[Place]) -> Option<Reference> {
    match shape {
        Shape::Plane => fit_plane(places),
        Shape::Cylinder { radius_mm, from_outside } => {
            let plane = fit_plane(places)?;
            let middle = median(places.iter().map(|p| p.y_mm).collect())?;
            let drop = radius_mm * if from_outside { 1.0 } else { -1.0 };
            let start = Reference {
                shape,
                z_mm: plane.z_mm + plane.slope_y * middle + drop,
                axis_y_mm: middle,
                slope_y: 0.0,
                ..plane
            };
            fit_cylinder(start, places, false)
        }
    }
}

/// Plane or cylinder for the stretches of a run, and the cylinder's radius with its spread between them, mm.
pub(super) fn choose(stretches: &[Vec<Place>]) -> (Shape, Option<f64>) {
    let mut gains = Vec::new();
    let mut radii_mm = Vec::new();
    let mut outside = 0_usize;
    for places in stretches {
        let (Some(plane), Some(cylinder)) = (fit_plane(places), free_cylinder(places)) else { continue };
        gains.push(cylinder.scatter_mm / plane.scatter_mm.max(LEAST_SCATTER_MM));
        if let Shape::Cylinder { radius_mm, from_outside } = cylinder.shape {
            radii_mm.push(radius_mm);
            outside += usize::from(from_outside);
        }
    }
    let from_outside = 2 * outside > radii_mm.len();
    match (median(gains), median(radii_mm.clone())) {
        (Some(gain), Some(radius_mm)) if gain < CYLINDER_GAIN => {
            let spread = median(radii_mm.iter().map(|r| (r - radius_mm).abs()).collect()).unwrap_or(0.0);
            (Shape::Cylinder { radius_mm, from_outside }, Some(1.4826 * spread))
        }
        _ => (Shape::Plane, None),
    }
}

fn fit_plane(places: &[Place]) -> Option<Reference> {
    let x_mm = middle_x_mm(places)?;
    let rows = |p: &Place| SVector::<f64, 3>::new(1.0, p.x_mm - x_mm, p.y_mm);
    let (solution, scatter_mm) = robust(places, rows)?;
    Some(Reference {
        shape: Shape::Plane,
        x_mm,
        z_mm: solution[0],
        slope_x: solution[1],
        slope_y: solution[2],
        axis_y_mm: 0.0,
        scatter_mm,
    })
}

/// A cylinder of any radius: from the parabola across the travel, then step by step.
pub(super) fn free_cylinder(places: &[Place]) -> Option<Reference> {
    let x_mm = middle_x_mm(places)?;
    let rows = |p: &Place| SVector::<f64, 4>::new(1.0, p.x_mm - x_mm, p.y_mm, p.y_mm * p.y_mm);
    let (parabola, scatter_mm) = robust(places, rows)?;
    let bend = parabola[3];
    if bend.abs() < 1e-9 {
        return None;
    }
    let from_outside = bend > 0.0;
    let axis_y_mm = -parabola[2] / (2.0 * bend);
    let reach = places.iter().map(|p| (p.y_mm - axis_y_mm).abs()).fold(0.0, f64::max);
    let radius_mm = (0.5 / bend.abs()).max(1.02 * reach);
    let crown = parabola[0] + parabola[2] * axis_y_mm / 2.0;
    let start = Reference {
        shape: Shape::Cylinder { radius_mm, from_outside },
        x_mm,
        z_mm: if from_outside { crown + radius_mm } else { crown - radius_mm },
        slope_x: parabola[1],
        slope_y: 0.0,
        axis_y_mm,
        scatter_mm,
    };
    fit_cylinder(start, places, true)
}

/// Gauss and Newton's steps from a start; the radius moves only with `free`.
fn fit_cylinder(start: Reference, places: &[Place], free: bool) -> Option<Reference> {
    let mut now = start;
    let Shape::Cylinder { from_outside, .. } = start.shape else { return None };
    let sign = if from_outside { -1.0 } else { 1.0 };
    for round in 0..ROUNDS {
        let Shape::Cylinder { radius_mm, .. } = now.shape else { return None };
        let off: Vec<f64> = places.iter().map(|p| p.z_mm - now.z_mm(p.x_mm, p.y_mm)).collect();
        now.scatter_mm = scatter_mm(&off)?;
        let reach = now.scatter_mm * if round < 6 { TUKEY_FIRST } else { TUKEY };
        let mut normal = SMatrix::<f64, 5, 5>::zeros();
        let mut right = SVector::<f64, 5>::zeros();
        for (place, off) in places.iter().zip(&off) {
            let weight = tukey(*off, reach);
            let (away, drop) = now.drop_mm(place.x_mm, place.y_mm, radius_mm);
            if weight == 0.0 || away.abs() > STEEP * radius_mm {
                continue;
            }
            let along = place.x_mm - now.x_mm;
            let across = sign * away / drop;
            let grows = if free { sign * radius_mm / drop } else { 0.0 };
            let row = SVector::<f64, 5>::new(1.0, along, across, across * along, grows);
            normal += weight * row * row.transpose();
            right += weight * *off * row;
        }
        // A short stretch tells no drift of the axis, a fixed radius no change: a trace of weight keeps them at 0.
        let trace = normal[(0, 0)].max(1.0);
        for i in 0..5 {
            normal[(i, i)] += 1e-9 * trace;
        }
        normal[(3, 3)] += 1e-3 * trace;
        let step = normal.cholesky()?.solve(&right);
        now.z_mm += step[0];
        now.slope_x += step[1];
        now.axis_y_mm += step[2];
        now.slope_y += step[3];
        if free {
            let radius_mm = (radius_mm + step[4].clamp(-0.3 * radius_mm, 0.3 * radius_mm)).clamp(1.0, 1e7);
            now.shape = Shape::Cylinder { radius_mm, from_outside };
        }
        if step.amax() < 1e-7 {
            break;
        }
    }
    now.scatter_mm.is_finite().then_some(now)
}

/// A robust linear fit of z, and its scatter in mm.
fn robust<const N: usize>(places: &[Place], row: impl Fn(&Place) -> SVector<f64, N>) -> Option<(SVector<f64, N>, f64)> {
    if places.len() < 4 * N {
        return None;
    }
    let mut solution = SVector::<f64, N>::zeros();
    // Numbers of a like size: z counts from its median.
    solution[0] = median(places.iter().map(|p| p.z_mm).collect())?;
    let mut scatter = f64::INFINITY;
    for round in 0..ROUNDS {
        let off: Vec<f64> = places.iter().map(|p| p.z_mm - row(p).dot(&solution)).collect();
        let reach = if round == 0 { f64::INFINITY } else { scatter * if round < 6 { TUKEY_FIRST } else { TUKEY } };
        let mut normal = SMatrix::<f64, N, N>::zeros();
        let mut right = SVector::<f64, N>::zeros();
        for (place, off) in places.iter().zip(&off) {
            let weight = tukey(*off, reach);
            let row = row(place);
            normal += weight * row * row.transpose();
            right += weight * *off * row;
        }
        let step = normal.try_inverse()? * right;
        solution += step;
        let before = scatter;
        let off: Vec<f64> = places.iter().map(|p| p.z_mm - row(p).dot(&solution)).collect();
        scatter = scatter_mm(&off)?;
        if round > 8 && (before - scatter).abs() < 1e-5 {
            break;
        }
    }
    Some((solution, scatter))
}

fn tukey(off: f64, reach: f64) -> f64 {
    let share = off / reach;
    if share.abs() < 1.0 { (1.0 - share * share).powi(2) } else { 0.0 }
}

fn scatter_mm(off: &[f64]) -> Option<f64> {
    Some((1.4826 * median(off.iter().map(|v| v.abs()).collect())?).max(LEAST_SCATTER_MM))
}

fn middle_x_mm(places: &[Place]) -> Option<f64> {
    (!places.is_empty()).then(|| places.iter().map(|p| p.x_mm).sum::<f64>() / places.len() as f64)
}

/// The median; `None` of nothing.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Places on a surface, a quarter of them in dents of 5 mm.
    fn places(z_mm: impl Fn(f64, f64) -> f64) -> Vec<Place> {
        let mut places = Vec::new();
        for i in 0..60 {
            for j in 0..40 {
                let (x_mm, y_mm) = (100.0 + 8.0 * f64::from(i), -160.0 + 8.0 * f64::from(j));
                let dent = if i % 20 < 10 && j % 20 < 10 { 5.0 } else { 0.0 };
                let noise = 0.05 * f64::from((i * 7 + j * 13) % 11 - 5);
                places.push(Place { x_mm, y_mm, z_mm: z_mm(x_mm, y_mm) + dent + noise });
            }
        }
        places
    }

    #[test]
    fn dents_do_not_bend_the_plane() {
        let places = places(|x, y| 850.0 + 0.01 * x - 0.02 * y);
        assert_eq!(choose(std::slice::from_ref(&places)).0, Shape::Plane);
        let plane = fit(Shape::Plane, &places).expect("a fit");
        assert!((plane.z_mm(300.0, 50.0) - (850.0 + 3.0 - 1.0)).abs() < 0.05, "{plane:?}");
    }

    #[test]
    fn a_pipe_is_known_from_outside_and_from_inside() {
        for (sign, from_outside) in [(-1.0, true), (1.0, false)] {
            let places = places(|x, y| 750.0 + 0.002 * x + sign * (300.0_f64.powi(2) - (y - 12.0).powi(2)).sqrt());
            let (shape, _) = choose(std::slice::from_ref(&places));
            let Shape::Cylinder { radius_mm, from_outside: found } = shape else { panic!("{shape:?}") };
            assert!((radius_mm - 300.0).abs() < 0.6 && found == from_outside, "{shape:?}");
            let fitted = fit(shape, &places).expect("a fit");
            assert!((fitted.axis_y_mm(300.0) - 12.0).abs() < 0.5, "{fitted:?}");
            let z = 750.6 + sign * (300.0_f64.powi(2) - 88.0_f64.powi(2)).sqrt();
            assert!((fitted.z_mm(300.0, 100.0) - z).abs() < 0.1, "{fitted:?}");
        }
    }
}
