//! The effective area: where the image has the laser's colour (METHOD.md, "Spot centroid", steps 1 to 4).
//!
//! The two readings of the printed text are two settings of the same kernels. `paper-literal` erodes by
//! 50 × 50 after dilating by 30 × 1, as printed, and so removes any stripe thinner than 21 px. `paper`
//! erodes by 20 × 50 and gives the height back: the dilated stripe is wider than 20 px and longer than
//! 50, so it stays, while a lamp or a speck of the same colour, shorter than 50 rows, goes. That is what
//! the publication's figure shows.

use opencv::core::{BORDER_CONSTANT, Mat, Point, Scalar, Size, bitwise_or, in_range};
use opencv::imgproc::{
    COLOR_BGR2HSV, MORPH_RECT, cvt_color_def, dilate, erode, get_structuring_element, morphology_default_border_value,
};
use opencv::prelude::*;

use crate::error::Result;
use crate::recipe::StripeOptions;
use crate::rig::LaserColour;

/// Hues of OpenCV's 8-bit images: half degrees.
const HUES: f64 = 180.0;

/// 255 where the laser's colour is accepted, else 0; the line runs along the image's columns.
pub(super) fn effective_area(bgr: &Mat, colour: LaserColour, options: &StripeOptions) -> Result<Mat> {
    let mut hsv = Mat::default();
    cvt_color_def(bgr, &mut hsv, COLOR_BGR2HSV)?;
    let mut mask = Mat::default();
    for (low, high) in hue_ranges(colour, options) {
        let mut part = Mat::default();
        let lower = Scalar::new(low, options.saturation_min, options.value_min, 0.0);
        let upper = Scalar::new(high, 255.0, 255.0, 0.0);
        in_range(&hsv, &lower, &upper, &mut part)?;
        if mask.empty() {
            mask = part;
        } else {
            let mut both = Mat::default();
            bitwise_or(&mask, &part, &mut both, &opencv::core::no_array())?;
            mask = both;
        }
    }
    let mask = morph(&mask, Step::Dilate, options.dilate_width_px, options.dilate_height_px)?;
    let mask = morph(&mask, Step::Erode, options.erode_width_px, options.erode_height_px)?;
    if options.restore_height {
        return morph(&mask, Step::Dilate, 1, options.erode_height_px);
    }
    Ok(mask)
}

enum Step {
    Dilate,
    Erode,
}

fn morph(mask: &Mat, step: Step, width_px: u32, height_px: u32) -> Result<Mat> {
    let kernel =
        |w: u32, h: u32| get_structuring_element(MORPH_RECT, Size::new(w as i32, h as i32), Point::new(-1, -1));
    let border = morphology_default_border_value()?;
    let anchor = Point::new(-1, -1);
    let mut out = Mat::default();
    match step {
        Step::Dilate => dilate(mask, &mut out, &kernel(width_px, height_px)?, anchor, 1, BORDER_CONSTANT, border)?,
        Step::Erode => erode(mask, &mut out, &kernel(width_px, height_px)?, anchor, 1, BORDER_CONSTANT, border)?,
    }
    Ok(out)
}

/// The hue intervals of a laser colour; red wraps around.
///
/// Green reaches up to 100 because a line on white turns bluish before it clips; red is narrow because
/// wood and skin begin at 10.
fn hue_ranges(colour: LaserColour, options: &StripeOptions) -> Vec<(f64, f64)> {
    let (centre, half) = match colour {
        LaserColour::Green => (75.0, 25.0),
        LaserColour::Red => (180.0, 10.0),
        LaserColour::Blue => (115.0, 15.0),
    };
    let (centre, half) = (centre + options.hue_shift, half * options.hue_widening);
    let (low, high) = (centre - half, centre + half);
    if high - low >= HUES {
        return vec![(0.0, HUES)];
    }
    let (low, high) = (low.rem_euclid(HUES), high.rem_euclid(HUES));
    if low <= high { vec![(low, high)] } else { vec![(low, HUES), (0.0, high)] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn red_wraps_around_the_hue_circle() {
        let options = StripeOptions::default();
        assert_eq!(hue_ranges(LaserColour::Red, &options), vec![(170.0, 180.0), (0.0, 10.0)]);
        assert_eq!(hue_ranges(LaserColour::Green, &options), vec![(50.0, 100.0)]);
        let wide = StripeOptions { hue_widening: 6.0, ..options };
        assert_eq!(hue_ranges(LaserColour::Green, &wide), vec![(0.0, 180.0)]);
    }
}
