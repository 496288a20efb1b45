//! The stripe of method `metric` on images whose line is known exactly.

use super::*;
use crate::geometry::Plane;
use crate::source::Image;
use crate::stripe::SpotChoice;

const WIDTH: usize = 480;
const HEIGHT: usize = 160;

/// Lines of a colour (blue, green, red; 1 is as bright as white) on a gray wall of that light, each at a column in row 0
/// and a tenth of a pixel further each row; in an sRGB image, clipped at white.
fn image(lines: &[(f64, [f64; 3])], wall: f64) -> Image {
    image_on(lines, |_, _| ([wall; 3], [1.0; 3]))
}

/// The same on a wall that has at each row and column a light of its own and reflects a share of the lines'.
fn image_on(lines: &[(f64, [f64; 3])], wall: impl Fn(usize, usize) -> ([f64; 3], [f64; 3])) -> Image {
    let encode = |light: f64| {
        let light = light.min(1.0);
        let value = if light <= 0.0031308 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
        (255.0 * value).round() as u8
    };
    let mut bgr = Vec::with_capacity(3 * WIDTH * HEIGHT);
    for row in 0..HEIGHT {
        for column in 0..WIDTH {
            let (mut light, share) = wall(row, column);
            for (start, colour) in lines {
                let off = column as f64 - start - 0.1 * row as f64;
                let bell = (-off * off / (2.0 * 2.5 * 2.5)).exp();
                (0..3).for_each(|i| light[i] += share[i] * colour[i] * bell);
            }
            bgr.extend(light.map(encode));
        }
    }
    Image::from_bgr(WIDTH as u32, HEIGHT as u32, bgr)
}

fn transposed(image: &Image) -> Image {
    let mut bgr = vec![0; image.bgr().len()];
    for row in 0..HEIGHT {
        for column in 0..WIDTH {
            let (from, to) = (3 * (row * WIDTH + column), 3 * (column * HEIGHT + row));
            bgr[to..to + 3].copy_from_slice(&image.bgr()[from..from + 3]);
        }
    }
    Image::from_bgr(HEIGHT as u32, WIDTH as u32, bgr)
}

fn stripe(image: &Image, colour: LaserColour, line: LineDirection, options: &SpotOptions) -> Stripe {
    let laser = Laser { colour, line, plane: Plane { normal: nalgebra::Vector3::x(), offset_mm: 100.0 } };
    let (mut finder, mut measurer) = stripe_stages(&laser, options);
    let seen = finder.see(image.yuv());
    measurer.measure(&seen, None)
}

fn largest_error(stripe: &Stripe, start: f64) -> f64 {
    let off = |(row, x): (usize, &f32)| (f64::from(*x) - start - 0.1 * row as f64).abs();
    stripe.across_px.iter().enumerate().map(off).fold(0.0, f64::max)
}

const GREEN: [f64; 3] = [0.05, 0.6, 0.02];

#[test]
fn lines_of_all_colours_are_met_on_dark_and_on_white_walls() {
    for (colour, light) in [
        (LaserColour::Green, GREEN),
        (LaserColour::Red, [0.02, 0.05, 0.8]),
        (LaserColour::Blue, [0.9, 0.06, 0.04]),
        // So strong that its core is white.
        (LaserColour::Green, [0.6, 6.0, 0.4]),
    ] {
        for wall in [0.01, 0.2, 0.5] {
            let image = image(&[(200.3, light)], wall);
            let found = stripe(&image, colour, LineDirection::Vertical, &SpotOptions::default());
            assert_eq!(found.found(), HEIGHT, "{colour:?} on {wall}");
            let error_px = largest_error(&found, 200.3);
            assert!(error_px < 0.05, "{colour:?} {light:?} on {wall}: {error_px} px");
        }
    }
}

#[test]
fn a_lying_line_is_the_standing_one_turned() {
    let upright = image(&[(200.3, GREEN)], 0.1);
    let lying = transposed(&upright);
    let found = stripe(&lying, LaserColour::Green, LineDirection::Horizontal, &SpotOptions::default());
    assert_eq!(found.found(), HEIGHT);
    assert!(largest_error(&found, 200.3) < 0.05);
}

#[test]
fn nothing_is_found_where_nothing_is() {
    let gray = image(&[(200.0, [0.5; 3])], 0.1);
    let empty = image(&[], 0.2);
    for image in [&gray, &empty] {
        let found = stripe(image, LaserColour::Green, LineDirection::Vertical, &SpotOptions::default());
        assert_eq!(found.found(), 0);
    }
}

