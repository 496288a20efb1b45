//! Photos of a checkerboard, with and without the laser's line → Rig. Or flat walls at known distances → Rig.
//!
//! ```text
//! photos ▶ board ▶ corners ▶ camera, lens, poses ─┐
//!    └───▶ line on the board's squares ───────────┴▶ points ▶ laser plane ▶ trust ▶ Rig
//! ```
//!
//! Any photo may or may not show the line; one and the same photo serves for both. Corners are measured in the two
//! colour channels that the laser leaves alone, and those beside the line are not used. A photo of the same board
//! pose without the laser is subtracted where there is one. Once the line is known, the corners that its light
//! does not reach are measured again in all three channels.

mod board;
mod camera;
mod corner;
mod coverage;
mod flat;
mod light;
mod line;
mod lines;
mod photos;
mod plane;
mod spot;
mod straight;
mod trust;

pub use board::{Board, Corner};
pub use camera::CameraDeviations;
pub use flat::{FlatOptions, FlatResult, FlatView, FlatWall, WallFit, calibrate_flat};
pub use photos::{Photo, read as read_photos};

use crate::error::{Error, Result};
use crate::geometry::RawPixel;
use crate::rig::{Laser, LaserColour, LineDirection, Rig};
use camera::{CameraFit, View};
use line::BoardLine;
use plane::{Line3, PlaneFit};

/// What is known beforehand.
#[derive(Clone, Debug)]
pub struct Options {
    /// The board.
    pub board: Board,
    /// The laser's colour.
    pub colour: LaserColour,
    /// How the line lies in the image; `None`: as the photos show.
    pub line: Option<LineDirection>,
    /// The rig's name.
    pub name: String,
}

/// What one photo gave.
#[derive(Clone, Debug, Default)]
pub struct PhotoReport {
    /// The photo's name.
    pub name: String,
    /// Corners that were used, and how far each was seen from its place, px (zero where no camera was fitted).
    pub corners: Vec<(RawPixel, (f64, f64))>,
    /// Root mean square of those distances, px.
    pub rms_px: Option<f64>,
    /// The laser's spots that were used.
    pub spots: Vec<RawPixel>,
    /// Root mean square distance of the spots from a straight line, px.
    pub line_rms_px: Option<f64>,
    /// Root mean square distance of its points from the laser plane, mm.
    pub plane_rms_mm: Option<f64>,
    /// Why the photo, or its line, was not used; empty where all is well.
    pub note: String,
}

/// The rig with everything that tells how good it is.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The result.
    pub rig: Rig,
    /// Standard deviations of the camera's figures.
    pub deviations: CameraDeviations,
    /// The lens terms that the photos can tell: `none`, `k1` … `k1 k2 p1 p2 k3`.
    pub lens: &'static str,
    /// Root mean square distance of all corners from their places, px.
    pub rms_px: f64,
    /// Root mean square distance of all laser points from the plane, mm.
    pub plane_rms_mm: f64,
    /// Standard deviation of the plane's direction, radians.
    pub plane_angle_rad: f64,
    /// Standard deviation of the plane's offset, mm.
    pub plane_offset_mm: f64,
    /// Depths at which the plane was seen, mm.
    pub plane_depth_mm: (f64, f64),
    /// Share of the image within the hull of all corners, 0 to 1.
    pub coverage: f64,
}

/// An attempt: what each photo gave, also where no rig came out.
pub struct Attempt {
    /// One report a photo, in their order.
    pub photos: Vec<PhotoReport>,
    /// The image's size, px.
    pub size_px: (u32, u32),
    /// What could be better.
    pub warnings: Vec<String>,
    /// The rig, or why there is none and what to do.
    pub result: Result<Calibration>,
}

impl Attempt {
    /// Draws what was covered: corners with their residuals, laser lines, key figures.
    ///
    /// # Errors
    /// What the disk says.
    pub fn write_picture(&self, path: &std::path::Path) -> Result<()> {
        coverage::write(self, path)
    }
}

/// Calibrates. `progress` hears (photos looked at, photos in all) and may end the work with an error.
///
/// # Errors
/// What `progress` says, defects of libraries; everything about the photos is in the [`Attempt`].
pub fn calibrate(
    photos: &[Photo],
    options: &Options,
    progress: &mut dyn FnMut(usize, usize) -> Result<()>,
) -> Result<Attempt> {
    let size_px = photos.first().map_or((0, 0), |p| (p.image.width_px(), p.image.height_px()));
    let reports = photos.iter().map(|p| PhotoReport { name: p.name.clone(), ..PhotoReport::default() }).collect();
    let mut attempt = Attempt { photos: reports, size_px, warnings: Vec::new(), result: Err(Error::Cancelled) };
    let views = find_boards(photos, options, &mut attempt, progress)?;
    attempt.result = solve(photos, options, views, &mut attempt.photos, &mut attempt.warnings, size_px);
    Ok(attempt)
}

fn find_boards(
    photos: &[Photo],
    options: &Options,
    attempt: &mut Attempt,
    progress: &mut dyn FnMut(usize, usize) -> Result<()>,
) -> Result<Vec<View>> {
    let mut views = Vec::new();
    for (number, photo) in photos.iter().enumerate() {
        match board::find(&photo.image, &options.board, options.colour)? {
            None => attempt.photos[number].note = "the board is not seen whole".into(),
            Some(corners) if corners.len() < camera::MIN_CORNERS => {
                attempt.photos[number].note = format!("only {} corners are sharp", corners.len());
            }
            Some(corners) => {
                attempt.photos[number].corners = corners.iter().map(|c| (c.pixel, (0.0, 0.0))).collect();
                views.push(View { photo: number, corners });
            }
        }
        progress(number + 1, photos.len())?;
    }
    Ok(views)
}

