//! `residual.tif`: how far the surface lies from its undamaged shape, as a GeoTIFF like `depth.tif`, in the cells that were
//! searched for defects; mm, above 0 away from the camera, NaN where nothing was measured.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

use crate::defects::ResidualStrip;
use crate::depth_map::{Cell, Grid, MapGeometry, MapReader, MapWindow, SurfaceMap};
use crate::error::{Error, Result};
use crate::export::depth_tif;

/// The file's name in a product folder.
pub const NAME: &str = "residual.tif";

/// Tiles of the residual held in memory; the others wait on disk.
const TILES_IN_MEMORY: usize = 24;
/// Steps of the values, mm: what is finer is noise, and does not shrink.
const STEP_MM: f32 = 0.002;

/// Tiles of a file that are kept when it is read.
const TILES_KEPT: usize = 24;
/// A file wider or higher than this is none of ours, px.
const MAX_SIDE_PX: u32 = 100_000_000;

/// Takes the residual strip by strip.
pub struct ResidualWriter {
    path: PathBuf,
    folder: PathBuf,
    map: Option<SurfaceMap>,
}

impl ResidualWriter {
    /// A writer of a file in a folder: [`NAME`], or another.
    pub fn new(folder: &Path, name: &str) -> ResidualWriter {
        ResidualWriter { path: folder.join(name), folder: folder.to_path_buf(), map: None }
    }

    /// Takes the next strip.
    pub fn push(&mut self, strip: &ResidualStrip) -> Result<()> {
        if self.map.is_none() {
            let grid = Grid { x_mm: strip.origin_mm.0, y_mm: strip.origin_mm.1, mm_per_px: strip.cell_mm };
            self.map = Some(SurfaceMap::create(grid, TILES_IN_MEMORY, &self.folder)?);
        }
        let Some(map) = &mut self.map else { return Ok(()) };
        let mut cells = Vec::with_capacity(strip.columns);
        for (row, values) in strip.values_mm.chunks_exact(strip.columns).enumerate() {
            let mut column = 0;
            for run in values.chunk_by(|a, b| a.is_finite() == b.is_finite()) {
                if run[0].is_finite() {
                    cells.clear();
                    let rounded = run.iter().map(|v| (v / STEP_MM).round() * STEP_MM);
                    cells.extend(rounded.map(|depth_mm| Cell { depth_mm, weight: 1.0, rgb: None }));
                    map.blend_run((strip.first_column + column) as i64, row as i64, &cells)?;
                }
                column += run.len();
            }
        }
        Ok(())
    }

    /// Writes the file; says whether there was anything to write.
    pub fn finish(mut self) -> Result<bool> {
        let finished = self.map.as_mut().map(SurfaceMap::finished).transpose()?.flatten();
        let Some(mut finished) = finished else { return Ok(false) };
        depth_tif::write(&mut finished, &self.path)?;
        Ok(true)
    }
}

/// A `residual.tif` for reading, tile by tile.
pub struct ResidualFile<R = BufReader<File>>
where
    R: Read + Seek,
{
    path: PathBuf,
    decoder: Decoder<R>,
    geometry: MapGeometry,
    side_px: usize,
    /// The tiles read last, with their numbers.
    tiles: VecDeque<(u32, Vec<f32>)>,
}

impl ResidualFile {
    /// Opens a file.
    ///
    /// # Errors
    /// One that is not there, or no residual map of stria.
    pub fn open(path: &Path) -> Result<ResidualFile> {
        let file = File::open(path).map_err(|e| Error::io(path, e))?;
        ResidualFile::read(BufReader::new(file), path)
    }
}

impl<R: Read + Seek> ResidualFile<R> {
    /// Reads a file that lies anywhere; `path` names it in errors.
    ///
    /// # Errors
    /// What is no residual map of stria.
    pub fn read(file: R, path: &Path) -> Result<ResidualFile<R>> {
        let wrong = |e: tiff::TiffError| refused(path, &e.to_string());
        let mut decoder = Decoder::new(file).map_err(wrong)?.with_limits(Limits::default());
        let (width, height) = decoder.dimensions().map_err(wrong)?;
        let matrix = decoder.get_tag_f64_vec(Tag::ModelTransformationTag).map_err(wrong)?;
        let (side_px, other_px) = decoder.chunk_dimensions();
        let placed = matrix.len() == 16 && matrix[0] > 0.0 && matrix.iter().all(|v| v.is_finite());
        if !placed || side_px != other_px || side_px == 0 || width.max(height) > MAX_SIDE_PX {
            return Err(refused(path, "another kind of TIFF"));
        }
        let geometry = MapGeometry {
            x0_mm: matrix[3],
            y0_mm: matrix[7],
            mm_per_px: matrix[0],
            width_px: width as usize,
            height_px: height as usize,
        };
        Ok(ResidualFile {
            path: path.to_path_buf(),
            decoder,
            geometry,
            side_px: side_px as usize,
            tiles: VecDeque::new(),
        })
    }

