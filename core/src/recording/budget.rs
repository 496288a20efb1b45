//! The recording's size: each kind of content has a share that it can never exceed, however long the run.

/// Bytes in a megabyte, as the recipe counts them.
const BYTES_PER_MB: f64 = 1e6;

/// What one kind of content may take, and how much of it is taken.
///
/// As a share fills, its content gets sparser: at full rate for the first half of the share, at half the rate
/// for the next quarter, at a quarter for the next eighth, and so on. A run of any length fits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Share {
    limit_bytes: f64,
    spent_bytes: f64,
}

impl Share {
    fn new(limit_bytes: f64) -> Share {
        Share { limit_bytes, spent_bytes: 0.0 }
    }

    /// Takes `bytes` out of the share; false, and nothing taken, where they do not fit any more.
    pub(super) fn spend(&mut self, bytes: usize) -> bool {
        let spent_bytes = self.spent_bytes + bytes as f64;
        if spent_bytes > self.limit_bytes {
            return false;
        }
        self.spent_bytes = spent_bytes;
        true
    }

    /// How often the rate is to be halved by now.
    pub(super) fn halvings(&self) -> u32 {
        let left = 1.0 - self.spent_bytes / self.limit_bytes;
        (-left.max(1e-6).log2()).floor() as u32
    }

    /// How often to halve the rate from the start, so that `bytes` (all of the content at full rate) fill no
    /// more than the half of the share that is free of further halving: the whole run is then equally dense.
    pub(super) fn halvings_for(&self, bytes: f64) -> u32 {
        (2.0 * bytes / self.limit_bytes).log2().ceil().clamp(0.0, 20.0) as u32
    }

    /// The share's size, bytes.
    pub(super) fn limit_bytes(&self) -> f64 {
        self.limit_bytes
    }
}

/// The shares of one recording.
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
    /// What cutting the recording into live segments costs on top.
    pub(super) segments: Share,
}

impl Budget {
    /// Surface points that a viewer in a browser still turns smoothly, in bytes of points.
    const SURFACE_MAX_BYTES: f64 = 32e6;

    pub(super) fn new(budget_mb: f64) -> Budget {
        let part = |share: f64| Share::new(share * budget_mb * BYTES_PER_MB);
        Budget {
            images: part(0.45),
            surface: Share::new((0.25 * budget_mb * BYTES_PER_MB).min(Self::SURFACE_MAX_BYTES)),
            rows: part(0.20),
            messages: part(0.01),
            map: part(0.05),
            segments: part(0.25),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_is_never_exceeded_and_thins_out_by_halves() {
        let mut share = Share::new(1000.0);
        let (mut step, mut kept, mut last) = (0u32, 0, 0);
        for _ in 0..100_000 {
            step += 1;
            if step >= 1 << share.halvings() {
                step = 0;
                kept += usize::from(share.spend(10));
            }
            assert!(share.halvings() >= last, "never denser again");
            last = share.halvings();
        }
        assert!((90..=100).contains(&kept), "{kept} of 100 fit");
        assert!(!share.spend(1000));
    }

    #[test]
    fn a_known_length_is_planned_at_one_density() {
        let share = Share::new(1000.0);
        assert_eq!(share.halvings_for(400.0), 0);
        assert_eq!(share.halvings_for(500.0), 0);
        assert_eq!(share.halvings_for(501.0), 1);
        assert_eq!(share.halvings_for(4000.0), 3);
        assert_eq!(share.halvings_for(0.0), 0);
    }

    #[test]
    fn the_shares_add_up_to_the_budget() {
        for mb in [5.0, 200.0, 2000.0] {
            let b = Budget::new(mb);
            let sum: f64 = [b.images, b.surface, b.rows, b.messages, b.map].iter().map(Share::limit_bytes).sum();
            assert!(sum <= 0.97 * mb * BYTES_PER_MB, "{mb} MB: the rest is the layout and the file's index");
        }
    }
}
