//! The growing surface: every profile thinned out, coloured by its depth, in batches of points.

use rerun::log::Chunk;
use rerun::{Points3D, Radius};

use super::budget::Share;
use super::data::{Moment, failed, fixed, rows};
use super::{FrameSteps, entity, metres};
use crate::error::Result;
use crate::surface::SurfacePoint;

/// Position and colour.
const POINT_BYTES: usize = 16;
/// Points that make a batch; the viewer draws each batch with one call.
const BATCH_POINTS: usize = 4096;
/// A live segment carries what there is of a batch from here on.
const LIVE_BATCH_POINTS: usize = 512;
/// The fewest points of a profile that still show its shape.
const PROFILE_POINTS_MIN: usize = 8;

/// Depths of the two ends of the colour scale, mm of world z. Fixed by the first batch: colours must not change
/// while the surface grows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct DepthRange {
    pub near_mm: f64,
    pub far_mm: f64,
}

/// Collects the surface's points.
pub(super) struct Surface {
    points_per_profile: usize,
    frames_skipped: u32,
    batch: Vec<SurfacePoint>,
    last: Moment,
    range: Option<DepthRange>,
}

impl Surface {
    pub(super) fn new(points_per_profile: u32, frames_expected: Option<u64>, share: &mut Share) -> Surface {
        if let Some(frames) = frames_expected {
            share.plan(frames as f64 * f64::from(points_per_profile) * POINT_BYTES as f64);
        }
        Surface {
            points_per_profile: points_per_profile as usize,
            frames_skipped: 0,
            batch: vec![],
            last: Moment::default(),
            range: None,
        }
    }

    /// How the points are drawn.
    pub(super) fn opening() -> Result<Vec<Chunk>> {
        Ok(vec![fixed(entity::SURFACE, &Points3D::update_fields().with_radii([Radius::new_ui_points(1.5)]))?])
    }

    pub(super) fn push(&mut self, steps: &FrameSteps<'_>, share: &mut Share) {
        if steps.points.is_empty() {
            return;
        }
        // Halvings go in turn to the frames and to the points of a frame, so that the surface stays evenly covered.
        let halvings = share.halvings();
        let wanted = (self.points_per_profile >> (halvings / 2)).max(PROFILE_POINTS_MIN);
        self.frames_skipped += 1;
        if self.frames_skipped < 1 << halvings.div_ceil(2) {
            return;
        }
        let step = steps.points.len().div_ceil(wanted);
        let kept = steps.points.len().div_ceil(step);
        if share.spend(kept * POINT_BYTES) {
            self.batch.extend(steps.points.iter().step_by(step));
            self.last = steps.moment();
            self.frames_skipped = 0;
        }
    }

    /// The batch, once it is large enough (`live`: for a live segment; `all`: at the end of the run).
    pub(super) fn take(&mut self, live: bool, all: bool) -> Result<Option<Chunk>> {
        let enough = match (all, live) {
            (true, _) => 1,
            (_, true) => LIVE_BATCH_POINTS,
            _ => BATCH_POINTS,
        };
        if self.batch.len() < enough {
            return Ok(None);
        }
        let range = *self.range.get_or_insert_with(|| depth_range(&self.batch));
        let points = Points3D::update_fields()
            .with_positions(self.batch.iter().map(|p| metres(&p.point_in_world)))
            .with_colors(self.batch.iter().map(|p| colour(p, range)));
        let chunk = rows(entity::SURFACE, &[self.last], points.columns([self.batch.len()]).map_err(failed)?)?;
        self.batch.clear();
        Ok(Some(chunk))
    }

    /// The colour scale's ends, once the first batch is out.
    pub(super) fn range(&self) -> Option<DepthRange> {
        self.range
    }
}

/// Nearly all of the depths, with a quarter of their spread on either side for what is still to come.
fn depth_range(points: &[SurfacePoint]) -> DepthRange {
    let mut z: Vec<f64> = points.iter().map(|p| p.point_in_world.z).filter(|z| z.is_finite()).collect();
    z.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| z.get((share * (z.len().max(1) - 1) as f64) as usize).copied().unwrap_or(0.0);
    let (low, high) = (at(0.02), at(0.98));
    let margin = 0.25 * (high - low) + 1.0;
    DepthRange { near_mm: low - margin, far_mm: high + margin }
}

/// The hue says how deep the point lies (red near, blue far), the brightness is the wall's own.
fn colour(point: &SurfacePoint, range: DepthRange) -> [u8; 3] {
    let depth = (point.point_in_world.z - range.near_mm) / (range.far_mm - range.near_mm);
    let [r, g, b] = point.rgb.map(f64::from);
    let brightness = (0.299 * r + 0.587 * g + 0.114 * b) / 255.0;
    let light = (0.65 + brightness).min(1.0);
    scale_colour(1.0 - depth).map(|c| (f64::from(c) * light).round() as u8)
}

/// Blue, cyan, green, yellow, red for 0 to 1.
fn scale_colour(value: f64) -> [u8; 3] {
    const STOPS: [[f64; 3]; 5] =
        [[48.0, 79.0, 214.0], [38.0, 188.0, 225.0], [90.0, 210.0, 90.0], [250.0, 208.0, 60.0], [220.0, 50.0, 47.0]];
    let x = if value.is_finite() { value.clamp(0.0, 1.0) * 4.0 } else { 0.0 };
    let i = (x as usize).min(3);
    let t = x - i as f64;
    std::array::from_fn(|c| (STOPS[i][c] + t * (STOPS[i + 1][c] - STOPS[i][c])).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    #[test]
    fn near_is_red_and_far_is_blue() {
        let at =
            |z| SurfacePoint { point_in_world: Point3::new(0.0, 0.0, z), rgb: [255; 3], confidence: 1.0, frame: 0 };
        let range = depth_range(&[at(100.0), at(110.0)]);
        assert!(range.near_mm < 100.0 && range.far_mm > 100.0);
        let (near, far) = (colour(&at(range.near_mm), range), colour(&at(range.far_mm), range));
        assert_eq!((near, far), ([220, 50, 47], [48, 79, 214]));
        assert_eq!(colour(&at(-1e9), range), near, "what lies beyond the scale has its end's colour");
        assert_eq!(depth_range(&[]), DepthRange { near_mm: -1.0, far_mm: 1.0 });
    }
}
