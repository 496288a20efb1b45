//! Depth map → defects: what departs from the undamaged shape, with how sure that is and what could not have been seen.
//!
//! The map is examined in stretches with margins, in cells of a millimetre or two; the memory does not depend on the
//! run's length. In each stretch a plane or a cylinder along the travel is fitted (chosen by evidence
//! for the whole run), then a background that follows slow waves and the poses' drift but leaves the defects out; what
//! is left is the *residual*. Its regions that rise above `max(defects.depth_min_mm, defects.noise_factor · σ)` are
//! defects; σ is the residual's own scatter beside them, row by row.
//!
//! # Figures
//!
//! - Positions are the world's (x along the travel, y down, z into the wall), chainage is the run's start ± x.
//! - `depth_mm` is along z, as everything in the map: above 0 away from the camera (dent, hole), below 0 towards it
//!   (bulge, step). `depth_normal_mm` is square to the undamaged surface.
//! - `area_mm2` is that of the footprint out to the rim, seen along z; `surface_area_mm2` lies on the surface.
//! - `length_mm` is along the travel (x), `width_mm` across it (y).

mod background;
mod cells;
pub mod change;
mod measure;
mod noise;
mod reference;
mod regions;
mod register;
mod section;
mod stretch;

use serde::{Deserialize, Serialize};

use crate::depth_map::MapReader;
use crate::error::Result;
use crate::recipe::DefectOptions;
use cells::{CellGrid, Field};
use reference::{Place, Shape, choose};
use section::pooled;
use stretch::{COARSE, Examined, FIRST_LENGTH, Task, Threshold, examine};

/// Version of the shape of `defects.json`; grows when a field changes its meaning.
pub const SCHEMA_VERSION: u32 = 1;

/// Smoothing before the search, standard deviation in cells.
const SMOOTHING_CELLS: f32 = 1.2;
/// Columns of cells that a stretch answers for, and that it reads on each side besides.
const CORE_COLUMNS: usize = 2048;
const MARGIN_COLUMNS: usize = 384;
/// Places where the kind of shape is looked at, and their length in coarse cells.
const SAMPLES: usize = 12;
const SAMPLE_COARSE: usize = 64;
/// Of so many coarse columns one is looked at there.
const SAMPLE_EVERY: usize = 4;
/// Waves longer than this share of the map's height belong to the undamaged surface, within limits in mm.
const WAVE_SHARE: f64 = 0.26;
const WAVE_LIMITS_MM: (f64, f64) = (60.0, 400.0);

/// What kind of departure a defect is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DefectKind {
    /// Away from the camera, with sloping sides.
    Dent,
    /// Towards the camera, with sloping sides.
    Bulge,
    /// Towards the camera, flat with steep sides: an edge, an offset, something stuck on.
    Step,
    /// Away from the camera, flat and deeper than `defects.hole_depth_mm`, with steep sides.
    Hole,
    /// Away from the camera, flat with steep sides: broken off, washed out.
    MissingMaterial,
}

impl DefectKind {
    /// All kinds.
    pub const ALL: [DefectKind; 5] =
        [DefectKind::Dent, DefectKind::Bulge, DefectKind::Step, DefectKind::Hole, DefectKind::MissingMaterial];

    /// As the files write it.
    pub fn name(self) -> &'static str {
        match self {
            DefectKind::Dent => "dent",
            DefectKind::Bulge => "bulge",
            DefectKind::Step => "step",
            DefectKind::Hole => "hole",
            DefectKind::MissingMaterial => "missing_material",
        }
    }
}

/// A rectangle around a defect in the world, mm.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Least x.
    pub x_min_mm: f64,
    /// Greatest x.
    pub x_max_mm: f64,
    /// Least y.
    pub y_min_mm: f64,
    /// Greatest y.
    pub y_max_mm: f64,
}

