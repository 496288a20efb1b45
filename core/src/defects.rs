//! Depth map → defects: what departs from the undamaged shape, with how sure that is and what could not have been seen.
//!
//! The map is examined in stretches with margins, in cells of a millimetre or two; the memory does not depend on the
//! run's length. In each stretch a plane or a cylinder along the travel is fitted (chosen by evidence
//! for the whole run), then a background that follows slow waves and the poses' drift but leaves the defects out; what
//! is left is the *residual*. Its regions that rise above `max(defects.depth_min_mm, defects.noise_factor · σ)` are
//! defects; σ is the residual's own scatter beside them, row by row. Cells whose weights say that the stripe was unsure there
//! are left out of it, and those that are less so do not make a defect alone.
//!
//! # Figures
//!
//! - Positions are the world's (x along the travel, y down, z into the wall), chainage is the run's start ± x.
//! - `depth_mm` is along z, as everything in the map: above 0 away from the camera (dent, hole), below 0 towards it
//!   (bulge, step). `depth_normal_mm` is square to the undamaged surface.
//! - A dent or bulge with sloping sides is measured as a whole: a raised cosine over an ellipse on a sloping ground,
//!   blurred as the map is, is fitted to its cells (and to its neighbours' together). `depth_mm` is that form's height
//!   above its ground, `depth_sd_mm` its standard deviation.
//! - `area_mm2` is the whole footprint seen along z, out to the rim where the deviation is 0: the form's ellipse; of what has
//!   steep sides, the area deeper than half of its depth. `surface_area_mm2` lies on the surface.
//! - `length_mm` is along the travel (x), `width_mm` across it (y).

mod background;
mod cells;
pub mod change;
mod doubt;
mod form;
mod gathered;
mod joint;
mod list;
mod measure;
mod noise;
mod reference;
mod regions;
mod register;
mod section;
mod stretch;
mod turned;

use crate::depth_map::MapReader;
use crate::error::Result;
use crate::recipe::DefectOptions;
use cells::{CellGrid, Field};
use doubt::Doubt;
use gathered::Gathered;
use reference::{Place, choose};
use stretch::{COARSE, Task, examine};

pub use list::{
    Bounds, Defect, DefectKind, DefectList, DetectionLimit, Inspected, ReferenceShape, SCHEMA_VERSION, SectionRow,
};

/// Smoothing before the search, standard deviation in cells.
const SMOOTHING_CELLS: f32 = 1.2;
/// Places where the kind of shape is looked at, and their length in coarse cells.
const SAMPLES: usize = 12;
const SAMPLE_COARSE: usize = 64;
/// Of so many coarse columns one is looked at there.
const SAMPLE_EVERY: usize = 4;
/// Waves longer than this share of the map's height belong to the undamaged surface, within limits in mm.
const WAVE_SHARE: f64 = 0.26;
const WAVE_LIMITS_MM: (f64, f64) = (60.0, 400.0);

/// Where a run lies on its asset.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Chainage {
    /// Chainage of the world's x = 0, mm.
    pub start_mm: f64,
    /// The chainage falls along world x.
    pub falls: bool,
}

impl Chainage {
    /// Chainage of a world x, mm.
    pub fn at_mm(&self, x_mm: f64) -> f64 {
        self.start_mm + if self.falls { -x_mm } else { x_mm }
    }
}

/// How densely a run measured the surface.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sampling {
    /// Mean travel from one profile to the next, mm; 0 where it is not known.
    pub profile_step_mm: f64,
    /// Distance of two line positions on the surface, mm; 0 where it is not known.
    pub line_step_mm: f64,
    /// Width of the laser's line on the surface, mm at half of its height; 0 where it is not known.
    pub line_width_mm: f64,
}

/// A stretch of the residual map, in cells: the deviation from the undamaged shape.
pub struct ResidualStrip<'a> {
    /// World x and y of the first cell of the whole map, mm.
    pub origin_mm: (f64, f64),
    /// Size of a cell, mm.
    pub cell_mm: f64,
    /// The strip's first column among the map's cells.
    pub first_column: usize,
    /// Its columns.
    pub columns: usize,
    /// Row by row, mm; NaN where not measured.
    pub values_mm: &'a [f32],
}

