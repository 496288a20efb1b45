//! The list of defects as `defects.json` holds it; the figures are explained in [`crate::defects`].

use serde::{Deserialize, Serialize};

/// Version of the shape of `defects.json`; grows when a field changes its meaning.
pub const SCHEMA_VERSION: u32 = 1;

/// Radius of the dent whose least depth is told first, mm.
pub(super) const LIMIT_RADIUS_MM: f64 = 20.0;

fn limit_radius_mm() -> f64 {
    LIMIT_RADIUS_MM
}

/// A region is longer at half its height than the travel between so many profiles: a single one that is wrong makes one as
/// long as 1, and half as much again once it is smoothed.
pub(super) const LEAST_PROFILES: f64 = 1.8;

/// Radius of the least dent that is longer than that at half of its depth, mm.
pub(super) fn least_radius_mm(profile_step_mm: f64) -> f64 {
    LEAST_PROFILES * profile_step_mm
}

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
    /// Standard deviation of the depth, mm.
    #[serde(default)]
    pub depth_sd_mm: f64,
    /// The depth square to the undamaged surface, mm.
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
    /// Area that was searched, mm²: measured, and surely enough.
    pub area_mm2: f64,
    /// Its share of the map, 0 to 1.
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
    /// A round dent of `detection_limit_radius_mm` must be at least so deep to be listed, over a typical row, mm.
    pub detection_limit_mm: f64,
    /// 20 mm; the next larger one of `detection_limits` where profiles lie too far apart for it.
    #[serde(default = "limit_radius_mm")]
    pub detection_limit_radius_mm: f64,
    /// The same for other radii, in a typical row; those that are missing are too short to be told from a single wrong profile.
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
    /// Distance of two line positions (image rows) on the surface, mm; 0 where it is not known.
    #[serde(default)]
    pub line_step_mm: f64,
    /// Width of the laser's line on the surface, mm at half of its height; 0 where it is not known.
    #[serde(default)]
    pub line_width_mm: f64,
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

impl DefectList {
    /// Dents of a lesser radius might be a single wrong profile and are not listed, mm.
    pub fn least_radius_mm(&self) -> f64 {
        least_radius_mm(self.profile_step_mm)
    }
}
