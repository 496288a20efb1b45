//! Tiles of `residual.tif` for browsing, cut from the file when they are asked for: the same numbers and the same form as
//! the depth tiles (`tiles.rs`), a value being the deviation from the undamaged shape.

use std::io::{Read, Seek};

use tiff::TiffError;
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

use crate::depth_map::{MapGeometry, TILE_SIDE_PX};
use crate::error::{Error, Result};
use crate::export::tiles::{OFFSET_MM, STEP_MM, TileGrid, TileLevel, TilesIndex, depth_png};

/// Version of the index' shape.
const SCHEMA_VERSION: u32 = 1;
/// The share of the deviations, without their signs, that the colours span.
const COLOUR_SHARE: f64 = 0.99;
/// And at least so far to both sides, mm: what is finer is noise.
const LEAST_COLOUR_MM: f64 = 2.0;
/// Overviews of a file; more would be wider than anything is long.
const MOST_LEVELS: usize = 32;

/// A `residual.tif`, open.
pub struct ResidualTiles<R: Read + Seek> {
    decoder: Decoder<R>,
    map: MapGeometry,
    /// Width and height of each level, px; 0 is full size.
    sizes_px: Vec<(usize, usize)>,
}

impl<R: Read + Seek> ResidualTiles<R> {
    /// Opens a file.
    ///
    /// # Errors
    /// What is no residual map of stria.
    pub fn open(file: R) -> Result<ResidualTiles<R>> {
        let mut decoder = Decoder::new(file).map_err(bad)?;
        let matrix = decoder.get_tag_f64_vec(Tag::ModelTransformationTag).map_err(bad)?;
        let &[mm_per_px, _, _, x0_mm, _, _, _, y0_mm, ..] = matrix.as_slice() else {
            return Err(Error::input("residual.tif", "a short transformation", "16 numbers"));
        };
        let mut sizes_px = Vec::new();
        loop {
            let (width, height) = decoder.dimensions().map_err(bad)?;
            let (side, other) = decoder.chunk_dimensions();
            if side != other || !(side as usize).is_multiple_of(TILE_SIDE_PX) {
                return Err(Error::input(
                    "residual.tif",
                    format!("tiles of {side} × {other} px"),
                    "a residual.tif of stria",
                ));
            }
            sizes_px.push((width as usize, height as usize));
            if !decoder.more_images() || sizes_px.len() == MOST_LEVELS {
                break;
            }
            decoder.next_image().map_err(bad)?;
        }
        let (width_px, height_px) = sizes_px[0];
        let map = MapGeometry { x0_mm, y0_mm, mm_per_px, width_px, height_px };
        Ok(ResidualTiles { decoder, map, sizes_px })
    }

    /// What tiles there are.
    ///
    /// # Errors
    /// What reading the file says.
    pub fn index(&mut self) -> Result<TilesIndex> {
        let reach_mm = self.colour_reach_mm()?;
        let levels = self.sizes_px.iter().zip(0_u32..).map(|((width, height), level)| TileLevel {
            level,
            mm_per_px: self.map.mm_per_px * f64::from(1_u32 << level),
            first_column: 0,
            last_column: width.div_ceil(TILE_SIDE_PX) as i64 - 1,
            first_row: 0,
            last_row: height.div_ceil(TILE_SIDE_PX) as i64 - 1,
        });
        Ok(TilesIndex {
            schema_version: SCHEMA_VERSION,
            complete: true,
            tile_side_px: TILE_SIDE_PX,
            grid: TileGrid { x0_mm: self.map.x0_mm, y0_mm: self.map.y0_mm, mm_per_px: self.map.mm_per_px },
            depth_step_mm: STEP_MM,
            depth_offset_mm: OFFSET_MM,
            depth_range_mm: Some([-reach_mm, reach_mm]),
            levels: levels.collect(),
            depth_map: Some(self.map),
            revision: 0,
            changed: Default::default(),
        })
    }

