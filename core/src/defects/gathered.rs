//! What the stretches show, put together to the run's list and sections.

use super::cells::CellGrid;
use super::list::{LIMIT_RADIUS_MM, least_radius_mm};
use super::reference::{self, Shape};
use super::section::pooled;
use super::stretch::{Examined, FIRST_LENGTH, Threshold};
use super::{
    Chainage, Defect, DefectList, DetectionLimit, Findings, Inspected, ReferenceShape, SCHEMA_VERSION, Sampling,
    SectionRow, noise,
};
use crate::recipe::DefectOptions;

/// What could be seen in a stretch.
struct Seen {
    cells: usize,
    first: Threshold,
    last: Threshold,
    noise_mm: f64,
}

/// What the stretches show, put together.
#[derive(Default)]
pub(super) struct Gathered {
    defects: Vec<Defect>,
    doubtful: usize,
    sections: Vec<SectionRow>,
    seen: Vec<Seen>,
    pub inspected_cells: usize,
}

impl Gathered {
    pub(super) fn add(&mut self, examined: Examined) {
        self.doubtful += examined.doubtful;
        self.sections.extend(examined.sections);
        self.inspected_cells += examined.inspected_cells;
        self.seen.push(Seen {
            cells: examined.inspected_cells,
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

    pub(super) fn findings(
        mut self,
        grid: &CellGrid,
        options: &DefectOptions,
        chainage: Chainage,
        (shape, radius_sd_mm): (Shape, Option<f64>),
        wave_mm: f64,
        sampling: Sampling,
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
        let (typical, worst) = self.limits(grid, wave_mm, sampling);
        let limit = limit_near(&typical, LIMIT_RADIUS_MM);
        let area_mm2 = self.inspected_cells as f64 * grid.cell_mm * grid.cell_mm;
        let (length_mm, height_mm) = (grid.columns as f64 * grid.cell_mm, grid.rows as f64 * grid.cell_mm);
        let noise_mm = reference::median(self.seen.iter().map(|s| s.noise_mm).collect()).unwrap_or(0.0);
        let list = DefectList {
            schema_version: SCHEMA_VERSION,
            start_chainage_mm: chainage.start_mm,
            chainage_falls: chainage.falls,
            detection_limit_mm: limit.depth_mm,
            detection_limit_radius_mm: limit.radius_mm,
            detection_limits: typical,
            detection_limits_worst_rows: worst,
            depth_min_mm: options.depth_min_mm,
            noise_mm,
            cell_mm: grid.cell_mm,
            profile_step_mm: sampling.profile_step_mm,
            line_step_mm: sampling.line_step_mm,
            line_width_mm: sampling.line_width_mm,
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

    fn limits(&self, grid: &CellGrid, wave_mm: f64, sampling: Sampling) -> (Vec<DetectionLimit>, Vec<DetectionLimit>) {
        // The stretch that was seen worst, of those that matter: the list must not promise too much.
        let most = self.seen.iter().map(|s| s.cells).max().unwrap_or(0);
        let matter = || self.seen.iter().filter(move |s| 4 * s.cells >= most);
        let worst = |pick: fn(&Seen) -> f64| matter().map(pick).fold(0.0, f64::max);
        let limits = |first: f64, last: f64| {
            let rounds = [(first, FIRST_LENGTH * wave_mm), (last, wave_mm)];
            noise::limits(&rounds, grid.cell_mm, least_radius_mm(sampling.profile_step_mm))
        };
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

/// The limit at a radius, or at the next larger one that can be seen at all.
fn limit_near(limits: &[DetectionLimit], radius_mm: f64) -> DetectionLimit {
    let next = limits.iter().find(|l| l.radius_mm >= radius_mm).or(limits.last());
    next.copied().unwrap_or(DetectionLimit { radius_mm, depth_mm: 0.0 })
}
