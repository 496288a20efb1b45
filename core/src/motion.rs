//! Frames → motion: how the camera moved.
//!
//! Two ways: [`paper`] follows the image from frame to frame, in pixels; [`metric`] finds the camera's pose in
//! millimetres against the surface that the laser has measured. Poses may also be given with the source: [`track`].

pub mod metric;
pub mod paper;
mod similarity;
pub mod track;

use nalgebra::{Isometry3, UnitQuaternion, Vector3};

use crate::rig::LineDirection;

/// `camera_from_world` at the run's start (lib.rs): the world is the camera's frame, turned so that x lies along the
/// travel.
pub fn start_pose(line: LineDirection) -> Isometry3<f64> {
    match line {
        LineDirection::Vertical => Isometry3::identity(),
        LineDirection::Horizontal => Isometry3::from_parts(
            Vector3::zeros().into(),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2),
        ),
    }
}

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
