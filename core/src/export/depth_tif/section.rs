//! A cross-section of `depth.tif`: the map's own values along a line, read from the tiles that the line crosses.

use std::io::{Read, Seek};

use tiff::TiffError;
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

use crate::depth_map::MapGeometry;
use crate::error::{Error, Result};

/// Where to cut: positions in the world, mm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Cut {
    /// Along y through the whole map, at the column nearest to this x.
    Across {
        /// World x, mm.
        x_mm: f64,
    },
    /// Along a straight line.
    Line {
        /// Where it begins: x, y.
        from_mm: [f64; 2],
        /// Where it ends: x, y.
        to_mm: [f64; 2],
    },
}

/// A cross-section.
#[derive(Clone, Debug, PartialEq)]
pub struct Section {
    /// The map it was cut from.
    pub map: MapGeometry,
    /// Way from one point to the next, mm.
    pub step_mm: f64,
    /// The points.
    pub points: Vec<SectionPoint>,
}

/// A point of a cross-section.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SectionPoint {
    /// Way along the line since its beginning, mm.
    pub distance_mm: f64,
    /// World x, mm.
    pub x_mm: f64,
    /// World y, mm.
    pub y_mm: f64,
    /// World z of the map's nearest pixel, mm; NaN where nothing was measured, or outside the map.
    pub z_mm: f32,
}

/// Cuts a map open: the value of the nearest pixel every `step_mm`, never a value between pixels, so that every number
/// is one that the map holds. Without a step it is the map's pixel, or longer where that were more than `most_points`.
///
/// # Errors
/// A file that is no `depth.tif`; a line or step that makes more than `most_points` points, or none.
pub fn cut(file: impl Read + Seek, cut: Cut, step_mm: Option<f64>, most_points: usize) -> Result<Section> {
    let mut tif = DepthTif::open(file)?;
    let map = tif.map;
    let (from_mm, to_mm) = match cut {
        Cut::Line { from_mm, to_mm } => (from_mm, to_mm),
        Cut::Across { x_mm } => {
            let height_mm = (map.height_px - 1) as f64 * map.mm_per_px;
            ([x_mm, map.y0_mm], [x_mm, map.y0_mm + height_mm])
        }
    };
    let way_mm = [to_mm[0] - from_mm[0], to_mm[1] - from_mm[1]];
    let length_mm = way_mm[0].hypot(way_mm[1]);
    let step_mm = step_mm.unwrap_or_else(|| map.mm_per_px.max(length_mm / (most_points - 1).max(1) as f64));
    // Half a millionth of a step more: a length that is a whole number of steps ends with a point.
    let steps = (length_mm / step_mm + 1e-6).floor();
    if !steps.is_finite() || steps < 0.0 || steps + 1.0 > most_points as f64 {
        let found = format!("a line of {length_mm:.1} mm in steps of {step_mm} mm");
        return Err(Error::field("profile", "step_mm", found, format!("at most {most_points} points")));
    }
    let mut points = Vec::with_capacity(steps as usize + 1);
    for index in 0..=steps as usize {
        let distance_mm = index as f64 * step_mm;
        let share = if length_mm > 0.0 { distance_mm / length_mm } else { 0.0 };
        let (x_mm, y_mm) = (from_mm[0] + way_mm[0] * share, from_mm[1] + way_mm[1] * share);
        points.push(SectionPoint { distance_mm, x_mm, y_mm, z_mm: tif.at(x_mm, y_mm)? });
    }
    Ok(Section { map, step_mm, points })
}

/// A `depth.tif`, open; the tile that was read last stays, since a straight line enters each tile once.
struct DepthTif<R: Read + Seek> {
    decoder: Decoder<R>,
    map: MapGeometry,
    side_px: [usize; 2],
    held: Option<Tile>,
}

struct Tile {
    index: u32,
    width_px: usize,
    depth_mm: Vec<f32>,
}

impl<R: Read + Seek> DepthTif<R> {
    fn open(file: R) -> Result<DepthTif<R>> {
        let mut decoder = Decoder::new(file).map_err(bad)?;
        let (width_px, height_px) = decoder.dimensions().map_err(bad)?;
        let (tile_width_px, tile_height_px) = decoder.chunk_dimensions();
        let matrix = decoder.get_tag_f64_vec(Tag::ModelTransformationTag).map_err(bad)?;
        let &[mm_per_px, _, _, x0_mm, _, _, _, y0_mm, ..] = matrix.as_slice() else {
            return Err(Error::input("depth.tif", "a short transformation", "16 numbers"));
        };
        let map = MapGeometry { x0_mm, y0_mm, mm_per_px, width_px: width_px as usize, height_px: height_px as usize };
        Ok(DepthTif { decoder, map, side_px: [tile_width_px as usize, tile_height_px as usize], held: None })
    }

