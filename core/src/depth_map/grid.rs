//! A small map held in memory as one piece.

use super::{MapGeometry, MapReader, MapWindow};
use crate::error::Result;

/// A map that fits into memory: for tests, and for maps made elsewhere.
#[derive(Clone, Debug, PartialEq)]
pub struct GridMap {
    geometry: MapGeometry,
    pixels: MapWindow,
}

impl GridMap {
    /// From its pixels; `pixel(column, row)` gives the depth in mm (NaN: not measured) and the colour.
    pub fn from_fn(geometry: MapGeometry, mut pixel: impl FnMut(usize, usize) -> (f32, Option<[u8; 3]>)) -> GridMap {
        let mut pixels = MapWindow::empty(geometry.width_px, geometry.height_px);
        for row in 0..geometry.height_px {
            for column in 0..geometry.width_px {
                let at = row * geometry.width_px + column;
                (pixels.depth_mm[at], pixels.texture[at]) = pixel(column, row);
            }
        }
        GridMap { geometry, pixels }
    }

    /// All of it.
    pub fn pixels(&self) -> &MapWindow {
        &self.pixels
    }
}

impl MapReader for GridMap {
    fn geometry(&self) -> MapGeometry {
        self.geometry
    }

    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
        let mut window = MapWindow::empty(width_px, height_px);
        let columns = width_px.min(self.geometry.width_px.saturating_sub(column_px));
        for row in 0..height_px.min(self.geometry.height_px.saturating_sub(row_px)) {
            let from = (row_px + row) * self.geometry.width_px + column_px;
            let to = row * width_px;
            window.depth_mm[to..to + columns].copy_from_slice(&self.pixels.depth_mm[from..from + columns]);
            window.texture[to..to + columns].copy_from_slice(&self.pixels.texture[from..from + columns]);
        }
        Ok(window)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_over_the_edge_is_empty_there() {
        let geometry = MapGeometry { x0_mm: 0.0, y0_mm: 0.0, mm_per_px: 1.0, width_px: 3, height_px: 2 };
        let mut map = GridMap::from_fn(geometry, |column, row| ((10 * row + column) as f32, Some([column as u8; 3])));
        let window = map.window(2, 1, 2, 2).expect("window");
        assert_eq!(window.depth_mm[0], 12.0);
        assert!(window.depth_mm[1..].iter().all(|z| z.is_nan()));
        assert_eq!(window.texture, vec![Some([2; 3]), None, None, None]);
        assert!(map.window(9, 9, 2, 2).expect("window").depth_mm.iter().all(|z| z.is_nan()));
    }
}
