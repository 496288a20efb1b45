//! `tiles/`: the maps cut into a pyramid for browsing, readable before the job has ended.
//!
//! - `tiles/depth/{level}/{column}_{row}.png`: 24-bit colour, value = red·65536 + green·256 + blue;
//!   0 = not measured, else z = value · 0.001 mm − 4000 mm. The same steps in every run, so that tiles of a
//!   run still going on never change their meaning.
//! - `tiles/texture/{level}/{column}_{row}.jpg`: the visible image, mid gray where there is none.
//! - `tiles/tiles.json`: a [`TilesIndex`].
//!
//! Tiles are 256 × 256 px. Level 0 is full size, each further level half of the one before. Tile (0, 0) begins
//! at the grid's origin, chosen when the run starts; a robot that goes backwards, or a wall that reaches
//! higher, gives tiles with negative numbers, and no tile ever changes its number. While the run goes on the
//! pyramid grows: `revision` counts its states, `changed` names the tiles that came or changed last, and tiles
//! not yet there are missing; at the end every tile inside each level's range exists.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::hash::{DefaultHasher, Hasher};
use std::path::{Path, PathBuf};

use png::{BitDepth, ColorType, Compression, Encoder, Filter};
use serde::{Deserialize, Serialize};

use crate::depth_map::{MapGeometry, MapReader, MapWindow, TILE_SIDE_PX, TileIndex};
use crate::error::{Error, Result};
use crate::export::new_file::{self, NewFile};
use crate::export::pyramid::{self, Layout, TileAddress, tile_range};
use crate::export::texture::small_jpeg;

mod depth_range;
mod growing;

use depth_range::DepthHistogram;
use growing::Growing;

/// Depth of one step of a tile's value, mm.
pub const STEP_MM: f64 = 0.001;
/// Depth of value 0, if it were one, mm.
pub const OFFSET_MM: f64 = -4000.0;
/// So many changes are listed: who has missed more asks for every tile in view again.
const CHANGES_LISTED: usize = 400;
/// Largest value that 24 bits hold.
const LARGEST_VALUE: f64 = 16_777_215.0;

/// Where the tiles' own grid lies.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TileGrid {
    /// World x of the centre of tile (0, 0)'s first pixel at level 0, mm.
    pub x0_mm: f64,
    /// World y of the centre of that pixel, mm.
    pub y0_mm: f64,
    /// Size of a pixel at level 0, mm.
    pub mm_per_px: f64,
}

/// One level of the pyramid: which tiles there are.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TileLevel {
    /// 0 is full size.
    pub level: u32,
    /// Size of a pixel, mm.
    pub mm_per_px: f64,
    /// Leftmost column of tiles.
    pub first_column: i64,
    /// Rightmost column of tiles.
    pub last_column: i64,
    /// Topmost row of tiles.
    pub first_row: i64,
    /// Lowest row of tiles.
    pub last_row: i64,
}

/// `tiles.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TilesIndex {
    /// Grows when a field changes its meaning.
    pub schema_version: u32,
    /// False while the run goes on.
    pub complete: bool,
    /// Side of a tile, px.
    pub tile_side_px: usize,
    /// Where the tiles lie.
    pub grid: TileGrid,
    /// Depth of one step of a value, mm.
    pub depth_step_mm: f64,
    /// z = value · step + offset, mm; value 0 is not measured.
    pub depth_offset_mm: f64,
    /// The middle 98 % of the depths so far, mm: a good range for colours.
    pub depth_range_mm: Option<[f64; 2]>,
    /// The levels that there are.
    pub levels: Vec<TileLevel>,
    /// The part of the grid that is the map; known at the end.
    pub depth_map: Option<MapGeometry>,
    /// Counts the states of a pyramid that grows.
    #[serde(default)]
    pub revision: u64,
    /// The newest changes of a pyramid that grows, the newest last: revision, level, column, row.
    #[serde(default)]
    pub changed: VecDeque<[i64; 4]>,
}

impl TilesIndex {
    /// Reads `tiles/tiles.json` of a product folder.
    pub fn load(product_folder: &Path) -> Result<TilesIndex> {
        let path = product_folder.join("tiles/tiles.json");
        let text = std::fs::read(&path).map_err(|e| Error::io(&path, e))?;
        serde_json::from_slice(&text)
            .map_err(|e| Error::input(path.display().to_string(), e.to_string(), "a tiles.json"))
    }
}

