//! A whole smaller size of a `depth.tif`, for what is made from a map long after its job.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use tiff::TiffError;
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

use crate::depth_map::MapGeometry;
use crate::error::{Error, Result};

/// One size of the map, whole.
pub struct LevelDepths {
    /// Where its pixels lie: a pixel is the mean of what was measured in it.
    pub geometry: MapGeometry,
    /// World z, mm; NaN where nothing was measured; row by row.
    pub depth_mm: Vec<f32>,
}

/// The largest size of the map at `path` that has at most so many pixels.
///
/// # Errors
/// What is no TIFF, or none of Stria's; a damaged file.
pub fn level_of_at_most(path: &Path, pixels: usize) -> Result<LevelDepths> {
    let file = File::open(path).map_err(|e| Error::io(path, e))?;
    let failed = |e| failed(path, e);
    let mut decoder = Decoder::new(BufReader::new(file)).map_err(failed)?;
    let matrix = decoder.get_tag_f64_vec(Tag::ModelTransformationTag).map_err(failed)?;
    if matrix.len() != 16 || matrix[0] <= 0.0 || matrix[0] != matrix[5] {
        let found = format!("a transformation {matrix:?}");
        return Err(Error::input(path.display().to_string(), found, "a depth.tif of stria"));
    }
    let mut factor = 1.0;
    loop {
        let (width, height) = decoder.dimensions().map_err(failed)?;
        if width as usize * height as usize <= pixels || !decoder.more_images() {
            break;
        }
        decoder.next_image().map_err(failed)?;
        factor *= 2.0;
    }
    let mut level = read(&mut decoder, path, &matrix, factor)?;
    while level.depth_mm.len() > pixels.max(1) && level.depth_mm.len() > 1 {
        level = level.halved();
    }
    Ok(level)
}

/// The size that the decoder is at, `factor` times smaller than the full one.
fn read(decoder: &mut Decoder<BufReader<File>>, path: &Path, matrix: &[f64], factor: f64) -> Result<LevelDepths> {
    let (width_px, height_px) = decoder.dimensions().map_err(|e| failed(path, e))?;
    let (width_px, height_px) = (width_px as usize, height_px as usize);
    let (tile_width, tile_height) = decoder.chunk_dimensions();
    let (tile_width, tile_height) = (tile_width as usize, tile_height as usize);
    let across = width_px.div_ceil(tile_width);
    let mut depth_mm = vec![f32::NAN; width_px * height_px];
    for tile in 0..across * height_px.div_ceil(tile_height) {
        let DecodingResult::F32(values) = decoder.read_chunk(tile as u32).map_err(|e| failed(path, e))? else {
            return Err(Error::input(path.display().to_string(), "other values than float32", "a depth.tif of stria"));
        };
        let (left, top) = (tile % across * tile_width, tile / across * tile_height);
        let width = tile_width.min(width_px - left);
        for (row, values) in values.chunks_exact(width).take(height_px - top).enumerate() {
            depth_mm[(top + row) * width_px + left..][..width].copy_from_slice(values);
        }
    }
    let shift_mm = (factor - 1.0) * matrix[0] / 2.0;
    let geometry = MapGeometry {
        x0_mm: matrix[3] + shift_mm,
        y0_mm: matrix[7] + shift_mm,
        mm_per_px: matrix[0] * factor,
        width_px,
        height_px,
    };
    Ok(LevelDepths { geometry, depth_mm })
}

impl LevelDepths {
    /// Half as wide and high: each pixel the mean of what was measured in its four.
    fn halved(&self) -> LevelDepths {
        let from = &self.geometry;
        let (width_px, height_px) = (from.width_px.div_ceil(2), from.height_px.div_ceil(2));
        let mean = |row: usize, column: usize| {
            let (mut sum, mut count) = (0.0, 0);
            for (r, c) in [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(r, c)| (2 * row + r, 2 * column + c)) {
                if r < from.height_px && c < from.width_px && self.depth_mm[r * from.width_px + c].is_finite() {
                    sum += f64::from(self.depth_mm[r * from.width_px + c]);
                    count += 1;
                }
            }
            if count > 0 { (sum / f64::from(count)) as f32 } else { f32::NAN }
        };
        let depth_mm = (0..height_px).flat_map(|row| (0..width_px).map(move |column| (row, column)));
        let depth_mm = depth_mm.map(|(row, column)| mean(row, column)).collect();
        let geometry = MapGeometry {
            x0_mm: from.x0_mm + from.mm_per_px / 2.0,
            y0_mm: from.y0_mm + from.mm_per_px / 2.0,
            mm_per_px: from.mm_per_px * 2.0,
            width_px,
            height_px,
        };
        LevelDepths { geometry, depth_mm }
    }
}

fn failed(path: &Path, error: TiffError) -> Error {
    match error {
        TiffError::IoError(e) => Error::io(path, e),
        other => Error::input(path.display().to_string(), other.to_string(), "a depth.tif of stria"),
    }
}
