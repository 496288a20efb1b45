//! The corners of many photos → the camera, its lens, and where the board was in each photo.
//!
//! Zhang, "A flexible new technique for camera calibration" (2000), as OpenCV has it. Which terms of the lens the
//! photos can tell is decided by the Bayesian information criterion: a term that explains nothing but noise would
//! make every other figure worse, the centre's and the laser plane's most of all.

use nalgebra::{Isometry3, Rotation3, UnitQuaternion, Vector3};
use opencv::calib3d::{
    CALIB_FIX_ASPECT_RATIO, CALIB_FIX_K1, CALIB_FIX_K2, CALIB_FIX_K3, CALIB_USE_INTRINSIC_GUESS,
    CALIB_ZERO_TANGENT_DIST, calibrate_camera_extended, rodrigues_def,
};
use opencv::core::{CV_64F, Mat, Point2f, Point3f, Size, TermCriteria, Vector};
use opencv::prelude::*;

use super::board::{Board, Corner};
use crate::error::{Error, Result};
use crate::rig::Camera;

/// Lens models from plain to rich: what is held at zero, parameters, name.
const LENSES: [(i32, usize, &str); 5] = [
    (CALIB_FIX_K1 | CALIB_FIX_K2 | CALIB_FIX_K3 | CALIB_ZERO_TANGENT_DIST, 0, "none"),
    (CALIB_FIX_K2 | CALIB_FIX_K3 | CALIB_ZERO_TANGENT_DIST, 1, "k1"),
    (CALIB_FIX_K3 | CALIB_ZERO_TANGENT_DIST, 2, "k1 k2"),
    (CALIB_FIX_K3, 4, "k1 k2 p1 p2"),
    (0, 5, "k1 k2 p1 p2 k3"),
];
/// How much better a richer model must be, in the criterion's unit ("very strong", Kass and Raftery 1995).
const BETTER_BIC: f64 = 10.0;
/// Corners farther off than so many robust standard deviations are left out.
const OUTLIER_SIGMAS: f64 = 5.0;
/// Corners nearer than this to their place are never left out, px.
const OUTLIER_FLOOR_PX: f64 = 0.15;
/// Rounds of leaving out and fitting again.
const OUTLIER_ROUNDS: usize = 3;
/// Fewest corners of a photo that still count: a pose needs four, and a margin.
pub(super) const MIN_CORNERS: usize = 8;
/// Focal lengths to begin with where the photos alone give no beginning, image widths.
const FOCAL_GUESSES: [f64; 3] = [0.7, 1.2, 2.5];

/// One photo's part in the fit.
#[derive(Clone, Debug)]
pub(super) struct View {
    /// The photo's number.
    pub photo: usize,
    /// Its corners; those that do not agree with the rest are taken out by the fit.
    pub corners: Vec<Corner>,
}

/// A photo with the board's pose.
#[derive(Clone, Debug)]
pub(super) struct Posed {
    pub photo: usize,
    pub corners: Vec<Corner>,
    /// Where each corner was seen, less where the model puts it, px.
    pub residuals_px: Vec<(f64, f64)>,
    pub camera_from_board: Isometry3<f64>,
}

impl Posed {
    /// Root of the mean squared distance of the corners from their places, px.
    pub(super) fn rms_px(&self) -> f64 {
        (self.residuals_px.iter().map(|(u, v)| u * u + v * v).sum::<f64>() / self.residuals_px.len() as f64).sqrt()
    }
}

/// Standard deviations of a camera's figures.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraDeviations {
    /// Of the focal length, px.
    pub focal_px: f64,
    /// Of the centre's column and row, px.
    pub centre_px: (f64, f64),
    /// Of k1 k2 p1 p2 k3; zero where the term is not used.
    pub distortion: [f64; 5],
}

/// The fit.
#[derive(Clone, Debug)]
pub(super) struct CameraFit {
    pub camera: Camera,
    pub deviations: CameraDeviations,
    pub lens: &'static str,
    pub rms_px: f64,
    pub views: Vec<Posed>,
}