#[test]
fn of_several_lines_the_recipe_chooses() {
    let two = image(&[(120.0, GREEN), (300.0, [0.1, 1.2, 0.04])], 0.1);
    for (choice, expected) in [
        (SpotChoice::First, 120.0),
        (SpotChoice::Last, 300.0),
        (SpotChoice::Strongest, 300.0),
        (SpotChoice::Continuous, 300.0),
    ] {
        let options = SpotOptions { choice, ..SpotOptions::default() };
        let found = stripe(&two, LaserColour::Green, LineDirection::Vertical, &options);
        assert_eq!(found.found(), HEIGHT, "{choice:?}");
        assert!(largest_error(&found, expected) < 0.05, "{choice:?}");
    }
}

#[test]
fn a_step_of_the_line_stays_sharp() {
    // Two half images, the lower one's line twelve pixels further.
    let (upper, lower) = (image(&[(200.0, GREEN)], 0.1), image(&[(212.0, GREEN)], 0.1));
    let half = 3 * WIDTH * HEIGHT / 2;
    let mut bgr = upper.bgr()[..half].to_vec();
    bgr.extend_from_slice(&lower.bgr()[half..]);
    let both = Image::from_bgr(WIDTH as u32, HEIGHT as u32, bgr);
    let found = stripe(&both, LaserColour::Green, LineDirection::Vertical, &SpotOptions::default());
    for (row, x) in found.across_px.iter().enumerate() {
        let start = if row < HEIGHT / 2 { 200.0 } else { 212.0 };
        let off = (f64::from(*x) - start - 0.1 * row as f64).abs();
        assert!(off < 0.15, "row {row}: off by {off} px");
    }
}

/// Largest error of a row in its own standard deviations, 0.1 px granted; and the largest error, px.
fn boldest_row(wall: impl Fn(usize, usize) -> ([f64; 3], [f64; 3])) -> (f64, f64) {
    let image = image_on(&[(200.3, [0.2, 2.0, 0.1])], wall);
    let found = stripe(&image, LaserColour::Green, LineDirection::Vertical, &SpotOptions::default());
    assert!(found.found() > HEIGHT / 2, "{} rows", found.found());
    let rows = found.across_px.iter().zip(&found.sigma_px).enumerate().filter(|(_, (x, _))| x.is_finite());
    rows.fold((0.0, 0.0), |(sigmas, largest_px): (f64, f64), (row, (x, sigma))| {
        let off_px = (f64::from(*x) - 200.3 - 0.1 * row as f64).abs();
        (sigmas.max((off_px - 0.1) / f64::from(*sigma)), largest_px.max(off_px))
    })
}

#[test]
fn what_a_highlight_draws_aside_is_not_said_to_be_sure() {
    let (sigmas, off_px) = boldest_row(|row, column| {
        let (down, aside) = ((row as f64 - 80.0) / 14.0, (column as f64 - 195.0) / 6.0);
        ([0.15 + 3.0 * (-0.5 * (down * down + aside * aside)).exp(); 3], [1.0; 3])
    });
    assert!(sigmas < 3.0, "off by {off_px} px, by {sigmas} standard deviations");
}

/// Beside the line in the middle rows, from under its right flank on.
fn beside(row: usize, column: usize) -> bool {
    (40..120).contains(&row) && column as f64 > 202.0 + 0.1 * row as f64
}

#[test]
fn what_the_edge_of_paint_draws_aside_is_not_said_to_be_sure() {
    // Red paint as bright as the wall in luma, which swallows green.
    let (sigmas, off_px) = boldest_row(|row, column| match beside(row, column) {
        true => ([0.03, 0.01, 0.55], [0.1, 0.05, 0.9]),
        false => ([0.12; 3], [1.0; 3]),
    });
    assert!(sigmas < 3.0, "off by {off_px} px, by {sigmas} standard deviations");
}

#[test]
fn what_a_lamp_of_the_laser_s_colour_draws_aside_is_not_said_to_be_sure() {
    let (sigmas, off_px) = boldest_row(|row, column| match beside(row, column) {
        true => ([0.37, 1.0, 0.22], [1.0; 3]),
        false => ([0.12; 3], [1.0; 3]),
    });
    assert!(sigmas < 3.0, "off by {off_px} px, by {sigmas} standard deviations");
}
