//! Everything around the map: title, legend, axes, scale bar.

use super::layout::{self, Layout, TOP_PX, WIDTH_PX};
use super::{PreviewText, Range, colour};
use crate::depth_map::MapGeometry;
use crate::export::canvas::{Align, Canvas, Rgb, Style};

const INK: Rgb = [31, 36, 48];
const PALE_INK: Rgb = [98, 106, 120];
const LINE: Rgb = [120, 127, 140];
const TITLE_PX: f32 = 50.0;
const TEXT_PX: f32 = 29.0;
const MARGIN_PX: i64 = 56;
/// The legend's bar.
const BAR_WIDTH_PX: i64 = 620;
const BAR_HEIGHT_PX: i64 = 28;

/// What is drawn around.
pub(super) struct Sheet<'a> {
    pub layout: Layout,
    pub geometry: MapGeometry,
    pub text: &'a PreviewText,
    /// `None` where nothing was measured.
    pub range: Option<Range>,
    /// Share of the map's pixels with a depth, 0 to 1.
    pub coverage: f64,
}

pub(super) fn draw(canvas: &mut Canvas, sheet: &Sheet<'_>) {
    let legend_left = legend(canvas, sheet.range);
    title(canvas, sheet, legend_left);
    for strip in 0..sheet.layout.strips {
        frame(canvas, &sheet.layout, strip);
        axis_along(canvas, sheet, strip);
        axis_across(canvas, sheet, strip);
    }
    foot(canvas, sheet);
}

fn style(size_px: f32, colour: Rgb, align: Align) -> Style {
    Style { size_px, colour, align }
}

fn title(canvas: &mut Canvas, sheet: &Sheet<'_>, right_end: i64) {
    let title = if sheet.text.title.is_empty() { "Depth map" } else { &sheet.text.title };
    let room_px = (right_end - MARGIN_PX - 40) as f32;
    let title = shortened(canvas, title, TITLE_PX, room_px);
    canvas.text(MARGIN_PX as f32, 70.0, &title, style(TITLE_PX, INK, Align::Left));
    let map = &sheet.geometry;
    let facts = format!(
        "{}   ·   {} mm per pixel   ·   {:.0} % measured",
        layout::size(map.width_px as f64 * map.mm_per_px, map.height_px as f64 * map.mm_per_px),
        (map.mm_per_px * 1000.0).round() / 1000.0,
        // Not 100 before all is there.
        (100.0 * sheet.coverage).floor(),
    );
    canvas.text(MARGIN_PX as f32, 116.0, &facts, style(TEXT_PX, PALE_INK, Align::Left));
}

/// A text that fits, with dots where it was cut.
fn shortened(canvas: &Canvas, text: &str, size_px: f32, room_px: f32) -> String {
    if canvas.text_width(text, size_px) <= room_px {
        return text.to_string();
    }
    let mut kept: Vec<char> = text.chars().collect();
    while kept.pop().is_some() {
        let candidate = format!("{}…", kept.iter().collect::<String>().trim_end());
        if canvas.text_width(&candidate, size_px) <= room_px {
            return candidate;
        }
    }
    String::new()
}

/// Draws the legend at the right end; returns where it begins.
fn legend(canvas: &mut Canvas, range: Option<Range>) -> i64 {
    let (bar_left, bar_top) = (WIDTH_PX as i64 - MARGIN_PX - BAR_HEIGHT_PX / 2 - BAR_WIDTH_PX, 58);
    let swatch_left = match range {
        Some(range) => {
            bar(canvas, bar_left, bar_top);
            bar_labels(canvas, range, bar_left, bar_top);
            bar_left - 260
        }
        None => WIDTH_PX as i64 - MARGIN_PX - 226,
    };
    for y in bar_top..bar_top + BAR_HEIGHT_PX {
        (swatch_left..swatch_left + BAR_HEIGHT_PX).for_each(|x| canvas.hatch(x, y));
    }
    canvas.outline(swatch_left, bar_top, BAR_HEIGHT_PX, BAR_HEIGHT_PX, LINE);
    let text_x = (swatch_left + BAR_HEIGHT_PX + 12) as f32;
    canvas.text(text_x, (bar_top + 24) as f32, "not measured", style(25.0, PALE_INK, Align::Left));
    swatch_left
}

/// The colours, pointed at both ends: what lies beyond them has the end's colour.
fn bar(canvas: &mut Canvas, left: i64, top: i64) {
    let half = BAR_HEIGHT_PX / 2;
    for x in -half..BAR_WIDTH_PX + half {
        let beyond = (-x).max(x - BAR_WIDTH_PX + 1).max(0);
        for y in beyond..BAR_HEIGHT_PX - beyond {
            let colour = colour::ramp(x as f64 / (BAR_WIDTH_PX - 1) as f64);
            canvas.blend(left + x, top + y, colour, 1.0);
        }
    }
}

fn bar_labels(canvas: &mut Canvas, range: Range, left: i64, top: i64) {
    let above = (top - 13) as f32;
    let right = left + BAR_WIDTH_PX;
    canvas.text(left as f32, above, "nearer", style(25.0, PALE_INK, Align::Left));
    canvas.text((left + right) as f32 / 2.0, above, "Depth (mm)", style(TEXT_PX, INK, Align::Centre));
    canvas.text(right as f32, above, "farther", style(25.0, PALE_INK, Align::Right));
    let px_per_mm = BAR_WIDTH_PX as f64 / (range.far_mm - range.near_mm);
    let (step, values) = layout::ticks(range.near_mm, range.far_mm, 92.0 / px_per_mm);
    for value_mm in values {
        let x = left + ((value_mm - range.near_mm) * px_per_mm).round() as i64;
        canvas.fill(x, top + BAR_HEIGHT_PX, 2, 8, LINE);
        let label = layout::label(value_mm, step);
        canvas.text(x as f32, (top + BAR_HEIGHT_PX + 36) as f32, &label, style(27.0, INK, Align::Centre));
    }
}

