//! The laser's line on a board of known pose: sub-pixel spots inside its squares, and the straight line that
//! they must form, since the board is flat.

use nalgebra::{Isometry3, Point3};

use super::board::Board;
use super::light::Plane;
use super::spot::{self, Spot};
use super::straight::{self, Straight};
use crate::geometry::RawPixel;
use crate::rig::{Camera, LineDirection};

/// Stay this far inside a square, px: nearer, the blur of the neighbour of the other colour pulls the spot.
const MARGIN_PX: f64 = 2.5;
/// Squares with less inside than this on a side are not used, px.
const MIN_INSIDE_PX: f64 = 7.0;
/// A spot must be this far from the ends of its row, standard deviations of the light: both flanks must be seen.
const MIN_ROOM_SIGMAS: f64 = 1.5;
/// No spot is surer than this, px: the paper's grain moves them all.
const SURE_PX: f64 = 0.03;
/// Spots so many times less sure than the best quarter are not used.
const UNSURE_RATIO: f64 = 3.0;
/// Fewest spots of a line.
pub(super) const MIN_SPOTS: usize = 15;
/// Widths that belong to one line, as ratios to the median.
const SAME_WIDTH: std::ops::Range<f64> = 0.6..1.7;
/// The line must run over at least this many squares.
const MIN_LENGTH_SQUARES: f64 = 1.5;

/// The line in one photo.
#[derive(Clone, Debug)]
pub(super) struct BoardLine {
    pub direction: LineDirection,
    /// The spots that lie on it, raw px.
    pub spots: Vec<RawPixel>,
    /// The line in undistorted coordinates.
    pub straight: Straight,
    /// Width of the light, standard deviation in px.
    pub sigma_px: f64,
    /// Root mean square distance of the spots from the line, px.
    pub rms_px: f64,
}

impl BoardLine {
    /// How far a pixel is from the line, px.
    pub(super) fn distance_px(&self, camera: &Camera, pixel: RawPixel) -> f64 {
        self.straight.distance(camera.undistort(pixel)).abs() * camera.fx_px
    }
}

/// Finds the line on the board; `None` where there is none. `evidence` is the laser's light.
///
/// White squares show it best, unless it is clipped there; then the black ones do.
pub(super) fn find(
    evidence: &Plane,
    camera: &Camera,
    board: &Board,
    camera_from_board: &Isometry3<f64>,
    direction: LineDirection,
) -> Option<BoardLine> {
    let mut spots: Vec<(Spot, (f64, f64))> = Vec::new();
    for row in -1..board.rows as i64 {
        for column in -1..board.columns as i64 {
            if let Some(square) = inside_of_square(camera, board, camera_from_board, column, row) {
                spots_inside(evidence, &square, direction, &mut spots);
            }
        }
    }
    if spots.len() < MIN_SPOTS {
        return None;
    }
    // The line is equally wide everywhere on a board, but for perspective; spots near a square's side are cut.
    let mut widths: Vec<f64> = spots.iter().map(|(s, _)| s.sigma_px).collect();
    let middle = widths.len() / 2;
    let sigma_px = *widths.select_nth_unstable_by(middle, f64::total_cmp).1;
    spots.retain(|(spot, (from, to))| {
        let room_px = (spot.across_px - from).min(to - spot.across_px);
        SAME_WIDTH.contains(&(spot.sigma_px / sigma_px)) && room_px > MIN_ROOM_SIGMAS * sigma_px
    });
    leave_out_unsure(&mut spots);
    let pixels: Vec<RawPixel> = spots.iter().map(|(s, _)| s.pixel(direction)).collect();
    let rays: Vec<_> = pixels.iter().map(|p| camera.undistort(*p)).collect();
    let weights: Vec<f64> = spots.iter().map(|(s, _)| s.deviation_px.max(SURE_PX).powi(-2)).collect();
    let (line, inliers) = straight::fit(&rays, &weights, direction, camera.fx_px)?;
    let spots: Vec<RawPixel> = inliers.iter().map(|i| pixels[*i]).collect();
    let sum: f64 = inliers.iter().map(|i| (line.distance(rays[*i]) * camera.fx_px).powi(2)).sum();
    let rms_px = (sum / inliers.len().max(1) as f64).sqrt();
    let long = length_mm(&inliers.iter().map(|i| rays[*i]).collect::<Vec<_>>(), camera_from_board);
    let good = spots.len() >= MIN_SPOTS && long > MIN_LENGTH_SQUARES * board.square_mm;
    good.then_some(BoardLine { direction, spots, straight: line, sigma_px, rms_px })
}

