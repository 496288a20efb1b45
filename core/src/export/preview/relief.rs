//! Light from the upper left: what shows a dent of two millimetres on a wall that leans by fifty.

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
    for _ in 0..2 {
        let (mut sums, mut counts): (Vec<f32>, Vec<f32>) =
            result.iter().map(|v| if v.is_finite() { (*v, 1.0) } else { (0.0, 0.0) }).unzip();
        for plane in [&mut sums, &mut counts] {
            for row in plane.chunks_exact_mut(width) {
                slide(row, radii.0);
            }
            let mut line = vec![0.0; height];
            for column in 0..width {
                line.iter_mut().enumerate().for_each(|(row, v)| *v = plane[row * width + column]);
                slide(&mut line, radii.1);
                line.iter().enumerate().for_each(|(row, v)| plane[row * width + column] = *v);
            }
        }
        for (i, value) in result.iter_mut().enumerate().filter(|(_, v)| v.is_finite()) {
            *value = sums[i] / counts[i];
        }
    }
    result
}

/// The sum over the neighbours up to `radius` away, in place.
fn slide(line: &mut [f32], radius: usize) {
    let source = line.to_vec();
    let mut sum: f64 = source.iter().take(radius).map(|v| f64::from(*v)).sum();
    for (i, value) in line.iter_mut().enumerate() {
        sum += source.get(i + radius).map_or(0.0, |v| f64::from(*v));
        sum -= i.checked_sub(radius + 1).map_or(0.0, |j| f64::from(source[j]));
        *value = sum as f32;
    }
}
