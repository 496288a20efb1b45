//! The publication's way to find the stripe (METHOD.md, "Spot centroid"): the area of the laser's colour, then in
//! each row of that area the adaptive threshold (8)(9) and the midpoint of its two crossings.

mod area;

use opencv::core::{Mat, transpose};
use opencv::prelude::*;

use super::choice::{self, Candidate};
use super::{Stripe, StripeSteps};
use crate::error::Result;
use crate::recipe::StripeOptions;
use crate::rig::{Laser, LineDirection};
use crate::source::Image;

/// Finds the laser line in an image.
pub fn find(image: &Image, laser: &Laser, options: &StripeOptions) -> Result<StripeSteps> {
    let flat = Mat::from_slice(image.bgr())?;
    let upright = flat.reshape(3, image.height_px() as i32)?;
    // A horizontal line is found as a vertical one in the transposed image.
    let mut bgr = Mat::default();
    match laser.line {
        LineDirection::Vertical => upright.copy_to(&mut bgr)?,
        LineDirection::Horizontal => transpose(&upright, &mut bgr)?,
    }
    let area = area::effective_area(&bgr, laser.colour, options)?;
    let rows = bgr.rows();
    let mut candidates = Vec::with_capacity(rows as usize);
    let mut row_threshold = vec![f32::NAN; rows as usize];
    let mut gray = Vec::new();
    for row in 0..rows {
        let mask = area.at_row::<u8>(row)?;
        let mut found = Vec::new();
        if mask.contains(&255) {
            gray_row(bgr.at_row::<opencv::core::Vec3b>(row)?, &mut gray);
            for (start, end) in pieces(mask) {
                if let Some((threshold, candidate)) = spot(&gray, start, end, options) {
                    if found.is_empty() || threshold > row_threshold[row as usize] {
                        row_threshold[row as usize] = threshold;
                    }
                    found.push(candidate);
                }
            }
        }
        candidates.push(found);
    }
    let chosen = choice::continuous(&candidates, options.piece_min_rows as usize);
    let effective_area = match laser.line {
        LineDirection::Vertical => area.data_bytes()?.to_vec(),
        LineDirection::Horizontal => {
            let mut back = Mat::default();
            transpose(&area, &mut back)?;
            back.data_bytes()?.to_vec()
        }
    };
    let stripe = Stripe {
        line: laser.line,
        across_px: chosen.iter().map(|c| c.map_or(f32::NAN, |c| c.across_px)).collect(),
        confidence: chosen.iter().map(|c| c.map_or(0.0, |c| c.contrast / 255.0)).collect(),
        sigma_px: vec![f32::NAN; chosen.len()],
    };
    Ok(StripeSteps { stripe, effective_area: Some(effective_area), row_threshold: Some(row_threshold) })
}

/// Equation (7), not rounded to whole gray values.
fn gray_row(bgr: &[opencv::core::Vec3b], gray: &mut Vec<f32>) {
    gray.clear();
    gray.extend(bgr.iter().map(|p| 0.114 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.299 * f32::from(p[2])));
}

/// The connected pieces of a row of the area: first column and the one after the last.
fn pieces(mask: &[u8]) -> impl Iterator<Item = (usize, usize)> + '_ {
    let mut at = 0;
    std::iter::from_fn(move || {
        let start = at + mask[at..].iter().position(|m| *m != 0)?;
        let end = start + mask[start..].iter().position(|m| *m == 0).unwrap_or(mask.len() - start);
        at = end;
        Some((start, end))
    })
}

/// Equations (8) and (9) over one piece of the row's area, and the midpoint of PtA and PtB.
///
/// Where the area of a row falls into several pieces, each is treated as the paper treats the row's
/// only one; `choice` then decides between them. Returns the threshold and the candidate.
fn spot(gray: &[f32], start: usize, end: usize, options: &StripeOptions) -> Option<(f32, Candidate)> {
    let piece = &gray[start..end];
    let average = piece.iter().sum::<f32>() / piece.len() as f32;
    let maximum = piece.iter().copied().fold(0.0, f32::max);
    let contrast = maximum - average;
    if contrast < options.contrast_min as f32 {
        return None;
    }
    let threshold = options.k as f32 * contrast + average;
    let (first, last) = widest_run(piece, threshold)?;
    let (first, last) = (start + first, start + last);
    // PtA and PtB lie between the last pixel below the threshold and the first one above it.
    let point_a = crossing(gray, first.checked_sub(1)?, threshold)?;
    let point_b = crossing(gray, last, threshold)?;
    Some((threshold, Candidate { across_px: (point_a + point_b) / 2.0, contrast }))
}

/// Where the gray curve crosses the threshold between `left` and the pixel right of it, px.
///
/// The curve is the cubic through the four pixels around: a straight line would cut across the spot's
/// round top and be off by up to 0.05 px, differently on the two sides.
fn crossing(gray: &[f32], left: usize, threshold: f32) -> Option<f32> {
    let (low, high) = (*gray.get(left)?, *gray.get(left + 1)?);
    if (low < threshold) == (high < threshold) {
        return None;
    }
    let before = gray[left.saturating_sub(1)];
    let after = gray.get(left + 2).copied().unwrap_or(high);
    let curve = |t: f32| {
        let (a, b, c) = (t + 1.0, t - 1.0, t - 2.0);
        -before * t * b * c / 6.0 + low * a * b * c / 2.0 - high * a * t * c / 2.0 + after * a * t * b / 6.0
    };
    let (mut start, mut end) = (0.0_f32, 1.0_f32);
    for _ in 0..16 {
        let middle = (start + end) / 2.0;
        if (curve(middle) < threshold) == (low < threshold) { start = middle } else { end = middle }
    }
    Some(left as f32 + (start + end) / 2.0)
}

