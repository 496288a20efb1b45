//! The depth map as foxglove.Grid messages: pieces of bounded size, and one overview.

use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::{Grid, RawImage, Timestamp, Vector2};

use super::points::{fields, pose_at};
use crate::depth_map::{MapGeometry, MapWindow};

/// A message holds at most this many cells, 8 bytes each: what a reader must keep in memory at once.
const CELLS_MAX: usize = 1 << 20;
/// Widest and highest overview, cells.
const OVERVIEW_SIDE: usize = 1000;
const CELL_BYTES: usize = 8;

/// A rectangle of the map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Piece {
    pub column_px: usize,
    pub row_px: usize,
    pub width_px: usize,
    pub height_px: usize,
}

impl Piece {
    /// Where this part of the map lies.
    pub(super) fn geometry(&self, map: &MapGeometry) -> MapGeometry {
        MapGeometry {
            x0_mm: map.x0_mm + self.column_px as f64 * map.mm_per_px,
            y0_mm: map.y0_mm + self.row_px as f64 * map.mm_per_px,
            mm_per_px: map.mm_per_px,
            width_px: self.width_px,
            height_px: self.height_px,
        }
    }
}

/// The map cut into pieces, column by column along the travel.
pub(super) fn pieces(map: &MapGeometry) -> Vec<Piece> {
    let rows = map.height_px.clamp(1, 4096);
    let columns = (CELLS_MAX / rows).clamp(1, map.width_px.max(1));
    let mut pieces = Vec::new();
    for column_px in (0..map.width_px).step_by(columns) {
        for row_px in (0..map.height_px).step_by(rows) {
            let (width_px, height_px) = (columns.min(map.width_px - column_px), rows.min(map.height_px - row_px));
            pieces.push(Piece { column_px, row_px, width_px, height_px });
        }
    }
    pieces
}

/// Every n-th cell of the map.
pub(super) struct Overview {
    step: usize,
    geometry: MapGeometry,
    content: MapWindow,
}

impl Overview {
    pub(super) fn new(map: &MapGeometry) -> Overview {
        let step = map.width_px.max(map.height_px).div_ceil(OVERVIEW_SIDE).max(1);
        let (width_px, height_px) = (map.width_px.div_ceil(step), map.height_px.div_ceil(step));
        // A cell of the overview covers step x step cells of the map and shows the first of them.
        let shift_mm = (step - 1) as f64 * map.mm_per_px / 2.0;
        let geometry = MapGeometry {
            x0_mm: map.x0_mm + shift_mm,
            y0_mm: map.y0_mm + shift_mm,
            mm_per_px: map.mm_per_px * step as f64,
            width_px,
            height_px,
        };
        let cells = width_px * height_px;
        let content = MapWindow { width_px, height_px, depth_mm: vec![f32::NAN; cells], texture: vec![None; cells] };
        Overview { step, geometry, content }
    }

    pub(super) fn add(&mut self, piece: &Piece, content: &MapWindow) {
        let first = |start: usize| start.div_ceil(self.step) * self.step;
        for row in (first(piece.row_px)..piece.row_px + piece.height_px).step_by(self.step) {
            for column in (first(piece.column_px)..piece.column_px + piece.width_px).step_by(self.step) {
                let from = (row - piece.row_px) * content.width_px + column - piece.column_px;
                let to = row / self.step * self.content.width_px + column / self.step;
                self.content.depth_mm[to] = content.depth_mm[from];
                self.content.texture[to] = content.texture[from];
            }
        }
    }

    pub(super) fn finish(self) -> (MapGeometry, MapWindow) {
        (self.geometry, self.content)
    }
}