/// One defect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Defect {
    /// From 1, in the order of the chainage.
    pub id: u32,
    /// What it is.
    pub kind: DefectKind,
    /// `minor`, `moderate` or `severe`, by the recipe's depths.
    pub severity: String,
    /// The operator's own code for the kind, where the recipe gives one.
    pub code: Option<String>,
    /// Chainage of its middle, mm.
    pub chainage_mm: f64,
    /// World x of its middle, weighted by depth, mm.
    pub x_mm: f64,
    /// World y of its middle, mm; downwards.
    pub y_mm: f64,
    /// World z of its deepest or highest place, mm.
    pub z_mm: f64,
    /// Clock position on a pipe, seen along the rising chainage, above 0 to 12 h; absent on a wall.
    pub clock_h: Option<f64>,
    /// Height on a wall above the camera's at the first frame, mm; absent on a pipe.
    pub height_mm: Option<f64>,
    /// Deepest (above 0: away from the camera) or highest (below 0: towards it) value, along z, mm.
    pub depth_mm: f64,
    /// The same square to the undamaged surface, mm.
    pub depth_normal_mm: f64,
    /// Extent along the travel, mm.
    pub length_mm: f64,
    /// Extent across the travel, mm.
    pub width_mm: f64,
    /// Area of the footprint seen along z, mm².
    pub area_mm2: f64,
    /// Area of the footprint on the surface, mm².
    pub surface_area_mm2: f64,
    /// Volume between the surface and the undamaged shape, mm³.
    pub volume_mm3: f64,
    /// Steepest slope against the undamaged shape, degrees.
    pub steepest_slope_deg: f64,
    /// How sure it is, 0 to 1: from its depth against the threshold, and the share of it that was measured.
    pub confidence: f64,
    /// Scatter of the residual in its rows, mm.
    pub noise_mm: f64,
    /// Share of it that was measured, 0 to 1.
    pub measured_share: f64,
    /// It reaches the edge of what was seen: it may be larger and deeper.
    pub at_edge: bool,
    /// World x of its deepest or highest place, mm.
    pub deepest_x_mm: f64,
    /// World y of it, mm.
    pub deepest_y_mm: f64,
    /// The rectangle that it lies in.
    pub bounds: Bounds,
}

/// The depth of a round dent (a raised cosine) that would just have been listed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DetectionLimit {
    /// Its radius, mm.
    pub radius_mm: f64,
    /// Its depth, mm.
    pub depth_mm: f64,
}

/// The undamaged shape that was chosen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReferenceShape {
    /// `plane` or `cylinder`.
    pub kind: String,
    /// Seen from `outside` or `inside`; absent for a plane.
    pub seen_from: Option<String>,
    /// Radius of the cylinder that fits what was seen best, mm.
    pub radius_mm: Option<f64>,
    /// Standard deviation of the radius, mm, from its spread along the run.
    pub radius_sd_mm: Option<f64>,
    /// Mean radius of the oval that fits what was seen best, mm; less certain than `radius_mm`, but an oval pipe's crown
    /// has another radius than the whole pipe.
    #[serde(default)]
    pub mean_radius_mm: Option<f64>,
    /// Ovality, (largest − smallest diameter) / mean, per cent; above 0: longest along the view, below 0: across it.
    pub ovality_percent: Option<f64>,
    /// Its standard deviation, from the sections' own and their spread along the run.
    pub ovality_sd_percent: Option<f64>,
    /// Waves longer than this count as the undamaged surface, mm.
    pub wave_mm: f64,
}

/// Measures of one cross-section.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SectionRow {
    /// Chainage of its middle, mm.
    pub chainage_mm: f64,
    /// World x of its middle, mm.
    pub x_mm: f64,
    /// Share of it that was measured, 0 to 1.
    pub measured_share: f64,
    /// A pipe's radius, mm; defects left out.
    pub radius_mm: Option<f64>,
    /// Mean radius of the oval that fits best, mm.
    pub mean_radius_mm: Option<f64>,
    /// Twice `radius_mm`.
    pub diameter_mm: Option<f64>,
    /// Ovality, per cent; above 0: longest along the view.
    pub ovality_percent: Option<f64>,
    /// Its standard deviation.
    pub ovality_sd_percent: Option<f64>,
    /// The arc that was seen, degrees.
    pub arc_deg: Option<f64>,
    /// Run's radius less the smallest one here, defects included, mm.
    pub radius_loss_mm: Option<f64>,
    /// A wall's flatness: highest less lowest place against a plane, mm.
    pub flatness_mm: Option<f64>,
    /// The same as root mean square, mm.
    pub flatness_rms_mm: Option<f64>,
    /// Root mean square of what is finer than some cells, defects left out, mm.
    pub roughness_mm: f64,
    /// Lowest residual, mm.
    pub deviation_min_mm: f64,
    /// Highest residual, mm.
    pub deviation_max_mm: f64,
}

/// How well the surface was seen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Inspected {
    /// World x where the map begins, mm.
    pub x_min_mm: f64,
    /// Length of the map, mm.
    pub length_mm: f64,
    /// Height of the map, mm.
    pub height_mm: f64,
    /// Measured area, mm².
    pub area_mm2: f64,
    /// Measured share of the map, 0 to 1.
    pub coverage: f64,
}

