//! How the image moved since the previous frame.
//!
//! The publication's steps (METHOD.md, "Image motion" and "Jitter"): Harris corners outside the laser's
//! band, Lucas-Kanade to the next frame, a median filter of window 3 over the shifts in random order and
//! their mean, and the scale of (14) from the same corners.

use opencv::core::{CV_8UC1, Mat, Point2f, Rect, Scalar, Size, TermCriteria, TermCriteria_Type, Vector};
use opencv::imgproc::{COLOR_BGR2GRAY, cvt_color_def, good_features_to_track, rectangle};
use opencv::prelude::*;
use opencv::video::calc_optical_flow_pyr_lk;
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;

use super::similarity::{FEWEST_CORNERS, median, scale_and_residual};
use super::{Shift, TrackedCorner};
use crate::error::Result;
use crate::recipe::MotionOptions;
use crate::rig::LineDirection;
use crate::source::Frame;
use crate::stripe::Stripe;

/// Harris' own constant in the corner measure det − k·trace².
const HARRIS_K: f64 = 0.04;
/// Follows the image from frame to frame; holds the previous frame only.
pub struct ImageTracker {
    options: MotionOptions,
    previous: Option<(Mat, Vector<Point2f>)>,
}

impl ImageTracker {
    /// A tracker that has seen nothing.
    pub fn new(options: &MotionOptions) -> ImageTracker {
        ImageTracker { options: options.clone(), previous: None }
    }

    /// The motion from the frame before to this one.
    pub fn track(&mut self, frame: &Frame, stripe: &Stripe) -> Result<Shift> {
        let flat = Mat::from_slice(frame.image.bgr())?;
        let bgr = flat.reshape(3, frame.image.height_px() as i32)?;
        let mut gray = Mat::default();
        cvt_color_def(&bgr, &mut gray, COLOR_BGR2GRAY)?;
        let shift = match &self.previous {
            Some((before, corners)) if corners.len() >= FEWEST_CORNERS => {
                let tracked = self.follow(before, &gray, corners)?;
                self.shift(tracked, frame.index)
            }
            _ => Shift::default(),
        };
        let corners = self.corners(&gray, stripe)?;
        self.previous = Some((gray, corners));
        Ok(shift)
    }

    /// Harris corners (10) outside the band in which the laser is.
    fn corners(&self, gray: &Mat, stripe: &Stripe) -> Result<Vector<Point2f>> {
        let mut allowed = Mat::new_rows_cols_with_default(gray.rows(), gray.cols(), CV_8UC1, Scalar::all(255.0))?;
        if let Some((low, high)) = stripe.extent_px() {
            let margin = self.options.band_half_width_px;
            let (start, end) = ((f64::from(low) - margin) as i32, (f64::from(high) + margin).ceil() as i32);
            let band = match stripe.line {
                LineDirection::Vertical => Rect::new(start, 0, end - start, gray.rows()),
                LineDirection::Horizontal => Rect::new(0, start, gray.cols(), end - start),
            };
            rectangle(&mut allowed, band, Scalar::all(0.0), opencv::imgproc::FILLED, opencv::imgproc::LINE_8, 0)?;
        }
        let mut corners = Vector::new();
        good_features_to_track(
            gray,
            &mut corners,
            self.options.corners as i32,
            self.options.corner_quality,
            self.options.corner_distance_px,
            &allowed,
            3,
            true,
            HARRIS_K,
        )?;
        Ok(corners)
    }

    /// Lucas-Kanade (11) to (13) on an image pyramid.
    fn follow(&self, before: &Mat, now: &Mat, corners: &Vector<Point2f>) -> Result<Vec<TrackedCorner>> {
        let (mut moved, mut status, mut error) = (Vector::<Point2f>::new(), Vector::<u8>::new(), Vector::<f32>::new());
        let window = Size::new(self.options.window_px as i32, self.options.window_px as i32);
        let stop = TermCriteria::new(TermCriteria_Type::COUNT as i32 + TermCriteria_Type::EPS as i32, 30, 0.005)?;
        let levels = self.options.pyramid_levels as i32;
        calc_optical_flow_pyr_lk(
            before,
            now,
            corners,
            &mut moved,
            &mut status,
            &mut error,
            window,
            levels,
            stop,
            0,
            1e-4,
        )?;
        let inside = |p: &Point2f| p.x >= 0.0 && p.y >= 0.0 && p.x < now.cols() as f32 && p.y < now.rows() as f32;
        let all = corners.iter().zip(moved.iter()).zip(status.iter());
        Ok(all
            .filter(|((_, to), ok)| *ok == 1 && inside(to))
            .map(|((from, to), _)| TrackedCorner { from_px: [from.x, from.y], to_px: [to.x, to.y] })
            .collect())
    }

