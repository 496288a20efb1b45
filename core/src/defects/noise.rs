//! How far the surface scatters where there is no defect, and what could not have been seen for it.

use super::cells::Field;
use super::{DetectionLimit, SMOOTHING_CELLS};

/// Rows on each side that share a row's scatter.
const SHARE_ROWS: usize = 3;
/// A row scatters at most so many times more than all.
const WORST: f32 = 4.0;
/// Least scatter that is believed, mm.
const LEAST_MM: f32 = 0.01;
/// Radii for which the limit is told, mm.
const RADII_MM: [f64; 6] = [5.0, 10.0, 20.0, 40.0, 80.0, 160.0];

/// The scatter of the smoothed deviation, row by row: what disturbs the line, such as a highlight, lies along the travel.
#[derive(Clone, Debug)]
pub(super) struct Noise {
    /// Standard deviation for each row, mm.
    pub rows_mm: Vec<f32>,
    /// Of all rows, mm.
    pub all_mm: f32,
}

impl Noise {
    /// From a deviation and the cells that are free of defects; `by_row` once it is known which.
    pub(super) fn of(smooth: &Field, free: &[bool], by_row: bool) -> Noise {
        let columns = smooth.columns;
        // Every third row and column tells enough.
        let mut some: Vec<f32> =
            smooth.values.iter().zip(free).step_by(7).filter(|(_, free)| **free).map(|(v, _)| *v).collect();
        let all_mm = Field::scatter(&mut some).unwrap_or(LEAST_MM).max(LEAST_MM);
        if !by_row {
            return Noise { rows_mm: vec![all_mm; smooth.rows], all_mm };
        }
        let each: Vec<Option<f32>> = (0..smooth.rows)
            .map(|row| {
                let cells = row * columns..(row + 1) * columns;
                let values = smooth.values[cells.clone()].iter().zip(&free[cells]);
                let mut values: Vec<f32> = values.filter(|(_, free)| **free).map(|(v, _)| *v).collect();
                // Of a row that is mostly covered, what is left says little.
                if values.len() * 8 < columns { None } else { Field::scatter(&mut values) }
            })
            .collect();
        let rows_mm = (0..smooth.rows)
            .map(|row| {
                let near = &each[row.saturating_sub(SHARE_ROWS)..(row + SHARE_ROWS + 1).min(each.len())];
                let known: Vec<f32> = near.iter().copied().flatten().collect();
                let worst = known.iter().copied().fold(0.0, f32::max);
                // A row may be worse than the others, never better: that would be chance. Nor much worse: then it is full of
                // defects.
                worst.clamp(all_mm, WORST * all_mm)
            })
            .collect();
        Noise { rows_mm, all_mm }
    }

    /// The scatter that a share of the rows does not exceed, mm.
    pub(super) fn quantile_mm(&self, share: f64) -> f32 {
        let mut rows = self.rows_mm.clone();
        if rows.is_empty() {
            return self.all_mm;
        }
        let at = ((rows.len() - 1) as f64 * share) as usize;
        *rows.select_nth_unstable_by(at, f32::total_cmp).1
    }
}

/// The depth of round dents that just reach a threshold: what smoothing and the background take from them included.
/// `rounds` gives (threshold in mm, length that the background follows in mm) of each search; the best one counts. Dents of
/// a radius up to `too_short_mm` are not listed however deep they are: they have no limit.
pub(super) fn limits(rounds: &[(f64, f64)], cell_mm: f64, too_short_mm: f64) -> Vec<DetectionLimit> {
    let limit = |radius_mm: f64| {
        let seen = rounds.iter().map(|(threshold_mm, follows_mm)| {
            let left = peak_left(radius_mm, f64::from(SMOOTHING_CELLS) * cell_mm);
            // A dent is a wave of four radii to the background.
            let kept = 1.0 - 1.0 / (1.0 + (follows_mm / (4.0 * radius_mm)).powi(4));
            threshold_mm / (left * kept)
        });
        seen.fold(f64::INFINITY, f64::min)
    };
    let seen = RADII_MM.into_iter().filter(|radius_mm| *radius_mm > too_short_mm);
    seen.map(|radius_mm| DetectionLimit { radius_mm, depth_mm: limit(radius_mm) }).collect()
}

/// What a Gaussian of `sigma_mm` leaves of the depth of a dent with the form of a raised cosine.
fn peak_left(radius_mm: f64, sigma_mm: f64) -> f64 {
    const STEPS: usize = 200;
    let step = radius_mm / STEPS as f64;
    (0..STEPS)
        .map(|i| {
            let r = (i as f64 + 0.5) * step;
            let height = (std::f64::consts::FRAC_PI_2 * r / radius_mm).cos().powi(2);
            height * r / sigma_mm.powi(2) * (-0.5 * (r / sigma_mm).powi(2)).exp() * step
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_noisy_row_has_its_own_scatter() {
        let (columns, rows) = (300, 40);
        let mut field = Field::new(columns, rows, 0.0);
        for (i, value) in field.values.iter_mut().enumerate() {
            let sigma = if i / columns == 20 { 0.35 } else { 0.1 };
            *value = sigma * (((i * 7919) % 1000) as f32 / 500.0 - 1.0);
        }
        let noise = Noise::of(&field, &vec![true; columns * rows], true);
        assert!(noise.rows_mm[20] > 3.0 * noise.rows_mm[5], "{:?}", noise.rows_mm);
        assert!(noise.rows_mm[17] == noise.rows_mm[20] && noise.rows_mm[10] == noise.all_mm);
    }

    #[test]
    fn small_dents_must_be_deeper_to_be_seen() {
        let limits = limits(&[(0.5, 400.0)], 1.0, 4.0);
        let depth = |radius: f64| limits.iter().find(|l| l.radius_mm == radius).map(|l| l.depth_mm).expect("listed");
        assert!(depth(5.0) > 1.2 * depth(20.0), "{limits:?}");
        assert!((depth(40.0) - 0.5).abs() < 0.1 && depth(160.0) > 0.6, "{limits:?}");
        let sparse = super::limits(&[(0.5, 400.0)], 1.0, 22.0);
        assert_eq!(sparse.first().map(|l| l.radius_mm), Some(40.0), "what lies between two profiles is not promised");
    }
}
