//! The report's pictures: strips of the residual map, and cut-outs about a defect.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use crate::defects::{Defect, DefectList};
use crate::depth_map::{MapReader, MapWindow, rectangles, written};
use crate::error::Result;
use crate::export::residual_tif::ResidualFile;
use crate::export::texture::small_jpeg;

/// Widest strip of the overview, px.
const STRIP_PX: usize = 1100;
/// Length of the wall that a strip shows at least, mm.
const STRIP_MM: f64 = 2000.0;
/// Strips of the overview, at most: a longer run is shown smaller.
const MAX_STRIPS: usize = 24;
/// Cells of the residual that are read at once for a strip, about.
const BAND_CELLS: usize = 4_000_000;
/// A cut-out's longer side, px.
const CUT_PX: usize = 260;
/// How much of the surroundings a cut-out shows, in sizes of the defect, and at least, mm.
const CUT_SIZES: f64 = 2.0;
const CUT_MIN_MM: f64 = 80.0;
/// Widest cut-out, px of the map: of a larger defect its deepest place is shown.
const CUT_MOST_PX: f64 = 2048.0;

/// Residual to colour: red away from the camera, blue towards it, pale where nothing is.
pub(super) struct Colours {
    /// The residual of the strongest colour, mm.
    pub reach_mm: f64,
    /// From the strongest towards the camera to the strongest away from it.
    ramp: Vec<[u8; 3]>,
}

/// Steps of the colours from pale to either end: more than a picture shows.
const STEPS: i32 = 512;

impl Colours {
    /// Colours that show a list's defects.
    pub(super) fn for_list(list: &DefectList) -> Colours {
        let mut depths: Vec<f64> = list.defects.iter().map(|d| d.depth_mm.abs()).collect();
        depths.sort_by(f64::total_cmp);
        let typical = depths.get(depths.len() * 7 / 10).copied().unwrap_or(0.0);
        let ramp = (-STEPS..=STEPS).map(|step| Colours::mixed(f64::from(step) / f64::from(STEPS))).collect();
        Colours { reach_mm: typical.max(2.0 * list.detection_limit_mm).max(1.0), ramp }
    }

    /// The colour of a residual, mm.
    pub(super) fn at(&self, residual_mm: f64) -> [u8; 3] {
        let share = (residual_mm / self.reach_mm).clamp(-1.0, 1.0);
        self.ramp[((share + 1.0) * f64::from(STEPS) + 0.5) as usize]
    }

    /// The colour of a share of the reach, -1 to 1.
    fn mixed(share: f64) -> [u8; 3] {
        const PALE: [f64; 3] = [244.0, 243.0, 240.0];
        const AWAY: [f64; 3] = [165.0, 20.0, 30.0];
        const TOWARDS: [f64; 3] = [15.0, 60.0, 140.0];
        let end = if share > 0.0 { AWAY } else { TOWARDS };
        // Small residuals show a little more than in proportion.
        let share = share.abs().powf(0.8);
        std::array::from_fn(|i| (PALE[i] + share * (end[i] - PALE[i])).round() as u8)
    }
}

/// A picture with its place in the world.
pub(super) struct Placed {
    pub width_px: usize,
    pub height_px: usize,
    /// World x and y of its left upper corner, mm.
    pub corner_mm: (f64, f64),
    /// mm to a pixel.
    pub mm_per_px: f64,
    /// JPEG as a data URL.
    pub url: String,
}

/// The whole residual map, line by line.
pub(super) fn strips(residual: &mut ResidualFile, colours: &Colours) -> Result<Vec<Placed>> {
    let map = residual.geometry();
    let length_mm = map.width_px as f64 * map.mm_per_px;
    let strip_mm = f64::max(STRIP_MM, length_mm / MAX_STRIPS as f64).min(length_mm);
    let cells = ((strip_mm / map.mm_per_px).ceil() as usize).max(1);
    let factor = cells.div_ceil(STRIP_PX).max(1);
    let mut strips = Vec::new();
    for first in (0..map.width_px).step_by(cells) {
        let columns = cells.min(map.width_px - first);
        let (width_px, height_px) = (columns.div_ceil(factor), map.height_px.div_ceil(factor));
        let mut pixels = Vec::with_capacity(width_px * height_px);
        // Whole lines of the picture at once.
        let band_px = (BAND_CELLS / (columns * factor)).max(1) * factor;
        for [_, top, _, rows] in rectangles([columns, map.height_px], [columns, band_px]) {
            pixels.extend(shrunk(&residual.window(first, top, columns, rows)?, factor, colours));
        }
        strips.push(Placed {
            width_px,
            height_px,
            corner_mm: (map.x0_mm + (first as f64 - 0.5) * map.mm_per_px, map.y0_mm - 0.5 * map.mm_per_px),
            mm_per_px: map.mm_per_px * factor as f64,
            url: jpeg_url(width_px, height_px, &pixels)?,
        });
    }
    Ok(strips)
}

/// The mean residual of each square, as a colour; none where nothing was measured.
fn shrunk(window: &MapWindow, factor: usize, colours: &Colours) -> Vec<Option<[u8; 3]>> {
    let (width, height) = (window.width_px.div_ceil(factor), window.height_px.div_ceil(factor));
    let mut sums = written((0.0_f64, 0.0_f64), width * height);
    for (row, line) in window.depth_mm.chunks_exact(window.width_px).enumerate() {
        for (column, value) in line.iter().enumerate().filter(|(_, v)| v.is_finite()) {
            let sum = &mut sums[row / factor * width + column / factor];
            *sum = (sum.0 + f64::from(*value), sum.1 + 1.0);
        }
    }
    sums.iter().map(|(sum, count)| (*count > 0.0).then(|| colours.at(sum / count))).collect()
}

