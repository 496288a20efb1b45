//! The range of depths that matters, without the few that are far off.

use super::OFFSET_MM;

/// Width of a bin, mm.
const BIN_MM: f64 = 0.25;
/// As many as the tiles' range of depths needs.
const BINS: usize = 67_108;
/// Share of the depths left out at each end.
const TAIL: f64 = 0.01;

/// Counts depths.
pub(super) struct DepthHistogram {
    counts: Vec<u64>,
    total: u64,
}

impl Default for DepthHistogram {
    fn default() -> Self {
        DepthHistogram { counts: vec![0; BINS], total: 0 }
    }
}

impl DepthHistogram {
    /// Counts the finite ones.
    pub(super) fn add(&mut self, depth_mm: &[f32]) {
        for z_mm in depth_mm.iter().filter(|z| z.is_finite()) {
            let bin = ((f64::from(*z_mm) - OFFSET_MM) / BIN_MM) as usize;
            self.counts[bin.min(BINS - 1)] += 1;
            self.total += 1;
        }
    }

    /// The middle 98 %: from the lower edge of the first bin to the upper edge of the last, mm.
    pub(super) fn middle(&self) -> Option<[f64; 2]> {
        let skip = (self.total as f64 * TAIL) as u64;
        let first = bin_after(self.counts.iter(), skip)?;
        let last = BINS - 1 - bin_after(self.counts.iter().rev(), skip)?;
        Some([first as f64 * BIN_MM + OFFSET_MM, (last + 1) as f64 * BIN_MM + OFFSET_MM])
    }
}

fn bin_after<'a>(counts: impl Iterator<Item = &'a u64>, skip: u64) -> Option<usize> {
    let mut seen = 0;
    for (bin, count) in counts.enumerate() {
        seen += count;
        if seen > skip {
            return Some(bin);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outliers_do_not_widen_the_range() {
        let mut depths = DepthHistogram::default();
        assert_eq!(depths.middle(), None);
        let values: Vec<f32> = (0..1000).map(|i| 800.0 + i as f32 * 0.1).chain([-3000.0, 9000.0, f32::NAN]).collect();
        depths.add(&values);
        let [low, high] = depths.middle().expect("range");
        assert!((low - 801.0).abs() < 0.5 && (high - 899.0).abs() < 0.5, "{low} to {high}");
    }
}