    /// The nearest pixel's value.
    fn at(&mut self, x_mm: f64, y_mm: f64) -> Result<f32> {
        let map = self.map;
        let column = ((x_mm - map.x0_mm) / map.mm_per_px).round();
        let row = ((y_mm - map.y0_mm) / map.mm_per_px).round();
        let inside = |value: f64, size: usize| value >= 0.0 && value < size as f64;
        if !inside(column, map.width_px) || !inside(row, map.height_px) {
            return Ok(f32::NAN);
        }
        let (column, row) = (column as usize, row as usize);
        let [width, height] = self.side_px;
        let index = (row / height * map.width_px.div_ceil(width) + column / width) as u32;
        let tile = match self.held.take() {
            Some(tile) if tile.index == index => tile,
            _ => self.read(index)?,
        };
        let z_mm = tile.depth_mm.get(row % height * tile.width_px + column % width).copied().unwrap_or(f32::NAN);
        self.held = Some(tile);
        Ok(z_mm)
    }

    fn read(&mut self, index: u32) -> Result<Tile> {
        let (width_px, _) = self.decoder.chunk_data_dimensions(index);
        match self.decoder.read_chunk(index).map_err(bad)? {
            DecodingResult::F32(depth_mm) => Ok(Tile { index, width_px: width_px as usize, depth_mm }),
            _ => Err(Error::input("depth.tif", "another kind of values", "float32")),
        }
    }
}

fn bad(error: TiffError) -> Error {
    match error {
        TiffError::IoError(source) => Error::io("depth.tif", source),
        other => Error::input("depth.tif", other.to_string(), "a depth map that Stria wrote"),
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::BufReader;

    use super::*;
    use crate::depth_map::{GridMap, MapReader};

    const MAP: MapGeometry =
        MapGeometry { x0_mm: -544.25, y0_mm: -305.5, mm_per_px: 0.5, width_px: 1301, height_px: 611 };

    fn value(column: usize, row: usize) -> f32 {
        if (column / 41 + row / 31).is_multiple_of(3) { f32::NAN } else { column as f32 + row as f32 / 1024.0 }
    }

    fn section(cut_at: Cut, step_mm: Option<f64>) -> Result<Section> {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("depth.tif");
        let mut map = GridMap::from_fn(MAP, |column, row| (value(column, row), None));
        assert_eq!(map.geometry(), MAP);
        super::super::write(&mut map, &path).expect("write");
        cut(BufReader::new(File::open(path).expect("open")), cut_at, step_mm, 2000)
    }

    fn same(a: f32, b: f32) -> bool {
        a == b || (a.is_nan() && b.is_nan())
    }

    #[test]
    fn a_section_across_is_a_column_of_the_map() {
        let section = section(Cut::Across { x_mm: -544.25 + 0.5 * 700.0 + 0.2 }, None).expect("section");
        assert_eq!(section.points.len(), 611);
        for (row, point) in section.points.iter().enumerate() {
            assert!(same(point.z_mm, value(700, row)), "row {row}: {point:?}");
            assert!((point.distance_mm - 0.5 * row as f64).abs() < 1e-9);
        }
    }

    #[test]
    fn a_slanting_line_takes_the_nearest_pixels_and_nothing_outside() {
        let line = Cut::Line { from_mm: [-600.0, -400.0], to_mm: [100.0, 0.0] };
        let section = section(line, Some(0.7)).expect("section");
        let mut measured = 0;
        for point in &section.points {
            let (column, row) = ((point.x_mm + 544.25) / 0.5, (point.y_mm + 305.5) / 0.5);
            let inside = column > -0.5 && row > -0.5;
            let expected = if inside { value(column.round() as usize, row.round() as usize) } else { f32::NAN };
            assert!(same(point.z_mm, expected), "{point:?}");
            measured += usize::from(point.z_mm.is_finite());
        }
        assert!(measured > 300 && section.points[0].z_mm.is_nan());
    }

    #[test]
    fn a_line_with_too_many_points_is_refused_or_thinned() {
        let line = Cut::Line { from_mm: [0.0, 0.0], to_mm: [5000.0, 0.0] };
        let refused = section(line, Some(0.5)).expect_err("refused").to_string();
        assert!(refused.contains("2000 points"), "{refused}");
        let thinned = section(line, None).expect("section");
        assert_eq!(thinned.points.len(), 2000);
        assert!(section(Cut::Line { from_mm: [0.0, 0.0], to_mm: [f64::NAN, 0.0] }, None).is_err());
    }
}
