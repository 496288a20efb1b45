//! Profiles in the world → cells of a metric grid.
//!
//! Each profile is cut by the grid's rows; between two profiles that follow one another the surface is taken to be
//! straight, and each cell whose centre lies between them gets its depth. A cell that several pairs reach gets their
//! mean, weighted by how sure they are. What lies further apart than a limit stays a hole.

use super::{Cell, Grid, SurfaceMap};
use crate::error::Result;
use crate::surface::SurfacePoint;

/// Line positions without a spot that a profile is drawn across; more is a hole.
const MAX_ROW_GAP: u32 = 4;
/// Two spots further apart along the travel or in depth than this many times their distance along the line, plus a
/// millimetre, are no neighbours on the surface: an edge hides what is between them.
const STEEPEST: f64 = 8.0;
const EDGE_MM: f64 = 1.0;
/// A point weighs at least this.
const LEAST_WEIGHT: f64 = 1e-3;
/// Frames that a row may be without a spot and still be joined to the one before.
const MAX_FRAME_GAP: u32 = 3;

/// The surface's colours between a frame's profile and the one before it.
#[derive(Clone, Debug, PartialEq)]
pub struct WallColours {
    /// Colours per line position, from the profile before to this one.
    pub steps: usize,
    /// `steps` colours for each line position; `None` where no image shows the wall without the laser.
    pub rgb: Vec<Option<[u8; 3]>>,
}

impl WallColours {
    /// The colour at a line position, `share` of the way from the profile before to this one.
    pub fn at(&self, line_position: u32, share: f64) -> Option<[u8; 3]> {
        let step = ((share * self.steps as f64) as usize).min(self.steps.saturating_sub(1));
        self.rgb.get(line_position as usize * self.steps + step).copied().flatten()
    }
}

/// Joins profiles to a surface on a grid.
pub struct Sheet {
    grid: Grid,
    bridge_mm: f64,
    first_row: i64,
    /// The last sample of each grid row from `first_row` on.
    rows: Vec<Option<Sample>>,
    cells: Vec<Cell>,
}

#[derive(Clone, Copy)]
struct Sample {
    x_mm: f64,
    z_mm: f64,
    /// 1 over the weight. Weights fall with a position's variance, and of a straight line it is the variances that mix.
    doubt: f64,
    line_position: u32,
    frame: u32,
    part: u32,
}

impl Sheet {
    /// A sheet without profiles; gaps wider than `bridge_mm`, along the travel or the line, stay holes.
    pub fn new(grid: Grid, bridge_mm: f64) -> Sheet {
        Sheet { grid, bridge_mm, first_row: 0, rows: Vec::new(), cells: Vec::new() }
    }

    /// Adds a frame's points, in the order of their line positions (`line_positions` beside them), to a map.
    pub fn add(
        &mut self,
        map: &mut SurfaceMap,
        points: &[SurfacePoint],
        line_positions: &[u32],
        part: u32,
        colours: Option<&WallColours>,
    ) -> Result<()> {
        for (pair, position) in points.windows(2).zip(line_positions.windows(2)) {
            let (a, b) = (&pair[0].point_in_world, &pair[1].point_in_world);
            let along_mm = (b.y - a.y).abs();
            let edge = (b.x - a.x).hypot(b.z - a.z) > EDGE_MM + STEEPEST * along_mm;
            // A ray that nearly grazes the laser plane ends far away: no surface reaches there from the spot before.
            if position[1] - position[0] > MAX_ROW_GAP || edge || along_mm > self.bridge_mm {
                continue;
            }
            let row_of = |y_mm: f64| (y_mm - self.grid.y_mm) / self.grid.mm_per_px;
            let (from, to) = (row_of(a.y), row_of(b.y));
            let (low, high) = (from.min(to).ceil() as i64, from.max(to).floor() as i64);
            for row in low..=high {
                let share = if to == from { 0.0 } else { (row as f64 - from) / (to - from) };
                let between = |p: f64, q: f64| p + share * (q - p);
                let sample = Sample {
                    x_mm: between(a.x, b.x),
                    z_mm: between(a.z, b.z),
                    doubt: between(doubt(&pair[0]), doubt(&pair[1])),
                    line_position: position[usize::from(share > 0.5)],
                    frame: pair[0].frame,
                    part,
                };
                self.put(map, row, sample, colours)?;
            }
        }
        Ok(())
    }

    /// Fills the cells between a row's last sample and this one.
    fn put(&mut self, map: &mut SurfaceMap, row: i64, sample: Sample, colours: Option<&WallColours>) -> Result<()> {
        let grid = self.grid;
        let column = |x_mm: f64| (x_mm - grid.x_mm) / grid.mm_per_px;
        let nearest = column(sample.x_mm).round() as i64;
        if !map.makes_room([nearest, nearest], row) {
            return Ok(());
        }
        let last = self.slot(row).replace(sample);
        let joined = last.filter(|last| {
            last.part == sample.part
                && last.frame < sample.frame
                && sample.frame - last.frame <= MAX_FRAME_GAP
                && (sample.x_mm - last.x_mm).abs() <= self.bridge_mm
        });
        let Some(last) = joined else {
            // The first of a row: the nearest cell alone.
            let cell = Cell {
                depth_mm: sample.z_mm as f32,
                weight: sample.doubt.recip() as f32,
                rgb: colours.and_then(|c| c.at(sample.line_position, 1.0)),
            };
            return map.blend_run(nearest, row, &[cell]);
        };
        let (from, to) = (column(last.x_mm), column(sample.x_mm));
        // Centres on the far end belong to this pair, those on the near end to the one before.
        let (low, high) = if to >= from {
            (from.floor() as i64 + 1, to.floor() as i64)
        } else {
            (to.ceil() as i64, from.ceil() as i64 - 1)
        };
        if high < low {
            return Ok(());
        }
        self.cells.clear();
        for at in low..=high {
            let share = (at as f64 - from) / (to - from);
            let doubt = last.doubt + share * (sample.doubt - last.doubt);
            self.cells.push(Cell {
                depth_mm: (last.z_mm + share * (sample.z_mm - last.z_mm)) as f32,
                weight: doubt.recip() as f32,
                rgb: colours.and_then(|c| c.at(sample.line_position, share)),
            });
        }
        map.blend_run(low, row, &self.cells)
    }