/// Writes tiles while the run goes on, and the whole pyramid at its end.
pub struct TileWriter {
    folder: PathBuf,
    index: TilesIndex,
    depths: DepthHistogram,
    growing: Growing,
    /// Tiles of level 0 since the last [`TileWriter::publish`].
    fresh: BTreeSet<TileIndex>,
    /// What each tile of level 0 held when it was last written.
    written: HashMap<TileIndex, u64>,
}

impl TileWriter {
    /// Makes `tiles/` in the product folder.
    pub fn create(product_folder: &Path, grid: TileGrid) -> Result<TileWriter> {
        let folder = product_folder.join("tiles");
        let index = TilesIndex {
            schema_version: 1,
            complete: false,
            tile_side_px: TILE_SIDE_PX,
            grid,
            depth_step_mm: STEP_MM,
            depth_offset_mm: OFFSET_MM,
            depth_range_mm: None,
            levels: Vec::new(),
            depth_map: None,
            revision: 0,
            changed: VecDeque::new(),
        };
        let writer = TileWriter {
            folder,
            index,
            depths: DepthHistogram::default(),
            growing: Growing::create(product_folder)?,
            fresh: BTreeSet::new(),
            written: HashMap::new(),
        };
        writer.make_level_folders(0)?;
        writer.write_index()?;
        Ok(writer)
    }

    /// Writes a tile of level 0 that is new or has changed: `TILE_SIDE_PX` by `TILE_SIDE_PX` pixels of the grid
    /// from column `256 · column` and row `256 · row` on.
    pub fn put(&mut self, column: i64, row: i64, tile: &MapWindow) -> Result<()> {
        self.depths.add(&tile.depth_mm);
        if !self.is_written((column, row), tile) {
            self.write_tile(TileAddress { level: 0, column, row }, tile)?;
        }
        self.growing.add(0, (column, row), tile)?;
        self.fresh.insert((column, row));
        Ok(())
    }

    /// Brings the upper levels and `tiles.json` up to what was put. Answers what changed: names inside the product
    /// folder, `tiles/tiles.json` last.
    pub fn publish(&mut self) -> Result<Vec<String>> {
        let mut fresh = std::mem::take(&mut self.fresh);
        let Some(bottom) = self.extended(&fresh) else { return Ok(Vec::new()) };
        self.index.revision += 1;
        let mut names = Vec::new();
        self.note(0, &fresh, &mut names);
        let known = self.index.levels.len() as u32;
        let count = growing::level_count(&bottom);
        self.index.levels = (0..count).map(|level| level_above(&bottom, level)).collect();
        for level in 1..count {
            if level >= known {
                self.make_level_folders(level)?;
                // A level that begins is written whole.
                fresh = all_tiles(&self.index.levels[level as usize]);
            } else {
                fresh = fresh.iter().map(|(column, row)| (column >> 1, row >> 1)).collect();
            }
            for (column, row) in &fresh {
                let tile = self.growing.tile(level, (*column, *row))?;
                self.write_tile(TileAddress { level, column: *column, row: *row }, &tile)?;
                self.growing.add(level, (*column, *row), &tile)?;
            }
            self.note(level, &fresh, &mut names);
        }
        self.index.depth_range_mm = self.depths.middle();
        self.write_index()?;
        names.push("tiles/tiles.json".into());
        Ok(names)
    }

    /// Completes the pyramid from the finished map: every level, and what of level 0 differs from what is there.
    ///
    /// # Errors
    /// A map whose pixels do not lie on the grid's; what the reading of the map or the disk says.
    pub fn finish(mut self, map: &mut dyn MapReader) -> Result<()> {
        let geometry = map.geometry();
        let (first_column_px, first_row_px) = place_on_grid(&geometry, &self.index.grid)?;
        let levels = level_count(&geometry);
        (1..levels).try_for_each(|level| self.make_level_folders(level))?;
        self.depths = DepthHistogram::default();
        // Nothing was written before where nobody watched.
        let watched = !self.written.is_empty();
        let layout = Layout { side_px: TILE_SIDE_PX, levels, first_column_px, first_row_px };
        pyramid::for_each_tile(map, &layout, &mut |address, tile| {
            if address.level == 0 {
                self.depths.add(&tile.depth_mm);
                if watched && self.is_written((address.column, address.row), tile) {
                    return Ok(());
                }
            }
            self.write_tile(address, tile)
        })?;
        self.index.levels = levels_of(&geometry, &self.index.grid, &layout);
        self.index.depth_range_mm = self.depths.middle();
        self.index.depth_map = Some(geometry);
        self.index.complete = true;
        self.index.revision += 1;
        self.index.changed.clear();
        self.write_index()
    }

