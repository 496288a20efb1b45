//! Stripe + Rig → Profile: each spot's ray meets the laser plane.
//!
//! The general form of the paper's equations (1) to (5): an undistorted ray against the calibrated
//! plane. For the paper's own geometry (a pinhole looking square at the wall, the plane X − Z/tan β = d)
//! the two agree; [`distance_from_column`] is equation (5) itself, kept as a reference.

use nalgebra::Point3;

use crate::geometry::RawPixel;
use crate::rig::Rig;
use crate::stripe::Stripe;

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
}

/// The stripe of one frame as 3D points, in the order of their line position.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Profile {
    /// The points; line positions without a spot, or whose ray misses the plane, are absent.
    pub points: Vec<ProfilePoint>,
}

impl Profile {
    /// Median distance from the camera along its axis, mm; `None` where there are no points.
    pub fn median_z_mm(&self) -> Option<f64> {
        let mut z: Vec<f64> = self.points.iter().map(|p| p.point_in_camera.z).collect();
        let middle = z.len() / 2;
        (!z.is_empty()).then(|| *z.select_nth_unstable_by(middle, f64::total_cmp).1)
    }
}

/// Places each spot of a stripe in space.
pub fn triangulate(stripe: &Stripe, rig: &Rig) -> Profile {
    let points = stripe.spots().filter_map(|(i, pixel)| {
        let point_in_camera = rig.laser.plane.meet(rig.camera.undistort(pixel))?;
        Some(ProfilePoint { line_position: i as u32, pixel, point_in_camera, confidence: stripe.confidence[i] })
    });
    Profile { points: points.collect() }
}

/// The paper's constants of a rig: C1 of equation (3), mm·px, and C2 of equation (4), px.
///
/// For a general plane these are the values of its section with the plane Y = 0 (X = 0 with a horizontal
/// line): x − C2 = C1 / l.
pub fn paper_constants(rig: &Rig) -> (f64, f64) {
    let normal = rig.laser.plane.normal;
    let (across, f_px) = match rig.laser.line {
        crate::rig::LineDirection::Vertical => (normal.x, rig.camera.fx_px),
        crate::rig::LineDirection::Horizontal => (normal.y, rig.camera.fy_px),
    };
    (f_px * rig.laser.plane.offset_mm / across, -f_px * normal.z / across)
}

/// Equation (5) with the sign that follows from (1) (METHOD.md's note): distance l, mm, of a spot at
/// column `x_px` counted from the principal point.
pub fn distance_from_column(c1_mm_px: f64, c2_px: f64, x_px: f64) -> f64 {
    c1_mm_px / (x_px - c2_px)
}

/// Equation (18): the depth step of one pixel at distance `l_mm`, mm.
pub fn depth_step_mm(c1_mm_px: f64, c2_px: f64, l_mm: f64) -> f64 {
    let x_px = c1_mm_px / l_mm + c2_px;
    distance_from_column(c1_mm_px, c2_px, x_px) - distance_from_column(c1_mm_px, c2_px, x_px + 1.0)
}

/// Equation (15) in its right form (METHOD.md's note: the printed factor is half): the height of the view
/// at distance `l_mm`, mm. It equals height_px · l / f for square pixels.
pub fn view_height_mm(rig: &Rig, l_mm: f64) -> f64 {
    f64::from(rig.camera.height_px) * l_mm / rig.camera.fy_px
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::{LaserColour, LineDirection};

    fn stripe_at(column_px: f32) -> Stripe {
        Stripe {
            across_px: vec![column_px; 720],
            confidence: vec![1.0; 720],
            ..Stripe::empty(LineDirection::Vertical, 720)
        }
    }

    #[test]
    fn the_plane_agrees_with_equation_5_for_any_angle() {
        for angle_deg in [60.0_f64, 90.0, 95.0, 120.0] {
            let rig = Rig::from_paper(1280, 720, 1.2, 150.0, angle_deg.to_radians(), LaserColour::Green);
            let (c1, c2) = paper_constants(&rig);
            // Equations (3) and (4) by the paper's own quantities.
            let d_over = 1280.0 / (2.0 * 0.6_f64.tan());
            assert!((c1 - d_over * 150.0).abs() < 1e-6 && (c2 - d_over / angle_deg.to_radians().tan()).abs() < 1e-6);
            let x_px = c1 / 700.0 + c2;
            let profile = triangulate(&stripe_at((x_px + rig.camera.cx_px) as f32), &rig);
            let z_mm = profile.median_z_mm().expect("points");
            assert!((z_mm - distance_from_column(c1, c2, x_px)).abs() < 1e-2, "{angle_deg}°: {z_mm} mm");
        }
    }

    #[test]
    fn the_papers_resolution_example() {
        // C1 = 225,800 mm·px: 3.2 mm at 850 mm and 0.9 mm at 450 mm.
        let round = |v: f64| (v * 10.0).round() / 10.0;
        assert_eq!(round(depth_step_mm(225_800.0, 0.0, 850.0)), 3.2);
        assert_eq!(round(depth_step_mm(225_800.0, 0.0, 450.0)), 0.9);
    }

    #[test]
    fn a_lens_moves_the_spot_but_not_the_point() {
        let mut rig = Rig::from_paper(1280, 720, 1.2, 150.0, 1.6, LaserColour::Green);
        rig.camera.distortion = [-0.28, 0.1, 0.0008, -0.0005, 0.0, 0.0, 0.0, 0.0];
        let truth = Point3::new(150.0 + 800.0 / 1.6_f64.tan(), -150.0, 800.0);
        let pixel = rig.camera.project(&truth);
        let found = rig.laser.plane.meet(rig.camera.undistort(pixel)).expect("meets");
        assert!((found - truth).norm() < 1e-6);
    }
}
