//! Frame → Stripe: where the laser line lies, one sub-pixel position per row.

use crate::geometry::RawPixel;
use crate::rig::LineDirection;

/// The laser line in one frame.
///
/// One entry per *line position*: per image row with a vertical line, per column with a horizontal one.
#[derive(Clone, Debug, PartialEq)]
pub struct Stripe {
    /// How the line lies.
    pub line: LineDirection,
    /// Raw image column (row, with a horizontal line) of the line's centre, px; NaN where none was found.
    pub across_px: Vec<f32>,
    /// How far the spot stands out of its row, 0 (not at all) to 1 (black to full scale); 0 where none.
    pub confidence: Vec<f32>,
}

impl Stripe {
    /// Number of line positions where the line was found.
    pub fn found(&self) -> usize {
        self.across_px.iter().filter(|x| x.is_finite()).count()
    }

    /// The spots: (line position, raw pixel).
    pub fn spots(&self) -> impl Iterator<Item = (usize, RawPixel)> + '_ {
        self.across_px.iter().enumerate().filter(|(_, x)| x.is_finite()).map(|(i, x)| {
            let (along, across) = (i as f64, f64::from(*x));
            let pixel = match self.line {
                LineDirection::Vertical => RawPixel { u_px: across, v_px: along },
                LineDirection::Horizontal => RawPixel { u_px: along, v_px: across },
            };
            (i, pixel)
        })
    }
}
