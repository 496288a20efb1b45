//! Photos as linear light: the share of the laser's colour, and the light beside it.

use crate::rig::LaserColour;
use crate::source::Image;

/// A picture of one number a pixel, row by row.
pub(super) struct Plane {
    pub width_px: usize,
    pub height_px: usize,
    pub data: Vec<f32>,
}

impl Plane {
    /// The value of a pixel; `None` outside.
    pub(super) fn at(&self, column: i64, row: i64) -> Option<f32> {
        let inside = (0..self.width_px as i64).contains(&column) && (0..self.height_px as i64).contains(&row);
        inside.then(|| self.data[row as usize * self.width_px + column as usize])
    }
}

/// Linear light, 0 to 1, of each stored value (IEC 61966-2-1, inverted).
fn linear_table() -> [f32; 256] {
    std::array::from_fn(|i| {
        let value = i as f64 / 255.0;
        let linear = if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) };
        linear as f32
    })
}

/// The places of the laser's channel and of the other two in a pixel's blue, green, red.
fn channels(colour: LaserColour) -> (usize, [usize; 2]) {
    match colour {
        LaserColour::Blue => (0, [1, 2]),
        LaserColour::Green => (1, [0, 2]),
        LaserColour::Red => (2, [0, 1]),
    }
}

/// A stored value from here on is clipped: noise and JPEG spread the sensor's full scale a little.
const CLIPPED: u8 = 252;

/// The laser's channel above the mean of the other two, in linear light; less the same of a photo without the
/// laser, where there is one. NaN where the laser's channel is clipped: there the light is not known.
pub(super) fn evidence(image: &Image, colour: LaserColour, without_laser: Option<&Image>) -> Plane {
    let (table, (own, others)) = (linear_table(), channels(colour));
    let value = |p: &[u8]| {
        let linear = |channel: usize| table[usize::from(p[channel])];
        let above = linear(own) - 0.5 * (linear(others[0]) + linear(others[1]));
        if p[own] >= CLIPPED { f32::NAN } else { above }
    };
    let mut data: Vec<f32> = image.bgr().chunks_exact(3).map(value).collect();
    if let Some(dark) = without_laser {
        data.iter_mut().zip(dark.bgr().chunks_exact(3)).for_each(|(v, p)| *v -= value(p));
    }
    Plane { width_px: image.width_px() as usize, height_px: image.height_px() as usize, data }
}

/// The mean of the two channels that the laser hardly touches, in linear light.
pub(super) fn beside_laser(image: &Image, colour: LaserColour) -> Plane {
    let (table, (_, others)) = (linear_table(), channels(colour));
    let value = |p: &[u8]| 0.5 * (table[usize::from(p[others[0]])] + table[usize::from(p[others[1]])]);
    let data = image.bgr().chunks_exact(3).map(value).collect();
    Plane { width_px: image.width_px() as usize, height_px: image.height_px() as usize, data }
}

/// The mean of all three channels, in linear light: less noise, where there is no laser light.
pub(super) fn all_light(image: &Image) -> Plane {
    let table = linear_table();
    let value = |p: &[u8]| p.iter().map(|v| table[usize::from(*v)]).sum::<f32>() / 3.0;
    let data = image.bgr().chunks_exact(3).map(value).collect();
    Plane { width_px: image.width_px() as usize, height_px: image.height_px() as usize, data }
}

/// The two channels' mean as stored, 8 bits: what a detector of boards wants.
pub(super) fn gray_beside_laser(image: &Image, colour: LaserColour) -> Vec<u8> {
    let (_, others) = channels(colour);
    let mean = |p: &[u8]| (u16::from(p[others[0]]) + u16::from(p[others[1]])).div_ceil(2) as u8;
    image.bgr().chunks_exact(3).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gray_is_no_evidence_and_the_lasers_colour_is() {
        let image = Image::from_bgr(4, 1, vec![128, 128, 128, 10, 250, 10, 250, 10, 10, 90, 255, 90]);
        let green = evidence(&image, LaserColour::Green, None);
        assert!(green.data[0].abs() < 1e-6 && green.data[1] > 0.9 && green.data[2] < 0.0);
        assert!(green.data[3].is_nan(), "clipped light is not known");
        assert!(evidence(&image, LaserColour::Green, Some(&image)).data[..3].iter().all(|v| *v == 0.0));
        assert_eq!(gray_beside_laser(&image, LaserColour::Green), [128, 10, 130, 90]);
        assert_eq!(green.at(1, 0), Some(green.data[1]));
        assert_eq!((green.at(4, 0), green.at(0, -1)), (None, None));
    }
}