fn frame(canvas: &mut Canvas, layout: &Layout, strip: usize) {
    let (left, top) = (layout.strip_left_px() as i64, layout.strip_top_px(strip) as i64);
    canvas.outline(left - 1, top - 1, layout.strip_width_px as i64 + 2, layout.strip_height_px as i64 + 2, LINE);
}

/// Chainage: in mm for a short map, in m for a long one.
fn axis_along(canvas: &mut Canvas, sheet: &Sheet<'_>, strip: usize) {
    let layout = &sheet.layout;
    let (left, width_px) = (layout.strip_left_px() as i64, layout.strip_width_px as f64);
    let base = (layout.strip_top_px(strip) + layout.strip_height_px) as i64 + 1;
    // The map begins half a pixel before its first pixel's centre.
    let map_left_mm = sheet.geometry.x0_mm - sheet.geometry.mm_per_px / 2.0;
    let x_mm = |px: f64| map_left_mm + (strip as f64 * width_px + px) * layout.mm_per_px;
    let unit_mm = if in_metres(sheet) { 1000.0 } else { 1.0 };
    let (from, to) = (sheet.text.chainage_mm(x_mm(0.0)) / unit_mm, sheet.text.chainage_mm(x_mm(width_px)) / unit_mm);
    let (step, values) = layout::ticks(from, to, (to - from).abs() * (150.0 / width_px).min(1.0));
    for value in values {
        let px = (value - from) / (to - from) * width_px;
        let x = left + px.round().min(width_px - 1.0) as i64;
        canvas.fill(x, base, 2, 10, LINE);
        canvas.text(x as f32, (base + 39) as f32, &layout::label(value, step), style(TEXT_PX, INK, Align::Centre));
    }
}

fn in_metres(sheet: &Sheet<'_>) -> bool {
    let map = &sheet.geometry;
    let ends_mm = [map.x0_mm, map.x0_mm + map.width_px as f64 * map.mm_per_px].map(|x| sheet.text.chainage_mm(x).abs());
    ends_mm[0].max(ends_mm[1]) > 3000.0
}

/// World y, downwards.
fn axis_across(canvas: &mut Canvas, sheet: &Sheet<'_>, strip: usize) {
    let layout = &sheet.layout;
    let (left, top) = (layout.strip_left_px() as i64, layout.strip_top_px(strip) as i64);
    let height_px = layout.strip_height_px as f64;
    let from_mm = sheet.geometry.y0_mm - sheet.geometry.mm_per_px / 2.0;
    let to_mm = from_mm + height_px * layout.mm_per_px;
    let (step, values) = layout::ticks(from_mm, to_mm, layout.mm_per_px * 64.0_f64.min(height_px));
    for value_mm in values {
        let y = top + ((value_mm - from_mm) / layout.mm_per_px).round().min(height_px - 1.0) as i64;
        canvas.fill(left - 11, y, 10, 2, LINE);
        let label = layout::label(value_mm, step);
        canvas.text((left - 19) as f32, (y + 11) as f32, &label, style(TEXT_PX, INK, Align::Right));
    }
    if strip == 0 && height_px > 200.0 {
        let (x, y) = ((left - 98) as f32, top as f32 + height_px as f32 / 2.0);
        canvas.text_upwards(x, y, "y, down (mm)", style(TEXT_PX, PALE_INK, Align::Centre));
    }
}

/// Scale bar at the left, the axis' name in the middle.
fn foot(canvas: &mut Canvas, sheet: &Sheet<'_>) {
    let layout = &sheet.layout;
    let left = layout.strip_left_px() as i64;
    let base = layout.height_px() as i64 - 34;
    let bar_mm = layout::round_down(layout.mm_per_px * 280.0);
    let bar_px = (bar_mm / layout.mm_per_px).round() as i64;
    canvas.fill(left, base - 8, bar_px, 4, INK);
    canvas.fill(left, base - 16, 3, 20, INK);
    canvas.fill(left + bar_px - 3, base - 16, 3, 20, INK);
    let text = if bar_mm >= 1000.0 { format!("{} m", bar_mm / 1000.0) } else { format!("{bar_mm} mm") };
    canvas.text((left + bar_px + 16) as f32, (base + 4) as f32, &text, style(TEXT_PX, INK, Align::Left));

    let unit = if in_metres(sheet) { "m" } else { "mm" };
    let middle = left as f32 + layout.strip_width_px as f32 / 2.0;
    let clear = (left + bar_px + 16) as f32 + canvas.text_width(&text, TEXT_PX) + 130.0;
    let name = style(TEXT_PX, PALE_INK, Align::Centre);
    canvas.text(middle.max(clear), (base + 4) as f32, &format!("Chainage ({unit})"), name);
    if layout.strips > 1 {
        let right = (left + layout.strip_width_px as i64) as f32;
        let note = format!("{} strips, read line by line", layout.strips);
        canvas.text(right, (base + 4) as f32, &note, style(TEXT_PX, PALE_INK, Align::Right));
    }
    debug_assert!(base > TOP_PX as i64);
}
