//! Light from the upper left: what shows a dent of two millimetres on a wall that leans by fifty.

use std::collections::VecDeque;

use super::reduce::Reduced;

/// Smoothing before the slopes are taken, px.
const FINE_PX: usize = 1;
/// Along the travel and across it: what stays the same over this neighbourhood is the wall's own shape, not its
/// relief. It is long and low since pipes and walls keep their cross-section along the travel.
const SHAPE_PX: (usize, usize) = (110, 10);
/// Slopes under which nothing is brought out further, rad: they would be noise.
const LEAST_SLOPE_RAD: f32 = 0.02;

/// Per pixel from −1 (in shadow) to 1 (lit); 0 where nothing was measured.
pub(super) fn shade(map: &Reduced) -> Vec<f32> {
    let (width, height) = (map.width_px, map.height_px);
    // Large maps: each step takes the place of the one before.
    let smooth = blurred(&map.depth_mm, width, height, (FINE_PX, FINE_PX));
    let mut relief = slopes(&smooth, width, height, map.mm_per_px as f32);
    drop(smooth);
    let mut leaning = blurred(&relief, width, height, SHAPE_PX);
    relief.iter_mut().zip(&leaning).for_each(|(slope, shape)| *slope -= shape);
    let middle = percentile(leaning.iter().copied(), 0.5).unwrap_or_default();
    leaning.iter_mut().for_each(|shape| *shape -= middle);
    let (gain_relief, gain_shape) = (gain(&relief), gain(&leaning));
    for (relief, shape) in relief.iter_mut().zip(&leaning) {
        let lit = 0.85 * soft(*relief * gain_relief) + 0.15 * soft(shape * gain_shape);
        *relief = if lit.is_finite() { lit } else { 0.0 };
    }
    relief
}

/// From −1 to 1, with room left for the steepest.
fn soft(light: f32) -> f32 {
    light / (1.0 + light * light).sqrt()
}

/// What brings the larger slopes of a map near full light.
fn gain(slopes: &[f32]) -> f32 {
    1.0 / percentile(slopes.iter().map(|s| s.abs()), 0.97).unwrap_or_default().max(LEAST_SLOPE_RAD)
}

fn percentile(values: impl Iterator<Item = f32>, share: f64) -> Option<f32> {
    let mut finite: Vec<f32> = values.filter(|v| v.is_finite()).collect();
    let index = (finite.len().checked_sub(1)? as f64 * share) as usize;
    Some(*finite.select_nth_unstable_by(index, f32::total_cmp).1)
}

/// The angle by which the surface is turned to the light, rad. An angle, so that an edge weighs no more than its
/// 90 degrees.
fn slopes(depth_mm: &[f32], width: usize, height: usize, mm_per_px: f32) -> Vec<f32> {
    let mut slopes = vec![f32::NAN; depth_mm.len()];
    for row in 0..height {
        for column in 0..width {
            let here = depth_mm[row * width + column];
            let at = |column: usize, row: usize| depth_mm[row * width + column];
            let along_x = difference(
                column.checked_sub(1).map(|c| at(c, row)),
                here,
                (column + 1 < width).then(|| at(column + 1, row)),
            );
            let along_y = difference(
                row.checked_sub(1).map(|r| at(column, r)),
                here,
                (row + 1 < height).then(|| at(column, row + 1)),
            );
            // Depth grows away from the viewer: a slope that comes nearer to the right and down faces the light.
            let rise = -(along_x + along_y) / (std::f32::consts::SQRT_2 * mm_per_px);
            slopes[row * width + column] = rise.atan();
        }
    }
    slopes
}

/// The change from one pixel to the next, from both neighbours or from the one that was measured; 0 from none.
fn difference(before: Option<f32>, here: f32, after: Option<f32>) -> f32 {
    let measured = |z: Option<f32>| z.filter(|z| z.is_finite());
    match (measured(before), measured(after)) {
        (Some(before), Some(after)) => (after - before) / 2.0,
        (Some(before), None) => here - before,
        (None, Some(after)) => after - here,
        (None, None) => here * 0.0,
    }
}

/// The mean over a rectangle of sides `2 · radius + 1`, twice (nearly a bell), of what was measured; NaN stays
/// NaN. Radii: along the rows, along the columns.
fn blurred(values: &[f32], width: usize, height: usize, radii: (usize, usize)) -> Vec<f32> {
    let mut result = values.to_vec();
    let mut counts = vec![0.0; values.len()];
    for _ in 0..2 {
        for (value, count) in result.iter_mut().zip(&mut counts) {
            (*value, *count) = if value.is_finite() { (*value, 1.0) } else { (0.0, 0.0) };
        }
        for plane in [&mut result, &mut counts] {
            plane.chunks_mut(LINES * width).for_each(|rows| slide_along(rows, width, radii.0));
            slide_down(plane, width, height, radii.1);
        }
        for ((mean, count), value) in result.iter_mut().zip(&counts).zip(values) {
            *mean = if value.is_finite() { *mean / count } else { f32::NAN };
        }
    }
    result
}

/// Rows that are summed at the same time: one sum waits for the one before it, several do not wait for each other.
const LINES: usize = 8;

/// Each value becomes the sum of its neighbours up to `radius` away in its row; up to [`LINES`] rows.
fn slide_along(rows: &mut [f32], width: usize, radius: usize) {
    let source = rows.to_vec();
    let count = rows.len() / width;
    let mut sums = [0.0_f64; LINES];
    let add = |sums: &mut [f64; LINES], column: usize, sign: f64| {
        for (line, sum) in sums.iter_mut().enumerate().take(count) {
            *sum += sign * f64::from(source[line * width + column]);
        }
    };
    (0..radius.min(width)).for_each(|column| add(&mut sums, column, 1.0));
    for column in 0..width {
        if column + radius < width {
            add(&mut sums, column + radius, 1.0);
        }
        if column > radius {
            add(&mut sums, column - radius - 1, -1.0);
        }
        for (line, sum) in sums.iter().enumerate().take(count) {
            rows[line * width + column] = *sum as f32;
        }
    }
}

/// Each value becomes the sum of its neighbours up to `radius` away in its column.
fn slide_down(plane: &mut [f32], width: usize, height: usize, radius: usize) {
    // The rows that a later row still takes away, as they were.
    let mut kept: VecDeque<Vec<f32>> = VecDeque::with_capacity(radius + 2);
    let mut sums = vec![0.0_f64; width];
    let add = |sums: &mut [f64], row: &[f32]| sums.iter_mut().zip(row).for_each(|(s, v)| *s += f64::from(*v));
    for row in plane.chunks_exact(width).take(radius) {
        add(&mut sums, row);
    }
    for row in 0..height {
        if row + radius < height {
            add(&mut sums, &plane[(row + radius) * width..][..width]);
        }
        let mut spare = Vec::new();
        if kept.len() > radius {
            spare = kept.pop_front().unwrap_or_default();
            sums.iter_mut().zip(&spare).for_each(|(s, v)| *s -= f64::from(*v));
        }
        let here = &mut plane[row * width..][..width];
        spare.clear();
        spare.extend_from_slice(here);
        kept.push_back(spare);
        here.iter_mut().zip(&sums).for_each(|(value, sum)| *value = *sum as f32);
    }
}
