//! Frames → motion: how the camera moved.
//!
//! Two ways: [`paper`] follows the image from frame to frame, in pixels; [`metric`] finds the camera's pose in
//! millimetres against the surface that the laser has measured.

pub mod metric;
pub mod paper;
mod similarity;

use crate::rig::LineDirection;

/// A corner followed from the previous frame to this one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackedCorner {
    /// Where it was in the previous frame, raw px (column, row).
    pub from_px: [f32; 2],
    /// Where it is in this frame, raw px (column, row).
    pub to_px: [f32; 2],
}

/// The image's motion since the previous frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shift {
    /// Shift of the image's content along the columns, px; negative when the robot moves towards +x.
    /// `None` on the first frame and where tracking was lost.
    pub dx_px: Option<f64>,
    /// Shift along the rows, px.
    pub dy_px: Option<f64>,
    /// Scale of the image; above 1 the camera came closer.
    pub scale: Option<f64>,
    /// Median distance of the corners from the fitted motion, px.
    pub residual_px: Option<f64>,
    /// The corners that were followed.
    pub corners: Vec<TrackedCorner>,
}

impl Shift {
    /// How far the camera moved along world x since the previous frame, px of the image (lib.rs says how the
    /// world lies); 0 where tracking was lost.
    pub fn travel_px(&self, line: LineDirection) -> f64 {
        match line {
            LineDirection::Vertical => -self.dx_px.unwrap_or(0.0),
            LineDirection::Horizontal => -self.dy_px.unwrap_or(0.0),
        }
    }

    /// The same along world y.
    pub fn across_px(&self, line: LineDirection) -> f64 {
        match line {
            LineDirection::Vertical => -self.dy_px.unwrap_or(0.0),
            LineDirection::Horizontal => self.dx_px.unwrap_or(0.0),
        }
    }
}
