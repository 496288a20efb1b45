//! Two small charts that explain the threshold: the gray values of one row, and the threshold of every row.
//!
//! The viewer has no chart with two lengths as its axes, so these are drawn as lines on a sheet of 480 by 255:
//! gray 0 at the bottom, 255 at the top.

use rerun::log::Chunk;
use rerun::{LineStrips2D, Points2D, Radius};

use super::data::{fixed, row};
use super::{FrameSteps, entity};
use crate::error::Result;
use crate::rig::LineDirection;
use crate::source::Image;
use crate::stripe::Stripe;

/// Width of the sheet.
pub(super) const SHEET_WIDTH: f32 = 480.0;
/// Height of the sheet: one unit a gray value.
pub(super) const SHEET_HEIGHT: f32 = 255.0;
/// What both charts of a frame take, at most.
pub(super) const BYTES: usize = 8 * (2 * HALF_WINDOW_PX + 1 + THRESHOLDS) + 400;

/// Pixels shown on either side of the spot.
const HALF_WINDOW_PX: usize = 60;
/// Line positions shown of the threshold of every row.
const THRESHOLDS: usize = 240;

/// The sheets' frames and the colours of the lines.
pub(super) fn opening() -> Result<Vec<Chunk>> {
    let style = |colour: [u8; 3], width: f32| {
        LineStrips2D::update_fields().with_colors([colour]).with_radii([Radius::new_ui_points(width)])
    };
    let sheet =
        LineStrips2D::new([[[0.0, SHEET_HEIGHT], [SHEET_WIDTH, SHEET_HEIGHT]], [[0.0, 0.0], [SHEET_WIDTH, 0.0]]])
            .with_colors([[110, 110, 110]]);
    let scale = labels(&[([30.0, SHEET_HEIGHT - 30.0], "gray 0".into()), ([36.0, 4.0], "gray 255".into())])
        .with_colors([[110, 110, 110]]);
    Ok(vec![
        fixed(&format!("{}/sheet", entity::ONE_ROW), &sheet)?,
        fixed(&format!("{}/scale", entity::ONE_ROW), &scale)?,
        fixed(&format!("{}/sheet", entity::ALL_ROWS), &sheet)?,
        fixed(&format!("{}/scale", entity::ALL_ROWS), &scale)?,
        fixed(&gray(), &style([80, 190, 80], 1.0))?,
        fixed(&threshold(), &style([240, 150, 0], 0.8))?,
        fixed(&spot(), &style([255, 40, 40], 0.8))?,
        fixed(&words(), &Points2D::update_fields().with_colors([[240, 150, 0], [255, 40, 40]]))?,
        fixed(&thresholds(), &style([240, 150, 0], 0.8))?,
    ])
}

/// Words at their places on a sheet.
fn labels(of: &[([f32; 2], String)]) -> Points2D {
    Points2D::update_fields()
        .with_positions(of.iter().map(|(place, _)| *place))
        .with_labels(of.iter().map(|(_, words)| words.clone()))
        .with_radii(of.iter().map(|_| Radius::new_ui_points(0.0)))
        .with_show_labels(true)
}

fn gray() -> String {
    format!("{}/gray", entity::ONE_ROW)
}

fn threshold() -> String {
    format!("{}/threshold", entity::ONE_ROW)
}

fn spot() -> String {
    format!("{}/spot", entity::ONE_ROW)
}

fn words() -> String {
    format!("{}/words", entity::ONE_ROW)
}

fn thresholds() -> String {
    format!("{}/threshold", entity::ALL_ROWS)
}

/// Both charts of one frame; empty ones where there is no line.
pub(super) fn show(steps: &FrameSteps<'_>, image: &Image) -> Result<Vec<Chunk>> {
    let Some(values) = steps.row_threshold else { return Ok(vec![]) };
    let at = steps.moment();
    let strips = |strips: Vec<Vec<[f32; 2]>>| LineStrips2D::update_fields().with_strips(strips);
    let mut chunks = match middle_spot(steps.stripe, values) {
        Some((position, across_px)) => {
            let curve = gray_curve(image, steps.stripe.line, position, across_px);
            let (level, x) = (SHEET_HEIGHT - values[position], curve.x(across_px));
            let (row_word, column_word) = match steps.stripe.line {
                LineDirection::Vertical => ("row", "column"),
                LineDirection::Horizontal => ("column", "row"),
            };
            let said = labels(&[
                ([SHEET_WIDTH - 60.0, level + 3.0], format!("threshold {:.0}", values[position])),
                ([x, SHEET_HEIGHT - 40.0], format!("{row_word} {position}: spot at {column_word} {across_px:.2}")),
            ]);
            vec![
                row(&gray(), at, &strips(vec![curve.strip()]))?,
                row(&threshold(), at, &strips(vec![vec![[0.0, level], [SHEET_WIDTH, level]]]))?,
                row(&spot(), at, &strips(vec![vec![[x, 0.0], [x, SHEET_HEIGHT]]]))?,
                row(&words(), at, &said)?,
            ]
        }
        None => vec![
            row(&gray(), at, &strips(vec![]))?,
            row(&threshold(), at, &strips(vec![]))?,
            row(&spot(), at, &strips(vec![]))?,
            row(&words(), at, &labels(&[]))?,
        ],
    };
    chunks.push(row(&thresholds(), at, &strips(threshold_strips(values)))?);
    Ok(chunks)
}