    /// A tile as PNG; `None` where there is none.
    ///
    /// # Errors
    /// What reading the file says.
    pub fn tile(&mut self, level: usize, column: usize, row: usize) -> Result<Option<Vec<u8>>> {
        let Some(&(width, height)) = self.sizes_px.get(level) else { return Ok(None) };
        let (left, top) = (column.saturating_mul(TILE_SIDE_PX), row.saturating_mul(TILE_SIDE_PX));
        if left >= width || top >= height {
            return Ok(None);
        }
        self.decoder.seek_to_image(level).map_err(bad)?;
        let side = self.decoder.chunk_dimensions().0 as usize;
        let number = (top / side * width.div_ceil(side) + left / side) as u32;
        // A tile of the file on its far edges comes without what lies beyond them.
        let chunk_width = side.min(width - left / side * side);
        let values = self.chunk(number)?;
        let mut tile = vec![f32::NAN; TILE_SIDE_PX * TILE_SIDE_PX];
        let (from_column, from_row) = (left % side, top % side);
        let count = TILE_SIDE_PX.min(width - left);
        for line in 0..TILE_SIDE_PX.min(height - top) {
            let start = (from_row + line) * chunk_width + from_column;
            let Some(source) = values.get(start..start + count) else {
                return Err(Error::input("residual.tif", "a tile of another size", "a residual.tif of stria"));
            };
            tile[line * TILE_SIDE_PX..][..count].copy_from_slice(source);
        }
        depth_png(&tile).map(Some)
    }

    fn chunk(&mut self, number: u32) -> Result<Vec<f32>> {
        match self.decoder.read_chunk(number).map_err(bad)? {
            DecodingResult::F32(values) => Ok(values),
            _ => Err(Error::input("residual.tif", "another kind of values", "float32")),
        }
    }

    /// How far the colours shall reach to both sides, by the smallest overview.
    fn colour_reach_mm(&mut self) -> Result<f64> {
        self.decoder.seek_to_image(self.sizes_px.len() - 1).map_err(bad)?;
        let mut sizes: Vec<f32> = self.chunk(0)?.into_iter().filter(|v| v.is_finite()).map(f32::abs).collect();
        if sizes.is_empty() {
            return Ok(LEAST_COLOUR_MM);
        }
        let at = ((sizes.len() - 1) as f64 * COLOUR_SHARE) as usize;
        let (_, reach, _) = sizes.select_nth_unstable_by(at, f32::total_cmp);
        Ok(f64::from(*reach).max(LEAST_COLOUR_MM))
    }
}

fn bad(error: TiffError) -> Error {
    match error {
        TiffError::IoError(source) => Error::io("residual.tif", source),
        other => Error::input("residual.tif", other.to_string(), "a residual map that Stria wrote"),
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::BufReader;

    use super::*;
    use crate::defects::ResidualStrip;
    use crate::export::residual_tif::{NAME, ResidualWriter};
    use crate::export::tiles::read_depth_tile;

    #[test]
    fn every_tile_holds_the_file_s_values() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let (columns, rows) = (1100, 530);
        let value = |c: usize, r: usize| c as f32 * 0.01 - r as f32 * 0.02;
        let values: Vec<f32> = (0..rows * columns).map(|i| value(i % columns, i / columns)).collect();
        let mut writer = ResidualWriter::new(folder.path(), NAME);
        let strip =
            ResidualStrip { origin_mm: (10.0, -5.0), cell_mm: 2.0, first_column: 0, columns, values_mm: &values };
        writer.push(&strip).expect("push");
        assert!(writer.finish().expect("write"));
        let file = File::open(folder.path().join(NAME)).expect("open");
        let mut tiles = ResidualTiles::open(BufReader::new(file)).expect("a pyramid");
        let index = tiles.index().expect("an index");
        assert_eq!((index.levels[0].last_column, index.levels[0].last_row, index.levels.len()), (4, 2, 3));
        let [near, far] = index.depth_range_mm.expect("a range");
        assert!(near == -far && far > 9.0 && far < 11.1, "{far}");
        let picture = folder.path().join("tile.png");
        for (level, column, row) in [(0, 0, 0), (0, 4, 2), (0, 1, 1), (0, 3, 0), (1, 1, 0), (2, 1, 0)] {
            std::fs::write(&picture, tiles.tile(level, column, row).expect("read").expect("a tile")).expect("write");
            let found = read_depth_tile(&picture).expect("a tile");
            for (x, y) in [(0, 0), (37, 11), (75, 17)] {
                let (c, r) = ((column * TILE_SIDE_PX + x) << level, (row * TILE_SIDE_PX + y) << level);
                let here = found[y * TILE_SIDE_PX + x];
                if c + (1 << level) <= columns && r + (1 << level) <= rows {
                    // A pixel of a smaller level is the mean of its own.
                    let half = ((1 << level) - 1) as f32 / 2.0;
                    let expected = value(c, r) + half * 0.01 - half * 0.02;
                    assert!((here - expected).abs() < 0.004, "{level} {column} {row} {x} {y}: {here} {expected}");
                }
            }
        }
        assert!(tiles.tile(0, 5, 0).expect("read").is_none() && tiles.tile(3, 0, 0).expect("read").is_none());
    }
}