    fn tile(&mut self, number: u32) -> Result<&[f32]> {
        if let Some(at) = self.tiles.iter().position(|tile| tile.0 == number) {
            return Ok(&self.tiles[at].1);
        }
        let values = match self.decoder.read_chunk(number) {
            Ok(DecodingResult::F32(values)) => values,
            Ok(_) => return Err(refused(&self.path, "values that are no float32")),
            Err(e) => return Err(refused(&self.path, &e.to_string())),
        };
        if self.tiles.len() == TILES_KEPT {
            self.tiles.pop_front();
        }
        self.tiles.push_back((number, values));
        Ok(self.tiles.back().map_or(&[], |tile| &tile.1))
    }
}

fn refused(path: &Path, found: &str) -> Error {
    Error::input(path.display().to_string(), found, "a residual.tif of stria")
}

impl<R: Read + Seek> MapReader for ResidualFile<R> {
    fn geometry(&self) -> MapGeometry {
        self.geometry
    }

    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
        let mut window = MapWindow::empty(width_px, height_px);
        let (side, MapGeometry { width_px: all, height_px: high, .. }) = (self.side_px, self.geometry);
        let (right, bottom) = ((column_px + width_px).min(all), (row_px + height_px).min(high));
        if column_px >= right || row_px >= bottom {
            return Ok(window);
        }
        for tile_row in row_px / side..=(bottom - 1) / side {
            for tile_column in column_px / side..=(right - 1) / side {
                let (left, top) = (tile_column * side, tile_row * side);
                // A tile on the far edges comes without what lies beyond them.
                let (tile_width, tile_height) = (side.min(all - left), side.min(high - top));
                let number = (tile_row * all.div_ceil(side) + tile_column) as u32;
                let tile = self.tile(number)?;
                if tile.len() != tile_width * tile_height {
                    return Err(Error::input("residual.tif", "a tile of another size", "a residual.tif of stria"));
                }
                let (from, to) = (left.max(column_px), (left + tile_width).min(right));
                for row in top.max(row_px)..(top + tile_height).min(bottom) {
                    let source = &tile[(row - top) * tile_width + from - left..][..to - from];
                    window.depth_mm[(row - row_px) * width_px + from - column_px..][..to - from]
                        .copy_from_slice(source);
                }
            }
        }
        Ok(window)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_written_is_read_in_any_window() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let (columns, rows) = (700, 530);
        let value = |c: usize, r: usize| {
            if (c / 90 + r / 70).is_multiple_of(4) { f32::NAN } else { c as f32 * 0.25 - r as f32 }
        };
        let mut writer = ResidualWriter::new(folder.path(), NAME);
        for first in [0, 400] {
            let some = if first == 0 { 400 } else { columns - 400 };
            let values: Vec<f32> = (0..rows * some).map(|i| value(first + i % some, i / some)).collect();
            let strip = ResidualStrip {
                origin_mm: (10.0, -5.0),
                cell_mm: 2.0,
                first_column: first,
                columns: some,
                values_mm: &values,
            };
            writer.push(&strip).expect("push");
        }
        assert!(writer.finish().expect("write"));
        let mut file = ResidualFile::open(&folder.path().join(NAME)).expect("open");
        // The map begins where something was measured.
        let geometry = file.geometry();
        let (left, top) = (((geometry.x0_mm - 10.0) / 2.0) as usize, ((geometry.y0_mm + 5.0) / 2.0) as usize);
        for (column, row, width, height) in [(0, 0, 90, 40), (480, 490, 60, 30), (100, 3, 590, 500)] {
            let window = file.window(column, row, width, height).expect("window");
            for (i, found) in window.depth_mm.iter().enumerate() {
                let (c, r) = (left + column + i % width, top + row + i / width);
                let expected = if c < columns && r < rows { value(c, r) } else { f32::NAN };
                assert!((found - expected).abs() < 0.01 || (found.is_nan() && expected.is_nan()), "{c}, {r}: {found}");
            }
        }
        std::fs::write(folder.path().join("no.tif"), "not at all").expect("write");
        assert!(ResidualFile::open(&folder.path().join("no.tif")).is_err());
    }
}
