//! What the undamaged surface does besides its shape: slow waves and the drift of the poses.
//!
//! A thin plate is laid over the places without defects and bends as little as it may across the others, so that no
//! defect pulls it to itself: the sum of w·(b − r)² + λ·(Δb)² is least.

use super::cells::Field;

/// Steps of the conjugate gradients, at most.
const MAX_STEPS: usize = 60;
/// The residual's fall at which they end.
const ENOUGH: f64 = 1e-9;
/// A side of fewer cells is not halved.
const LEAST_HALVED: usize = 6;
/// Rounds of the robust fit that needs no mask.
const ROUNDS: usize = 4;
/// The weight with which a place without a say still holds the plate at the shape: across a wide defect at the edge a
/// plate would swing away.
const HOLD: f32 = 0.02;
/// A value further from the plate than this many of the scatter has no say.
const TUKEY: f32 = 4.0;

/// λ for a plate that follows half of a wave of `length` cells.
pub(super) fn stiffness(length: f64) -> f32 {
    ((length / std::f64::consts::TAU).powi(4)) as f32
}

/// The plate over the values that are finite, with weights. Where little holds it, conjugate gradients move it slowly: they
/// start from the plate on cells of twice the size.
pub(super) fn plate(values: &Field, weights: &[f32], stiffness: f32) -> Field {
    let (columns, rows) = (values.columns, values.rows);
    let start = if columns.min(rows) >= LEAST_HALVED && columns.max(rows) >= 2 * LEAST_HALVED {
        let (half, half_weights) = halved(values, weights);
        // Twice the spacing: a bend is a quarter in each of two factors.
        refined(&plate(&half, &half_weights, stiffness / 16.0), 2, columns, rows)
    } else {
        Field::new(columns, rows, 0.0)
    };
    improved(start, values, weights, stiffness)
}

/// Values and weights on cells of twice the size.
fn halved(values: &Field, weights: &[f32]) -> (Field, Vec<f32>) {
    let (columns, rows) = (values.columns.div_ceil(2), values.rows.div_ceil(2));
    let mut sums = Field::new(columns, rows, 0.0);
    let mut total = vec![0.0_f32; columns * rows];
    for (cell, (value, weight)) in values.values.iter().zip(weights).enumerate().filter(|(_, (_, w))| **w > 0.0) {
        let to = cell / values.columns / 2 * columns + cell % values.columns / 2;
        sums.values[to] += value * weight;
        total[to] += weight;
    }
    for (sum, total) in sums.values.iter_mut().zip(&mut total) {
        *sum = if *total > 0.0 { *sum / *total } else { f32::NAN };
        *total /= 4.0;
    }
    (sums, total)
}

/// Conjugate gradients from a start.
fn improved(mut plate: Field, values: &Field, weights: &[f32], stiffness: f32) -> Field {
    let columns = values.columns;
    let target: Vec<f32> = values.values.iter().zip(weights).map(|(v, w)| if *w > 0.0 { v * w } else { 0.0 }).collect();
    let mut scratch = vec![0.0; target.len()];
    let mut applied = vec![0.0; target.len()];
    apply(&plate.values, weights, stiffness, columns, &mut scratch, &mut applied);
    let mut residual: Vec<f32> = target.iter().zip(&applied).map(|(t, a)| t - a).collect();
    let mut direction = residual.clone();
    let mut square = dot(&residual, &residual);
    let enough = ENOUGH * dot(&target, &target).max(1e-12);
    for _ in 0..MAX_STEPS {
        if square <= enough {
            break;
        }
        apply(&direction, weights, stiffness, columns, &mut scratch, &mut applied);
        let length = (square / dot(&direction, &applied).max(1e-30)) as f32;
        plate.values.iter_mut().zip(&direction).for_each(|(p, d)| *p += length * d);
        residual.iter_mut().zip(&applied).for_each(|(r, a)| *r -= length * a);
        let next = dot(&residual, &residual);
        let share = (next / square) as f32;
        direction.iter_mut().zip(&residual).for_each(|(d, r)| *d = r + share * *d);
        square = next;
    }
    plate
}

/// A plate that defects pull little, before it is known where they are.
pub(super) fn robust_plate(values: &Field, stiffness: f32, least_scatter: f32) -> Field {
    // The shape itself is the first plate: it was fitted robustly.
    let mut fitted = Field::new(values.columns, values.rows, 0.0);
    for _ in 0..ROUNDS {
        let off: Vec<f32> = values.values.iter().zip(&fitted.values).map(|(v, p)| v - p).collect();
        let scatter = Field::scatter(&mut off.clone()).unwrap_or(least_scatter).max(least_scatter);
        let weight = |off: &f32| {
            let share = off / (TUKEY * scatter);
            if share.abs() < 1.0 { (1.0 - share * share).powi(2) } else { 0.0 }
        };
        let weights: Vec<f32> = off.iter().map(weight).collect();
        fitted = plate(values, &weights, stiffness);
    }
    fitted
}

/// (W + λ·Δ²) x, where no place is without all weight.
fn apply(x: &[f32], weights: &[f32], stiffness: f32, columns: usize, bend: &mut [f32], out: &mut [f32]) {
    laplacian(x, columns, bend);
    laplacian(bend, columns, out);
    for ((out, weight), x) in out.iter_mut().zip(weights).zip(x) {
        *out = stiffness * *out + weight.max(HOLD) * x;
    }
}

