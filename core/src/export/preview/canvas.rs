//! A picture to draw on: rectangles, lines, hatching, text.

use ab_glyph::{Font, FontRef, Glyph, PxScale, ScaleFont, point};

use crate::error::{Error, Result};

/// A colour: red, green, blue.
pub(super) type Rgb = [u8; 3];

/// Ubuntu Light, from a library of fonts.
const FONT: &[u8] = epaint_default_fonts::UBUNTU_LIGHT;

/// Where a text's given point lies in it.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Align {
    Left,
    Centre,
    Right,
}

/// How a text looks.
#[derive(Clone, Copy)]
pub(super) struct Style {
    pub size_px: f32,
    pub colour: Rgb,
    pub align: Align,
}

/// The picture.
pub(super) struct Canvas {
    pub width_px: usize,
    pub height_px: usize,
    pixels: Vec<Rgb>,
    font: FontRef<'static>,
}

impl Canvas {
    pub(super) fn new(width_px: usize, height_px: usize, background: Rgb) -> Result<Canvas> {
        let font = FontRef::try_from_slice(FONT).map_err(|e| Error::internal("preview font", e))?;
        Ok(Canvas { width_px, height_px, pixels: vec![background; width_px * height_px], font })
    }

    /// The bytes: red, green, blue of each pixel.
    pub(super) fn rgb(&self) -> &[u8] {
        self.pixels.as_flattened()
    }

    /// Mixes a colour in; outside the picture nothing happens.
    pub(super) fn blend(&mut self, x: i64, y: i64, colour: Rgb, alpha: f32) {
        let inside = (0..self.width_px as i64).contains(&x) && (0..self.height_px as i64).contains(&y);
        if inside {
            let pixel = &mut self.pixels[y as usize * self.width_px + x as usize];
            for (old, new) in pixel.iter_mut().zip(colour) {
                *old = (f32::from(*old) + (f32::from(new) - f32::from(*old)) * alpha.clamp(0.0, 1.0)).round() as u8;
            }
        }
    }

    pub(super) fn fill(&mut self, x: i64, y: i64, width_px: i64, height_px: i64, colour: Rgb) {
        for row in y..y + height_px {
            for column in x..x + width_px {
                self.blend(column, row, colour, 1.0);
            }
        }
    }

    /// A rectangle's outline, drawn inside it.
    pub(super) fn outline(&mut self, x: i64, y: i64, width_px: i64, height_px: i64, colour: Rgb) {
        self.fill(x, y, width_px, 1, colour);
        self.fill(x, y + height_px - 1, width_px, 1, colour);
        self.fill(x, y, 1, height_px, colour);
        self.fill(x + width_px - 1, y, 1, height_px, colour);
    }

    /// One pixel of the pattern that says *not measured*: pale slanting lines.
    pub(super) fn hatch(&mut self, x: i64, y: i64) {
        // Distance from the middle of the nearest line, in px along a row.
        let across = ((x + y).rem_euclid(14) - 7).abs() as f32;
        self.blend(x, y, [243, 244, 246], 1.0);
        self.blend(x, y, [205, 209, 215], 1.8 - across);
    }

    /// Writes on a line whose base runs through `y`.
    pub(super) fn text(&mut self, x: f32, y: f32, text: &str, style: Style) {
        for (column, row, coverage) in self.coverage(text, style) {
            self.blend(x.round() as i64 + column, y.round() as i64 + row, style.colour, coverage);
        }
    }

    /// Writes upwards along a line whose base runs through `x`.
    pub(super) fn text_upwards(&mut self, x: f32, y: f32, text: &str, style: Style) {
        for (column, row, coverage) in self.coverage(text, style) {
            self.blend(x.round() as i64 + row, y.round() as i64 - column, style.colour, coverage);
        }
    }

    /// How wide a text becomes, px.
    pub(super) fn text_width(&self, text: &str, size_px: f32) -> f32 {
        self.glyphs(text, size_px).1
    }

    /// The pixels that a text covers, from its point on.
    fn coverage(&self, text: &str, style: Style) -> Vec<(i64, i64, f32)> {
        let (glyphs, width) = self.glyphs(text, style.size_px);
        let shift = match style.align {
            Align::Left => 0.0,
            Align::Centre => -width / 2.0,
            Align::Right => -width,
        };
        let mut pixels = Vec::new();
        for glyph in glyphs {
            if let Some(outline) = self.font.outline_glyph(glyph) {
                let bounds = outline.px_bounds();
                let (left, top) = (bounds.min.x as i64 + shift.round() as i64, bounds.min.y as i64);
                outline.draw(|x, y, coverage| pixels.push((left + i64::from(x), top + i64::from(y), coverage)));
            }
        }
        pixels
    }

    fn glyphs(&self, text: &str, size_px: f32) -> (Vec<Glyph>, f32) {
        let scale = PxScale::from(size_px);
        let font = self.font.as_scaled(scale);
        let mut x = 0.0;
        let mut before = None;
        let mut glyphs = Vec::new();
        for letter in text.chars() {
            let id = font.glyph_id(letter);
            x += before.map_or(0.0, |before| font.kern(before, id));
            glyphs.push(id.with_scale_and_position(scale, point(x, 0.0)));
            x += font.h_advance(id);
            before = Some(id);
        }
        (glyphs, x)
    }
}
