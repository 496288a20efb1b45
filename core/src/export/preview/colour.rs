//! Depth to colour: even steps of depth are even steps for the eye.

use crate::export::canvas::Rgb;

/// The ramp in OKLCh: lightness 0 to 1, chroma, hue in degrees; from near to far. Lightness falls steadily, so
/// that the ramp also works in gray and for the colour-blind; it stops well above black, so that the relief's
/// shadows can still be seen on it.
const RAMP: [[f64; 3]; 6] = [
    [0.910, 0.105, 96.0],
    [0.830, 0.140, 84.0],
    [0.740, 0.135, 135.0],
    [0.620, 0.105, 190.0],
    [0.500, 0.110, 245.0],
    [0.380, 0.130, 285.0],
];

/// The colour of a place on the ramp: 0 is nearest, 1 farthest; beyond them the ends.
pub(super) fn ramp(share: f64) -> Rgb {
    let place = share.clamp(0.0, 1.0) * (RAMP.len() - 1) as f64;
    let index = (place as usize).min(RAMP.len() - 2);
    let part = place - index as f64;
    let [lightness, chroma, hue_deg] = [0, 1, 2].map(|i| RAMP[index][i] + (RAMP[index + 1][i] - RAMP[index][i]) * part);
    let hue_rad = hue_deg.to_radians();
    srgb_from_oklab(lightness, chroma * hue_rad.cos(), chroma * hue_rad.sin())
}

/// Ottosson, "A perceptual color space for image processing" (2020): his matrices.
fn srgb_from_oklab(lightness: f64, a: f64, b: f64) -> Rgb {
    let l = (lightness + 0.396_337_777_4 * a + 0.215_803_757_3 * b).powi(3);
    let m = (lightness - 0.105_561_345_8 * a - 0.063_854_172_8 * b).powi(3);
    let s = (lightness - 0.089_484_177_5 * a - 1.291_485_548_0 * b).powi(3);
    [
        4.076_741_662_1 * l - 3.307_711_591_3 * m + 0.230_969_929_2 * s,
        -1.268_438_004_6 * l + 2.609_757_401_1 * m - 0.341_319_396_5 * s,
        -0.004_196_086_3 * l - 0.703_418_614_7 * m + 1.707_614_701_0 * s,
    ]
    .map(encode_srgb)
}

fn encode_srgb(linear: f64) -> u8 {
    let linear = linear.clamp(0.0, 1.0);
    let encoded = if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
    (encoded * 255.0 + 0.5) as u8
}

/// A colour in light (`shade` up to 1) or shadow (down to −1).
pub(super) fn shaded(colour: Rgb, shade: f32) -> Rgb {
    colour.map(|channel| {
        let value = f32::from(channel);
        let lit = if shade < 0.0 { value * (1.0 + 0.62 * shade) } else { value + (255.0 - value) * 0.55 * shade };
        (lit + 0.5) as u8
    })
}

/// The ramp in steps finer than a picture shows: a colour for each pixel would take longer than all the rest.
pub(super) struct Ramp {
    colours: Vec<Rgb>,
}

impl Ramp {
    const STEPS: usize = 2048;

    pub(super) fn new() -> Ramp {
        Ramp { colours: (0..=Ramp::STEPS).map(|i| ramp(i as f64 / Ramp::STEPS as f64)).collect() }
    }

    /// The colour at a share from 0 (near) to 1 (far); beyond, that of the end.
    pub(super) fn at(&self, share: f64) -> Rgb {
        self.colours[(share.clamp(0.0, 1.0) * Ramp::STEPS as f64 + 0.5) as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn white_and_black_are_what_they_are() {
        assert_eq!(srgb_from_oklab(1.0, 0.0, 0.0), [255; 3]);
        assert_eq!(srgb_from_oklab(0.0, 0.0, 0.0), [0; 3]);
    }

    #[test]
    fn nearer_is_always_lighter() {
        let luma = |i: usize| {
            let [r, g, b] = ramp(i as f64 / 50.0).map(f64::from);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        assert!((1..=50).all(|i| luma(i) < luma(i - 1)));
        assert_eq!(ramp(-3.0), ramp(0.0));
        assert_eq!(ramp(7.0), ramp(1.0));
    }
}
