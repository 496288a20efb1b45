//! Stripe + Rig → Profile: each spot's ray meets the laser plane.

use nalgebra::Point3;

use crate::geometry::RawPixel;

/// One measured point of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProfilePoint {
    /// Image row of the spot (column, with a horizontal line).
    pub line_position: u32,
    /// Where the spot was seen.
    pub pixel: RawPixel,
    /// Where it is, in the camera's frame, mm.
    pub point_in_camera: Point3<f64>,
    /// The stripe's confidence there, 0 to 1.
    pub confidence: f32,
    /// The wall's colour beside the line: red, green, blue.
    pub rgb: [u8; 3],
}

/// The stripe of one frame as 3D points, in the order of their line position.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Profile {
    /// The points; line positions without a spot are absent.
    pub points: Vec<ProfilePoint>,
}
