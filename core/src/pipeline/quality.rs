//! How well the run was measured: figures, gaps, and the paper's resolution for the run's own geometry.

use super::Request;
use super::progress::Progress;
use crate::error::Result;
use crate::export::manifest::{Gap, Quality, Resolution};
use crate::motion::metric::Drift;
use crate::motion::track::TrackUse;
use crate::rig::Rig;
use crate::stripe::Stripe;
use crate::surface::Placed;
use crate::triangulation::{depth_step_mm, paper_constants, view_height_mm};

/// Gaps that the manifest lists, at most; later ones are only counted.
const MAX_GAPS: usize = 1000;
/// Values that a running median keeps, at most.
const MEDIAN_SAMPLES: usize = 8192;

/// Counts while the frames go by.
pub(super) struct QualityCounter {
    given: Option<TrackUse>,
    quality: Quality,
    line_positions: u64,
    gaps: Vec<Gap>,
    distance_mm: RunningMedian,
    residual_px: RunningMedian,
    last_x_mm: f64,
}

impl QualityCounter {
    /// `given` says what poses given with the source are for.
    pub(super) fn new(given: Option<TrackUse>) -> QualityCounter {
        QualityCounter {
            given,
            quality: Quality::default(),
            line_positions: 0,
            gaps: Vec::new(),
            distance_mm: RunningMedian::default(),
            residual_px: RunningMedian::default(),
            last_x_mm: 0.0,
        }
    }

    /// Counts a frame with its stripe.
    pub(super) fn add<T>(&mut self, placed: &Placed<T>, stripe: &Stripe) {
        let measured = &placed.measured;
        let quality = &mut self.quality;
        quality.frames += 1;
        quality.spots += stripe.found() as u64;
        quality.points += measured.profile.points.len() as u64;
        quality.duration_s = measured.time_s;
        if let Some(pose) = placed.world_from_camera {
            let x_mm = pose.translation.x;
            quality.travel_mm += (x_mm - self.last_x_mm).abs();
            self.last_x_mm = x_mm;
        }
        match placed.degrees_of_freedom {
            6 => quality.frames_6_dof += 1,
            3 => quality.frames_3_dof += 1,
            _ => {}
        }
        quality.breaks = placed.part;
        self.line_positions += stripe.across_px.len() as u64;
        if stripe.found() > 0 {
            quality.frames_with_stripe += 1;
        } else {
            add_gap(&mut self.gaps, measured.frame, "no_stripe");
        }
        if let Some(z_mm) = measured.profile.median_z_mm() {
            self.distance_mm.add(z_mm);
        }
        // A pose that is given needs no motion of the image; then the first frame may lack one, too.
        let has_pose = placed.world_from_camera.is_some();
        let tracked = has_pose && (measured.shift.dx_px.is_some() || self.given.is_some());
        let first = measured.frame == 0;
        quality.frames_tracked += u64::from(tracked && !first);
        if if first { !has_pose && self.given == Some(TrackUse::Instead) } else { !tracked } {
            add_gap(&mut self.gaps, measured.frame, "not_tracked");
        }
        if let Some(residual_px) = measured.shift.residual_px {
            self.residual_px.add(residual_px);
        }
    }

    /// Notes how far the poses may have drifted.
    pub(super) fn note_drift(&mut self, drift: Option<Drift>) {
        self.quality.drift = drift;
    }

    /// The figures; `coverage` is the share of map pixels with a depth.
    pub(super) fn finish(self, rig: &Rig, coverage: f64) -> (Quality, Vec<Gap>, Option<Resolution>) {
        let mut quality = self.quality;
        quality.coverage = coverage;
        quality.rows_found = quality.spots as f64 / self.line_positions.max(1) as f64;
        quality.residual_px = self.residual_px.median();
        let resolution = self.distance_mm.median().map(|z_mm| resolution(rig, z_mm, &quality));
        (quality, self.gaps, resolution)
    }
}

