//! From light to 8 bits: noise, saturation, the display curve.

use super::bands::for_bands;
use super::noise::{Normals, Stream};
use super::render::Pixel;
use super::scene::SensorNoise;

/// A sensor and the camera's processing behind it.
pub(super) struct Sensor {
    noise: Option<SensorNoise>,
    normals: Normals,
    curve: Vec<u8>,
}

/// Steps of linear light that the curve's table tells apart.
const CURVE_STEPS: usize = 65536;

impl Sensor {
    pub(super) fn new(noise: Option<SensorNoise>) -> Sensor {
        let curve =
            (0..CURVE_STEPS).map(|i| (255.0 * srgb(i as f64 / (CURVE_STEPS - 1) as f64)).round() as u8).collect();
        Sensor { noise, normals: Normals::new(), curve }
    }

    /// Standard deviation of a signal's noise, both in full scales.
    pub(super) fn noise_of(&self, signal: f32) -> f32 {
        self.noise.map_or(0.0, |n| (n.read * n.read + f64::from(signal.clamp(0.0, 1.0)) / n.electrons).sqrt() as f32)
    }

    /// The image: blue, green, red of each pixel. The same seed gives the same noise.
    pub(super) fn expose(&self, pixels: &[Pixel], width_px: usize, seed: u64) -> Vec<u8> {
        let mut bgr = vec![0u8; 3 * pixels.len()];
        for_bands(&mut bgr, 3 * width_px, 16, |first_row, rows| {
            for (i, row) in rows.chunks_exact_mut(3 * width_px).enumerate() {
                let number = first_row + i;
                let light = &pixels[number * width_px..][..width_px];
                match self.noise {
                    Some(noise) => self.noisy_row(light, noise, Stream::at(seed, number as i64, 3), row),
                    None => self.clean_row(light, row),
                }
            }
        });
        bgr
    }

    fn noisy_row(&self, light: &[Pixel], noise: SensorNoise, mut stream: Stream, out: &mut [u8]) {
        let (read, shot) = ((noise.read * noise.read) as f32, (1.0 / noise.electrons) as f32);
        for (pixel, bgr) in light.iter().zip(out.chunks_exact_mut(3)) {
            let bits = stream.bits();
            for c in 0..3 {
                let signal = pixel.rgb[c];
                let noisy = signal + (read + shot * signal).sqrt() * self.normals.pick(bits >> (12 * c));
                bgr[2 - c] = self.encode(noisy);
            }
        }
    }

    fn clean_row(&self, light: &[Pixel], out: &mut [u8]) {
        for (pixel, bgr) in light.iter().zip(out.chunks_exact_mut(3)) {
            for c in 0..3 {
                bgr[2 - c] = self.encode(pixel.rgb[c]);
            }
        }
    }

    fn encode(&self, signal: f32) -> u8 {
        self.curve[(signal.clamp(0.0, 1.0) * (CURVE_STEPS - 1) as f32 + 0.5) as usize]
    }
}

/// The sRGB curve (IEC 61966-2-1): linear light 0 to 1 to the value that is stored, 0 to 1.
fn srgb(linear: f64) -> f64 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_has_its_size_and_no_bias() {
        let noise = SensorNoise { read: 0.004, electrons: 4000.0 };
        let sensor = Sensor::new(Some(noise));
        let pixels = vec![Pixel { rgb: [0.2; 3], from_plane_mm: 0.0 }; 200 * 200];
        let bgr = sensor.expose(&pixels, 200, 42);
        let linear = |v: u8| ((f64::from(v) / 255.0 + 0.055) / 1.055).powf(2.4);
        let mean = bgr.iter().map(|v| linear(*v)).sum::<f64>() / bgr.len() as f64;
        let sigma = (bgr.iter().map(|v| (linear(*v) - mean).powi(2)).sum::<f64>() / bgr.len() as f64).sqrt();
        let expected = f64::from(sensor.noise_of(0.2));
        assert!((mean - 0.2).abs() < 2e-4, "mean {mean}");
        assert!((sigma / expected - 1.0).abs() < 0.05, "sigma {sigma}, expected {expected}");
        assert_eq!(bgr, sensor.expose(&pixels, 200, 42));
        assert_ne!(bgr, sensor.expose(&pixels, 200, 43));
    }

    #[test]
    fn the_curve_is_srgb() {
        let clean = Sensor::new(None);
        for (linear, stored) in
            [(0.0, 0), (0.0031308, 10), (0.2140, 127), (0.5, 188), (1.0, 255), (7.0, 255), (-1.0, 0)]
        {
            assert_eq!(clean.encode(linear), stored, "{linear}");
        }
    }
}