/// The spot nearest to the middle of the line, as (line position, raw px across).
fn middle_spot(stripe: &Stripe, thresholds: &[f32]) -> Option<(usize, f32)> {
    let middle = stripe.across_px.len() / 2;
    let measured = |i: &usize| stripe.across_px[*i].is_finite() && thresholds.get(*i).is_some_and(|t| t.is_finite());
    let position = (0..stripe.across_px.len()).filter(measured).min_by_key(|i| i.abs_diff(middle))?;
    Some((position, stripe.across_px[position]))
}

/// Gray values along the image across the line.
struct Curve {
    first_px: usize,
    gray: Vec<f32>,
}

impl Curve {
    /// Where a position across the line lies on the sheet.
    fn x(&self, across_px: f32) -> f32 {
        (across_px - self.first_px as f32) / (self.gray.len().max(2) - 1) as f32 * SHEET_WIDTH
    }

    fn strip(&self) -> Vec<[f32; 2]> {
        let point = |(i, gray): (usize, &f32)| [self.x((self.first_px + i) as f32), SHEET_HEIGHT - gray];
        self.gray.iter().enumerate().map(point).collect()
    }
}

/// Equation (7) around the spot.
fn gray_curve(image: &Image, line: LineDirection, position: usize, across_px: f32) -> Curve {
    let (width, height) = (image.width_px() as usize, image.height_px() as usize);
    let (length, place): (usize, &dyn Fn(usize) -> (usize, usize)) = match line {
        LineDirection::Vertical => (width, &|across| (across, position)),
        LineDirection::Horizontal => (height, &|across| (position, across)),
    };
    let spot = (across_px.max(0.0) as usize).min(length - 1);
    let (first, last) = (spot.saturating_sub(HALF_WINDOW_PX), (spot + HALF_WINDOW_PX).min(length - 1));
    let gray = |across: usize| match image.bgr_at(place(across).0, place(across).1) {
        Some([b, g, r]) => 0.299 * f32::from(r) + 0.587 * f32::from(g) + 0.114 * f32::from(b),
        None => 0.0,
    };
    Curve { first_px: first, gray: (first..=last).map(gray).collect() }
}

/// The threshold along the line; broken where a row has none.
fn threshold_strips(values: &[f32]) -> Vec<Vec<[f32; 2]>> {
    let step = values.len().div_ceil(THRESHOLDS).max(1);
    let x = |i: usize| i as f32 / values.len() as f32 * SHEET_WIDTH;
    let picked: Vec<(usize, f32)> = values.iter().copied().enumerate().step_by(step).collect();
    let finite = picked.split(|(_, v)| !v.is_finite()).filter(|piece| piece.len() > 1);
    finite.map(|piece| piece.iter().map(|(i, v)| [x(*i), SHEET_HEIGHT - v]).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(gray: impl Fn(usize, usize) -> u8) -> Image {
        let (width, height) = (200, 100);
        let bgr = (0..height).flat_map(|v| (0..width).map(move |u| (u, v))).flat_map(|(u, v)| [gray(u, v); 3]);
        Image::from_bgr(width as u32, height as u32, bgr.collect())
    }

    #[test]
    fn the_curve_is_the_row_around_the_spot() {
        let image = image(|u, v| (u + v) as u8);
        let curve = gray_curve(&image, LineDirection::Vertical, 10, 100.4);
        assert_eq!((curve.first_px, curve.gray.len()), (40, 121));
        assert!((curve.gray[0] - 50.0).abs() < 0.01 && (curve.gray[120] - 170.0).abs() < 0.01);
        assert_eq!(curve.x(40.0), 0.0);
        assert_eq!(curve.strip()[120][0], SHEET_WIDTH);
        let curve = gray_curve(&image, LineDirection::Horizontal, 10, 95.0);
        assert_eq!((curve.first_px, curve.gray.len()), (35, 65), "ends at the image's last row");
        assert!((curve.gray[0] - 45.0).abs() < 0.01);
    }

    #[test]
    fn rows_without_a_threshold_break_the_line() {
        let strips = threshold_strips(&[10.0, 20.0, f32::NAN, 30.0, 40.0, 50.0]);
        assert_eq!(strips.iter().map(Vec::len).collect::<Vec<_>>(), [2, 3]);
        assert_eq!(strips[0][1], [80.0, 235.0]);
    }
}
