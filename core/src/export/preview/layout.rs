//! Where things go: strips for long maps, ticks at round numbers.

use crate::depth_map::MapGeometry;

/// Width of the picture, px.
pub(super) const WIDTH_PX: usize = 2000;
/// Left of the maps: the axis across.
pub(super) const LEFT_PX: usize = 132;
/// Right of the maps.
const RIGHT_PX: usize = 56;
/// Above the first strip: title and legend.
pub(super) const TOP_PX: usize = 168;
/// Below each strip: the axis along.
pub(super) const AXIS_PX: usize = 78;
/// Below the last axis: scale bar.
pub(super) const FOOT_PX: usize = 58;
/// A strip is at most this many times as wide as high, if the picture does not get too high.
const WIDEST_STRIP: f64 = 6.0;
/// Highest single map, px.
const HIGHEST_MAP_PX: f64 = 1500.0;
/// Highest stack of strips, px.
const HIGHEST_STACK_PX: f64 = 2600.0;

/// How the map is laid on the picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Layout {
    /// Number of strips, from top to bottom.
    pub strips: usize,
    /// Width of a strip, px.
    pub strip_width_px: usize,
    /// Height of a strip, px.
    pub strip_height_px: usize,
    /// What a pixel of the picture stands for, mm.
    pub mm_per_px: f64,
}

impl Layout {
    pub(super) fn of(map: &MapGeometry) -> Layout {
        let room_px = (WIDTH_PX - LEFT_PX - RIGHT_PX) as f64;
        let aspect = map.width_px as f64 / map.height_px as f64;
        let mut strips = (aspect / WIDEST_STRIP).ceil().max(1.0);
        while strips > 1.0 && strips * (room_px * strips / aspect + AXIS_PX as f64) > HIGHEST_STACK_PX {
            strips -= 1.0;
        }
        let width_px = room_px.min(HIGHEST_MAP_PX * aspect / strips).max(1.0);
        let height_px = (width_px * strips / aspect).max(1.0);
        let strip_mm = map.width_px as f64 * map.mm_per_px / strips;
        Layout {
            strips: strips as usize,
            strip_width_px: width_px.round() as usize,
            strip_height_px: height_px.round().min(HIGHEST_MAP_PX) as usize,
            mm_per_px: strip_mm / width_px,
        }
    }

    /// Left edge of the strips, px: narrow maps stand in the middle.
    pub(super) fn strip_left_px(&self) -> usize {
        let room_px = WIDTH_PX - LEFT_PX - RIGHT_PX;
        LEFT_PX + (room_px - self.strip_width_px.min(room_px)) / 2
    }

    /// Top edge of a strip, px.
    pub(super) fn strip_top_px(&self, strip: usize) -> usize {
        TOP_PX + strip * (self.strip_height_px + AXIS_PX)
    }

    /// Height of the picture, px.
    pub(super) fn height_px(&self) -> usize {
        self.strip_top_px(self.strips) + FOOT_PX
    }
}

/// The largest of 1, 2, 5 times a power of ten that is no larger than `length`.
pub(super) fn round_down(length: f64) -> f64 {
    let power = 10_f64.powf(length.log10().floor());
    let digit = [5.0, 2.0].into_iter().find(|digit| digit * power <= length * (1.0 + 1e-9)).unwrap_or(1.0);
    digit * power
}

/// Round numbers between `from` and `to`, no closer than `least_step` to each other; `to` may be the smaller.
pub(super) fn ticks(from: f64, to: f64, least_step: f64) -> (f64, Vec<f64>) {
    let (low, high) = (from.min(to), from.max(to));
    let mut step = round_down(least_step);
    while step < least_step {
        step = round_down(step * 2.6);
    }
    let slack = 1e-9 * step;
    let (first, last) = (((low - slack) / step).ceil() as i64, ((high + slack) / step).floor() as i64);
    (step, (first..=last).map(|i| i as f64 * step).collect())
}

/// A number with the decimals that its step needs.
pub(super) fn label(value: f64, step: f64) -> String {
    let decimals = (-(step * (1.0 + 1e-9)).log10().floor()).max(0.0) as usize;
    let text = format!("{value:.decimals$}");
    let is_zero = text.bytes().all(|b| matches!(b, b'-' | b'0' | b'.'));
    if is_zero { text.replace('-', "") } else { text.replace('-', "\u{2212}") }
}

/// Width and height for people: in mm, or in m from a metre on.
pub(super) fn size(width_mm: f64, height_mm: f64) -> String {
    match width_mm.max(height_mm) {
        large if large >= 10_000.0 => format!("{:.1} × {:.2} m", width_mm / 1000.0, height_mm / 1000.0),
        large if large >= 1000.0 => format!("{:.2} × {:.2} m", width_mm / 1000.0, height_mm / 1000.0),
        _ => format!("{width_mm:.0} × {height_mm:.0} mm"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(width_px: usize, height_px: usize) -> Layout {
        Layout::of(&MapGeometry { x0_mm: 0.0, y0_mm: 0.0, mm_per_px: 1.0, width_px, height_px })
    }

    #[test]
    fn any_map_fits_the_picture() {
        for (width, height) in [(1, 1), (1000, 600), (600, 4000), (20_000, 1000), (700_000, 1080), (3, 100_000)] {
            let layout = layout(width, height);
            assert!(layout.strip_width_px >= 1 && layout.strip_height_px >= 1);
            assert!(layout.strip_left_px() + layout.strip_width_px <= WIDTH_PX);
            assert!(layout.height_px() < 3500, "{width} x {height}: {layout:?}");
        }
    }

    #[test]
    fn long_maps_wrap() {
        assert_eq!(layout(5000, 1000).strips, 1);
        let twenty = layout(20_000, 1000);
        assert_eq!(twenty.strips, 4);
        assert!((twenty.mm_per_px - 5000.0 / twenty.strip_width_px as f64).abs() < 0.01);
        assert!(layout(700_000, 1000).strip_height_px >= 40);
    }

    #[test]
    fn ticks_are_round() {
        assert_eq!(ticks(-130.0, 270.0, 70.0), (100.0, vec![-100.0, 0.0, 100.0, 200.0]));
        assert_eq!(ticks(0.5, -0.5, 0.19).1.len(), 5);
        assert_eq!(ticks(0.0, 1.0, 0.21).0, 0.5);
        assert_eq!(round_down(1000.0), 1000.0);
        assert_eq!(round_down(999.0), 500.0);
    }

    #[test]
    fn labels_show_what_the_step_needs() {
        assert_eq!(label(-0.2, 0.2), "\u{2212}0.2");
        assert_eq!(label(-0.0, 100.0), "0");
        assert_eq!(label(12.25, 0.05), "12.25");
        assert_eq!(label(1500.0, 500.0), "1500");
    }
}