/// The sum of the neighbours less the value; at the edges the neighbour is the value itself.
fn laplacian(x: &[f32], columns: usize, out: &mut [f32]) {
    let rows = x.len() / columns;
    for row in 0..rows {
        let line = &x[row * columns..(row + 1) * columns];
        let above = &x[row.saturating_sub(1) * columns..][..columns];
        let below = &x[(row + 1).min(rows - 1) * columns..][..columns];
        let out = &mut out[row * columns..(row + 1) * columns];
        let beside = |column: usize| line[column.saturating_sub(1)] + line[(column + 1).min(columns - 1)];
        for (column, (out, (above, below))) in out.iter_mut().zip(above.iter().zip(below)).enumerate() {
            *out = beside(column) + above + below - 4.0 * line[column];
        }
    }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    // In pieces: a sum in f32 of a million products would lose digits, one in f64 throughout is slow.
    a.chunks(256).zip(b.chunks(256)).map(|(a, b)| f64::from(a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>())).sum()
}

/// A plate of coarse cells, `factor` to one, at every fine cell of `columns` by `rows` (Catmull and Rom's cubics).
pub(super) fn refined(plate: &Field, factor: usize, columns: usize, rows: usize) -> Field {
    let taps_x = taps(columns, factor, plate.columns);
    let taps_y = taps(rows, factor, plate.rows);
    let mut wide = Field::new(columns, plate.rows, 0.0);
    for (line, out) in plate.values.chunks_exact(plate.columns).zip(wide.values.chunks_exact_mut(columns)) {
        for (out, (places, weights)) in out.iter_mut().zip(&taps_x) {
            *out = places.iter().zip(weights).map(|(place, weight)| line[*place] * weight).sum();
        }
    }
    let mut fine = Field::new(columns, rows, 0.0);
    for (out, (places, weights)) in fine.values.chunks_exact_mut(columns).zip(&taps_y) {
        for (place, weight) in places.iter().zip(weights) {
            let line = &wide.values[place * columns..(place + 1) * columns];
            out.iter_mut().zip(line).for_each(|(o, v)| *o += weight * v);
        }
    }
    fine
}

/// For each fine cell the four coarse ones about it and their weights.
fn taps(length: usize, factor: usize, coarse: usize) -> Vec<([usize; 4], [f32; 4])> {
    let last = coarse as i64 - 1;
    (0..length)
        .map(|i| {
            let at = (i as f64 + 0.5) / factor as f64 - 0.5;
            let (base, t) = (at.floor() as i64, (at - at.floor()) as f32);
            let places = [-1, 0, 1, 2].map(|k| (base + k).clamp(0, last) as usize);
            let (t2, t3) = (t * t, t * t * t);
            let weights = [
                0.5 * (-t3 + 2.0 * t2 - t),
                0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
                0.5 * (-3.0 * t3 + 4.0 * t2 + t),
                0.5 * (t3 - t2),
            ];
            (places, weights)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slow wave with a dent on it.
    fn wavy(dent: f32) -> (Field, Field) {
        let (columns, rows) = (120, 60);
        let wave = |c: usize, r: usize| (c as f32 / 25.0).sin() + 0.5 * (r as f32 / 20.0).cos();
        let mut clean = Field::new(columns, rows, 0.0);
        let mut dented = clean.clone();
        for row in 0..rows {
            for column in 0..columns {
                let at = row * columns + column;
                let away = (column as f32 - 60.0).hypot(row as f32 - 30.0) / 8.0;
                clean.values[at] = wave(column, row);
                dented.values[at] = clean.values[at] + if away < 1.0 { dent * (1.0 - away * away) } else { 0.0 };
            }
        }
        (clean, dented)
    }

    #[test]
    fn a_masked_defect_does_not_pull_the_plate() {
        let (clean, dented) = wavy(10.0);
        let masked = |c: usize, r: usize| (c as f32 - 60.0).hypot(r as f32 - 30.0) < 9.0;
        let weights: Vec<f32> = (0..120 * 60).map(|i| if masked(i % 120, i / 120) { 0.0 } else { 1.0 }).collect();
        let plate = plate(&dented, &weights, stiffness(20.0));
        let worst = plate.values.iter().zip(&clean.values).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 0.1, "{worst}");
    }

    #[test]
    fn the_robust_plate_finds_the_wave_under_the_dent() {
        let (clean, dented) = wavy(10.0);
        let plate = robust_plate(&dented, stiffness(40.0), 0.05);
        let at = 30 * 120 + 60;
        assert!((plate.values[at] - clean.values[at]).abs() < 0.5, "{} {}", plate.values[at], clean.values[at]);
    }

    #[test]
    fn refining_keeps_slopes() {
        let mut coarse = Field::new(12, 9, 0.0);
        coarse.values.iter_mut().enumerate().for_each(|(i, v)| *v = (i % 12) as f32 + 2.0 * (i / 12) as f32);
        let fine = refined(&coarse, 5, 60, 45);
        let expected = |c: usize, r: usize| (c as f32 + 0.5) / 5.0 - 0.5 + 2.0 * ((r as f32 + 0.5) / 5.0 - 0.5);
        assert!((fine.values[22 * 60 + 31] - expected(31, 22)).abs() < 1e-4);
    }
}