/// Everything found in a map.
pub struct Findings {
    /// The list.
    pub list: DefectList,
    /// The sections, in the order of the travel.
    pub sections: Vec<SectionRow>,
}

/// Finds the defects of a map; `take` gets the residual map, strip by strip along x. `None` where too little was measured.
/// What a single profile shows is no defect: `sampling` tells how far they lie apart.
///
/// # Errors
/// What reading the map or `take` says.
pub fn find(
    map: &mut dyn MapReader,
    options: &DefectOptions,
    chainage: Chainage,
    sampling: Sampling,
    take: &mut dyn FnMut(&ResidualStrip) -> Result<()>,
) -> Result<Option<Findings>> {
    let geometry = map.geometry();
    let Some(distance_mm) = distance_mm(map)? else { return Ok(None) };
    let grid = CellGrid::new(&geometry, distance_mm, options.cell_mm);
    if grid.columns < COARSE || grid.rows < COARSE {
        return Ok(None);
    }
    let height_mm = grid.rows as f64 * grid.cell_mm;
    let wave_mm = match options.wave_mm {
        length if length > 0.0 => length,
        _ => (WAVE_SHARE * height_mm).clamp(WAVE_LIMITS_MM.0, WAVE_LIMITS_MM.1),
    };
    let (shape, radius_sd_mm) = choose(&samples(map, &grid)?);
    let mut gathered = Gathered::default();
    for (core, columns) in grid.stretches() {
        let depth = grid.read(map, columns.start, columns.len())?;
        let doubt = grid.read_doubt(map, columns.start, columns.len())?;
        let task = Task { grid: &grid, options, shape, wave_mm, sampling, columns, core: core.clone() };
        let examined = examine(&task, &depth, &Doubt::of(&doubt));
        let nothing = Field::new(core.len(), grid.rows, f32::NAN);
        take(&ResidualStrip {
            origin_mm: (grid.x0_mm, grid.y0_mm),
            cell_mm: grid.cell_mm,
            first_column: core.start,
            columns: core.len(),
            values_mm: examined.as_ref().map_or(&nothing, |e| &e.residual).values.as_slice(),
        })?;
        if let Some(examined) = examined {
            gathered.add(examined);
        }
    }
    if gathered.inspected_cells == 0 {
        return Ok(None);
    }
    Ok(Some(gathered.findings(&grid, options, chainage, (shape, radius_sd_mm), wave_mm, sampling)))
}

/// The median z of some columns, mm.
fn distance_mm(map: &mut dyn MapReader) -> Result<Option<f64>> {
    let geometry = map.geometry();
    let mut some = Vec::new();
    for i in 0..SAMPLES {
        let column = (2 * i + 1) * geometry.width_px / (2 * SAMPLES);
        let window = map.window(column, 0, 1, geometry.height_px)?;
        some.extend(window.depth_mm.iter().filter(|z| z.is_finite()).map(|z| f64::from(*z)));
    }
    Ok(reference::median(some).map(f64::abs).filter(|z| *z > 0.0))
}

/// Coarse places in some stretches of the run.
fn samples(map: &mut dyn MapReader, grid: &CellGrid) -> Result<Vec<Vec<Place>>> {
    let length = (SAMPLE_COARSE * COARSE).min(grid.columns);
    let count = SAMPLES.min(grid.columns.div_ceil(length));
    let mut samples = Vec::new();
    for i in 0..count {
        let start = if count == 1 { 0 } else { i * (grid.columns - length) / (count - 1) };
        let mut places = Vec::new();
        for first in (start..start + length - COARSE + 1).step_by(SAMPLE_EVERY * COARSE) {
            let strip = grid.read(map, first, COARSE)?.shrunk(COARSE, 0.3);
            let middle = (COARSE - 1) as f64 / 2.0;
            let known = strip.values.iter().enumerate().filter(|(_, z)| z.is_finite());
            places.extend(known.map(|(row, z)| Place {
                x_mm: grid.x_mm(first as f64 + middle),
                y_mm: grid.y_mm((row * COARSE) as f64 + middle),
                z_mm: f64::from(*z),
            }));
        }
        samples.push(places);
    }
    Ok(samples)
}

#[cfg(test)]
mod tests;
