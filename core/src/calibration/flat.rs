//! The second way, for people without a board: flat walls, seen squarely at known distances.
//!
//! The paper's equations (3) to (5): on a wall at the distance l the line stands at x = C1/l + C2, counted in px
//! from the image's middle. Two unknowns, so three distances show whether the model holds. The focal length cannot
//! come from such photos (a longer lens and a longer baseline look the same): it is given.

mod wall;

use std::path::PathBuf;

use nalgebra::{DMatrix, DVector, Vector3};

use crate::error::{Error, Result};
use crate::geometry::Plane;
use crate::rig::{Camera, Laser, LaserColour, LineDirection, Rig};

/// Distances between camera and wall that are believable, mm.
const DISTANCE_MM: (f64, f64) = (20.0, 100_000.0);
/// Fewest walls: with two distances the model always fits and nothing shows an error.
const MIN_WALLS: usize = 3;
/// The farthest wall must be at least this much farther than the nearest: nearer together, C1 and C2 mix.
const MIN_RATIO: f64 = 1.25;
/// Distances are different where they differ by this share.
const DIFFERENT: f64 = 0.02;
/// Largest distance of a wall's line from the fit, px in an image 1280 px wide.
const MAX_OFF_PX: f64 = 2.0;
/// Largest difference between a wall's slope of the line and the common one, px over half the image's height.
const MAX_TURN_PX: f64 = 6.0;

/// A wall with its distance.
#[derive(Clone, Debug)]
pub struct FlatWall {
    /// A photo, a video or a folder of images.
    pub source: PathBuf,
    /// From the camera's lens, along its optical axis, mm.
    pub distance_mm: f64,
}

/// How the camera's focal length is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FlatView {
    /// By the horizontal field of view, radians.
    FovRad(f64),
    /// In px.
    FocalPx(f64),
}

/// What is known beforehand.
#[derive(Clone, Debug)]
pub struct FlatOptions {
    /// The focal length.
    pub view: FlatView,
    /// The laser's colour.
    pub colour: LaserColour,
    /// How the line lies in the image.
    pub line: LineDirection,
    /// The rig's name.
    pub name: String,
}

/// What one wall gave.
#[derive(Clone, Debug)]
pub struct WallFit {
    /// Its name.
    pub name: String,
    /// The distance that was given, mm.
    pub distance_mm: f64,
    /// Rows (columns, with a horizontal line) with the line.
    pub rows: usize,
    /// Where the line stands at the image's middle row, px from the image's middle.
    pub column_px: f64,
    /// By how much the line leans: px across for each px along.
    pub slope: f64,
    /// Where it stands, less where the fit puts it, px.
    pub residual_px: f64,
    /// The same as depth, mm.
    pub residual_mm: f64,
}

/// The fit.
#[derive(Clone, Debug)]
pub struct FlatResult {
    /// The rig.
    pub rig: Rig,
    /// C1 of the paper, px·mm, and its standard deviation.
    pub c1: (f64, f64),
    /// C2 of the paper, px, and its standard deviation.
    pub c2: (f64, f64),
    /// The paper's baseline d = C1/f, mm.
    pub baseline_mm: f64,
    /// The paper's angle β = atan(f/C2), radians.
    pub angle_rad: f64,
    /// Lean of the laser's plane about the optical axis, radians.
    pub lean_rad: f64,
    /// Root mean square of the residuals, px.
    pub rms_px: f64,
    /// Each wall.
    pub walls: Vec<WallFit>,
    /// What could be better.
    pub warnings: Vec<String>,
}

/// Reads the walls and fits the plane.
///
/// # Errors
/// Sources that cannot be read or show no line, too few or too similar distances, residuals that no flat wall
/// at those distances would have.
pub fn calibrate_flat(
    walls: &[FlatWall],
    options: &FlatOptions,
    progress: &mut dyn FnMut(usize, usize) -> Result<()>,
) -> Result<FlatResult> {
    check_distances(walls)?;
    let (mut fits, mut size_px) = (Vec::new(), None);
    for (number, wall) in walls.iter().enumerate() {
        let (picture, name) = wall::mean_evidence(wall, options.colour, &mut size_px)?;
        let size = (picture.width_px as u32, picture.height_px as u32);
        fits.push(wall::find_line(&picture, &camera(size, options.view), options.line, name, wall.distance_mm)?);
        progress(number + 1, walls.len())?;
    }
    solve(fits, &camera(size_px.unwrap_or((0, 0)), options.view), options)
}

