//! Profiles + motion → the surface: each profile placed in the world, streaming.
//!
//! A profile measured with `metric` is placed by its own pose. [`paper`] places them side by side, as the image moved.

pub mod paper;

use nalgebra::Point3;

use crate::geometry::WorldFromCamera;
use crate::motion::Shift;
use crate::triangulation::Profile;

/// One point of the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Where it is in the world, mm.
    pub point_in_world: Point3<f64>,
    /// The wall's colour beside the line: red, green, blue.
    pub rgb: [u8; 3],
    /// The stripe's confidence, 0 to 1.
    pub confidence: f32,
    /// The frame that measured it.
    pub frame: u32,
}

/// What one frame gives to the surface.
pub struct Measured<T> {
    /// The frame's index.
    pub frame: u32,
    /// Its capture time, s.
    pub time_s: f64,
    /// Its profile.
    pub profile: Profile,
    /// Its motion.
    pub shift: Shift,
    /// Whatever else travels with the frame.
    pub cargo: T,
}

/// A frame with its place in the world.
pub struct Placed<T> {
    /// What was measured.
    pub measured: Measured<T>,
    /// The camera's place; `None` where the motion was lost: such a frame gives nothing to the surface.
    pub world_from_camera: Option<WorldFromCamera>,
    /// How many of the pose's degrees of freedom were measured, or given with the source; the others are the starting
    /// ones. 0 where the image's motion was lost, even if a given motion carried the pose on.
    pub degrees_of_freedom: u8,
    /// The part of the way without a break that the frame belongs to, from 0.
    pub part: u32,
    /// The frame's strip in the publication's map; only with method `paper`.
    pub strip: Option<paper::StripPlace>,
}
