//! Pixels, points, planes and poses. Lengths in mm, angles in radians.
//!
//! Raw and undistorted image positions are different types, so that the compiler catches the
//! classic mistake of triangulating a pixel that the lens has moved.

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};

/// A position in the image as recorded, in px: (0, 0) is the centre of the top left pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RawPixel {
    /// Column, px.
    pub u_px: f64,
    /// Row, px.
    pub v_px: f64,
}

/// A viewing direction with the lens distortion removed: the point (x, y, 1) in the camera's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UndistortedRay {
    /// X / Z, no unit.
    pub x: f64,
    /// Y / Z, no unit.
    pub y: f64,
}

impl UndistortedRay {
    /// The ray's direction, scaled to z = 1.
    pub fn direction(&self) -> Vector3<f64> {
        Vector3::new(self.x, self.y, 1.0)
    }
}

/// A plane in the camera's frame: every X with `normal · X = offset_mm`; the normal has length 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Unit normal.
    pub normal: Vector3<f64>,
    /// Signed distance of the plane from the camera's centre along the normal, mm.
    pub offset_mm: f64,
}

impl Plane {
    /// Where a ray from the camera's centre meets the plane, in front of the camera; `None` where it
    /// never does (parallel, or behind).
    pub fn meet(&self, ray: UndistortedRay) -> Option<Point3<f64>> {
        let slope = self.normal.dot(&ray.direction());
        if slope.abs() < 1e-9 {
            return None;
        }
        let z_mm = self.offset_mm / slope;
        (z_mm.is_finite() && z_mm > 0.0).then(|| Point3::from(ray.direction() * z_mm))
    }
}

/// Where the camera is: takes a point in the camera's frame to the world, mm.
pub type WorldFromCamera = Isometry3<f64>;

/// Builds a pose from a position (mm) and CONTRACT's angles (radians): R = Ry(yaw)·Rx(pitch)·Rz(roll).
pub fn world_from_camera(position_mm: Vector3<f64>, roll_rad: f64, pitch_rad: f64, yaw_rad: f64) -> WorldFromCamera {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw_rad)
        * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), pitch_rad)
        * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), roll_rad);
    Isometry3::from_parts(position_mm.into(), rotation)
}

/// The inverse of [`world_from_camera`]: (roll, pitch, yaw) in radians.
pub fn roll_pitch_yaw(pose: &WorldFromCamera) -> (f64, f64, f64) {
    let r = pose.rotation.to_rotation_matrix();
    let m = r.matrix();
    let pitch = (-m[(1, 2)]).clamp(-1.0, 1.0).asin();
    let yaw = m[(0, 2)].atan2(m[(2, 2)]);
    let roll = m[(1, 0)].atan2(m[(1, 1)]);
    (roll, pitch, yaw)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_survive_a_round_trip() {
        let pose = world_from_camera(Vector3::new(1.0, 2.0, 3.0), 0.1, -0.2, 0.3);
        let (roll, pitch, yaw) = roll_pitch_yaw(&pose);
        assert!((roll - 0.1).abs() < 1e-12 && (pitch + 0.2).abs() < 1e-12 && (yaw - 0.3).abs() < 1e-12);
    }

    #[test]
    fn a_plane_behind_the_camera_is_never_met() {
        let plane = Plane { normal: Vector3::x(), offset_mm: -100.0 };
        assert!(plane.meet(UndistortedRay { x: 0.5, y: 0.0 }).is_none());
        let point = plane.meet(UndistortedRay { x: -0.5, y: 0.1 }).expect("in front");
        assert!((point.z - 200.0).abs() < 1e-9);
    }
}