fn check_distances(walls: &[FlatWall]) -> Result<()> {
    let mut distances: Vec<f64> = walls.iter().map(|w| w.distance_mm).collect();
    if let Some(bad) = walls.iter().find(|w| !(DISTANCE_MM.0..=DISTANCE_MM.1).contains(&w.distance_mm)) {
        return Err(Error::field(
            format!("--flat {}", bad.source.display()),
            "the distance",
            format!("{} mm", bad.distance_mm),
            format!("{} to {} mm", DISTANCE_MM.0, DISTANCE_MM.1),
        ));
    }
    distances.sort_by(f64::total_cmp);
    distances.dedup_by(|far, near| *far < *near * (1.0 + DIFFERENT));
    let (near, far) = (distances.first().copied().unwrap_or(1.0), distances.last().copied().unwrap_or(1.0));
    if distances.len() < MIN_WALLS {
        return Err(Error::input(
            "--flat",
            format!("{} different distances", distances.len()),
            format!(
                "at least {MIN_WALLS}, better 5: two unknowns fit two distances whatever they are, and no residual could show a wrong one"
            ),
        ));
    }
    if far < MIN_RATIO * near {
        return Err(Error::input(
            "--flat",
            format!("distances from {near} to {far} mm"),
            format!("the farthest at least {MIN_RATIO} times as far as the nearest"),
        ));
    }
    Ok(())
}

/// The paper's camera: no lens distortion, the centre in the middle.
fn camera(size_px: (u32, u32), view: FlatView) -> Camera {
    let fov_rad = match view {
        FlatView::FovRad(fov_rad) => fov_rad,
        FlatView::FocalPx(focal_px) => 2.0 * (f64::from(size_px.0) / (2.0 * focal_px)).atan(),
    };
    Rig::from_paper(size_px.0, size_px.1, fov_rad, 1.0, std::f64::consts::FRAC_PI_2, LaserColour::Green).camera
}

/// Least squares over the walls, then the checks.
fn solve(mut walls: Vec<WallFit>, camera: &Camera, options: &FlatOptions) -> Result<FlatResult> {
    let (c1, c2) =
        constants(&walls, None).ok_or_else(|| Error::internal("calibrate", "the walls give no C1 and C2"))?;
    let residual = |w: &WallFit| w.column_px - c1 / w.distance_mm - c2;
    let freedom = (walls.len() - 2).max(1) as f64;
    let square: f64 = walls.iter().map(|w| residual(w).powi(2)).sum();
    for wall in &mut walls {
        wall.residual_px = residual(wall);
        // dl = −l²/C1 · dx (equation 16).
        wall.residual_mm = -wall.residual_px * wall.distance_mm * wall.distance_mm / c1;
    }
    let slope = walls.iter().map(|w| w.slope).sum::<f64>() / walls.len() as f64;
    check_residuals(&walls, camera, slope)?;
    let focal_px = camera.fx_px;
    let normal = match options.line {
        LineDirection::Vertical => Vector3::new(1.0, -slope, -c2 / focal_px),
        LineDirection::Horizontal => Vector3::new(-slope, 1.0, -c2 / focal_px),
    };
    let plane = Plane { normal: normal.normalize(), offset_mm: c1 / focal_px / normal.norm() };
    let laser = Laser { colour: options.colour, line: options.line, plane };
    let rig = Rig { name: options.name.clone(), camera: camera.clone(), laser };
    let rig = Rig::from_toml("the calibrated rig", &rig.to_toml())?;
    let (s1, s2) = deviations(&walls, (square / freedom).sqrt());
    let mut warnings = vec![
        "the lens is taken as free of distortion and its centre as the image's: photos of a checkerboard would tell"
            .into(),
    ];
    if walls.len() == MIN_WALLS {
        warnings.push("three distances leave one residual only; five show which one is wrong".into());
    }
    Ok(FlatResult {
        rig,
        c1: (c1, s1),
        c2: (c2, s2),
        baseline_mm: c1 / focal_px,
        angle_rad: focal_px.atan2(c2),
        lean_rad: slope.atan(),
        rms_px: (square / walls.len() as f64).sqrt(),
        walls,
        warnings,
    })
}

/// C1 and C2 by least squares, with one wall left out where one is named.
fn constants(walls: &[WallFit], without: Option<usize>) -> Option<(f64, f64)> {
    let used: Vec<&WallFit> = walls.iter().enumerate().filter(|(i, _)| Some(*i) != without).map(|(_, w)| w).collect();
    let design = DMatrix::from_fn(used.len(), 2, |r, c| if c == 0 { 1.0 / used[r].distance_mm } else { 1.0 });
    let columns = DVector::from_iterator(used.len(), used.iter().map(|w| w.column_px));
    let solved = design.svd(true, true).solve(&columns, 1e-12).ok()?;
    Some((solved[0], solved[1]))
}

/// Standard deviations of C1 and C2 from that of a wall's column.
fn deviations(walls: &[WallFit], sigma_px: f64) -> (f64, f64) {
    let count = walls.len() as f64;
    let mean = walls.iter().map(|w| 1.0 / w.distance_mm).sum::<f64>() / count;
    let square: f64 = walls.iter().map(|w| (1.0 / w.distance_mm - mean).powi(2)).sum();
    (sigma_px / square.sqrt(), sigma_px * (1.0 / count + mean * mean / square).sqrt())
}