    fn shift(&self, corners: Vec<TrackedCorner>, frame: u32) -> Shift {
        if corners.len() < FEWEST_CORNERS {
            return Shift { corners, ..Shift::default() };
        }
        let mut shuffled: Vec<&TrackedCorner> = corners.iter().collect();
        // Random, and yet the same on every run of the same source.
        shuffled.shuffle(&mut StdRng::seed_from_u64(u64::from(frame)));
        let along = |axis: usize| -> Vec<f64> {
            shuffled.iter().map(|c| f64::from(c.to_px[axis]) - f64::from(c.from_px[axis])).collect()
        };
        let window = self.options.median_window as usize;
        let (dx, dy) = (mean_of_medians(&along(0), window), mean_of_medians(&along(1), window));
        let (scale, residual_px) = scale_and_residual(&corners);
        Shift { dx_px: Some(dx), dy_px: Some(dy), scale, residual_px: Some(residual_px), corners }
    }
}

/// The mean of a running median over the values.
fn mean_of_medians(values: &[f64], window: usize) -> f64 {
    let window = window.clamp(1, values.len());
    let medians = values.windows(window).map(|part| median(&mut part.to_vec()));
    medians.sum::<f64>() / (values.len() - window + 1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::Image;

    /// Smooth blobs that move by (dx, dy) px and grow by `scale` about the image's middle.
    fn blobs(dx: f64, dy: f64, scale: f64) -> Frame {
        let (width, height) = (320_u32, 240_u32);
        let mut bgr = Vec::new();
        for row in 0..height {
            for column in 0..width {
                let x = (f64::from(column) - dx - 160.0) / scale;
                let y = (f64::from(row) - dy - 120.0) / scale;
                let value =
                    128.0 + 50.0 * (x * 0.21 + 0.05 * y).sin() * (y * 0.17).cos() + 40.0 * (x * 0.07 - y * 0.11).sin();
                bgr.extend([value.round() as u8; 3]);
            }
        }
        Frame { index: 0, time_s: 0.0, image: Image::from_bgr(width, height, bgr) }
    }

    fn no_stripe() -> Stripe {
        Stripe::empty(LineDirection::Vertical, 240)
    }

    #[test]
    fn shift_and_scale_are_met() {
        for (dx, dy, scale) in [(-3.4, 0.6, 1.0), (7.25, -1.5, 1.0), (-3.0, 0.0, 1.01), (0.0, 0.0, 0.99)] {
            let mut tracker = ImageTracker::new(&MotionOptions::default());
            assert_eq!(tracker.track(&blobs(0.0, 0.0, 1.0), &no_stripe()).expect("first").dx_px, None);
            let shift = tracker.track(&blobs(dx, dy, scale), &no_stripe()).expect("second");
            let (found_dx, found_dy) = (shift.dx_px.expect("dx"), shift.dy_px.expect("dy"));
            // With scale, the mean over the corners depends on where they lie.
            let slack = if scale == 1.0 { 0.02 } else { 0.5 };
            assert!((found_dx - dx).abs() < slack && (found_dy - dy).abs() < slack, "{found_dx} {found_dy}");
            assert!((shift.scale.expect("scale") - scale).abs() < 5e-4, "{:?}", shift.scale);
        }
    }

    #[test]
    fn a_blank_wall_is_not_tracked() {
        let blank = || Frame { index: 0, time_s: 0.0, image: Image::from_bgr(64, 64, vec![90; 64 * 64 * 3]) };
        let mut tracker = ImageTracker::new(&MotionOptions::default());
        tracker.track(&blank(), &no_stripe()).expect("first");
        assert_eq!(tracker.track(&blank(), &no_stripe()).expect("second").dx_px, None);
    }

    #[test]
    fn no_corner_is_taken_in_the_lasers_band() {
        let tracker = ImageTracker::new(&MotionOptions { band_half_width_px: 30.0, ..MotionOptions::default() });
        let stripe = Stripe { across_px: vec![150.0; 240], confidence: vec![1.0; 240], ..no_stripe() };
        let frame = blobs(0.0, 0.0, 1.0);
        let flat = Mat::from_slice(frame.image.bgr()).expect("mat");
        let mut gray = Mat::default();
        cvt_color_def(&flat.reshape(3, 240).expect("rows"), &mut gray, COLOR_BGR2GRAY).expect("gray");
        let corners = tracker.corners(&gray, &stripe).expect("corners");
        assert!(corners.len() > 20 && corners.iter().all(|c| (c.x - 150.0).abs() >= 30.0));
    }
}
