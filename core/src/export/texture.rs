//! `texture.jpg`: the visible image of the wall on the depth map's grid.
//!
//! JPEG at quality 90 with full colour resolution. Where no image fell the picture is a flat mid gray;
//! `depth.tif` says what was measured. Maps wider than
//! [`MAX_PART_WIDTH_PX`](crate::export::parts::MAX_PART_WIDTH_PX) become numbered parts.

use std::cell::RefCell;
use std::iter::repeat;
use std::path::Path;

use jpeg_encoder::{ColorType, Encoder, EncodingError, ImageBuffer, JpegColorType, rgb_to_ycbcr};

use crate::depth_map::{BAND_ROWS, MapReader, band};
use crate::error::{Error, Result};
use crate::export::new_file::NewFile;
use crate::export::parts::{Part, parts};

/// JPEG quality of the maps and the tiles, 1 to 100.
pub(super) const QUALITY: u8 = 90;
/// What stands where no image fell.
pub(super) const NO_IMAGE: [u8; 3] = [128; 3];

/// Writes `texture.jpg`, or `texture-0001.jpg` and so on, into `folder`.
///
/// # Errors
/// An empty map, or one higher than JPEG's 65,535 px; what the reading of the map or the disk says.
pub fn write(map: &mut dyn MapReader, folder: &Path) -> Result<()> {
    let geometry = map.geometry();
    if geometry.width_px == 0 || !(1..=65_535).contains(&geometry.height_px) {
        let size = format!("a map of {} x {} px", geometry.width_px, geometry.height_px);
        return Err(Error::internal("texture.jpg", size));
    }
    for part in parts("texture", "jpg", geometry.width_px) {
        write_part(map, &folder.join(&part.name), &part)?;
    }
    Ok(())
}

/// A whole small picture as JPEG: `height_px * width_px` colours, row by row.
pub(super) fn small_jpeg(width_px: usize, height_px: usize, texture: &[Option<[u8; 3]>]) -> Result<Vec<u8>> {
    let rgb: Vec<u8> = texture.iter().flat_map(|colour| colour.unwrap_or(NO_IMAGE)).collect();
    let mut bytes = Vec::new();
    Encoder::new(&mut bytes, QUALITY)
        .encode(&rgb, width_px as u16, height_px as u16, ColorType::Rgb)
        .map_err(|e| Error::internal("texture tile", e))?;
    Ok(bytes)
}

fn write_part(map: &mut dyn MapReader, path: &Path, part: &Part) -> Result<()> {
    let mut file = NewFile::create(path)?;
    let band = Band { map, part, first_row_px: 0, pixels: Vec::new(), failed: None };
    let image = BandedImage(RefCell::new(band));
    let outcome = Encoder::new(&mut file, QUALITY).encode_image(&image);
    if let Some(error) = image.0.into_inner().failed {
        return Err(error);
    }
    outcome.map_err(|e| match e {
        EncodingError::IoError(source) => Error::io(path, source),
        other => Error::internal("texture.jpg", other),
    })?;
    file.commit()
}

/// The rows that the encoder is at. It asks for them from top to bottom, so one band at a time is enough.
struct Band<'a> {
    map: &'a mut dyn MapReader,
    part: &'a Part,
    first_row_px: usize,
    /// Whole rows; none before the first was asked for, or after a failure.
    pixels: Vec<[u8; 3]>,
    /// The encoder's way of asking has no way to say no: the reason waits here.
    failed: Option<Error>,
}

impl Band<'_> {
    fn row(&mut self, row_px: usize) -> &[[u8; 3]] {
        let width_px = self.part.width_px;
        let held = self.first_row_px..self.first_row_px + self.pixels.len() / width_px;
        if !held.contains(&row_px) && self.failed.is_none() {
            self.first_row_px = row_px / BAND_ROWS * BAND_ROWS;
            // The last band goes before the next comes.
            self.pixels = Vec::new();
            match band(self.map, self.part.columns(), self.first_row_px, NO_IMAGE, |_, rgb| rgb.unwrap_or(NO_IMAGE)) {
                Ok(pixels) => self.pixels = pixels,
                Err(error) => self.failed = Some(error),
            }
        }
        let start = (row_px - self.first_row_px) * width_px;
        self.pixels.get(start..start + width_px).unwrap_or_default()
    }
}