fn jpeg_url(width_px: usize, height_px: usize, pixels: &[Option<[u8; 3]>]) -> Result<String> {
    let jpeg = small_jpeg(width_px, height_px, pixels)?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)))
}

/// A defect from near.
pub(super) struct Views {
    /// The residual.
    pub residual: Placed,
    /// The visible image; none where there is none.
    pub texture: Option<Placed>,
    /// Residual along x and along y through the deepest place: (mm from it, mm).
    pub along_x: Vec<(f64, f64)>,
    pub along_y: Vec<(f64, f64)>,
}

/// Cuts a defect out.
pub(super) fn views(
    defect: &Defect,
    map: &mut dyn MapReader,
    residual: &mut ResidualFile,
    colours: &Colours,
) -> Result<Views> {
    let deepest = (defect.deepest_x_mm, defect.deepest_y_mm);
    let whole_mm = (CUT_SIZES * defect.length_mm.max(defect.width_mm)).max(CUT_MIN_MM);
    let most_mm = CUT_MOST_PX * map.geometry().mm_per_px;
    let (centre, side_mm) =
        if whole_mm <= most_mm { ((defect.x_mm, defect.y_mm), whole_mm) } else { (deepest, most_mm) };
    let (near, texture_window) = (cut(residual, centre, side_mm)?, cut(map, centre, side_mm)?);
    let factor = near.window.width_px.div_ceil(CUT_PX).max(1);
    let residual_view = near.picture(factor, &shrunk(&near.window, factor, colours))?;
    let texture = match texture_window.window.texture.iter().any(Option::is_some) {
        true => {
            let factor = texture_window.window.width_px.div_ceil(CUT_PX).max(1);
            Some(texture_window.picture(factor, &texture_window.thinned(factor))?)
        }
        false => None,
    };
    Ok(Views {
        along_x: near.line(deepest, true),
        along_y: near.line(deepest, false),
        residual: residual_view,
        texture,
    })
}

/// A square of a map.
struct Cut {
    window: MapWindow,
    /// Centre of its first pixel, mm.
    first_mm: (f64, f64),
    mm_per_px: f64,
}

fn cut(map: &mut dyn MapReader, (x_mm, y_mm): (f64, f64), side_mm: f64) -> Result<Cut> {
    let geometry = map.geometry();
    let at = |mm: f64, zero_mm: f64, most: usize| {
        (((mm - zero_mm) / geometry.mm_per_px).round().max(0.0) as usize).min(most.saturating_sub(1))
    };
    let half = side_mm / 2.0;
    let (left, right) =
        (at(x_mm - half, geometry.x0_mm, geometry.width_px), at(x_mm + half, geometry.x0_mm, geometry.width_px));
    let (top, bottom) =
        (at(y_mm - half, geometry.y0_mm, geometry.height_px), at(y_mm + half, geometry.y0_mm, geometry.height_px));
    Ok(Cut {
        window: map.window(left, top, right - left + 1, bottom - top + 1)?,
        first_mm: (geometry.x0_mm + left as f64 * geometry.mm_per_px, geometry.y0_mm + top as f64 * geometry.mm_per_px),
        mm_per_px: geometry.mm_per_px,
    })
}

impl Cut {
    fn picture(&self, factor: usize, pixels: &[Option<[u8; 3]>]) -> Result<Placed> {
        let (width_px, height_px) = (self.window.width_px.div_ceil(factor), self.window.height_px.div_ceil(factor));
        Ok(Placed {
            width_px,
            height_px,
            corner_mm: (self.first_mm.0 - 0.5 * self.mm_per_px, self.first_mm.1 - 0.5 * self.mm_per_px),
            mm_per_px: self.mm_per_px * factor as f64,
            url: jpeg_url(width_px, height_px, pixels)?,
        })
    }

    /// One pixel of each square.
    fn thinned(&self, factor: usize) -> Vec<Option<[u8; 3]>> {
        let window = &self.window;
        let rows = (0..window.height_px).step_by(factor);
        rows.flat_map(|row| {
            (0..window.width_px).step_by(factor).map(move |c| window.texture[row * window.width_px + c])
        })
        .collect()
    }

    /// Values along the row or the column of a place.
    fn line(&self, (x_mm, y_mm): (f64, f64), along_x: bool) -> Vec<(f64, f64)> {
        let window = &self.window;
        let column = (((x_mm - self.first_mm.0) / self.mm_per_px).round().max(0.0) as usize).min(window.width_px - 1);
        let row = (((y_mm - self.first_mm.1) / self.mm_per_px).round().max(0.0) as usize).min(window.height_px - 1);
        let count = if along_x { window.width_px } else { window.height_px };
        let value = |i: usize| {
            let (c, r) = if along_x { (i, row) } else { (column, i) };
            let away = (i as f64 - if along_x { column } else { row } as f64) * self.mm_per_px;
            (away, f64::from(window.depth_mm[r * window.width_px + c]))
        };
        (0..count).map(value).collect()
    }
}