/// Fits camera, lens and poses.
///
/// # Errors
/// [`Error::Input`] where no camera explains the corners.
pub(super) fn fit(board: &Board, size_px: (u32, u32), mut views: Vec<View>) -> Result<CameraFit> {
    let mut best = choose(board, size_px, &views)?;
    for _ in 0..OUTLIER_ROUNDS {
        let left_out = leave_out(&mut views, &best);
        if left_out == 0 {
            break;
        }
        best = choose(board, size_px, &views)?;
    }
    Ok(best)
}

/// The plainest model that a richer one does not clearly beat.
fn choose(board: &Board, size_px: (u32, u32), views: &[View]) -> Result<CameraFit> {
    let mut best: Option<(f64, i32, CameraFit)> = None;
    for (flags, terms, lens) in LENSES {
        consider(&mut best, board, size_px, views, (flags | CALIB_FIX_ASPECT_RATIO, terms, lens));
    }
    // Square pixels unless the photos say otherwise.
    if let Some((_, flags, fit)) = &best {
        let terms = LENSES.iter().find(|l| l.2 == fit.lens).map_or(0, |l| l.1);
        let free = (flags & !CALIB_FIX_ASPECT_RATIO, terms + 1, fit.lens);
        consider(&mut best, board, size_px, views, free);
    }
    best.map(|b| b.2).ok_or_else(|| {
        Error::input(
            "the photos",
            "no camera explains where the board's corners are seen",
            "a stiff, flat board, tilted by 15° to 40° in different directions from photo to photo",
        )
    })
}