/// The run of pixels at or above the threshold that holds the most light above it: speckle and texture
/// break the top of the curve into several.
fn widest_run(piece: &[f32], threshold: f32) -> Option<(usize, usize)> {
    let mut best: Option<(f32, usize, usize)> = None;
    let mut at = 0;
    while at < piece.len() {
        if piece[at] < threshold {
            at += 1;
            continue;
        }
        let end = at + piece[at..].iter().take_while(|g| **g >= threshold).count();
        let light: f32 = piece[at..end].iter().map(|g| g - threshold + 1.0).sum();
        if best.is_none_or(|(most, ..)| light > most) {
            best = Some((light, at, end - 1));
        }
        at = end;
    }
    best.map(|(_, first, last)| (first, last))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Plane;
    use crate::rig::LaserColour;

    const WIDTH: u32 = 400;
    const HEIGHT: u32 = 120;

    /// A vertical Gaussian line of the given colour on black, its centre at `center_px` in row 0 and a
    /// tenth of a pixel further each row.
    fn line_image(center_px: f64, colour: [f64; 3]) -> Image {
        let mut bgr = Vec::new();
        for row in 0..HEIGHT {
            for column in 0..WIDTH {
                let off = f64::from(column) - center_px - 0.1 * f64::from(row);
                let light = (-off * off / (2.0 * 16.0)).exp();
                bgr.extend(colour.map(|c| (c * light).round().min(255.0) as u8));
            }
        }
        Image::from_bgr(WIDTH, HEIGHT, bgr)
    }

    fn laser(colour: LaserColour, line: LineDirection) -> Laser {
        Laser { colour, line, plane: Plane { normal: nalgebra::Vector3::x(), offset_mm: 100.0 } }
    }

    /// Root mean square and largest error, px.
    fn errors(stripe: &Stripe, center_px: f64) -> (f64, f64) {
        let error = |(i, x): (usize, &f32)| (f64::from(*x) - center_px - 0.1 * i as f64).abs();
        let errors: Vec<f64> = stripe.across_px.iter().enumerate().map(error).collect();
        let square = errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64;
        (square.sqrt(), errors.iter().copied().fold(0.0, f64::max))
    }

    #[test]
    fn a_clean_line_is_met_to_a_fiftieth_of_a_pixel() {
        for (colour, bgr) in [
            (LaserColour::Green, [60.0, 250.0, 10.0]),
            (LaserColour::Red, [20.0, 20.0, 250.0]),
            (LaserColour::Blue, [250.0, 60.0, 20.0]),
        ] {
            let image = line_image(180.3, bgr);
            let steps = find(&image, &laser(colour, LineDirection::Vertical), &StripeOptions::default()).expect("find");
            assert_eq!(steps.stripe.found(), HEIGHT as usize, "{colour:?}");
            let (rms, largest) = errors(&steps.stripe, 180.3);
            // Half a gray level of 250 on a slope of 8 % a pixel is 0.024 px at each of the two crossings, at
            // worst both the same way.
            assert!(rms < 0.02 && largest < 0.05, "{colour:?}: RMS {rms} px, largest {largest} px");
        }
    }

    #[test]
    fn a_horizontal_line_is_the_transposed_one() {
        let upright = line_image(180.3, [60.0, 250.0, 10.0]);
        let mut bgr = vec![0; upright.bgr().len()];
        for row in 0..HEIGHT as usize {
            for column in 0..WIDTH as usize {
                let (from, to) = (3 * (row * WIDTH as usize + column), 3 * (column * HEIGHT as usize + row));
                bgr[to..to + 3].copy_from_slice(&upright.bgr()[from..from + 3]);
            }
        }
        let lying = Image::from_bgr(HEIGHT, WIDTH, bgr);
        let options = StripeOptions::default();
        let a = find(&upright, &laser(LaserColour::Green, LineDirection::Vertical), &options).expect("find");
        let b = find(&lying, &laser(LaserColour::Green, LineDirection::Horizontal), &options).expect("find");
        assert_eq!(a.stripe.across_px, b.stripe.across_px);
        let (i, pixel) = b.stripe.spots().next().expect("a spot");
        assert_eq!((pixel.u_px, pixel.v_px), (i as f64, f64::from(b.stripe.across_px[i])));
    }

    #[test]
    fn nothing_green_gives_nothing() {
        let image = line_image(180.3, [250.0, 250.0, 250.0]);
        let steps =
            find(&image, &laser(LaserColour::Green, LineDirection::Vertical), &StripeOptions::default()).expect("find");
        assert_eq!(steps.stripe.found(), 0);
        assert!(steps.effective_area.is_some_and(|area| area.iter().all(|m| *m == 0)));
    }

    #[test]
    fn the_printed_kernels_remove_a_thin_stripe() {
        // METHOD.md's note: dilating by 30 and eroding by 50 leaves nothing of a stripe under 21 px.
        let literal = crate::recipe::Recipe::built_in("paper-literal").expect("built in").stripe;
        let image = line_image(180.3, [60.0, 250.0, 10.0]);
        let steps = find(&image, &laser(LaserColour::Green, LineDirection::Vertical), &literal).expect("find");
        assert_eq!(steps.stripe.found(), 0);
    }
}
