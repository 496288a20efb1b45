//! The upper levels of the pyramid while the run goes on: kept like the map itself, a few tiles in memory and the others
//! in a scratch file, so that a long run needs no more memory than a short one.

use std::path::Path;

use super::TileLevel;
use crate::depth_map::{Grid, MapWindow, SurfaceMap, TILE_SIDE_PX, TileIndex};
use crate::error::Result;
use crate::export::pyramid::halved;

/// Levels while the run goes on: the topmost shows half a million columns in a tile.
const LEVELS: u32 = 12;
/// Tiles of a level that are kept in memory.
const TILES_IN_MEMORY: usize = 4;

/// Levels 1 and up. Each level has what was added to the one below, one level ahead of what is shown.
pub(super) struct Growing {
    levels: Vec<SurfaceMap>,
}

impl Growing {
    /// Empty levels, their scratch files in `folder`.
    pub(super) fn create(folder: &Path) -> Result<Growing> {
        let grid = Grid { x_mm: 0.0, y_mm: 0.0, mm_per_px: 1.0 };
        let level = |_| SurfaceMap::create(grid, TILES_IN_MEMORY, folder);
        Ok(Growing { levels: (1..=LEVELS).map(level).collect::<Result<_>>()? })
    }

    /// Puts a tile of `level` at half its size into the level above.
    pub(super) fn add(&mut self, level: u32, (column, row): TileIndex, tile: &MapWindow) -> Result<()> {
        let Some(above) = self.levels.get_mut(level as usize) else { return Ok(()) };
        let half = halved(tile);
        let side = (TILE_SIDE_PX / 2) as i64;
        for at in 0..half.depth_mm.len() {
            let (x, y) = ((at % half.width_px) as i64 + column * side, (at / half.width_px) as i64 + row * side);
            if half.depth_mm[at].is_finite() {
                above.put_depth(x, y, half.depth_mm[at])?;
            }
            if let Some(rgb) = half.texture[at] {
                above.put_texture(x, y, rgb, true)?;
            }
        }
        Ok(())
    }

    /// A tile of a level from 1 on.
    pub(super) fn tile(&mut self, level: u32, index: TileIndex) -> Result<MapWindow> {
        self.levels[level as usize - 1].tile_window(index)
    }
}

/// As many levels as it takes until the map is no larger than a tile, as far as they are kept.
pub(super) fn level_count(bottom: &TileLevel) -> u32 {
    let columns = bottom.last_column - bottom.first_column + 1;
    let rows = bottom.last_row - bottom.first_row + 1;
    let levels = columns.max(rows).max(1).unsigned_abs().next_power_of_two().ilog2() + 1;
    levels.min(LEVELS)
}
