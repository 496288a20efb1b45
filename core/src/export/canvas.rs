//! A picture to draw on: rectangles, lines, discs, hatching, text.

use std::path::Path;

use ab_glyph::{Font, FontRef, Glyph, PxScale, ScaleFont, point};

use png::{BitDepth, ColorType, Compression, Encoder};

use crate::error::{Error, Result};
use crate::export::new_file::NewFile;

/// A colour: red, green, blue.
pub(crate) type Rgb = [u8; 3];

/// Ubuntu Light, from a library of fonts.
const FONT: &[u8] = epaint_default_fonts::UBUNTU_LIGHT;

/// Where a text's given point lies in it.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Align {
    Left,
    Centre,
    Right,
}

/// How a text looks.
#[derive(Clone, Copy)]
pub(crate) struct Style {
    pub size_px: f32,
    pub colour: Rgb,
    pub align: Align,
}

/// The picture.
pub(crate) struct Canvas {
    pub width_px: usize,
    pub height_px: usize,
    pixels: Vec<Rgb>,
    font: FontRef<'static>,
}

impl Canvas {
    pub(crate) fn new(width_px: usize, height_px: usize, background: Rgb) -> Result<Canvas> {
        let font = FontRef::try_from_slice(FONT).map_err(|e| Error::internal("preview font", e))?;
        Ok(Canvas { width_px, height_px, pixels: vec![background; width_px * height_px], font })
    }

    /// The bytes: red, green, blue of each pixel.
    pub(crate) fn rgb(&self) -> &[u8] {
        self.pixels.as_flattened()
    }

    /// Sets a pixel; outside the picture nothing happens.
    pub(crate) fn put(&mut self, x: i64, y: i64, colour: Rgb) {
        if (0..self.width_px as i64).contains(&x) && (0..self.height_px as i64).contains(&y) {
            self.pixels[y as usize * self.width_px + x as usize] = colour;
        }
    }

    /// Mixes a colour in; outside the picture nothing happens.
    pub(crate) fn blend(&mut self, x: i64, y: i64, colour: Rgb, alpha: f32) {
        let inside = (0..self.width_px as i64).contains(&x) && (0..self.height_px as i64).contains(&y);
        if inside {
            let pixel = &mut self.pixels[y as usize * self.width_px + x as usize];
            for (old, new) in pixel.iter_mut().zip(colour) {
                *old = (f32::from(*old) + (f32::from(new) - f32::from(*old)) * alpha.clamp(0.0, 1.0) + 0.5) as u8;
            }
        }
    }

    pub(crate) fn fill(&mut self, x: i64, y: i64, width_px: i64, height_px: i64, colour: Rgb) {
        for row in y..y + height_px {
            for column in x..x + width_px {
                self.blend(column, row, colour, 1.0);
            }
        }
    }

    /// A rectangle's outline, drawn inside it.
    pub(crate) fn outline(&mut self, x: i64, y: i64, width_px: i64, height_px: i64, colour: Rgb) {
        self.fill(x, y, width_px, 1, colour);
        self.fill(x, y + height_px - 1, width_px, 1, colour);
        self.fill(x, y, 1, height_px, colour);
        self.fill(x + width_px - 1, y, 1, height_px, colour);
    }

    /// A straight line with soft edges.
    pub(crate) fn line(&mut self, from: (f64, f64), to: (f64, f64), width_px: f64, colour: Rgb) {
        let (dx, dy) = (to.0 - from.0, to.1 - from.1);
        let square = dx * dx + dy * dy;
        self.soft_shape(
            (from.0.min(to.0), from.1.min(to.1)),
            (from.0.max(to.0), from.1.max(to.1)),
            width_px,
            colour,
            |x, y| {
                let along = if square > 0.0 { ((x - from.0) * dx + (y - from.1) * dy) / square } else { 0.0 };
                let along = along.clamp(0.0, 1.0);
                (x - from.0 - along * dx).hypot(y - from.1 - along * dy)
            },
        );
    }

    /// A filled circle with a soft edge.
    pub(crate) fn disc(&mut self, centre: (f64, f64), radius_px: f64, colour: Rgb) {
        self.soft_shape(centre, centre, 2.0 * radius_px, colour, |x, y| (x - centre.0).hypot(y - centre.1));
    }

    /// All pixels nearer than half a width to a shape that lies between two corners.
    fn soft_shape(
        &mut self,
        low: (f64, f64),
        high: (f64, f64),
        width_px: f64,
        colour: Rgb,
        distance_px: impl Fn(f64, f64) -> f64,
    ) {
        let half = width_px / 2.0;
        for y in (low.1 - half).floor() as i64..=(high.1 + half).ceil() as i64 {
            for x in (low.0 - half).floor() as i64..=(high.0 + half).ceil() as i64 {
                let cover = half + 0.5 - distance_px(x as f64, y as f64);
                if cover > 0.0 {
                    self.blend(x, y, colour, cover.min(1.0) as f32);
                }
            }
        }
    }

    /// Writes the picture as a PNG file; it appears under its name when it is whole.
    ///
    /// # Errors
    /// What the disk says.
    pub(crate) fn save_png(&self, path: &Path) -> Result<()> {
        let refused = |e: png::EncodingError| Error::io(path, e.into());
        let mut file = NewFile::create(path)?;
        let mut encoder = Encoder::new(&mut file, self.width_px as u32, self.height_px as u32);
        encoder.set_color(ColorType::Rgb);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::Fast);
        let mut writer = encoder.write_header().map_err(refused)?;
        writer.write_image_data(self.rgb()).map_err(refused)?;
        writer.finish().map_err(refused)?;
        file.commit()
    }

    /// One pixel of the pattern that says *not measured*: pale slanting lines.
    pub(crate) fn hatch(&mut self, x: i64, y: i64) {
        // Distance from the middle of the nearest line, in px along a row.
        let across = ((x + y).rem_euclid(14) - 7).abs() as f32;
        self.blend(x, y, [243, 244, 246], 1.0);
        self.blend(x, y, [205, 209, 215], 1.8 - across);
    }

    /// Writes on a line whose base runs through `y`.
    pub(crate) fn text(&mut self, x: f32, y: f32, text: &str, style: Style) {
        for (column, row, coverage) in self.coverage(text, style) {
            self.blend(x.round() as i64 + column, y.round() as i64 + row, style.colour, coverage);
        }
    }

    /// Writes upwards along a line whose base runs through `x`.
    pub(crate) fn text_upwards(&mut self, x: f32, y: f32, text: &str, style: Style) {
        for (column, row, coverage) in self.coverage(text, style) {
            self.blend(x.round() as i64 + row, y.round() as i64 - column, style.colour, coverage);
        }
    }

    /// How wide a text becomes, px.
    pub(crate) fn text_width(&self, text: &str, size_px: f32) -> f32 {
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
