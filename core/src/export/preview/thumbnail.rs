//! The map alone, small, for lists: as high as the box, or as wide; what sticks out is cut off on both sides.

use std::path::Path;

use jpeg_encoder::{ColorType, Encoder};

use super::reduce::{Between, Reduced};
use super::{Range, colour, reduce};
use crate::error::{Error, Result};
use crate::export::new_file;

/// Width, px.
pub(super) const WIDTH_PX: usize = 320;
/// Height, px.
pub(super) const HEIGHT_PX: usize = 160;
/// JPEG quality, 1 to 100.
const QUALITY: u8 = 80;
/// What stands where nothing was measured.
const NOTHING: [u8; 3] = [176, 186, 192];

/// Red, green, blue of each pixel.
pub(super) struct Thumbnail {
    rgb: Vec<u8>,
}

impl Thumbnail {
    /// Paints it from the map, its shades and the depths at the ends of the colours.
    pub(super) fn of(map: &Reduced, shades: &[f32], range: Option<Range>) -> Thumbnail {
        let range = range.unwrap_or(Range { near_mm: 0.0, far_mm: 1.0 });
        let ramp = colour::Ramp::new();
        let (width, height) = (map.width_px as f64, map.height_px as f64);
        let scale = (width / WIDTH_PX as f64).min(height / HEIGHT_PX as f64);
        let left = (width - WIDTH_PX as f64 * scale) / 2.0;
        let top = (height - HEIGHT_PX as f64 * scale) / 2.0;
        let mut rgb = Vec::with_capacity(3 * WIDTH_PX * HEIGHT_PX);
        for row in 0..HEIGHT_PX {
            let y = Between::of(top + (row as f64 + 0.5) * scale - 0.5, map.height_px);
            for column in 0..WIDTH_PX {
                let x = Between::of(left + (column as f64 + 0.5) * scale - 0.5, map.width_px);
                let z_mm = reduce::between(&map.depth_mm, map.width_px, x, y);
                rgb.extend(if z_mm.is_nan() {
                    NOTHING
                } else {
                    let share = (f64::from(z_mm) - range.near_mm) / (range.far_mm - range.near_mm);
                    colour::shaded(ramp.at(share), reduce::between(shades, map.width_px, x, y))
                });
            }
        }
        Thumbnail { rgb }
    }

    /// Writes it as a JPEG file.
    pub(super) fn save(&self, path: &Path) -> Result<()> {
        let mut bytes = Vec::new();
        Encoder::new(&mut bytes, QUALITY)
            .encode(&self.rgb, WIDTH_PX as u16, HEIGHT_PX as u16, ColorType::Rgb)
            .map_err(|e| Error::internal("thumbnail.jpg", e))?;
        new_file::write(path, &bytes)
    }
}
