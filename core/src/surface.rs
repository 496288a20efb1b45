//! Profiles + poses → the surface: points in the world, streaming.

use nalgebra::Point3;

/// One point of the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Where it is in the world, mm.
    pub point_in_world: Point3<f64>,
    /// The wall's colour: red, green, blue.
    pub rgb: [u8; 3],
    /// The stripe's confidence, 0 to 1.
    pub confidence: f32,
    /// The frame that measured it.
    pub frame: u32,
}