/// Says in words what the figures mean for a person.
pub(super) fn warn_of_quality(
    quality: &Quality,
    gaps: &[Gap],
    request: &Request,
    given: Option<TrackUse>,
    progress: &mut Progress<'_, '_>,
) -> Result<()> {
    if quality.points == 0 && quality.spots > 0 {
        return progress.warn(
            "no point was measured: the laser line was found, but no ray to it meets the rig's laser plane in front of the \
             camera; check that the rig is this run's, and the sign of its baseline"
                .into(),
        );
    }
    if quality.points == 0 {
        let colour = format!("{:?}", request.rig.laser.colour).to_lowercase();
        return progress.warn(format!(
            "no point was measured: no {colour} laser line was found in any of the {} frames; check that the laser was on, \
             and the rig's laser colour",
            quality.frames
        ));
    }
    let without = quality.frames - quality.frames_with_stripe;
    if without > 0 {
        progress.warn(format!("no laser line was found in {without} of {} frames", quality.frames))?;
    }
    if quality.frames == 1 {
        return progress.warn("the run has a single frame: there is no motion, and the map is one column wide".into());
    }
    let lost = quality.frames - 1 - quality.frames_tracked;
    // Of given poses that leave frames out, their reader has said so.
    if lost > 0 && given != Some(TrackUse::Instead) {
        let places = gaps.iter().filter(|g| g.reason == "not_tracked").count();
        progress.warn(format!(
            "the motion was lost in {lost} of {} frames, in {places} places: lengths along the travel are too short there",
            quality.frames
        ))?;
    }
    Ok(())
}

/// Equations (15) to (18) at the run's own distance, speed and frame rate.
fn resolution(rig: &Rig, distance_mm: f64, quality: &Quality) -> Resolution {
    let (c1_mm_px, c2_px) = paper_constants(rig);
    let d_vertical_mm = view_height_mm(rig, distance_mm);
    let steps = quality.frames.saturating_sub(1);
    Resolution {
        distance_mm,
        c1_mm_px,
        c2_px,
        d_vertical_mm,
        r_vertical_mm: d_vertical_mm / f64::from(rig.camera.height_px),
        r_lateral_mm: (steps > 0).then(|| quality.travel_mm / steps as f64),
        r_depth_mm: depth_step_mm(c1_mm_px, c2_px, distance_mm).abs(),
    }
}

/// Adds a frame to a list of gaps.
pub(super) fn add_gap(gaps: &mut Vec<Gap>, frame: u32, reason: &str) {
    let running = gaps.iter_mut().rev().find(|g| g.reason == reason).filter(|g| g.last_frame + 1 == frame);
    if let Some(gap) = running {
        gap.last_frame = frame;
    } else if gaps.len() < MAX_GAPS {
        gaps.push(Gap { first_frame: frame, last_frame: frame, reason: reason.to_string() });
    }
}

/// The median of any number of values from a bounded number of them: when full, every second is dropped
/// and from then on only every second is taken.
#[derive(Default)]
struct RunningMedian {
    values: Vec<f64>,
    every: usize,
    seen: usize,
}

impl RunningMedian {
    fn add(&mut self, value: f64) {
        self.every = self.every.max(1);
        if self.seen.is_multiple_of(self.every) {
            self.values.push(value);
        }
        self.seen += 1;
        if self.values.len() == MEDIAN_SAMPLES {
            let mut index = 0;
            self.values.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.every *= 2;
        }
    }

    fn median(mut self) -> Option<f64> {
        let middle = self.values.len() / 2;
        (!self.values.is_empty()).then(|| *self.values.select_nth_unstable_by(middle, f64::total_cmp).1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_running_median_needs_no_more_room_for_more_values() {
        let mut median = RunningMedian::default();
        for i in 0..100_000 {
            median.add(f64::from(i));
            assert!(median.values.len() <= MEDIAN_SAMPLES);
        }
        let found = median.median().expect("values");
        assert!((found - 50_000.0).abs() < 200.0, "{found}");
    }

    #[test]
    fn neighbouring_frames_make_one_gap() {
        let mut gaps = Vec::new();
        for (frame, reason) in
            [(3, "no_stripe"), (4, "no_stripe"), (4, "not_tracked"), (5, "no_stripe"), (9, "no_stripe")]
        {
            add_gap(&mut gaps, frame, reason);
        }
        let spans: Vec<_> = gaps.iter().map(|g| (g.first_frame, g.last_frame, g.reason.as_str())).collect();
        assert_eq!(spans, [(3, 5, "no_stripe"), (4, 4, "not_tracked"), (9, 9, "no_stripe")]);
    }
}
