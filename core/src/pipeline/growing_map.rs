//! The map while the frames go by: begun with the first points, never larger than its limits.

use super::quality::add_gap;
use super::{Cargo, Colours, Request};
use crate::depth_map::sheet::Sheet;
use crate::depth_map::strips::{add_strip, strip_grid};
use crate::depth_map::{Grid, MapLimits, SurfaceMap};
use crate::error::Result;
use crate::export::manifest::Gap;
use crate::export::tiles::TileGrid;
use crate::rig::{LineDirection, Rig};
use crate::surface::{Placed, SurfacePoint};

/// The map of a job, and what lays profiles on it.
#[derive(Default)]
pub(super) struct GrowingMap {
    map: Option<SurfaceMap>,
    /// With method `metric`.
    sheet: Option<Sheet>,
    beyond: Beyond,
}

/// Frames of which something lies beyond the map's limits.
#[derive(Default)]
pub(super) struct Beyond {
    frames: u64,
    pub(super) gaps: Vec<Gap>,
}

impl GrowingMap {
    /// Adds a placed frame with its points in the world. Answers the grid when the map begins with it.
    pub(super) fn add(
        &mut self,
        request: &Request,
        placed: &Placed<Cargo>,
        points: &[SurfacePoint],
    ) -> Result<Option<TileGrid>> {
        let begun = self.begin(request, placed)?;
        let Some(map) = &mut self.map else { return Ok(None) };
        let (measured, left_out) = (&placed.measured, map.left_out());
        let colours = &measured.cargo.colours;
        match &mut self.sheet {
            Some(sheet) => {
                let positions: Vec<u32> = measured.profile.points.iter().map(|point| point.line_position).collect();
                let colours = match colours {
                    Colours::Wall(wall) => Some(wall),
                    _ => None,
                };
                sheet.add(map, points, &positions, placed.part, colours)?;
            }
            None => {
                let strip = match colours {
                    Colours::Strip(strip) => Some(strip),
                    _ => None,
                };
                add_strip(map, request.rig.laser.line, placed, strip)?;
            }
        }
        if map.left_out() > left_out {
            self.beyond.frames += 1;
            add_gap(&mut self.beyond.gaps, measured.frame, "beyond_map");
        }
        Ok(begun)
    }

    /// The map, where it has begun.
    pub(super) fn begun(&mut self) -> Option<&mut SurfaceMap> {
        self.map.as_mut()
    }

    /// The map as it became, and what is not on it.
    pub(super) fn finish(self) -> (Option<SurfaceMap>, Beyond) {
        (self.map, self.beyond)
    }

    /// The map begins with the first placed frame that has points: their distance gives the pixel's size.
    fn begin(&mut self, request: &Request, placed: &Placed<Cargo>) -> Result<Option<TileGrid>> {
        let (rig, recipe) = (&request.rig, &request.recipe);
        let (None, Some(z_mm), Some(pose)) =
            (&self.map, placed.measured.profile.median_z_mm(), &placed.world_from_camera)
        else {
            return Ok(None);
        };
        let grid = match &placed.strip {
            Some(place) => {
                // Grid column 0 is where this frame's line lies.
                let mut grid = strip_grid(rig, z_mm, line_x_mm(rig, z_mm) + pose.translation.x);
                grid.x_mm -= place.travel_px.round() * grid.mm_per_px;
                grid
            }
            None => {
                let mm_per_px = match recipe.map.mm_per_px {
                    size if size > 0.0 => size,
                    _ => round_up_125(z_mm / rig.camera.fx_px.min(rig.camera.fy_px)),
                };
                self.sheet = Some(Sheet::new(Grid { x_mm: 0.0, y_mm: 0.0, mm_per_px }, recipe.map.bridge_mm));
                Grid { x_mm: 0.0, y_mm: 0.0, mm_per_px }
            }
        };
        let limits = MapLimits {
            rows: u64::from(recipe.limits.map_rows),
            pixels: u64::from(recipe.limits.map_megapixels) * 1_000_000,
        };
        let map = SurfaceMap::create(grid, recipe.map.tiles_in_memory as usize, &request.out_dir)?;
        self.map = Some(map.limited(limits));
        Ok(Some(TileGrid { x0_mm: grid.x_mm, y0_mm: grid.y_mm, mm_per_px: grid.mm_per_px }))
    }
}

impl Beyond {
    /// In words; `None` where the map has everything.
    pub(super) fn warning(&self, request: &Request) -> Option<String> {
        let (first, last) = (self.gaps.first()?, self.gaps.last()?);
        let limits = &request.recipe.limits;
        Some(format!(
            "the map has no room for what was measured in {} frames between {} and {}: it would have more than {} rows \
             (limits.map_rows) or {} million pixels (limits.map_megapixels), as where the motion was lost and parts of the \
             wall lie apart; the cloud has all of it",
            self.frames, first.first_frame, last.last_frame, limits.map_rows, limits.map_megapixels
        ))
    }
}

/// World x, seen from the camera, of the laser line at distance `z_mm` on the optical axis' level.
fn line_x_mm(rig: &Rig, z_mm: f64) -> f64 {
    let plane = &rig.laser.plane;
    let across = match rig.laser.line {
        LineDirection::Vertical => plane.normal.x,
        LineDirection::Horizontal => plane.normal.y,
    };
    (plane.offset_mm - plane.normal.z * z_mm) / across
}

/// The next of 1, 2 and 5 times a power of ten.
fn round_up_125(value: f64) -> f64 {
    let power = 10f64.powf(value.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|step| step * power).find(|size| *size >= value).unwrap_or(10.0 * power)
}