/// `defects.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DefectList {
    /// [`SCHEMA_VERSION`].
    pub schema_version: u32,
    /// Chainage of the world's x = 0, mm.
    pub start_chainage_mm: f64,
    /// The chainage falls along world x.
    pub chainage_falls: bool,
    /// A round dent of 20 mm radius must be at least so deep to be listed, over a typical row, mm.
    pub detection_limit_mm: f64,
    /// The same for other radii, in a typical row.
    pub detection_limits: Vec<DetectionLimit>,
    /// The same where the surface is seen worst (one row in ten is worse).
    pub detection_limits_worst_rows: Vec<DetectionLimit>,
    /// Least depth that the recipe lists, mm.
    pub depth_min_mm: f64,
    /// Scatter of the residual in a typical row, mm.
    pub noise_mm: f64,
    /// Size of the cells that were searched, mm.
    pub cell_mm: f64,
    /// Mean travel from one profile to the next, mm: what is not much longer may be a single one's error, and is not listed.
    pub profile_step_mm: f64,
    /// The undamaged shape.
    pub reference: ReferenceShape,
    /// What was looked at.
    pub inspected: Inspected,
    /// Departures beside gaps and edges that were too little seen to be believed.
    pub doubtful: usize,
    /// Defects beyond the recipe's `defects.list_max`, the shallowest ones, that are not listed.
    pub omitted: usize,
    /// The defects, in the order of the chainage.
    pub defects: Vec<Defect>,
}

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
/// `profile_step_mm` is the travel from one profile to the next, 0 where it is not known: what a single profile shows is
/// no defect.
///
/// # Errors
/// What reading the map or `take` says.
pub fn find(
    map: &mut dyn MapReader,
    options: &DefectOptions,
    chainage: Chainage,
    profile_step_mm: f64,
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
    for start in (0..grid.columns).step_by(CORE_COLUMNS) {
        let core = start..(start + CORE_COLUMNS).min(grid.columns);
        let columns = start.saturating_sub(MARGIN_COLUMNS)..(core.end + MARGIN_COLUMNS).min(grid.columns);
        let depth = grid.read(map, columns.start, columns.len())?;
        let task = Task { grid: &grid, options, shape, wave_mm, profile_step_mm, columns, core: core.clone() };
        let examined = examine(&task, &depth);
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
    if gathered.measured_cells == 0 {
        return Ok(None);
    }
    Ok(Some(gathered.findings(&grid, options, chainage, (shape, radius_sd_mm), [wave_mm, profile_step_mm])))
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

/// What could be seen in a stretch.
struct Seen {
    cells: usize,
    first: Threshold,
    last: Threshold,
    noise_mm: f64,
}

/// What the stretches show, put together.
#[derive(Default)]
struct Gathered {
    defects: Vec<Defect>,
    doubtful: usize,
    sections: Vec<SectionRow>,
    seen: Vec<Seen>,
    measured_cells: usize,
}

impl Gathered {
    fn add(&mut self, examined: Examined) {
        self.doubtful += examined.doubtful;
        self.sections.extend(examined.sections);
        self.measured_cells += examined.measured_cells;
        self.seen.push(Seen {
            cells: examined.measured_cells,
            first: examined.first,
            last: examined.last,
            noise_mm: examined.noise_mm,
        });
        for defect in examined.defects {
            // Two stretches may both claim one on their border.
            let known = self.defects.iter().rev().take(64).any(|d| same_place(d, &defect));
            if !known {
                self.defects.push(defect);
            }
        }
    }

    fn findings(
        mut self,
        grid: &CellGrid,
        options: &DefectOptions,
        chainage: Chainage,
        (shape, radius_sd_mm): (Shape, Option<f64>),
        [wave_mm, profile_step_mm]: [f64; 2],
    ) -> Findings {
        let omitted = self.keep_the_deepest(options.list_max as usize);
        for defect in &mut self.defects {
            defect.chainage_mm = chainage.at_mm(defect.x_mm);
            defect.severity = severity(defect.depth_mm, options).to_string();
            // Seen against the rising chainage, left and right change places.
            defect.clock_h = defect.clock_h.map(|h| if chainage.falls { turned_h(h) } else { h });
        }
        self.defects.sort_by(|a, b| a.chainage_mm.total_cmp(&b.chainage_mm));
        (1..).zip(&mut self.defects).for_each(|(id, defect)| defect.id = id);
        self.sections.iter_mut().for_each(|row| row.chainage_mm = chainage.at_mm(row.x_mm));
        let (typical, worst) = self.limits(grid, wave_mm);
        let area_mm2 = self.measured_cells as f64 * grid.cell_mm * grid.cell_mm;
        let (length_mm, height_mm) = (grid.columns as f64 * grid.cell_mm, grid.rows as f64 * grid.cell_mm);
        let noise_mm = reference::median(self.seen.iter().map(|s| s.noise_mm).collect()).unwrap_or(0.0);
        let list = DefectList {
            schema_version: SCHEMA_VERSION,
            start_chainage_mm: chainage.start_mm,
            chainage_falls: chainage.falls,
            detection_limit_mm: limit_at(&typical, 20.0),
            detection_limits: typical,
            detection_limits_worst_rows: worst,
            depth_min_mm: options.depth_min_mm,
            noise_mm,
            cell_mm: grid.cell_mm,
            profile_step_mm,
            reference: self.reference(shape, radius_sd_mm, wave_mm),
            inspected: Inspected {
                x_min_mm: grid.x_mm(-0.5),
                length_mm,
                height_mm,
                area_mm2,
                coverage: area_mm2 / (length_mm * height_mm),
            },
            doubtful: self.doubtful,
            omitted,
            defects: self.defects,
        };
        Findings { list, sections: self.sections }
    }

    fn keep_the_deepest(&mut self, most: usize) -> usize {
        let omitted = self.defects.len().saturating_sub(most);
        if omitted > 0 {
            self.defects.sort_by(|a, b| b.depth_mm.abs().total_cmp(&a.depth_mm.abs()));
            self.defects.truncate(most);
        }
        omitted
    }

    fn limits(&self, grid: &CellGrid, wave_mm: f64) -> (Vec<DetectionLimit>, Vec<DetectionLimit>) {
        // The stretch that was seen worst, of those that matter: the list must not promise too much.
        let most = self.seen.iter().map(|s| s.cells).max().unwrap_or(0);
        let matter = || self.seen.iter().filter(move |s| 4 * s.cells >= most);
        let worst = |pick: fn(&Seen) -> f64| matter().map(pick).fold(0.0, f64::max);
        let limits =
            |first: f64, last: f64| noise::limits(&[(first, FIRST_LENGTH * wave_mm), (last, wave_mm)], grid.cell_mm);
        (
            limits(worst(|s| s.first.typical_mm), worst(|s| s.last.typical_mm)),
            limits(worst(|s| s.first.bad_mm), worst(|s| s.last.bad_mm)),
        )
    }

    fn reference(&self, shape: Shape, radius_sd_mm: Option<f64>, wave_mm: f64) -> ReferenceShape {
        match shape {
            Shape::Plane => ReferenceShape {
                kind: "plane".into(),
                seen_from: None,
                radius_mm: None,
                radius_sd_mm: None,
                mean_radius_mm: None,
                ovality_percent: None,
                ovality_sd_percent: None,
                wave_mm,
            },
            Shape::Cylinder { radius_mm, from_outside } => {
                let all =
                    |pick: &dyn Fn(&SectionRow) -> Option<f64>| pooled(self.sections.iter().filter_map(pick).collect());
                let radius = all(&|s| s.radius_mm);
                let ovality = all(&|s| s.ovality_percent);
                // The sections' own errors, too, shrink with their number.
                let count = self.sections.iter().filter(|s| s.ovality_percent.is_some()).count().max(1) as f64;
                let formal = all(&|s| s.ovality_sd_percent.map(|sd| sd / count.sqrt()));
                ReferenceShape {
                    kind: "cylinder".into(),
                    seen_from: Some(if from_outside { "outside" } else { "inside" }.into()),
                    radius_mm: Some(radius.map_or(radius_mm, |r| r.0)),
                    mean_radius_mm: all(&|s| s.mean_radius_mm).map(|r| r.0),
                    radius_sd_mm: radius.map(|r| r.1).or(radius_sd_mm),
                    ovality_percent: ovality.map(|o| o.0),
                    ovality_sd_percent: ovality.zip(formal).map(|(o, formal)| o.1.hypot(formal.0)),
                    wave_mm,
                }
            }
        }
    }
}

fn same_place(a: &Defect, b: &Defect) -> bool {
    let near = (a.x_mm - b.x_mm).hypot(a.y_mm - b.y_mm);
    (a.depth_mm > 0.0) == (b.depth_mm > 0.0) && near < 0.25 * (a.length_mm + a.width_mm).min(b.length_mm + b.width_mm)
}

fn severity(depth_mm: f64, options: &DefectOptions) -> &'static str {
    match depth_mm.abs() {
        depth if depth >= options.severe_mm => "severe",
        depth if depth >= options.moderate_mm => "moderate",
        _ => "minor",
    }
}

/// A clock position seen from the other end of the pipe.
fn turned_h(hour: f64) -> f64 {
    let turned = (12.0 - hour).rem_euclid(12.0);
    if turned <= 0.0 { 12.0 } else { turned }
}

fn limit_at(limits: &[DetectionLimit], radius_mm: f64) -> f64 {
    limits.iter().find(|l| l.radius_mm == radius_mm).map_or(0.0, |l| l.depth_mm)
}

#[cfg(test)]
mod tests;
