//! A run that went the other way, seen as if it had gone this way.
//!
//! A camera that sees the same surface on the way back is turned half about its axis (a crawler that has turned round on the
//! pipe's crown): world x and y point the other way, z stays. One that stays upright sees the same surface with the same x,
//! also when it moves backwards; seen from a robot that has turned round it sees the other wall.

use super::{Bounds, Defect, DefectList};
use crate::depth_map::{MapGeometry, MapReader, MapWindow};
use crate::error::Result;

/// A map turned half about z.
pub(super) struct TurnedMap<'a> {
    pub map: &'a mut dyn MapReader,
}

impl MapReader for TurnedMap<'_> {
    fn geometry(&self) -> MapGeometry {
        let own = self.map.geometry();
        let turned = |first_mm: f64, count: usize| -(first_mm + count.saturating_sub(1) as f64 * own.mm_per_px);
        MapGeometry { x0_mm: turned(own.x0_mm, own.width_px), y0_mm: turned(own.y0_mm, own.height_px), ..own }
    }

    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
        let own = self.map.geometry();
        // What of the window lies within the map, from whose far end it counts.
        let columns = width_px.min(own.width_px.saturating_sub(column_px));
        let rows = height_px.min(own.height_px.saturating_sub(row_px));
        let mut window = MapWindow::empty(width_px, height_px);
        if columns == 0 || rows == 0 {
            return Ok(window);
        }
        let first = (own.width_px - column_px - columns, own.height_px - row_px - rows);
        let read = self.map.window(first.0, first.1, columns, rows)?;
        for row in 0..rows {
            for column in 0..columns {
                let from = (rows - 1 - row) * columns + columns - 1 - column;
                let to = row * width_px + column;
                window.depth_mm[to] = read.depth_mm[from];
                window.texture[to] = read.texture[from];
            }
        }
        Ok(window)
    }
}

/// The list of such a run: the chainage, and what belongs to the asset, stay.
pub(super) fn turned(list: &DefectList) -> DefectList {
    let mut list = list.clone();
    list.chainage_falls = !list.chainage_falls;
    list.inspected.x_min_mm = -(list.inspected.x_min_mm + list.inspected.length_mm);
    list.defects.iter_mut().for_each(turn);
    list
}

fn turn(defect: &mut Defect) {
    let own = defect.bounds;
    (defect.x_mm, defect.y_mm) = (-defect.x_mm, -defect.y_mm);
    (defect.deepest_x_mm, defect.deepest_y_mm) = (-defect.deepest_x_mm, -defect.deepest_y_mm);
    defect.height_mm = defect.height_mm.map(|height| -height);
    defect.bounds =
        Bounds { x_min_mm: -own.x_max_mm, x_max_mm: -own.x_min_mm, y_min_mm: -own.y_max_mm, y_max_mm: -own.y_min_mm };
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth_map::GridMap;

    #[test]
    fn every_place_of_a_turned_map_is_its_own_opposite() {
        let geometry = MapGeometry { x0_mm: 10.0, y0_mm: -4.0, mm_per_px: 2.0, width_px: 7, height_px: 5 };
        let mut map = GridMap::from_fn(geometry, |column, row| ((10 * row + column) as f32, Some([column as u8; 3])));
        let mut turned = TurnedMap { map: &mut map };
        let own = turned.geometry();
        assert_eq!((own.x0_mm, own.y0_mm), (-22.0, -4.0));
        // A window that reaches over the far corner.
        let window = turned.window(5, 3, 3, 4).expect("window");
        for (row, line) in window.depth_mm.chunks_exact(3).enumerate() {
            for (column, z_mm) in line.iter().enumerate() {
                let (c, r) = (5 + column, 3 + row);
                if c < 7 && r < 5 {
                    assert_eq!(*z_mm, (10 * (4 - r) + 6 - c) as f32, "{c}, {r}");
                    assert_eq!(window.texture[row * 3 + column], Some([(6 - c) as u8; 3]));
                } else {
                    assert!(z_mm.is_nan(), "{c}, {r} lies outside");
                }
            }
        }
    }
}