/// From corners to the rig.
fn solve(
    photos: &[Photo],
    options: &Options,
    views: Vec<View>,
    reports: &mut [PhotoReport],
    warnings: &mut Vec<String>,
    size_px: (u32, u32),
) -> Result<Calibration> {
    if views.len() < trust::MIN_BOARDS {
        return Err(too_few(photos, options, views.len())?);
    }
    // A first camera shows where the laser's lines are; the final one does without the corners beside them.
    let first = camera::fit(&options.board, size_px, views.clone())?;
    let lines = lines::find(photos, options, &first);
    let clear = views.into_iter().map(|view| lines::without(view, photos, &lines, &first)).collect();
    let fit = camera::fit(&options.board, size_px, clear)?;
    let coverage = coverage::share(&fit);
    report_corners(&fit, reports);
    trust::check_camera(&fit, coverage)?;
    let (plane, line) = fit_plane(&fit, &lines, reports)?;
    let (angle_rad, offset_mm) = with_camera(&plane, &fit);
    trust::check_plane(&plane, angle_rad, offset_mm)?;
    warnings.extend(trust::warnings(&fit, coverage, &plane, angle_rad));
    let laser = Laser { colour: options.colour, line, plane: plane.plane };
    let rig = Rig { name: options.name.clone(), camera: fit.camera.clone(), laser };
    // The same checks as when it is loaded: a rig that Stria would refuse is never written.
    let rig = Rig::from_toml("the calibrated rig", &rig.to_toml())?;
    Ok(Calibration {
        rig,
        deviations: fit.deviations,
        lens: fit.lens,
        rms_px: fit.rms_px,
        plane_rms_mm: plane.rms_mm,
        plane_angle_rad: angle_rad,
        plane_offset_mm: offset_mm,
        plane_depth_mm: plane.depth_mm,
        coverage,
    })
}

/// Why there are too few boards: none at all is mostly a wrong count.
fn too_few(photos: &[Photo], options: &Options, found: usize) -> Result<Error> {
    let board = &options.board;
    let mut expected = format!(
        "at least {} photos, better 12 to 20, of the whole board: sharp, evenly lit, no reflections, a white rim around it",
        trust::MIN_BOARDS
    );
    if found == 0
        && let Some(photo) = photos.first()
        && let Some((columns, rows)) = board::miscounted(&photo.image, board, options.colour)?
    {
        expected = format!(
            "--board {columns}x{rows}: {} shows {columns}x{rows} inner corners (people often count squares; corners are where four squares meet)",
            photo.name
        );
    }
    let found =
        format!("a board of {}x{} inner corners was found in {found} of {}", board.columns, board.rows, photos.len());
    Ok(Error::input("the photos", found, expected))
}

fn report_corners(fit: &CameraFit, reports: &mut [PhotoReport]) {
    for view in &fit.views {
        let report = &mut reports[view.photo];
        report.corners = view.corners.iter().map(|c| c.pixel).zip(view.residuals_px.iter().copied()).collect();
        report.rms_px = Some(view.rms_px());
    }
}

/// The laser's points, by the final camera, and their plane.
fn fit_plane(
    fit: &CameraFit,
    lines: &[Option<BoardLine>],
    reports: &mut [PhotoReport],
) -> Result<(PlaneFit, LineDirection)> {
    let mut points = Vec::new();
    let mut direction = LineDirection::Vertical;
    for (view, found) in fit.views.iter().zip(lines) {
        let Some(found) = found else {
            reports[view.photo].note = "no laser line on the board".into();
            continue;
        };
        let plane = line::board_plane(&view.camera_from_board);
        direction = found.direction;
        reports[view.photo].spots = found.spots.clone();
        reports[view.photo].line_rms_px = Some(found.rms_px);
        let met = found.spots.iter().filter_map(|p| plane.meet(fit.camera.undistort(*p)));
        points.push(Line3 { photo: view.photo, points: met.collect() });
    }
    let Some(plane) = plane::fit(&points) else {
        return Err(Error::input(
            "the photos",
            format!("the laser's line is seen on the board in {} of {}", points.len(), fit.views.len()),
            format!(
                "at least {}, better 8 or more, photos with the laser on and its line across the board, at different distances (--laser says its colour)",
                plane::MIN_LINES
            ),
        ));
    };
    for line in &points {
        let report = &mut reports[line.photo];
        report.plane_rms_mm = Some(line.rms_mm(&plane.plane));
        if !plane.photos.contains(&line.photo) {
            report.note = "its laser line does not lie in the others' plane; left out".into();
        }
    }
    Ok((plane, direction))
}

/// The plane's deviations with the camera's share: a centre that is off by a pixel turns everything by 1/f about
/// the other axis.
fn with_camera(plane: &PlaneFit, fit: &CameraFit) -> (f64, f64) {
    let (u, v) = fit.deviations.centre_px;
    let n = plane.plane.normal;
    let turn_rad = (u * n.x.hypot(n.z)).hypot(v * n.y.hypot(n.z)) / fit.camera.fx_px;
    (plane.angle_rad.hypot(turn_rad), plane.offset_mm)
}

#[cfg(test)]
mod tests;
