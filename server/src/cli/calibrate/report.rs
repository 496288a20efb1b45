//! What `stria calibrate` says: a line for each photo or wall, then the figures with their uncertainty.

use std::path::Path;

use serde_json::{Value, json};
use stria_core::Error;
use stria_core::calibration::{Attempt, Calibration, FlatResult, PhotoReport};

/// A line for each photo.
pub(super) fn photos(attempt: &Attempt) {
    let width = attempt.photos.iter().map(|p| p.name.chars().count()).max().unwrap_or(0).max(5);
    println!("{:width$}  corners  off by px  laser spots  off the plane mm", "photo");
    for photo in &attempt.photos {
        let number = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.3}"));
        println!(
            "{:width$}  {:>7}  {:>9}  {:>11}  {:>16}{}{}",
            photo.name,
            photo.corners.len(),
            number(photo.rms_px),
            photo.spots.len(),
            number(photo.plane_rms_mm),
            if photo.note.is_empty() { "" } else { "  " },
            photo.note
        );
    }
}

/// The rig by a board.
pub(super) fn board(found: &Calibration, warnings: &[String], out: &Path, picture: &Path) {
    let (camera, plane) = (&found.rig.camera, &found.rig.laser.plane);
    let n = plane.normal;
    println!("\n{}: rig '{}' of {} x {} px", out.display(), found.rig.name, camera.width_px, camera.height_px);
    let focal = if camera.fx_px == camera.fy_px {
        format!("{:.2}", camera.fx_px)
    } else {
        format!("{:.2} x {:.2}", camera.fx_px, camera.fy_px)
    };
    println!(
        "  focal length  {focal} ± {:.2} px ({:.3} %)",
        found.deviations.focal_px,
        100.0 * found.deviations.focal_px / camera.fx_px
    );
    println!(
        "  centre        {:.2} ± {:.2}, {:.2} ± {:.2} px",
        camera.cx_px, found.deviations.centre_px.0, camera.cy_px, found.deviations.centre_px.1
    );
    println!("  distortion    {}", distortion(found));
    println!("  corners       {:.3} px off where the camera sees them (root mean square)", found.rms_px);
    println!(
        "  laser plane   normal [{:.5}, {:.5}, {:.5}] ± {:.3}°, offset {:.3} ± {:.3} mm",
        n.x,
        n.y,
        n.z,
        found.plane_angle_rad.to_degrees(),
        plane.offset_mm,
        found.plane_offset_mm
    );
    println!(
        "  its points    {:.3} mm off the plane (root mean square), seen {:.0} to {:.0} mm from the camera",
        found.plane_rms_mm, found.plane_depth_mm.0, found.plane_depth_mm.1
    );
    println!("  coverage      {:.0} % of the image: {}", 100.0 * found.coverage, picture.display());
    warnings.iter().for_each(|w| println!("  warning       {w}"));
}

fn distortion(found: &Calibration) -> String {
    let names = ["k1", "k2", "p1", "p2", "k3"];
    let terms = names.iter().zip(found.rig.camera.distortion).zip(found.deviations.distortion);
    let used: Vec<String> = terms
        .filter(|((name, _), _)| found.lens.split(' ').any(|used| used == **name))
        .map(|((name, value), sigma)| format!("{name} {value:.5} ± {sigma:.5}"))
        .collect();
    if used.is_empty() { "none that the photos can tell".into() } else { used.join(", ") }
}

/// The rig by walls.
pub(super) fn walls(found: &FlatResult, out: &Path) {
    let width = found.walls.iter().map(|w| w.name.chars().count()).max().unwrap_or(0).max(4);
    println!("{:width$}  distance mm   rows  column px  off by px  off by mm", "wall");
    for w in &found.walls {
        println!(
            "{:width$}  {:>11.1}  {:>5}  {:>9.2}  {:>+9.3}  {:>+9.3}",
            w.name, w.distance_mm, w.rows, w.column_px, w.residual_px, w.residual_mm
        );
    }
    println!("\n{}: rig '{}'", out.display(), found.rig.name);
    println!("  C1            {:.1} ± {:.1} px mm (baseline {:.3} mm)", found.c1.0, found.c1.1, found.baseline_mm);
    println!("  C2            {:.2} ± {:.2} px (angle {:.3}°)", found.c2.0, found.c2.1, found.angle_rad.to_degrees());
    println!("  lean          {:.3}° about the optical axis", found.lean_rad.to_degrees());
    println!("  residual      {:.3} px (root mean square over the distances)", found.rms_px);
    found.warnings.iter().for_each(|w| println!("  warning       {w}"));
}

/// A JSON line for each photo.
pub(super) fn photos_json(attempt: &Attempt) {
    let line = |p: &PhotoReport| {
        json!({
            "type": "photo",
            "name": p.name,
            "corners": p.corners.len(),
            "reprojection_rms_px": p.rms_px,
            "laser_spots": p.spots.len(),
            "line_rms_px": p.line_rms_px,
            "plane_rms_mm": p.plane_rms_mm,
            "note": (!p.note.is_empty()).then_some(&p.note),
        })
    };
    attempt.photos.iter().for_each(|p| println!("{}", line(p)));
}

/// The last JSON line.
pub(super) fn board_json(found: &Calibration, warnings: &[String], out: &Path, picture: &Path) {
    let d = &found.deviations;
    let figures = json!({
        "focal_px": d.focal_px,
        "centre_px": [d.centre_px.0, d.centre_px.1],
        "distortion": d.distortion,
        "plane_angle_deg": found.plane_angle_rad.to_degrees(),
        "plane_offset_mm": found.plane_offset_mm,
    });
    println!(
        "{}",
        json!({
            "type": "result",
            "rig": found.rig.to_json(),
            "file": out.display().to_string(),
            "coverage_picture": picture.display().to_string(),
            "standard_deviations": figures,
            "lens_terms": found.lens,
            "reprojection_rms_px": found.rms_px,
            "plane_rms_mm": found.plane_rms_mm,
            "plane_depth_mm": [found.plane_depth_mm.0, found.plane_depth_mm.1],
            "coverage": found.coverage,
            "warnings": warnings,
        })
    );
}

/// A JSON line for each wall, then the result.
pub(super) fn walls_json(found: &FlatResult, out: &Path) {
    for w in &found.walls {
        println!(
            "{}",
            json!({
                "type": "wall",
                "name": w.name,
                "distance_mm": w.distance_mm,
                "rows": w.rows,
                "column_px": w.column_px,
                "slope": w.slope,
                "residual_px": w.residual_px,
                "residual_mm": w.residual_mm,
            })
        );
    }
    let constant = |(value, sigma): (f64, f64)| -> Value { json!({ "value": value, "standard_deviation": sigma }) };
    println!(
        "{}",
        json!({
            "type": "result",
            "rig": found.rig.to_json(),
            "file": out.display().to_string(),
            "c1_px_mm": constant(found.c1),
            "c2_px": constant(found.c2),
            "baseline_mm": found.baseline_mm,
            "angle_deg": found.angle_rad.to_degrees(),
            "lean_deg": found.lean_rad.to_degrees(),
            "residual_rms_px": found.rms_px,
            "warnings": found.warnings,
        })
    );
}

/// Why there is no result.
pub(super) fn error_json(error: &Error) {
    println!("{}", json!({ "type": "error", "kind": error.kind(), "message": error.to_string() }));
}