fn consider(
    best: &mut Option<(f64, i32, CameraFit)>,
    board: &Board,
    size_px: (u32, u32),
    views: &[View],
    (flags, terms, lens): (i32, usize, &'static str),
) {
    let Some(fit) = solve(board, size_px, views, flags, lens) else { return };
    let values = 2.0 * fit.views.iter().map(|v| v.corners.len()).sum::<usize>() as f64;
    let bic = values * (fit.rms_px * fit.rms_px).max(1e-12).ln() + terms as f64 * values.ln();
    if best.as_ref().is_none_or(|(least, ..)| bic + BETTER_BIC < *least) {
        *best = Some((bic, flags, fit));
    }
}

/// One run of OpenCV's, from its own beginning or, where that fails, from a guess.
fn solve(board: &Board, size_px: (u32, u32), views: &[View], flags: i32, lens: &'static str) -> Option<CameraFit> {
    let own = run(board, size_px, views, flags, lens, None);
    let guessed = || {
        let guesses = FOCAL_GUESSES.iter().filter_map(|g| {
            run(board, size_px, views, flags | CALIB_USE_INTRINSIC_GUESS, lens, Some(g * f64::from(size_px.0)))
        });
        guesses.min_by(|a, b| a.rms_px.total_cmp(&b.rms_px))
    };
    // A beginning that went wrong is far off, not a little.
    own.filter(|fit| fit.rms_px < 2.0).or_else(guessed)
}

fn run(
    board: &Board,
    size_px: (u32, u32),
    views: &[View],
    flags: i32,
    lens: &'static str,
    focal_px: Option<f64>,
) -> Option<CameraFit> {
    let (width, height) = (f64::from(size_px.0), f64::from(size_px.1));
    let mut places: Vector<Vector<Point3f>> = Vector::new();
    let mut seen: Vector<Vector<Point2f>> = Vector::new();
    for view in views {
        let place = |c: &Corner| {
            let p = board.place_mm(c.index);
            Point3f::new(p.x as f32, p.y as f32, 0.0)
        };
        places.push(view.corners.iter().map(place).collect());
        seen.push(view.corners.iter().map(|c| Point2f::new(c.pixel.u_px as f32, c.pixel.v_px as f32)).collect());
    }
    let focal = focal_px.unwrap_or(width);
    let rows = [[focal, 0.0, (width - 1.0) / 2.0], [0.0, focal, (height - 1.0) / 2.0], [0.0, 0.0, 1.0]];
    let mut matrix = Mat::from_slice_2d(&rows).ok()?;
    let mut distortion = Mat::zeros(5, 1, CV_64F).ok()?.to_mat().ok()?;
    let (mut turns, mut shifts) = (Vector::<Mat>::new(), Vector::<Mat>::new());
    let (mut deviations, mut pose_deviations, mut per_view) = (Mat::default(), Mat::default(), Mat::default());
    let until = TermCriteria::new(3, 200, 1e-12).ok()?;
    let rms_px = calibrate_camera_extended(
        &places,
        &seen,
        Size::new(size_px.0 as i32, size_px.1 as i32),
        &mut matrix,
        &mut distortion,
        &mut turns,
        &mut shifts,
        &mut deviations,
        &mut pose_deviations,
        &mut per_view,
        flags,
        until,
    )
    .ok()?;
    let m = |r, c| matrix.at_2d::<f64>(r, c).copied().ok();
    let mut camera = Camera {
        width_px: size_px.0,
        height_px: size_px.1,
        fx_px: m(0, 0)?,
        fy_px: m(1, 1)?,
        cx_px: m(0, 2)?,
        cy_px: m(1, 2)?,
        distortion: [0.0; 8],
    };
    let terms = distortion.data_typed::<f64>().ok()?;
    camera.distortion[..5].copy_from_slice(terms.get(..5)?);
    let s = deviations.data_typed::<f64>().ok()?;
    let deviations = CameraDeviations {
        // Where the ratio is held, one of the two is reported as zero.
        focal_px: s.first()?.max(*s.get(1)?),
        centre_px: (*s.get(2)?, *s.get(3)?),
        distortion: std::array::from_fn(|i| s.get(4 + i).copied().unwrap_or(0.0)),
    };
    let finite = rms_px.is_finite() && camera.fx_px.is_finite() && camera.fx_px > 0.0 && camera.cx_px.is_finite();
    let posed = views.iter().enumerate().map(|(i, view)| {
        let pose = pose(&turns.get(i).ok()?, &shifts.get(i).ok()?)?;
        Some(posed(board, &camera, view, pose))
    });
    let views = posed.collect::<Option<Vec<Posed>>>()?;
    finite.then_some(CameraFit { camera, deviations, lens, rms_px, views })
}

fn posed(board: &Board, camera: &Camera, view: &View, camera_from_board: Isometry3<f64>) -> Posed {
    let residual = |corner: &Corner| {
        let expected = camera.project(&(camera_from_board * board.place_mm(corner.index)));
        (corner.pixel.u_px - expected.u_px, corner.pixel.v_px - expected.v_px)
    };
    Posed {
        photo: view.photo,
        residuals_px: view.corners.iter().map(residual).collect(),
        corners: view.corners.clone(),
        camera_from_board,
    }
}

fn pose(turn: &Mat, shift: &Mat) -> Option<Isometry3<f64>> {
    let mut matrix = Mat::default();
    rodrigues_def(turn, &mut matrix).ok()?;
    let r = matrix.data_typed::<f64>().ok()?;
    let t = shift.data_typed::<f64>().ok()?;
    let rotation = Rotation3::from_matrix_unchecked(nalgebra::Matrix3::from_row_slice(r.get(..9)?));
    let translation = Vector3::from_column_slice(t.get(..3)?);
    Some(Isometry3::from_parts(translation.into(), UnitQuaternion::from_rotation_matrix(&rotation)))
}

/// Takes out corners that do not agree with the rest; returns how many.
fn leave_out(views: &mut [View], fit: &CameraFit) -> usize {
    let mut off_px: Vec<f64> = fit.views.iter().flat_map(|v| v.residuals_px.iter().map(|(u, v)| u.hypot(*v))).collect();
    let middle = off_px.len() / 2;
    let Some(median) = (!off_px.is_empty()).then(|| *off_px.select_nth_unstable_by(middle, f64::total_cmp).1) else {
        return 0;
    };
    // The median of a two-dimensional normal error's length is 1.18 standard deviations of either axis.
    let limit_px = (OUTLIER_SIGMAS * median / 1.18).max(OUTLIER_FLOOR_PX);
    let mut left_out = 0;
    for (view, posed) in views.iter_mut().zip(&fit.views) {
        let far = posed.residuals_px.iter().filter(|(u, v)| u.hypot(*v) > limit_px).count();
        if far == 0 || view.corners.len() - far < MIN_CORNERS {
            continue;
        }
        let mut residuals = posed.residuals_px.iter();
        view.corners.retain(|_| residuals.next().is_none_or(|(u, v)| u.hypot(*v) <= limit_px));
        left_out += far;
    }
    left_out
}
