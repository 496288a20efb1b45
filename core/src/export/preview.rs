//! `preview.png`: the depth map for people: coloured by depth, shaded as if lit from the upper left, with
//! axes, legend and scale bar; at most 2,000 px wide.
//!
//! The colours span the middle 98 % of the depths, so that a few stray points do not flatten the rest. Long
//! maps are wrapped into strips, read like lines of text.

mod colour;
mod furniture;
mod layout;
mod reduce;
mod relief;
mod thumbnail;

use std::path::Path;

use crate::depth_map::MapReader;
use crate::error::{Error, Result};
use crate::export::canvas::Canvas;

use layout::{Layout, WIDTH_PX};
use reduce::{Between, Reduced};
use thumbnail::Thumbnail;

/// Share of the depths beyond each end of the colours.
const TAIL: f64 = 0.01;
/// Least span of the colours, mm: a flat plate must not become a picture of noise.
const LEAST_SPAN_MM: f64 = 0.2;

/// What the picture says beside the map.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PreviewText {
    /// The first line; empty: *Depth map*.
    pub title: String,
    /// Chainage of the world's x = 0, mm.
    pub start_chainage_mm: f64,
    /// The chainage falls along world x.
    pub chainage_falls: bool,
}

impl PreviewText {
    fn chainage_mm(&self, x_mm: f64) -> f64 {
        self.start_chainage_mm + if self.chainage_falls { -x_mm } else { x_mm }
    }
}

/// Depths at the ends of the colours, mm.
#[derive(Clone, Copy)]
struct Range {
    near_mm: f64,
    far_mm: f64,
}

/// The picture in memory.
pub struct Picture {
    canvas: Canvas,
    thumbnail: Thumbnail,
}

impl Picture {
    /// Columns.
    pub fn width_px(&self) -> usize {
        self.canvas.width_px
    }

    /// Rows.
    pub fn height_px(&self) -> usize {
        self.canvas.height_px
    }

    /// Red, green, blue of each pixel.
    pub fn rgb(&self) -> &[u8] {
        self.canvas.rgb()
    }

    /// Writes it as a PNG file.
    ///
    /// # Errors
    /// What the disk says.
    pub fn save(&self, path: &Path) -> Result<()> {
        self.canvas.save_png(path)
    }

    /// Writes a small picture of the map alone, for lists, as a JPEG file.
    ///
    /// # Errors
    /// What the disk says.
    pub fn save_thumbnail(&self, path: &Path) -> Result<()> {
        self.thumbnail.save(path)
    }
}

/// Paints the picture.
///
/// # Errors
/// An empty map; what the reading of the map says.
pub fn picture(map: &mut dyn MapReader, text: &PreviewText) -> Result<Picture> {
    let geometry = map.geometry();
    if geometry.width_px == 0 || geometry.height_px == 0 {
        return Err(Error::internal("preview.png", "an empty map"));
    }
    let layout = Layout::of(&geometry);
    let factor = (layout.mm_per_px / geometry.mm_per_px).round().max(1.0) as usize;
    let reduced = Reduced::read(map, factor)?;
    let range = colour_range(&reduced);
    let mut canvas = Canvas::new(WIDTH_PX, layout.height_px(), [255; 3])?;
    let shades = relief::shade(&reduced);
    draw_map(&mut canvas, &layout, &reduced, &shades, range);
    furniture::draw(&mut canvas, &furniture::Sheet { layout, geometry, text, range, coverage: reduced.coverage });
    let thumbnail = Thumbnail::of(&reduced, &shades, range);
    Ok(Picture { canvas, thumbnail })
}

fn colour_range(map: &Reduced) -> Option<Range> {
    let (near_mm, far_mm) = map.range_mm(TAIL)?;
    let widen_mm = ((LEAST_SPAN_MM - (far_mm - near_mm)) / 2.0).max(0.0);
    Some(Range { near_mm: near_mm - widen_mm, far_mm: far_mm + widen_mm })
}

fn draw_map(canvas: &mut Canvas, layout: &Layout, map: &Reduced, shades: &[f32], range: Option<Range>) {
    let range = range.unwrap_or(Range { near_mm: 0.0, far_mm: 1.0 });
    let ramp = colour::Ramp::new();
    let scale = layout.mm_per_px / map.mm_per_px;
    // Centres of pixels are at whole numbers in the map, at halves in the ratio of sizes.
    let place = |px: usize, length_px: usize| Between::of((px as f64 + 0.5) * scale - 0.5, length_px);
    let rows: Vec<Between> = (0..layout.strip_height_px).map(|row| place(row, map.height_px)).collect();
    for strip in 0..layout.strips {
        let (left, top) = (layout.strip_left_px(), layout.strip_top_px(strip));
        let first = strip * layout.strip_width_px;
        let columns: Vec<Between> =
            (first..first + layout.strip_width_px).map(|column| place(column, map.width_px)).collect();
        for (row, y) in rows.iter().enumerate() {
            for (column, x) in columns.iter().enumerate() {
                let (at_x, at_y) = ((left + column) as i64, (top + row) as i64);
                let z_mm = reduce::between(&map.depth_mm, map.width_px, *x, *y);
                if z_mm.is_nan() {
                    canvas.hatch(at_x, at_y);
                    continue;
                }
                let share = (f64::from(z_mm) - range.near_mm) / (range.far_mm - range.near_mm);
                let shade = reduce::between(shades, map.width_px, *x, *y);
                canvas.put(at_x, at_y, colour::shaded(ramp.at(share), shade));
            }
        }
    }
}

#[cfg(test)]
mod tests;