    fn write_tile(&mut self, address: TileAddress, tile: &MapWindow) -> Result<()> {
        assert_eq!((tile.width_px, tile.height_px), (TILE_SIDE_PX, TILE_SIDE_PX), "a whole tile");
        let place = |kind: &str, extension: &str| {
            let TileAddress { level, column, row } = address;
            self.folder.join(format!("{kind}/{level}/{column}_{row}.{extension}"))
        };
        put_file(&place("depth", "png"), &depth_png(&tile.depth_mm)?)?;
        put_file(&place("texture", "jpg"), &small_jpeg(TILE_SIDE_PX, TILE_SIDE_PX, &tile.texture)?)
    }

    /// Whether a tile of level 0 stands there as it is already; from now on it does.
    fn is_written(&mut self, index: TileIndex, tile: &MapWindow) -> bool {
        let hash = content_hash(tile);
        self.written.insert(index, hash) == Some(hash)
    }

    /// Level 0's range with these tiles; `None` where there are none.
    fn extended(&self, fresh: &BTreeSet<TileIndex>) -> Option<TileLevel> {
        let (column, row) = fresh.first().copied()?;
        let alone = TileLevel {
            level: 0,
            mm_per_px: self.index.grid.mm_per_px,
            first_column: column,
            last_column: column,
            first_row: row,
            last_row: row,
        };
        let mut level = self.index.levels.first().copied().unwrap_or(alone);
        for (column, row) in fresh {
            level.first_column = level.first_column.min(*column);
            level.last_column = level.last_column.max(*column);
            level.first_row = level.first_row.min(*row);
            level.last_row = level.last_row.max(*row);
        }
        Some(level)
    }

    /// Lists tiles as changed.
    fn note(&mut self, level: u32, tiles: &BTreeSet<TileIndex>, names: &mut Vec<String>) {
        for (column, row) in tiles {
            names.push(format!("tiles/depth/{level}/{column}_{row}.png"));
            names.push(format!("tiles/texture/{level}/{column}_{row}.jpg"));
            self.index.changed.push_back([self.index.revision as i64, i64::from(level), *column, *row]);
        }
        let too_many = self.index.changed.len().saturating_sub(CHANGES_LISTED);
        self.index.changed.drain(..too_many);
    }

    fn make_level_folders(&self, level: u32) -> Result<()> {
        ["depth", "texture"].iter().try_for_each(|kind| {
            let folder = self.folder.join(format!("{kind}/{level}"));
            std::fs::create_dir_all(&folder).map_err(|e| Error::io(folder, e))
        })
    }

    fn write_index(&self) -> Result<()> {
        let text = serde_json::to_vec(&self.index).map_err(|e| Error::internal("tiles.json", e))?;
        new_file::write(&self.folder.join("tiles.json"), &text)
    }
}

fn put_file(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut file = NewFile::create(path)?;
    file.put(bytes)?;
    file.commit_without_sync()
}

/// The grid's pixel that is the map's first.
fn place_on_grid(map: &MapGeometry, grid: &TileGrid) -> Result<(i64, i64)> {
    let column = (map.x0_mm - grid.x0_mm) / grid.mm_per_px;
    let row = (map.y0_mm - grid.y0_mm) / grid.mm_per_px;
    let off = (column - column.round()).abs().max((row - row.round()).abs());
    let other_size = (map.mm_per_px / grid.mm_per_px - 1.0).abs();
    if off > 0.01 || other_size > 1e-6 {
        return Err(Error::internal("tiles", format!("the map {map:?} does not lie on the tiles' grid {grid:?}")));
    }
    Ok((column.round() as i64, row.round() as i64))
}

/// As many levels as it takes until the map is no larger than a tile.
fn level_count(map: &MapGeometry) -> u32 {
    let side_px = map.width_px.max(map.height_px).max(1);
    side_px.div_ceil(TILE_SIDE_PX).next_power_of_two().ilog2() + 1
}

