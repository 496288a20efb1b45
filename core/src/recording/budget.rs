//! The recording's size: each kind of content has a share that it can never exceed, however long the run.

/// Bytes in a megabyte, as the recipe counts them.
const BYTES_PER_MB: f64 = 1e6;
/// The rate is halved at most this often.
const HALVINGS_MAX: u32 = 24;

/// What one kind of content may take, and how much of it is taken.
///
/// A run whose length is known is thinned out evenly from the start, so that it fills no more than half of the share.
/// Otherwise content comes at full rate at first, and then at rates that fall with the length of the run: at half the
/// rate from twice that length on, at a quarter from four times, and so on. Each doubling of the run costs the same,
/// and the last tenth of the share is given out ever more slowly, so that a run of any length fits and its latest part
/// is still shown.
#[derive(Clone, Copy, Debug)]
pub(super) struct Share {
    limit_bytes: f64,
    /// Content up to here comes at the full (or planned) rate.
    free_bytes: f64,
    spent_bytes: f64,
    /// What would have been spent at the full (or planned) rate.
    offered_bytes: f64,
    planned: u32,
}

impl Share {
    fn new(limit_bytes: f64, free_part: f64) -> Share {
        Share { limit_bytes, free_bytes: free_part * limit_bytes, spent_bytes: 0.0, offered_bytes: 0.0, planned: 0 }
    }

    /// Plans for a run whose content takes `bytes` in all at full rate.
    pub(super) fn plan(&mut self, bytes: f64) {
        self.free_bytes = 0.5 * self.limit_bytes;
        self.planned = (bytes / self.free_bytes).log2().ceil().clamp(0.0, f64::from(HALVINGS_MAX)) as u32;
    }

    /// Takes `bytes` out of the share; false, and nothing taken, where they do not fit any more.
    pub(super) fn spend(&mut self, bytes: usize) -> bool {
        let bytes = bytes as f64;
        if self.spent_bytes + bytes > self.limit_bytes {
            return false;
        }
        self.offered_bytes += bytes * f64::from(self.thinning()).exp2();
        self.spent_bytes += bytes;
        true
    }

    /// How often the rate is to be halved by now, 0 to 24.
    pub(super) fn halvings(&self) -> u32 {
        (self.planned + self.thinning()).min(HALVINGS_MAX)
    }

    /// The halvings on top of the plan.
    fn thinning(&self) -> u32 {
        let doublings = (self.offered_bytes / self.free_bytes).log2().floor().max(-1.0) + 1.0;
        let left = 1.0 - self.spent_bytes / self.limit_bytes;
        let scarce = (0.1 / left.max(1e-6)).floor();
        (doublings + scarce).min(f64::from(HALVINGS_MAX)) as u32
    }
}

/// The shares of one recording. What they leave is for the layout and the file's index.
#[derive(Clone, Copy, Debug)]
pub(super) struct Budget {
    /// Frames with what was found in them.
    pub(super) images: Share,
    /// Points of the surface.
    pub(super) surface: Share,
    /// Plots and poses: one row a frame, then one row for 2, 4, 8 … frames.
    pub(super) rows: Share,
    /// Warnings.
    pub(super) messages: Share,
    /// The depth image.
    pub(super) map: Share,
    /// What cutting the recording into live segments costs on top; not part of the file.
    pub(super) segments: Share,
}

impl Budget {
    /// Surface points that a viewer in a browser still turns smoothly, in bytes of points.
    const SURFACE_MAX_BYTES: f64 = 32e6;

    pub(super) fn new(budget_mb: f64) -> Budget {
        let bytes = budget_mb * BYTES_PER_MB;
        Budget {
            images: Share::new(0.45 * bytes, 0.15),
            surface: Share::new((0.25 * bytes).min(Self::SURFACE_MAX_BYTES), 0.25),
            rows: Share::new(0.20 * bytes, 0.4),
            messages: Share::new(0.01 * bytes, 1.0),
            map: Share::new(0.05 * bytes, 1.0),
            segments: Share::new(0.25 * bytes, 0.4),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Offers an item of 10 bytes at every step; gives the steps at which one was taken.
    fn taken(share: &mut Share, steps: u32) -> Vec<u32> {
        let (mut waited, mut taken) = (0u32, Vec::new());
        for step in 0..steps {
            waited += 1;
            if waited >= 1 << share.halvings() {
                waited = 0;
                if share.spend(10) {
                    taken.push(step);
                }
            }
            assert!(share.spent_bytes <= share.limit_bytes);
        }
        taken
    }

    #[test]
    fn content_thins_out_and_still_reaches_the_end_of_a_long_run() {
        for steps in [10, 100, 1_000, 10_000, 100_000, 1_000_000] {
            let mut share = Share::new(2000.0, 0.2);
            let taken = taken(&mut share, steps);
            let last = taken.last().copied().unwrap_or_default();
            // Fifty times too much for the share is where it gets scarce.
            let near_the_end = match steps {
                0..=10_000 => 0.85,
                10_001..=100_000 => 0.4,
                _ => 0.1,
            };
            assert!(
                f64::from(last) > near_the_end * f64::from(steps) - 1.0,
                "the last of {steps} is {last}: {taken:?}"
            );
            assert!(taken.iter().take(20).eq(&(0..20.min(steps)).collect::<Vec<_>>()), "the start is complete");
            if steps >= 1000 {
                assert!(taken.len() > 120, "{} of 200 used for {steps}", taken.len());
            }
        }
        assert!(!Share::new(100.0, 0.1).spend(101));
    }

    #[test]
    fn a_known_length_is_evenly_dense() {
        for (steps, every) in [(99, 1), (100, 1), (101, 2), (799, 8), (12_800, 128)] {
            let mut share = Share::new(2000.0, 0.2);
            share.plan(10.0 * f64::from(steps));
            let taken = taken(&mut share, steps);
            assert!(taken.windows(2).all(|w| w[1] - w[0] == every), "{steps} steps: {taken:?}");
            assert!(taken.len() as u32 >= (steps - 1) / every);
        }
        // Longer than announced: it thins out from there on, and still fits.
        let mut share = Share::new(2000.0, 0.2);
        share.plan(1000.0);
        assert!(taken(&mut share, 100_000).len() > 150);
    }

    #[test]
    fn the_shares_add_up_to_the_budget() {
        for mb in [5.0, 200.0, 2000.0] {
            let b = Budget::new(mb);
            let sum: f64 = [b.images, b.surface, b.rows, b.messages, b.map].iter().map(|share| share.limit_bytes).sum();
            assert!(sum <= 0.97 * mb * BYTES_PER_MB, "{mb} MB");
        }
    }
}