/// Takes out spots much less sure than the better ones: black squares in weak light add nothing but noise.
fn leave_out_unsure(spots: &mut Vec<(Spot, (f64, f64))>) {
    let mut deviations: Vec<f64> = spots.iter().map(|(s, _)| s.deviation_px).collect();
    let quarter = deviations.len() / 4;
    if !deviations.is_empty() {
        let good = deviations.select_nth_unstable_by(quarter, f64::total_cmp).1.max(SURE_PX);
        spots.retain(|(s, _)| s.deviation_px <= UNSURE_RATIO * good);
    }
}

/// How far the spots reach on the board, mm.
fn length_mm(rays: &[crate::geometry::UndistortedRay], camera_from_board: &Isometry3<f64>) -> f64 {
    let plane = board_plane(camera_from_board);
    let points: Vec<Point3<f64>> = rays.iter().filter_map(|r| plane.meet(*r)).collect();
    let far = |from: &Point3<f64>| points.iter().map(|p| (p - from).norm()).fold(0.0, f64::max);
    // From any point, the farthest is an end; from that end, the farthest is the other one.
    let Some(first) = points.first() else { return 0.0 };
    let end = points.iter().max_by(|a, b| (*a - first).norm().total_cmp(&(*b - first).norm())).unwrap_or(first);
    far(end)
}

/// The board's plane in the camera's frame.
pub(super) fn board_plane(camera_from_board: &Isometry3<f64>) -> crate::geometry::Plane {
    let normal = camera_from_board.rotation * nalgebra::Vector3::z();
    crate::geometry::Plane { normal, offset_mm: normal.dot(&camera_from_board.translation.vector) }
}

/// A square's inside in the image: its four corners in turn, px.
type Quad = [(f64, f64); 4];

/// The inside of a square that is seen whole; those at the board's rim have numbers from −1.
fn inside_of_square(
    camera: &Camera,
    board: &Board,
    camera_from_board: &Isometry3<f64>,
    column: i64,
    row: i64,
) -> Option<Quad> {
    let seen = |u: f64, v: f64| {
        let place = Point3::new((column as f64 + u) * board.square_mm, (row as f64 + v) * board.square_mm, 0.0);
        let pixel = camera.project(&(camera_from_board * place));
        (pixel.u_px, pixel.v_px)
    };
    let rim = [seen(0.0, 0.0), seen(1.0, 0.0), seen(1.0, 1.0), seen(0.0, 1.0)];
    let side_px =
        (0..4).map(|i| (rim[i].0 - rim[(i + 1) % 4].0).hypot(rim[i].1 - rim[(i + 1) % 4].1)).fold(f64::MAX, f64::min);
    let margin = MARGIN_PX / side_px;
    let (width, height) = (f64::from(camera.width_px) - 1.0, f64::from(camera.height_px) - 1.0);
    let in_image = rim.iter().all(|(x, y)| (0.0..=width).contains(x) && (0.0..=height).contains(y));
    let large = side_px - 2.0 * MARGIN_PX >= MIN_INSIDE_PX;
    let (low, high) = (margin, 1.0 - margin);
    (in_image && large).then(|| [seen(low, low), seen(high, low), seen(high, high), seen(low, high)])
}

/// A spot for each row (column, with a horizontal line) of a square's inside, with the ends of the inside.
fn spots_inside(evidence: &Plane, quad: &Quad, direction: LineDirection, out: &mut Vec<(Spot, (f64, f64))>) {
    // (along, across): along counts the line's positions.
    let corners = quad.map(|(x, y)| match direction {
        LineDirection::Vertical => (y, x),
        LineDirection::Horizontal => (x, y),
    });
    let first = corners.iter().map(|c| c.0).fold(f64::MAX, f64::min).ceil() as i64;
    let last = corners.iter().map(|c| c.0).fold(f64::MIN, f64::max).floor() as i64;
    for along in first..=last {
        let Some((from, to)) = chord(&corners, along as f64) else { continue };
        let (start, end) = (from.ceil() as i64, to.floor() as i64);
        let value = |across: i64| match direction {
            LineDirection::Vertical => evidence.at(across, along),
            LineDirection::Horizontal => evidence.at(along, across),
        };
        let profile: Option<Vec<f32>> = (start..=end).map(value).collect();
        if let Some(found) = profile.and_then(|p| spot::find(&p)) {
            out.push((found.moved(along as f64, start as f64), (from, to)));
        }
    }
}

/// Where a convex outline is cut at `along`.
fn chord(corners: &Quad, along: f64) -> Option<(f64, f64)> {
    let (mut low, mut high) = (f64::MAX, f64::MIN);
    for i in 0..4 {
        let (a, b) = (corners[i], corners[(i + 1) % 4]);
        if (a.0 <= along) != (b.0 <= along) {
            let across = a.1 + (b.1 - a.1) * (along - a.0) / (b.0 - a.0);
            (low, high) = (low.min(across), high.max(across));
        }
    }
    (high > low).then_some((low, high))
}
