//! Is the calibration to be trusted? Refusals and warnings, each with what to photograph next.

use super::camera::CameraFit;
use super::plane::PlaneFit;
use crate::error::{Error, Result};

/// Fewest photos with the board: a lens with distortion and a plane need some spread of views.
pub(super) const MIN_BOARDS: usize = 6;
/// The board must be tilted out of the image's plane by this much in some photo, degrees: without tilt, focal
/// length and distance cannot be told apart.
const MIN_TILT_DEG: f64 = 10.0;
/// Largest reprojection error, px in an image 1280 px wide: beyond it the board is not flat, or not that board.
const MAX_RMS_PX: f64 = 1.0;
/// Largest standard deviation of the focal length, share of it: depth is as wrong as the focal length.
const MAX_FOCAL_SHARE: f64 = 3e-3;
/// Standard deviation of the focal length from which a warning is due, share of it.
const GOOD_FOCAL_SHARE: f64 = 1e-3;
/// Largest standard deviation of the centre, share of the image's width.
const MAX_CENTRE_SHARE: f64 = 2e-3;
/// Share of the image, by the hull of all corners, below which a lens cannot be known beyond the boards.
const MIN_COVERAGE: f64 = 0.12;
/// Share below which a warning is due.
const GOOD_COVERAGE: f64 = 0.25;
/// Least spread of the laser's points across their main direction, share of their distance.
const MIN_SPREAD: f64 = 0.02;
/// Largest standard deviation of the laser plane's direction, degrees, and of its offset, mm.
const MAX_PLANE_DEG: f64 = 0.15;
const MAX_PLANE_MM: f64 = 0.5;
/// Standard deviation of its direction from which a warning is due, degrees.
const GOOD_PLANE_DEG: f64 = 0.05;
/// Largest distance of the laser's points from the plane, share of their distance.
const MAX_PLANE_RMS_SHARE: f64 = 2e-3;

/// Refuses a camera that the photos do not determine; `coverage` is the share of the image that they cover.
pub(super) fn check_camera(fit: &CameraFit, coverage: f64) -> Result<()> {
    let refuse = |found: String, advice: &str| Err(Error::input("the photos", found, advice));
    let camera = &fit.camera;
    let width = f64::from(camera.width_px);
    let tilt_deg = largest_tilt_deg(fit);
    if tilt_deg < MIN_TILT_DEG {
        return refuse(
            format!("the board is never tilted by more than {tilt_deg:.0}° against the image"),
            "photos with the board tilted by 15° to 40°, to the left, to the right, up and down",
        );
    }
    let max_rms_px = MAX_RMS_PX * (width / 1280.0).max(1.0);
    if fit.rms_px > max_rms_px {
        return refuse(
            format!(
                "the corners are {:.2} px off where the camera would see them (at most {max_rms_px:.2} px)",
                fit.rms_px
            ),
            "a stiff, flat board of equal squares, sharp photos, camera and board at rest, no zoom or autofocus between them",
        );
    }
    if coverage < MIN_COVERAGE {
        return refuse(
            format!("the boards cover {:.0} % of the image", 100.0 * coverage),
            "photos with the board near each corner and each side of the image, filling a third of it or more",
        );
    }
    let share = fit.deviations.focal_px / camera.fx_px;
    if share.is_nan() || share > MAX_FOCAL_SHARE {
        return refuse(
            format!("the focal length is only known to ± {:.2} %", 100.0 * share),
            "± 0.3 % or better: more photos, nearer, with the board tilted by 15° to 40° in different directions",
        );
    }
    let (u, v) = fit.deviations.centre_px;
    if (u + v).is_nan() || u.max(v) > MAX_CENTRE_SHARE * width {
        return refuse(
            format!("the image's centre is only known to ± {:.1} px", u.max(v)),
            "more photos with the board tilted, turned by 90°, and near each corner of the image",
        );
    }
    Ok(())
}

/// Refuses a laser plane that the lines do not determine.
pub(super) fn check_plane(fit: &PlaneFit, angle_rad: f64, offset_mm: f64) -> Result<()> {
    let refuse = |found: String, advice: &str| Err(Error::input("the photos", found, advice));
    let mean_mm = 0.5 * (fit.depth_mm.0 + fit.depth_mm.1);
    if fit.spread < MIN_SPREAD {
        return refuse(
            format!(
                "all laser lines lie on one another, {:.0} to {:.0} mm from the camera: they fix no plane",
                fit.depth_mm.0, fit.depth_mm.1
            ),
            "photos with the laser on and the board at clearly different distances, from the nearest to the farthest wall",
        );
    }
    if fit.rms_mm > MAX_PLANE_RMS_SHARE * mean_mm {
        return refuse(
            format!("the laser's points are {:.2} mm off a plane", fit.rms_mm),
            "a laser fixed to the camera, a straight line, a flat board",
        );
    }
    let angle_deg = angle_rad.to_degrees();
    if (angle_deg + offset_mm).is_nan() || angle_deg > MAX_PLANE_DEG || offset_mm > MAX_PLANE_MM {
        return refuse(
            format!("the laser plane is only known to ± {angle_deg:.2}° and ± {offset_mm:.2} mm"),
            "± 0.15° and ± 0.5 mm or better: more photos with the laser's line on the board, at more different distances",
        );
    }
    Ok(())
}

/// What could be better, in words for people.
pub(super) fn warnings(camera: &CameraFit, coverage: f64, plane: &PlaneFit, angle_rad: f64) -> Vec<String> {
    let mut warnings = Vec::new();
    let share = camera.deviations.focal_px / camera.camera.fx_px;
    if share > GOOD_FOCAL_SHARE {
        warnings.push(format!(
            "the focal length is known to ± {:.2} %: more photos, nearer and more tilted, make it better",
            100.0 * share
        ));
    }
    if angle_rad.to_degrees() > GOOD_PLANE_DEG {
        warnings.push(format!(
            "the laser plane is known to ± {:.2}°: more photos, near each corner of the image and at more distances, make it better",
            angle_rad.to_degrees()
        ));
    }
    if coverage < GOOD_COVERAGE {
        warnings.push(format!(
            "the boards cover {:.0} % of the image; outside them the lens is a guess: take photos with the board near the image's corners",
            100.0 * coverage
        ));
    }
    if camera.views.len() < 10 {
        warnings.push(format!("{} photos with the board; 12 to 20 make the figures sturdier", camera.views.len()));
    }
    if plane.photos.len() < 6 {
        warnings
            .push(format!("the laser's line lies on the board in {} photos; 8 or more are better", plane.photos.len()));
    }
    warnings
}

/// The largest angle between a board and the image's plane, degrees.
fn largest_tilt_deg(fit: &CameraFit) -> f64 {
    let tilt = |pose: &nalgebra::Isometry3<f64>| (pose.rotation * nalgebra::Vector3::z()).z.abs().min(1.0).acos();
    fit.views.iter().map(|v| tilt(&v.camera_from_board)).fold(0.0, f64::max).to_degrees()
}
