//! The board, and its corners in a photo.

use nalgebra::Point3;
use opencv::calib3d::{
    CALIB_CB_ADAPTIVE_THRESH, CALIB_CB_EXHAUSTIVE, CALIB_CB_NORMALIZE_IMAGE, find_chessboard_corners,
    find_chessboard_corners_sb,
};
use opencv::core::{Mat, Point2f, Size, Vector};
use opencv::prelude::*;

use super::corner;
use super::light::{all_light, beside_laser, gray_beside_laser};
use crate::error::{Error, Result};
use crate::geometry::RawPixel;
use crate::rig::LaserColour;
use crate::source::Image;

/// Fewest inner corners a side: with fewer the detector finds boards everywhere.
const MIN_SIDE: u32 = 3;
/// Most inner corners a side.
const MAX_SIDE: u32 = 100;
/// Sides of a square that are believable, mm.
const SQUARE_MM: (f64, f64) = (0.5, 1000.0);
/// The window around a corner, as a share of the distance to the nearest other one: it must show one corner only.
const WINDOW_SHARE: f64 = 0.42;
/// Least and greatest reach of the window, px: the fit needs pixels, and far ones see bent edges.
const WINDOW_PX: (f64, f64) = (3.0, 12.0);

/// A checkerboard.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Board {
    /// Inner corners a row: where four squares meet, one less than squares.
    pub columns: u32,
    /// Inner corners a column.
    pub rows: u32,
    /// Side of a square, mm.
    pub square_mm: f64,
}

/// A corner in a photo.
#[derive(Clone, Copy, Debug)]
pub struct Corner {
    /// Its number on the board, row by row.
    pub index: usize,
    /// Where it is seen.
    pub pixel: RawPixel,
    /// How far around it the pixels count, px.
    pub window_px: f64,
    /// Directions of the two edges that cross there, radians.
    edges_rad: [f64; 2],
}

impl Board {
    /// From `9x6` and the side of a square.
    ///
    /// # Errors
    /// Text that is not `CxR`, sides outside 3 to 100 corners, squares outside 0.5 to 1000 mm.
    pub fn new(text: &str, square_mm: f64) -> Result<Board> {
        let sides = text.split_once(['x', 'X', '×']);
        let sides = sides.and_then(|(c, r)| Some((c.trim().parse::<u32>().ok()?, r.trim().parse::<u32>().ok()?)));
        let fits = |side: u32| (MIN_SIDE..=MAX_SIDE).contains(&side);
        let Some((columns, rows)) = sides.filter(|(c, r)| fits(*c) && fits(*r)) else {
            let expected = format!("inner corners a row x a column, {MIN_SIDE} to {MAX_SIDE} each, as in 9x6");
            return Err(Error::input("--board", format!("'{text}'"), expected));
        };
        if !(SQUARE_MM.0..=SQUARE_MM.1).contains(&square_mm) {
            let expected = format!("the side of one square, {} to {} mm", SQUARE_MM.0, SQUARE_MM.1);
            return Err(Error::input("--square-mm", format!("{square_mm} mm"), expected));
        }
        Ok(Board { columns, rows, square_mm })
    }

    /// Inner corners in all.
    pub fn corners(&self) -> usize {
        (self.columns * self.rows) as usize
    }

    /// A corner's place on the board, mm; the board's frame has z = 0 on it.
    pub fn place_mm(&self, index: usize) -> Point3<f64> {
        let (column, row) = (index % self.columns as usize, index / self.columns as usize);
        Point3::new(column as f64 * self.square_mm, row as f64 * self.square_mm, 0.0)
    }
}

impl std::fmt::Display for Board {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{} inner corners of {} mm squares", self.columns, self.rows, self.square_mm)
    }
}