struct BandedImage<'a>(RefCell<Band<'a>>);

impl ImageBuffer for &BandedImage<'_> {
    fn get_jpeg_color_type(&self) -> JpegColorType {
        JpegColorType::Ycbcr
    }

    fn width(&self) -> u16 {
        self.0.borrow().part.width_px as u16
    }

    fn height(&self) -> u16 {
        self.0.borrow().map.geometry().height_px as u16
    }

    fn fill_buffers(&self, y: u16, buffers: &mut [Vec<u8>; 4]) {
        let mut band = self.0.borrow_mut();
        let width_px = band.part.width_px;
        // The encoder wants a row whatever happened; what it makes of it is thrown away.
        for [red, green, blue] in band.row(usize::from(y)).iter().chain(repeat(&NO_IMAGE)).take(width_px) {
            let (luma, cb, cr) = rgb_to_ycbcr(*red, *green, *blue);
            buffers[0].push(luma);
            buffers[1].push(cb);
            buffers[2].push(cr);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;
    use crate::depth_map::{GridMap, MapGeometry, MapWindow};
    use crate::export::parts::MAX_PART_WIDTH_PX;

    fn read(path: &Path) -> (usize, usize, Vec<u8>) {
        let bytes = std::fs::read(path).expect("read");
        let mut decoder = zune_jpeg::JpegDecoder::new(Cursor::new(bytes));
        decoder.set_options(decoder.options().set_max_width(MAX_PART_WIDTH_PX));
        let pixels = decoder.decode().expect("a JPEG");
        let (width, height) = decoder.dimensions().expect("dimensions");
        (width, height, pixels)
    }

    fn map(width_px: usize, height_px: usize) -> GridMap {
        let geometry = MapGeometry { x0_mm: 0.0, y0_mm: 0.0, mm_per_px: 1.0, width_px, height_px };
        GridMap::from_fn(geometry, |c, r| (f32::NAN, (r < 600).then_some([(c % 200) as u8, (r % 200) as u8, 90])))
    }

    #[test]
    fn colours_come_back_within_the_quality() {
        let folder = tempfile::tempdir().expect("temporary folder");
        write(&mut map(333, 700), folder.path()).expect("write");
        let (width, height, pixels) = read(&folder.path().join("texture.jpg"));
        assert_eq!((width, height), (333, 700));
        let at = |c: usize, r: usize| &pixels[3 * (r * 333 + c)..][..3];
        for (c, r, expected) in [(100, 100, [100, 100, 90]), (50, 555, [50, 155, 90]), (300, 650, NO_IMAGE)] {
            let far = at(c, r).iter().zip(expected).any(|(a, b)| a.abs_diff(b) > 6);
            assert!(!far, "({c}, {r}): {:?} for {expected:?}", at(c, r));
        }
    }

    #[test]
    fn a_wide_map_becomes_parts() {
        let folder = tempfile::tempdir().expect("temporary folder");
        write(&mut map(33_000, 20), folder.path()).expect("write");
        assert_eq!(read(&folder.path().join("texture-0001.jpg")).0, 32_768);
        let (width, _, pixels) = read(&folder.path().join("texture-0002.jpg"));
        assert_eq!(width, 33_000 - 32_768);
        assert!(pixels[3 * 10].abs_diff(((32_768 + 10) % 200) as u8) < 12);
    }

    #[test]
    fn a_failing_map_leaves_no_file() {
        struct Failing;
        impl MapReader for Failing {
            fn geometry(&self) -> MapGeometry {
                MapGeometry { x0_mm: 0.0, y0_mm: 0.0, mm_per_px: 1.0, width_px: 10, height_px: 700 }
            }
            fn window(&mut self, _: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
                if row_px > 0 { Err(Error::Cancelled) } else { Ok(MapWindow::empty(width_px, height_px)) }
            }
        }
        let folder = tempfile::tempdir().expect("temporary folder");
        assert!(matches!(write(&mut Failing, folder.path()), Err(Error::Cancelled)));
        assert_eq!(std::fs::read_dir(folder.path()).expect("list").count(), 0);
    }
}