fn check_residuals(walls: &[WallFit], camera: &Camera, slope: f64) -> Result<()> {
    let scale = (f64::from(camera.width_px) / 1280.0).max(1.0);
    let (limit_px, turn_px) = (MAX_OFF_PX * scale, MAX_TURN_PX * scale);
    if walls.iter().any(|w| w.residual_px.abs() > limit_px) {
        let (worst, how) = worst(walls);
        return Err(Error::input(
            format!("--flat {}={}", worst.name, worst.distance_mm),
            format!(
                "the line stands {:+.2} px ({:+.1} mm) from where the other distances put it{how}",
                worst.residual_px, worst.residual_mm
            ),
            format!("at most {limit_px:.1} px: check this distance, and that the wall is flat and seen squarely"),
        ));
    }
    let half_px = f64::from(camera.height_px) / 2.0;
    let turn = |w: &WallFit| (w.slope - slope).abs() * half_px;
    if let Some(worst) = walls.iter().filter(|w| turn(w) > turn_px).max_by(|a, b| turn(a).total_cmp(&turn(b))) {
        return Err(Error::input(
            format!("--flat {}={}", worst.name, worst.distance_mm),
            format!("the line leans by {:.1} px more than at the other distances", turn(worst)),
            format!("at most {turn_px:.1} px: the optical axis square to the wall at every distance"),
        ));
    }
    Ok(())
}

/// The wall without which the others fit best. With three walls each one's absence heals the fit: the largest
/// residual is named.
fn worst(walls: &[WallFit]) -> (WallFit, &'static str) {
    let remainder = |without: usize| {
        let Some((c1, c2)) = constants(walls, Some(without)) else { return f64::MAX };
        let others = walls.iter().enumerate().filter(|(i, _)| *i != without);
        others.map(|(_, w)| (w.column_px - c1 / w.distance_mm - c2).powi(2)).sum()
    };
    let (index, how) = if walls.len() > MIN_WALLS {
        ((0..walls.len()).min_by(|a, b| remainder(*a).total_cmp(&remainder(*b))), "")
    } else {
        let size = |i: &usize| walls[*i].residual_px.abs();
        ((0..walls.len()).max_by(|a, b| size(a).total_cmp(&size(b))), " (of three, any may be the wrong one)")
    };
    let mut wall = walls[index.unwrap_or(0)].clone();
    if walls.len() > MIN_WALLS
        && let Some((c1, c2)) = constants(walls, index)
    {
        // Against the others' fit: its own would hide half of the error.
        wall.residual_px = wall.column_px - c1 / wall.distance_mm - c2;
        wall.residual_mm = -wall.residual_px * wall.distance_mm * wall.distance_mm / c1;
    }
    (wall, how)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wall(distance_mm: f64, off_px: f64) -> WallFit {
        let column_px = 150_000.0 / distance_mm - 87.0 + off_px;
        WallFit {
            name: format!("{distance_mm}.png"),
            distance_mm,
            rows: 700,
            column_px,
            slope: 0.01,
            residual_px: 0.0,
            residual_mm: 0.0,
        }
    }

    fn options() -> FlatOptions {
        FlatOptions {
            view: FlatView::FovRad(1.14),
            colour: LaserColour::Green,
            line: LineDirection::Vertical,
            name: "flat".into(),
        }
    }

    #[test]
    fn exact_walls_give_the_papers_constants_and_their_plane() {
        let camera = camera((1280, 720), options().view);
        let walls = [300.0, 450.0, 600.0, 900.0].map(|l| wall(l, 0.0)).to_vec();
        let fit = solve(walls, &camera, &options()).expect("a fit");
        assert!((fit.c1.0 - 150_000.0).abs() < 1e-6 && (fit.c2.0 + 87.0).abs() < 1e-9 && fit.rms_px < 1e-9);
        let plane = &fit.rig.laser.plane;
        // A point of the line at 500 mm, 100 px below the middle.
        let x = (150_000.0 / 500.0 - 87.0 + 1.0) / camera.fx_px * 500.0;
        let point = Vector3::new(x, 100.0 / camera.fx_px * 500.0, 500.0);
        assert!((plane.normal.dot(&point) - plane.offset_mm).abs() < 1e-9);
    }

    #[test]
    fn the_wrong_distance_is_named() {
        let camera = camera((1280, 720), options().view);
        let walls = vec![wall(300.0, 0.0), wall(450.0, 0.1), wall(600.0, 9.0), wall(750.0, -0.1), wall(900.0, 0.0)];
        let message = solve(walls, &camera, &options()).expect_err("a wrong one").to_string();
        assert!(message.contains("600.png=600") && message.contains("px"), "{message}");
    }

    #[test]
    fn too_few_or_similar_distances_are_refused() {
        let walls = |distances: &[f64]| -> Vec<FlatWall> {
            distances.iter().map(|d| FlatWall { source: "w.png".into(), distance_mm: *d }).collect()
        };
        for (distances, word) in [
            (&[300.0, 600.0][..], "residual"),
            (&[300.0, 301.0, 600.0], "residual"),
            (&[300.0, 320.0, 340.0], "1.25"),
            (&[300.0, -4.0, 500.0], "-4 mm"),
        ] {
            let message = check_distances(&walls(distances)).expect_err(word).to_string();
            assert!(message.contains(word), "{message}");
        }
        assert!(check_distances(&walls(&[300.0, 400.0, 600.0])).is_ok());
    }
}
