//! Frame → Stripe: where the laser line lies, one sub-pixel position per line position.
//!
//! Two ways: [`paper`] is the publication's, [`metric`] the one that Stria measures with.

mod choice;
pub mod metric;
pub mod paper;

use crate::geometry::RawPixel;
use crate::rig::LineDirection;

pub use choice::SpotChoice;

/// The laser line in one frame.
///
/// One entry per *line position*: per image row with a vertical line, per column with a horizontal one.
#[derive(Clone, Debug, PartialEq)]
pub struct Stripe {
    /// How the line lies.
    pub line: LineDirection,
    /// Raw image column (row, with a horizontal line) of the line's centre, px; NaN where none was found.
    pub across_px: Vec<f32>,
    /// How far to trust the spot, 0 to 1; 0 where none. `paper`: how far it stands out of its row (1: black to full
    /// scale). `metric`: from its standard deviation (1: certain, 0.5: a fifth of a pixel).
    pub confidence: Vec<f32>,
    /// Standard deviation of `across_px`, px; NaN where there is none or the method does not tell.
    pub sigma_px: Vec<f32>,
}

impl Stripe {
    /// A stripe in which nothing was found.
    pub fn empty(line: LineDirection, positions: usize) -> Stripe {
        Stripe {
            line,
            across_px: vec![f32::NAN; positions],
            confidence: vec![0.0; positions],
            sigma_px: vec![f32::NAN; positions],
        }
    }

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

    /// `across_px` with the gaps filled from the spot before (at the start: the first one); empty where nothing was found.
    pub fn filled_px(&self) -> Vec<f32> {
        let Some(mut last) = self.across_px.iter().copied().find(|x| x.is_finite()) else { return Vec::new() };
        let fill = |x: &f32| {
            last = if x.is_finite() { *x } else { last };
            last
        };
        self.across_px.iter().map(fill).collect()
    }

    /// The median of `across_px`; `None` where nothing was found.
    pub fn median_px(&self) -> Option<f64> {
        let mut found: Vec<f32> = self.across_px.iter().copied().filter(|x| x.is_finite()).collect();
        let middle = found.len() / 2;
        (!found.is_empty()).then(|| f64::from(*found.select_nth_unstable_by(middle, f32::total_cmp).1))
    }

    /// The least and the greatest `across_px`; `None` where nothing was found.
    pub fn extent_px(&self) -> Option<(f32, f32)> {
        let found = self.across_px.iter().copied().filter(|x| x.is_finite());
        found.fold(None, |extent, x| match extent {
            None => Some((x, x)),
            Some((low, high)) => Some((x.min(low), x.max(high))),
        })
    }
}

/// The stripe and the steps that led to it, for people who want to see why.
#[derive(Clone, Debug)]
pub struct StripeSteps {
    /// The result.
    pub stripe: Stripe,
    /// The effective area: 255 where the laser's colour was accepted, else 0; as the image lies. Only `paper` has one.
    pub effective_area: Option<Vec<u8>>,
    /// The threshold of equation (9) per line position, gray value 0 to 255; NaN where there was no area. Only `paper`
    /// has one.
    pub row_threshold: Option<Vec<f32>>,
}
