//! The search on maps that are known: what is on them, and nothing else.

use super::*;
use crate::depth_map::{GridMap, MapGeometry, MapWindow};
use crate::recipe::Recipe;

/// A raised cosine: (x, y, radius, height), mm.
type Bump = (f64, f64, f64, f64);

/// A number from −1 to 1 that looks random.
fn noise(i: usize) -> f64 {
    let hashed = (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let mixed = (hashed ^ (hashed >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    ((mixed ^ (mixed >> 32)) % 20_001) as f64 / 10_000.0 - 1.0
}

fn map(width_px: usize, base: impl Fn(f64, f64) -> f64, bumps: &[Bump], hole: impl Fn(f64, f64) -> bool) -> GridMap {
    let geometry = MapGeometry { x0_mm: 50.0, y0_mm: -300.0, mm_per_px: 1.0, width_px, height_px: 600 };
    GridMap::from_fn(geometry, |column, row| {
        let (x, y) = (50.0 + column as f64, -300.0 + row as f64);
        let mut z = base(x, y) + 0.2 * noise(row * width_px + column);
        for (cx, cy, radius, height) in bumps {
            let away = (x - cx).hypot(y - cy) / radius;
            if away < 1.0 {
                z += height * (std::f64::consts::FRAC_PI_2 * away).cos().powi(2);
            }
        }
        (if hole(x, y) { f32::NAN } else { z as f32 }, None)
    })
}

/// The maps of these tests are not blurred.
const SAMPLING: Sampling = Sampling { profile_step_mm: 0.1, line_step_mm: 0.0, line_width_mm: 0.0 };

fn found(map: &mut dyn MapReader) -> Findings {
    let recipe = Recipe::default();
    find(map, &recipe.defects, Chainage { start_mm: 1000.0, falls: false }, SAMPLING, &mut |_| Ok(()))
        .expect("find")
        .expect("measured")
}

fn wall(x: f64, y: f64) -> f64 {
    850.0 + 0.02 * x - 0.03 * y + 0.8 * (x / 90.0).sin() * (y / 110.0).cos()
}

const BUMPS: [Bump; 6] = [
    (200.0, -150.0, 25.0, 3.0),
    (420.0, 100.0, 90.0, -15.0),
    (600.0, -100.0, 60.0, 9.0),
    (690.0, -90.0, 40.0, -6.0),
    (1200.0, 50.0, 20.0, 3.0),
    (2350.0, 0.0, 50.0, -5.0),
];

#[test]
fn dents_and_bulges_are_found_with_their_figures_and_nothing_else() {
    // 5,000 mm: two stretches.
    let found = found(&mut map(5000, wall, &BUMPS, |_, _| false));
    assert_eq!(found.list.reference.kind, "plane");
    assert_eq!(found.list.defects.len(), BUMPS.len(), "{:#?}", found.list.defects);
    for (defect, (x, y, radius, height)) in found.list.defects.iter().zip(BUMPS) {
        let off = (defect.x_mm - x).hypot(defect.y_mm - y);
        assert!(off < 2.0, "{off} mm off: {defect:#?}");
        assert!((defect.depth_mm - height).abs() < f64::max(0.3, 0.05 * height.abs()), "{height} mm: {defect:#?}");
        let area_mm2 = std::f64::consts::PI * radius * radius;
        assert!((defect.area_mm2 / area_mm2 - 1.0).abs() < 0.15, "{area_mm2} mm²: {defect:#?}");
        assert!((defect.length_mm / (2.0 * radius) - 1.0).abs() < 0.2, "{defect:#?}");
        // The volume of a raised cosine is h·π·r²·(1/2 − 2/π²).
        let volume_mm3 = height.abs() * area_mm2 * (0.5 - 2.0 / std::f64::consts::PI.powi(2));
        assert!((defect.volume_mm3 / volume_mm3 - 1.0).abs() < 0.15, "{volume_mm3} mm³: {defect:#?}");
        assert_eq!(defect.kind, if height > 0.0 { DefectKind::Dent } else { DefectKind::Bulge });
        assert!((defect.chainage_mm - defect.x_mm - 1000.0).abs() < 1e-9 && defect.height_mm == Some(-defect.y_mm));
        assert!(defect.confidence > 0.9, "{defect:#?}");
    }
    assert!(found.sections.len() >= 49 && found.sections.iter().all(|s| s.flatness_mm.is_some()));
}

#[test]
fn an_empty_wall_gives_an_empty_list_and_a_limit() {
    let found = found(&mut map(1500, wall, &[], |_, _| false));
    assert!(found.list.defects.is_empty(), "{:#?}", found.list.defects);
    let limit = found.list.detection_limit_mm;
    assert!((0.5..1.5).contains(&limit), "{limit}");
}

#[test]
fn a_pipe_with_a_highlight_is_no_list_of_gaps() {
    let pipe = |_: f64, y: f64| 750.0 - (300.0_f64.powi(2) - (y * 0.6).powi(2)).sqrt();
    let bumps = [(300.0, 100.0, 20.0, 2.0), (700.0, -40.0, 40.0, -4.0)];
    // A band without measurements across the second bump.
    let found = found(&mut map(1500, pipe, &bumps, |x, y| (y + 40.0 + 4.0 * (x / 30.0).sin()).abs() < 6.0));
    assert_eq!(found.list.reference.kind, "cylinder");
    assert_eq!(found.list.defects.len(), 2, "{:#?}", found.list.defects);
    let [dent, bulge] = &found.list.defects[..] else { unreachable!("two") };
    assert!((dent.depth_mm - 2.0).abs() < 0.25 && (bulge.depth_mm + 4.0).abs() < 0.5, "{dent:#?} {bulge:#?}");
    assert!(bulge.measured_share < 1.0 && dent.clock_h.is_some_and(|h| h > 3.0 && h < 4.5), "{dent:#?}");
}

#[test]
fn blocks_and_pits_with_steep_sides_have_their_own_names() {
    let block = |x: f64, y: f64, z: f64| if (400.0..500.0).contains(&x) && (-50.0..0.0).contains(&y) { z } else { 0.0 };
    for (height, kind) in [(-4.0, DefectKind::Step), (4.0, DefectKind::MissingMaterial), (30.0, DefectKind::Hole)] {
        let found = found(&mut map(1200, |x, y| wall(x, y) + block(x, y, height), &[], |_, _| false));
        assert_eq!(found.list.defects.len(), 1, "{:#?}", found.list.defects);
        let defect = &found.list.defects[0];
        assert_eq!(defect.kind, kind, "{defect:#?}");
        assert!((defect.depth_mm / height - 1.0).abs() < 0.1, "{defect:#?}");
        assert!((defect.area_mm2 / 5000.0 - 1.0).abs() < 0.1 && (defect.length_mm - 100.0).abs() < 6.0, "{defect:#?}");
    }
}

#[test]
fn a_dent_in_another_s_footprint_is_told_apart_and_neither_spoils_the_other() {
    let bumps =
        [(400.0, 0.0, 90.0, 14.0), (462.0, 10.0, 26.0, -4.5), (700.0, 60.0, 45.0, -8.0), (768.0, 90.0, 40.0, 6.0)];
    let found = found(&mut map(1200, wall, &bumps, |_, _| false));
    assert_eq!(found.list.defects.len(), bumps.len(), "{:#?}", found.list.defects);
    for (x, y, radius, height) in bumps {
        let apart = |d: &&Defect| (d.x_mm - x).hypot(d.y_mm - y);
        let defect = found.list.defects.iter().min_by(|a, b| apart(a).total_cmp(&apart(b))).expect("some");
        assert!(apart(&defect) < 3.0, "({x}, {y}): {defect:#?}");
        assert!((defect.depth_mm - height).abs() < f64::max(0.3, 0.1 * height.abs()), "{height} mm: {defect:#?}");
        let area_mm2 = std::f64::consts::PI * radius * radius;
        assert!((defect.area_mm2 / area_mm2 - 1.0).abs() < 0.15, "{area_mm2} mm²: {defect:#?}");
        assert!((defect.depth_mm - height).abs() < 3.0 * defect.depth_sd_mm, "{height} mm: {defect:#?}");
    }
}

/// A map whose depths are not equally sure; what one weighs is told by its place.
struct Weighed<'a> {
    map: GridMap,
    weight: &'a dyn Fn(f64, f64) -> f32,
}

impl MapReader for Weighed<'_> {
    fn geometry(&self) -> MapGeometry {
        self.map.geometry()
    }

    fn window(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<MapWindow> {
        self.map.window(column_px, row_px, width_px, height_px)
    }

    fn weights(&mut self, column_px: usize, row_px: usize, width_px: usize, height_px: usize) -> Result<Vec<f32>> {
        let MapGeometry { x0_mm, y0_mm, .. } = self.geometry();
        let weight = |at: usize| {
            let (column, row) = (column_px + at % width_px, row_px + at / width_px);
            (self.weight)(x0_mm + column as f64, y0_mm + row as f64)
        };
        Ok((0..width_px * height_px).map(weight).collect())
    }
}

/// Where a wall with a dent at x = 300 mm and another at x = 700 mm has defects.
fn where_found(weight: &dyn Fn(f64, f64) -> f32) -> Vec<f64> {
    let map = map(1200, wall, &[(300.0, 0.0, 30.0, 4.0), (700.0, 0.0, 30.0, 4.0)], |_, _| false);
    found(&mut Weighed { map, weight }).list.defects.iter().map(|d| 100.0 * (d.x_mm / 100.0).round()).collect()
}

#[test]
fn what_stands_out_where_the_map_is_doubtful_is_no_defect() {
    let second = |weight: f32| move |x: f64, y: f64| if (x - 700.0).hypot(y) < 35.0 { weight } else { 0.95 };
    assert_eq!(where_found(&second(0.95)), [300.0, 700.0]);
    // Too doubtful to be looked at, and too doubtful to be believed.
    assert_eq!(where_found(&second(0.1)), [300.0]);
    assert_eq!(where_found(&second(0.45)), [300.0]);
    // Less sure than the rest, and sure enough.
    assert_eq!(where_found(&second(0.6)), [300.0, 700.0]);
}

#[test]
fn a_map_that_is_doubtful_everywhere_is_searched_all_the_same() {
    assert_eq!(where_found(&|_, _| 0.2), [300.0, 700.0]);
}

#[test]
fn a_doubtful_spike_in_a_dent_does_not_spoil_its_figures() {
    let bumps = [(600.0, 0.0, 40.0, 6.0), (610.0, 10.0, 8.0, -12.0)];
    let weight = |x: f64, y: f64| if (x - 610.0).hypot(y - 10.0) < 8.0 { 0.1 } else { 0.95 };
    let map = map(1200, wall, &bumps, |_, _| false);
    let believed = found(&mut map.clone());
    let doubted = found(&mut Weighed { map, weight: &weight });
    let [dent] = &doubted.list.defects[..] else { unreachable!("{:#?}", doubted.list.defects) };
    assert!((dent.depth_mm - 6.0).abs() < 0.4 && (dent.x_mm - 600.0).hypot(dent.y_mm) < 2.0, "{dent:#?}");
    // What was left out was not searched.
    let coverages = [&doubted, &believed].map(|found| found.list.inspected.coverage);
    assert!(coverages[0] < coverages[1] && coverages[0] > coverages[1] - 0.01, "{coverages:?}");
    let as_good = |d: &Defect| (d.depth_mm - 6.0).abs() < 0.4 && (d.x_mm - 600.0).hypot(d.y_mm) < 2.0;
    assert!(believed.list.defects.len() != 1 || !as_good(&believed.list.defects[0]), "the spike is none");
}