    /// The last sample of a row. The map had room for it: there are no more rows than its limits allow.
    fn slot(&mut self, row: i64) -> &mut Option<Sample> {
        if self.rows.is_empty() {
            self.first_row = row;
        }
        if row < self.first_row {
            let missing = (self.first_row - row) as usize;
            self.rows.splice(0..0, std::iter::repeat_n(None, missing));
            self.first_row = row;
        }
        let at = (row - self.first_row) as usize;
        if at >= self.rows.len() {
            self.rows.resize(at + 1, None);
        }
        &mut self.rows[at]
    }
}

fn doubt(point: &SurfacePoint) -> f64 {
    f64::from(point.confidence).max(LEAST_WEIGHT).recip()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    fn profile(x_mm: f64, frame: u32, rows: std::ops::Range<u32>) -> (Vec<SurfacePoint>, Vec<u32>) {
        let point = |row: u32| SurfacePoint {
            point_in_world: Point3::new(x_mm, f64::from(row) * 0.4, 500.0 + 0.1 * x_mm + 0.2 * f64::from(row) * 0.4),
            rgb: [0; 3],
            confidence: 0.8,
            frame,
        };
        (rows.clone().map(point).collect(), rows.collect())
    }

    fn map_of(frames: &[(f64, u32, u32)]) -> SurfaceMap {
        let grid = Grid { x_mm: 0.0, y_mm: 0.0, mm_per_px: 1.0 };
        let mut map = SurfaceMap::create(grid, 8, &std::env::temp_dir()).expect("map");
        let mut sheet = Sheet::new(grid, 10.0);
        for (x_mm, frame, part) in frames {
            let (points, positions) = profile(*x_mm, *frame, 0..100);
            sheet.add(&mut map, &points, &positions, *part, None).expect("add");
        }
        map
    }

    #[test]
    fn between_two_profiles_the_surface_is_straight() {
        let mut map = map_of(&[(0.0, 0, 0), (4.3, 1, 0), (7.9, 2, 0)]);
        let window = map.window(0, 0, 8, 39).expect("window");
        for row in 0..39 {
            for column in 0..8 {
                let expected = 500.0 + 0.1 * column as f64 + 0.2 * row as f64;
                let found = f64::from(window.depth_mm[row * 8 + column]);
                // World y and z are float in the points: the rows are cut to a hundredth of a millimetre.
                assert!((found - expected).abs() < 2e-2, "{column}, {row}: {found} mm, not {expected}");
            }
        }
    }

    #[test]
    fn between_a_sure_profile_and_a_doubtful_one_it_is_the_variances_that_mix() {
        let grid = Grid { x_mm: 0.0, y_mm: 0.0, mm_per_px: 1.0 };
        let mut map = SurfaceMap::create(grid, 8, &std::env::temp_dir()).expect("map");
        let mut sheet = Sheet::new(grid, 10.0);
        for (frame, x_mm, confidence) in [(0, 0.0, 0.8), (1, 4.0, 0.1)] {
            let (mut points, positions) = profile(x_mm, frame, 0..100);
            points.iter_mut().for_each(|point| point.confidence = confidence);
            sheet.add(&mut map, &points, &positions, 0, None).expect("add");
        }
        let weights = map.weights(0, 7, 5, 1).expect("weights");
        for (column, weight) in weights.iter().enumerate() {
            // 1 over the weight goes straight from 1.25 to 10.
            let expected = 1.0 / (1.25 + (10.0 - 1.25) * column as f32 / 4.0);
            assert!((weight / expected - 1.0).abs() < 1e-5, "{column}: {weights:?}");
        }
    }

    #[test]
    fn wide_gaps_and_breaks_of_the_way_stay_holes() {
        for frames in [[(0.0, 0, 0), (20.0, 1, 0)], [(0.0, 0, 0), (8.0, 9, 0)], [(0.0, 0, 0), (8.0, 1, 1)]] {
            let mut map = map_of(&frames);
            let window = map.window(0, 0, 9, 39).expect("window");
            assert!(window.depth_mm[5 * 9 + 4].is_nan(), "{frames:?}");
            assert!(window.depth_mm[5 * 9].is_finite());
        }
    }

    #[test]
    fn going_back_averages_and_standing_still_changes_nothing() {
        let mut there = map_of(&[(0.0, 0, 0), (6.0, 1, 0)]);
        let mut back = map_of(&[(0.0, 0, 0), (6.0, 1, 0), (6.0, 2, 0), (0.0, 3, 0)]);
        let (a, b) = (there.window(0, 0, 7, 39).expect("window"), back.window(0, 0, 7, 39).expect("window"));
        assert!(a.depth_mm.iter().zip(&b.depth_mm).all(|(a, b)| (a - b).abs() < 1e-3));
    }
}