fn levels_of(map: &MapGeometry, grid: &TileGrid, layout: &Layout) -> Vec<TileLevel> {
    let columns = tile_range(layout.first_column_px, map.width_px, layout.side_px);
    let rows = tile_range(layout.first_row_px, map.height_px, layout.side_px);
    let bottom = TileLevel {
        level: 0,
        mm_per_px: grid.mm_per_px,
        first_column: columns.start,
        last_column: columns.end - 1,
        first_row: rows.start,
        last_row: rows.end - 1,
    };
    (0..layout.levels).map(|level| level_above(&bottom, level)).collect()
}

/// A level by level 0's range. A shift of a negative number rounds down: the tile that holds it.
fn level_above(bottom: &TileLevel, level: u32) -> TileLevel {
    TileLevel {
        level,
        mm_per_px: bottom.mm_per_px * f64::from(1_u32 << level),
        first_column: bottom.first_column >> level,
        last_column: bottom.last_column >> level,
        first_row: bottom.first_row >> level,
        last_row: bottom.last_row >> level,
    }
}

fn all_tiles(level: &TileLevel) -> BTreeSet<TileIndex> {
    let rows = level.first_row..=level.last_row;
    (level.first_column..=level.last_column).flat_map(|column| rows.clone().map(move |row| (column, row))).collect()
}

fn content_hash(tile: &MapWindow) -> u64 {
    let mut hasher = DefaultHasher::new();
    let depths = tile.depth_mm.iter().flat_map(|z| z.to_bits().to_ne_bytes());
    let colours = tile.texture.iter().flat_map(|rgb| rgb.map_or([0; 4], |[red, green, blue]| [1, red, green, blue]));
    // In one piece: the hasher takes much longer over many small ones.
    hasher.write(&depths.chain(colours).collect::<Vec<u8>>());
    hasher.finish()
}

/// The three bytes of a depth; depths out of the range of 24 bits count as not measured.
fn value_bytes(z_mm: f32) -> [u8; 3] {
    let value = ((f64::from(z_mm) - OFFSET_MM) / STEP_MM).round();
    if !(1.0..=LARGEST_VALUE).contains(&value) {
        return [0; 3];
    }
    let [_, red, green, blue] = (value as u32).to_be_bytes();
    [red, green, blue]
}

/// A depth tile of `TILE_SIDE_PX * TILE_SIDE_PX` values in mm, NaN where not measured.
pub(super) fn depth_png(depth_mm: &[f32]) -> Result<Vec<u8>> {
    let rgb: Vec<u8> = depth_mm.iter().flat_map(|z| value_bytes(*z)).collect();
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, TILE_SIDE_PX as u32, TILE_SIDE_PX as u32);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Balanced);
    // Between two profiles the depth is straight: differences along the row repeat. Smaller than the filter that would be
    // chosen row by row, and quicker.
    encoder.set_filter(Filter::Sub);
    let mut writer = encoder.write_header().map_err(|e| Error::internal("depth tile", e))?;
    writer.write_image_data(&rgb).map_err(|e| Error::internal("depth tile", e))?;
    writer.finish().map_err(|e| Error::internal("depth tile", e))?;
    Ok(bytes)
}

/// Reads a depth tile back: `TILE_SIDE_PX * TILE_SIDE_PX` depths in mm, NaN where not measured.
pub fn read_depth_tile(path: &Path) -> Result<Vec<f32>> {
    let bad = |e: &dyn std::fmt::Display| Error::input(path.display().to_string(), e.to_string(), "a depth tile");
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().map_err(|e| bad(&e))?;
    if reader.info().color_type != ColorType::Rgb || reader.info().bit_depth != BitDepth::Eight {
        return Err(bad(&"another kind of pixels"));
    }
    let mut rgb = vec![0; reader.output_buffer_size().unwrap_or_default()];
    reader.next_frame(&mut rgb).map_err(|e| bad(&e))?;
    Ok(rgb
        .chunks_exact(3)
        .map(|c| match u32::from_be_bytes([0, c[0], c[1], c[2]]) {
            0 => f32::NAN,
            value => (f64::from(value) * STEP_MM + OFFSET_MM) as f32,
        })
        .collect())
}

#[cfg(test)]
mod tests;
