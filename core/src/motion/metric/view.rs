//! A frame as the odometry sees it: brightness, and where the laser line hides the wall.

use std::cell::OnceCell;

use super::image::{Gray, Small};
use crate::rig::LineDirection;
use crate::source::Yuv;
use crate::stripe::Stripe;

/// What the frame shows, for all steps.
pub(super) struct FrameView<'a> {
    pub gray: Gray<'a>,
    small: OnceCell<Small>,
    pub line: LineBand,
    pub frame: u32,
}

impl<'a> FrameView<'a> {
    /// A frame's image with its line, `line_width_px` wide.
    pub(super) fn new(frame: u32, image: Yuv<'a>, stripe: &Stripe, line_width_px: f32) -> FrameView<'a> {
        FrameView { gray: Gray::of(image), small: OnceCell::new(), line: LineBand::of(stripe, line_width_px), frame }
    }

    /// The shrunk image.
    pub(super) fn small(&self) -> Gray<'_> {
        self.small.get_or_init(|| Small::of(self.gray)).gray()
    }
}

/// Where the laser line is: nothing near it is the wall's own look.
pub(super) struct LineBand {
    direction: LineDirection,
    /// At each line position the line's place or its neighbours', px; empty where there is no line at all.
    across_px: Vec<f32>,
    half_px: f32,
}

impl LineBand {
    fn of(stripe: &Stripe, line_width_px: f32) -> LineBand {
        let across_px = stripe.filled_px();
        LineBand { direction: stripe.line, across_px, half_px: 2.0 * line_width_px + 14.0 }
    }

    /// (along, across) of an image place.
    pub(super) fn axes(&self, place: (f64, f64)) -> (f64, f64) {
        match self.direction {
            LineDirection::Vertical => (place.1, place.0),
            LineDirection::Horizontal => (place.0, place.1),
        }
    }

    /// Signed distance across the line, px.
    pub(super) fn distance_px(&self, place: (f64, f64)) -> Option<f64> {
        let (along, across) = self.axes(place);
        let last = self.across_px.len().checked_sub(1)?;
        let at = along.round().clamp(0.0, last as f64) as usize;
        Some(across - f64::from(self.across_px[at]))
    }

    /// Whether a landmark's patch there would show the line.
    pub(super) fn covers(&self, place: (f64, f64)) -> bool {
        let (along, across) = self.axes(place);
        let Some(last) = self.across_px.len().checked_sub(1) else { return false };
        // Over the patch's own height the line may lean.
        [-9.0, 0.0, 9.0].iter().any(|off| {
            let at = (along + off).round().clamp(0.0, last as f64) as usize;
            (across - f64::from(self.across_px[at])).abs() < f64::from(self.half_px)
        })
    }
}
