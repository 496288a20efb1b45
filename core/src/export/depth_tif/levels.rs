//! A smaller size of a `depth.tif`, or of a stretch of it, for what is made from a map long after its job.

use std::fs::File;
use std::io::BufReader;
use std::ops::{Range, RangeInclusive};
use std::path::Path;

use tiff::TiffError;
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

use crate::depth_map::MapGeometry;
use crate::error::{Error, Result};

/// One size of the map, or of a stretch of it.
pub struct LevelDepths {
    /// Where its pixels lie: a pixel is the mean of what was measured in it.
    pub geometry: MapGeometry,
    /// World z, mm; NaN where nothing was measured; row by row.
    pub depth_mm: Vec<f32>,
}

/// The largest size of the map at `path` of which the stretch `x_mm` of the world has at most so many pixels; that stretch.
///
/// # Errors
/// What is no TIFF, or none of Stria's; a damaged file; a stretch beside the map.
pub fn level_of_at_most(path: &Path, pixels: usize, x_mm: &RangeInclusive<f64>) -> Result<LevelDepths> {
    let file = File::open(path).map_err(|e| Error::io(path, e))?;
    let failed = |e| failed(path, e);
    let mut decoder = Decoder::new(BufReader::new(file)).map_err(failed)?;
    let matrix = decoder.get_tag_f64_vec(Tag::ModelTransformationTag).map_err(failed)?;
    if matrix.len() != 16 || matrix[0] <= 0.0 || matrix[0] != matrix[5] {
        let found = format!("a transformation {matrix:?}");
        return Err(Error::input(path.display().to_string(), found, "a depth.tif of stria"));
    }
    let mut factor = 1.0;
    let (geometry, columns) = loop {
        let geometry = geometry(&mut decoder, path, &matrix, factor)?;
        let columns = columns_within(&geometry, x_mm);
        if columns.len() * geometry.height_px <= pixels || !decoder.more_images() {
            break (geometry, columns);
        }
        decoder.next_image().map_err(failed)?;
        factor *= 2.0;
    };
    if columns.is_empty() {
        let found = format!("{:.0} to {:.0} mm of the run's own x is beside the map", x_mm.start(), x_mm.end());
        let end_mm = geometry.x0_mm + geometry.width_px as f64 * geometry.mm_per_px;
        let expected = format!("a part of {:.0} to {end_mm:.0} mm", geometry.x0_mm);
        return Err(Error::input(path.display().to_string(), found, expected));
    }
    let mut level = read(&mut decoder, path, &geometry, columns)?;
    while level.depth_mm.len() > pixels.max(1) && level.depth_mm.len() > 1 {
        level = level.halved();
    }
    Ok(level)
}

/// Where the pixels of the size that the decoder is at lie, `factor` times smaller than the full one.
fn geometry(decoder: &mut Decoder<BufReader<File>>, path: &Path, matrix: &[f64], factor: f64) -> Result<MapGeometry> {
    let (width_px, height_px) = decoder.dimensions().map_err(|e| failed(path, e))?;
    let shift_mm = (factor - 1.0) * matrix[0] / 2.0;
    Ok(MapGeometry {
        x0_mm: matrix[3] + shift_mm,
        y0_mm: matrix[7] + shift_mm,
        mm_per_px: matrix[0] * factor,
        width_px: width_px as usize,
        height_px: height_px as usize,
    })
}

/// The columns whose centres lie in a stretch.
fn columns_within(map: &MapGeometry, x_mm: &RangeInclusive<f64>) -> Range<usize> {
    let column = |x_mm: f64| (x_mm - map.x0_mm) / map.mm_per_px;
    // From minus to plus infinity: a number that is too large becomes the largest.
    let (start, end) = (column(*x_mm.start()).ceil().max(0.0) as usize, (column(*x_mm.end()).floor() + 1.0).max(0.0));
    start..(end as usize).min(map.width_px).max(start)
}

/// Some columns of the size that the decoder is at.
fn read(
    decoder: &mut Decoder<BufReader<File>>,
    path: &Path,
    map: &MapGeometry,
    columns: Range<usize>,
) -> Result<LevelDepths> {
    let (tile_width, tile_height) = decoder.chunk_dimensions();
    let (tile_width, tile_height) = (tile_width as usize, tile_height as usize);
    let across = map.width_px.div_ceil(tile_width);
    let mut depth_mm = vec![f32::NAN; columns.len() * map.height_px];
    for tile_row in 0..map.height_px.div_ceil(tile_height) {
        for tile_column in columns.start / tile_width..columns.end.div_ceil(tile_width) {
            let tile = (tile_row * across + tile_column) as u32;
            let DecodingResult::F32(values) = decoder.read_chunk(tile).map_err(|e| failed(path, e))? else {
                return Err(Error::input(
                    path.display().to_string(),
                    "other values than float32",
                    "a depth.tif of stria",
                ));
            };
            let (left, top) = (tile_column * tile_width, tile_row * tile_height);
            let width = tile_width.min(map.width_px - left);
            let (from, to) = (left.max(columns.start), (left + width).min(columns.end));
            for (row, values) in (top..map.height_px).zip(values.chunks_exact(width)) {
                depth_mm[row * columns.len() + from - columns.start..][..to - from]
                    .copy_from_slice(&values[from - left..to - left]);
            }
        }
    }
    let x0_mm = map.x0_mm + columns.start as f64 * map.mm_per_px;
    Ok(LevelDepths { geometry: MapGeometry { x0_mm, width_px: columns.len(), ..*map }, depth_mm })
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