/// A piece of the map: elevation (float32, world z in metres, NaN where nothing was measured) and the visible image
/// (red green blue, alpha 0 where there is none).
pub(super) fn message(timestamp: Timestamp, frame_id: &str, geometry: &MapGeometry, content: &MapWindow) -> Grid {
    let mut data = Vec::with_capacity(CELL_BYTES * content.depth_mm.len());
    for (depth_mm, texture) in content.depth_mm.iter().zip(&content.texture) {
        data.extend((depth_mm / 1000.0).to_le_bytes());
        let [r, g, b] = texture.unwrap_or_default();
        data.extend([r, g, b, if texture.is_some() { 255 } else { 0 }]);
    }
    let cell_m = geometry.mm_per_px / 1000.0;
    // A grid's origin is the corner of its first cell; the map's is the cell's centre.
    let origin_m = |centre_mm: f64| centre_mm / 1000.0 - cell_m / 2.0;
    Grid {
        timestamp: Some(timestamp),
        frame_id: frame_id.into(),
        pose: Some(pose_at([origin_m(geometry.x0_mm), origin_m(geometry.y0_mm), 0.0])),
        column_count: geometry.width_px as u32,
        cell_size: Some(Vector2 { x: cell_m, y: cell_m }),
        row_stride: (CELL_BYTES * geometry.width_px) as u32,
        cell_stride: CELL_BYTES as u32,
        fields: fields(&[
            ("elevation", 0, NumericType::Float32),
            ("red", 4, NumericType::Uint8),
            ("green", 5, NumericType::Uint8),
            ("blue", 6, NumericType::Uint8),
            ("alpha", 7, NumericType::Uint8),
        ]),
        data: data.into(),
    }
}

/// A rectangle of the map as an image of float32, world z in metres, NaN where nothing was measured.
pub(super) fn image(timestamp: Timestamp, frame_id: &str, content: &MapWindow) -> RawImage {
    let data: Vec<u8> = content.depth_mm.iter().flat_map(|depth_mm| (depth_mm / 1000.0).to_le_bytes()).collect();
    RawImage {
        timestamp: Some(timestamp),
        frame_id: frame_id.into(),
        width: content.width_px as u32,
        height: content.height_px as u32,
        encoding: "32FC1".into(),
        step: 4 * content.width_px as u32,
        data: data.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(width_px: usize, height_px: usize) -> MapGeometry {
        MapGeometry { x0_mm: 10.0, y0_mm: -5.0, mm_per_px: 0.5, width_px, height_px }
    }

    #[test]
    fn pieces_cover_every_cell_once_and_stay_small() {
        for (width, height) in [(1, 1), (3000, 1080), (100_000, 30), (700, 9000)] {
            let map = map(width, height);
            let pieces = pieces(&map);
            assert_eq!(pieces.iter().map(|p| p.width_px * p.height_px).sum::<usize>(), width * height);
            assert!(pieces.iter().all(|p| p.width_px * p.height_px <= CELLS_MAX));
            let last = pieces.last().expect("some").geometry(&map);
            let end_mm = last.x0_mm + (last.width_px - 1) as f64 * 0.5;
            assert!((end_mm - (10.0 + (width - 1) as f64 * 0.5)).abs() < 1e-9);
        }
        assert!(pieces(&map(0, 0)).is_empty());
    }

    #[test]
    fn the_overview_is_the_map_seen_from_afar() {
        let map = map(2500, 1200);
        let mut overview = Overview::new(&map);
        for piece in pieces(&map) {
            let value = |i: usize| (piece.column_px + i % piece.width_px) as f32;
            let cells = piece.width_px * piece.height_px;
            let content = MapWindow {
                width_px: piece.width_px,
                height_px: piece.height_px,
                depth_mm: (0..cells).map(value).collect(),
                texture: vec![Some([1, 2, 3]); cells],
            };
            overview.add(&piece, &content);
        }
        let (geometry, content) = overview.finish();
        assert_eq!((geometry.width_px, geometry.height_px, geometry.mm_per_px), (834, 400, 1.5));
        assert_eq!(geometry.x0_mm, 10.5, "the centre of three columns");
        assert!(content.depth_mm.iter().enumerate().all(|(i, z)| *z == (3 * (i % 834)) as f32));
    }
}