/// The board's corners in a photo, in the colours that the laser leaves alone; `None` where the whole board is
/// not seen. Corners that the light's model does not fit are left out.
pub(super) fn find(image: &Image, board: &Board, colour: LaserColour) -> Result<Option<Vec<Corner>>> {
    let gray = gray_beside_laser(image, colour);
    let Some(rough) = detect(&gray, image.height_px(), board.columns, board.rows)? else { return Ok(None) };
    let light = beside_laser(image, colour);
    let (columns, rows) = (board.columns as usize, board.rows as usize);
    let mut corners = Vec::with_capacity(rough.len());
    for (index, (x, y)) in rough.iter().enumerate() {
        let (column, row) = (index % columns, index / columns);
        let along = |a: usize, b: usize| (rough[b].0 - rough[a].0, rough[b].1 - rough[a].1);
        let side = if column + 1 < columns { along(index, index + 1) } else { along(index - 1, index) };
        let down = if row + 1 < rows { along(index, index + columns) } else { along(index - columns, index) };
        let near_px = neighbours(index, columns, rows)
            .map(|other| (rough[other].0 - x).hypot(rough[other].1 - y))
            .fold(f64::MAX, f64::min);
        let window_px = (WINDOW_SHARE * near_px).clamp(WINDOW_PX.0, WINDOW_PX.1);
        let edges_rad = [side.1.atan2(side.0), down.1.atan2(down.0)];
        if let Some(fitted) = corner::refine(&light, *x, *y, edges_rad, window_px) {
            let pixel = RawPixel { u_px: fitted.x_px, v_px: fitted.y_px };
            corners.push(Corner { index, pixel, window_px, edges_rad });
        }
    }
    Ok(Some(corners))
}

/// Corners that the laser's light does not reach, measured again in all three channels.
pub(super) fn measure_again(image: &Image, corners: &mut Vec<Corner>) {
    let light = all_light(image);
    corners.retain_mut(|corner| {
        let (x_px, y_px) = (corner.pixel.u_px, corner.pixel.v_px);
        let fitted = corner::refine(&light, x_px, y_px, corner.edges_rad, corner.window_px);
        if let Some(fitted) = fitted {
            corner.pixel = RawPixel { u_px: fitted.x_px, v_px: fitted.y_px };
        }
        fitted.is_some()
    });
}

/// The corners beside a corner, along the rows and columns.
fn neighbours(index: usize, columns: usize, rows: usize) -> impl Iterator<Item = usize> {
    let (column, row) = (index % columns, index / columns);
    let left = (column > 0).then(|| index - 1);
    let right = (column + 1 < columns).then(|| index + 1);
    let up = (row > 0).then(|| index - columns);
    let down = (row + 1 < rows).then(|| index + columns);
    [left, right, up, down].into_iter().flatten()
}

/// Other numbers of inner corners that people give for a board: of squares instead of corners, or the other way.
/// Returns the one that the photo shows.
pub(super) fn miscounted(image: &Image, board: &Board, colour: LaserColour) -> Result<Option<(u32, u32)>> {
    let gray = gray_beside_laser(image, colour);
    let (c, r) = (board.columns, board.rows);
    for (columns, rows) in [(c - 1, r - 1), (c + 1, r + 1), (c - 1, r), (c, r - 1)] {
        if columns >= MIN_SIDE && rows >= MIN_SIDE && detect(&gray, image.height_px(), columns, rows)?.is_some() {
            return Ok(Some((columns, rows)));
        }
    }
    Ok(None)
}

/// OpenCV's two detectors, the sturdier one first. A detector that breaks on a photo has not found the board there.
fn detect(gray: &[u8], height_px: u32, columns: u32, rows: u32) -> Result<Option<Vec<(f64, f64)>>> {
    let flat = Mat::from_slice(gray)?;
    let photo = flat.reshape(1, height_px as i32)?;
    let pattern = Size::new(columns as i32, rows as i32);
    let mut found: Vector<Point2f> = Vector::new();
    let flags = CALIB_CB_NORMALIZE_IMAGE | CALIB_CB_EXHAUSTIVE;
    let mut whole = find_chessboard_corners_sb(&photo, pattern, &mut found, flags).unwrap_or(false);
    if !whole {
        let flags = CALIB_CB_NORMALIZE_IMAGE | CALIB_CB_ADAPTIVE_THRESH;
        whole = find_chessboard_corners(&photo, pattern, &mut found, flags).unwrap_or(false);
    }
    let complete = whole && found.len() == (columns * rows) as usize;
    Ok(complete.then(|| found.iter().map(|p| (f64::from(p.x), f64::from(p.y))).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boards_are_read_or_refused() {
        let board = Board::new("9x6", 25.0).expect("a board");
        assert_eq!((board.columns, board.rows, board.corners()), (9, 6, 54));
        assert_eq!(board.place_mm(10), Point3::new(25.0, 25.0, 0.0));
        for (text, square_mm, word) in
            [("9", 25.0, "--board"), ("2x6", 25.0, "3 to 100"), ("9x6", 0.0, "--square-mm"), ("9x6", f64::NAN, "mm")]
        {
            let message = Board::new(text, square_mm).expect_err(text).to_string();
            assert!(message.contains(word), "{message}");
        }
    }
}
