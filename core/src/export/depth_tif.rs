//! `depth.tif`: the depth map as a cloud-optimised GeoTIFF.
//!
//! float32, mm, NaN where nothing was measured; tiles of 512 × 512 px, deflate with the floating-point
//! predictor; overviews, each the mean of what was measured. All directories stand at the start of the file,
//! the smallest overview's tiles come first and the full size last, so that a reader far away gets an
//! impression from the first kilobytes. Files that would pass 4 GB become BigTIFF.
//!
//! The transformation from pixels to mm is written as a matrix (GeoTIFF's ModelTransformation): it carries
//! pixel (0, 0)'s centre, with raster type *point*, and it is the only form that says *y runs down* in a way
//! all readers obey: GDAL takes ModelPixelScale's y for its absolute value, by long custom.

mod container;
mod levels;
pub mod section;

use std::fs::File;
use std::io::{BufReader, BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

use flate2::Compression;
use flate2::write::ZlibEncoder;

use crate::depth_map::{MapGeometry, MapReader};
use crate::error::{Error, Result};
use crate::export::new_file::{self, NewFile};
use crate::export::pyramid::{self, Layout};

use container::{Container, Entry, Value};

pub use levels::{LevelDepths, level_of_at_most};

/// Side of a tile, px.
const SIDE_PX: usize = 512;
/// Deflate's effort, 0 to 9: above 1 the files shrink by a tenth, the time doubles.
const EFFORT: u32 = 1;

/// Writes the map to `path`; as BigTIFF where the file would pass 4 GB.
///
/// # Errors
/// An empty map; what the reading of the map or the disk says.
pub fn write(map: &mut dyn MapReader, path: &Path) -> Result<()> {
    write_as(map, path, None)
}

/// As [`write()`], but BigTIFF whatever the size.
pub fn write_big(map: &mut dyn MapReader, path: &Path) -> Result<()> {
    write_as(map, path, Some(Container::Big))
}

fn write_as(map: &mut dyn MapReader, path: &Path, wanted: Option<Container>) -> Result<()> {
    let geometry = map.geometry();
    if geometry.width_px == 0 || geometry.height_px == 0 {
        return Err(Error::internal("depth.tif", "an empty map"));
    }
    let mut levels = Level::all(&geometry, new_file::folder_of(path)).map_err(|e| Error::io(path, e))?;
    compress_tiles(map, &mut levels, path)?;
    let mut file = NewFile::create(path)?;
    file.put(&directories(&geometry, &levels, wanted))?;
    for level in levels.into_iter().rev() {
        level.copy_to(&mut file)?;
    }
    file.commit()
}

/// One size of the image while it is being made: compressed tiles on disk, in the order they came.
struct Level {
    width_px: usize,
    height_px: usize,
    data: BufWriter<File>,
    data_bytes: u64,
    /// Per tile, row by row: place in `data` and length.
    tiles: Vec<(u64, u32)>,
}

impl Level {
    /// Full size and every half, until one tile holds it all; the tiles wait in nameless files in `folder`.
    fn all(geometry: &MapGeometry, folder: &Path) -> std::io::Result<Vec<Level>> {
        let (mut width_px, mut height_px) = (geometry.width_px, geometry.height_px);
        let mut levels = Vec::new();
        loop {
            let tiles = width_px.div_ceil(SIDE_PX) * height_px.div_ceil(SIDE_PX);
            let data = BufWriter::new(tempfile::tempfile_in(folder)?);
            levels.push(Level { width_px, height_px, data, data_bytes: 0, tiles: vec![(0, 0); tiles] });
            if width_px <= SIDE_PX && height_px <= SIDE_PX {
                return Ok(levels);
            }
            (width_px, height_px) = (width_px.div_ceil(2), height_px.div_ceil(2));
        }
    }

    fn push(&mut self, column: i64, row: i64, bytes: &[u8]) -> std::io::Result<()> {
        let index = row as usize * self.width_px.div_ceil(SIDE_PX) + column as usize;
        self.tiles[index] = (self.data_bytes, bytes.len() as u32);
        self.data_bytes += bytes.len() as u64;
        self.data.write_all(bytes)
    }

    fn copy_to(self, file: &mut NewFile) -> Result<()> {
        let path = file.path().to_path_buf();
        let copy = || -> std::io::Result<()> {
            let mut data = self.data.into_inner().map_err(|e| e.into_error())?;
            data.seek(SeekFrom::Start(0))?;
            std::io::copy(&mut BufReader::with_capacity(1 << 20, data), file).map(|_| ())
        };
        copy().map_err(|e| Error::io(path, e))
    }
}

fn compress_tiles(map: &mut dyn MapReader, levels: &mut [Level], path: &Path) -> Result<()> {
    let layout = Layout { side_px: SIDE_PX, levels: levels.len() as u32, first_column_px: 0, first_row_px: 0 };
    pyramid::for_each_tile(map, &layout, &mut |address, tile| {
        let bytes = compress(&tile.depth_mm).map_err(|e| Error::io(path, e))?;
        levels[address.level as usize].push(address.column, address.row, &bytes).map_err(|e| Error::io(path, e))
    })
}

/// A tile's bytes: the floating-point predictor (TIFF Technical Note 3), then deflate.
fn compress(values: &[f32]) -> std::io::Result<Vec<u8>> {
    let mut encoder = ZlibEncoder::new(Vec::with_capacity(values.len()), Compression::new(EFFORT));
    let mut line = [0_u8; 4 * SIDE_PX];
    for row in values.chunks_exact(SIDE_PX) {
        // The four bytes of the numbers apart, the most significant first ...
        for (column, value) in row.iter().enumerate() {
            // One NaN, whatever its bits were.
            let value = if value.is_nan() { f32::NAN } else { *value };
            for (plane, byte) in value.to_be_bytes().into_iter().enumerate() {
                line[plane * SIDE_PX + column] = byte;
            }
        }
        // ... and each byte as the difference from the one before.
        for i in (1..line.len()).rev() {
            line[i] = line[i].wrapping_sub(line[i - 1]);
        }
        encoder.write_all(&line)?;
    }
    encoder.finish()
}

/// Everything that stands before the tiles.
fn directories(geometry: &MapGeometry, levels: &[Level], wanted: Option<Container>) -> Vec<u8> {
    let describe = |container: Container, starts: &[u64]| {
        let all: Vec<Vec<Entry>> =
            (0..levels.len()).map(|index| entries(geometry, levels, index, starts[index])).collect();
        container::bytes(container, &all)
    };
    let data_bytes: u64 = levels.iter().map(|l| l.data_bytes).sum();
    let nowhere = vec![0; levels.len()];
    let fits = |container| describe(container, &nowhere).len() as u64 + data_bytes <= u64::from(u32::MAX);
    let container = wanted.unwrap_or(if fits(Container::Classic) { Container::Classic } else { Container::Big });

    // The directories' length does not depend on the places they name.
    let mut start = describe(container, &nowhere).len() as u64;
    let mut starts = nowhere;
    for (index, level) in levels.iter().enumerate().rev() {
        starts[index] = start;
        start += level.data_bytes;
    }
    describe(container, &starts)
}

fn entries(geometry: &MapGeometry, levels: &[Level], index: usize, start: u64) -> Vec<Entry> {
    let level = &levels[index];
    let mut entries = vec![
        Entry(254, Value::Long(vec![u32::from(index > 0)])), // NewSubfileType: 1 is a smaller version
        Entry(256, Value::Long(vec![level.width_px as u32])), // ImageWidth
        Entry(257, Value::Long(vec![level.height_px as u32])), // ImageLength
        Entry(258, Value::Short(vec![32])),                  // BitsPerSample
        Entry(259, Value::Short(vec![8])),                   // Compression: deflate
        Entry(262, Value::Short(vec![1])),                   // Photometric: larger is brighter
        Entry(277, Value::Short(vec![1])),                   // SamplesPerPixel
        Entry(284, Value::Short(vec![1])),                   // PlanarConfiguration
        Entry(317, Value::Short(vec![3])),                   // Predictor: floating point
        Entry(322, Value::Long(vec![SIDE_PX as u32])),       // TileWidth
        Entry(323, Value::Long(vec![SIDE_PX as u32])),       // TileLength
        Entry(324, Value::Place(level.tiles.iter().map(|t| start + t.0).collect())), // TileOffsets
        Entry(325, Value::Long(level.tiles.iter().map(|t| t.1).collect())), // TileByteCounts
        Entry(339, Value::Short(vec![3])),                   // SampleFormat: floating point
        Entry(42113, Value::Text("nan".into())),             // GDAL_NODATA
    ];
    if index == 0 {
        entries.push(Entry(305, Value::Text(concat!("stria ", env!("CARGO_PKG_VERSION")).into()))); // Software
        entries.extend(georeference(geometry));
    }
    entries
}

/// From pixels to mm, in a local system of coordinates.
fn georeference(geometry: &MapGeometry) -> Vec<Entry> {
    let (step, x0, y0) = (geometry.mm_per_px, geometry.x0_mm, geometry.y0_mm);
    let matrix = vec![step, 0.0, 0.0, x0, 0.0, step, 0.0, y0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let citation = "Wall: x along the travel, y down, z into the wall, mm|";
    let keys: Vec<u16> = [
        [1, 1, 0, 4],                            // version 1.1.0, four keys
        [1024, 0, 1, 32767],                     // GTModelType: user-defined, no place on Earth
        [1025, 0, 1, 2],                         // GTRasterType: a value stands for its pixel's centre
        [1026, 34737, citation.len() as u16, 0], // GTCitation
        [3076, 0, 1, 1025],                      // ProjLinearUnits: EPSG's millimetre
    ]
    .concat();
    let unit = "<GDALMetadata><Item name=\"UNITTYPE\" sample=\"0\" role=\"unittype\">mm</Item></GDALMetadata>";
    vec![
        Entry(34264, Value::Double(matrix)),        // ModelTransformation
        Entry(34735, Value::Short(keys)),           // GeoKeyDirectory
        Entry(34737, Value::Text(citation.into())), // GeoAsciiParams
        Entry(42112, Value::Text(unit.into())),     // GDAL_METADATA
    ]
}

#[cfg(test)]
mod tests {
    use std::io::BufReader;

    use tiff::decoder::{Decoder, DecodingResult};
    use tiff::tags::Tag;

    use super::*;
    use crate::depth_map::GridMap;

    fn map() -> GridMap {
        let geometry = MapGeometry { x0_mm: -544.25, y0_mm: -305.5, mm_per_px: 0.5, width_px: 1301, height_px: 611 };
        GridMap::from_fn(geometry, |column, row| {
            let hole = (column / 41 + row / 31) % 3 == 0;
            let z = 850.0 + 18.0 * (column as f32 / 90.0).sin() + 0.01 * row as f32;
            (if hole { f32::NAN } else { z }, None)
        })
    }

    fn read_level(path: &Path, index: usize) -> (u32, u32, Vec<f32>) {
        let mut decoder = Decoder::new(BufReader::new(File::open(path).expect("open"))).expect("a TIFF");
        decoder.seek_to_image(index).expect("level");
        let (width, height) = decoder.dimensions().expect("dimensions");
        let DecodingResult::F32(values) = decoder.read_image().expect("pixels") else { panic!("not float32") };
        (width, height, values)
    }

    fn same(a: &[f32], b: &[f32]) -> bool {
        a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a == b || (a.is_nan() && b.is_nan()))
    }

    #[test]
    fn values_come_back_bit_for_bit_in_both_containers() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let mut map = map();
        for (name, big) in [("classic.tif", false), ("big.tif", true)] {
            let path = folder.path().join(name);
            if big { write_big(&mut map, &path) } else { write(&mut map, &path) }.expect("write");
            let start = std::fs::read(&path).expect("read")[..4].to_vec();
            assert_eq!(start, [b'I', b'I', if big { 43 } else { 42 }, 0]);
            let (width, height, values) = read_level(&path, 0);
            assert_eq!((width, height), (1301, 611));
            assert!(same(&values, &map.pixels().depth_mm), "{name}: other values");
        }
    }

    #[test]
    fn overviews_average_only_what_was_measured() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("depth.tif");
        let mut map = map();
        write(&mut map, &path).expect("write");
        let (width, height, half) = read_level(&path, 1);
        assert_eq!((width, height), (651, 306));
        let full = &map.pixels().depth_mm;
        let mut with_holes = 0;
        for row in 0..305 {
            for column in 0..650 {
                let first = 2 * row * 1301 + 2 * column;
                let measured: Vec<f64> = [first, first + 1, first + 1301, first + 1302]
                    .into_iter()
                    .filter(|i| full[*i].is_finite())
                    .map(|i| f64::from(full[i]))
                    .collect();
                let value = half[row * 651 + column];
                if measured.is_empty() {
                    assert!(value.is_nan());
                } else {
                    let mean = measured.iter().sum::<f64>() / measured.len() as f64;
                    assert!((f64::from(value) - mean).abs() < 1e-4, "({column}, {row}): {value} for {mean}");
                    with_holes += usize::from(measured.len() < 4);
                }
            }
        }
        assert!(with_holes > 1000, "the map has edges of holes to test");
        assert_eq!(read_level(&path, 2).0, 326);
    }

    #[test]
    fn the_matrix_gives_the_map_s_place() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("depth.tif");
        write(&mut map(), &path).expect("write");
        let mut decoder = Decoder::new(BufReader::new(File::open(&path).expect("open"))).expect("a TIFF");
        let matrix = decoder.get_tag_f64_vec(Tag::ModelTransformationTag).expect("matrix");
        assert_eq!((matrix[0], matrix[3], matrix[5], matrix[7]), (0.5, -544.25, 0.5, -305.5));
    }
}
