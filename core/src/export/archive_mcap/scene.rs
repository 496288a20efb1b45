//! Defects as a foxglove.SceneUpdate: a box around each with its name.

use foxglove::messages::{
    Color, CubePrimitive, KeyValuePair, SceneEntity, SceneUpdate, TextPrimitive, Timestamp, Vector3,
};
use serde::Deserialize;

use super::points::pose_at;

/// What a scene shows of `defects.json`.
#[derive(Deserialize)]
pub(super) struct DefectScene {
    defects: Vec<SceneDefect>,
}

#[derive(Deserialize)]
struct SceneDefect {
    id: u32,
    kind: String,
    severity: String,
    chainage_mm: f64,
    z_mm: f64,
    depth_mm: f64,
    bounds: Bounds,
}

#[derive(Deserialize)]
struct Bounds {
    x_min_mm: f64,
    x_max_mm: f64,
    y_min_mm: f64,
    y_max_mm: f64,
}

/// A box is at least so thick that it can be seen, m.
const THINNEST_M: f64 = 0.002;
/// Height of the letters, m.
const LETTERS_M: f64 = 0.012;

/// The message that shows them.
pub(super) fn update(timestamp: Timestamp, frame_id: &str, scene: &DefectScene) -> SceneUpdate {
    let entities = scene.defects.iter().map(|defect| entity(timestamp, frame_id, defect)).collect();
    SceneUpdate { deletions: Vec::new(), entities }
}

fn entity(timestamp: Timestamp, frame_id: &str, defect: &SceneDefect) -> SceneEntity {
    let b = &defect.bounds;
    let middle = |low: f64, high: f64| (low + high) / 2000.0;
    // From the undamaged surface to the deepest place.
    let z_m = (defect.z_mm - defect.depth_mm / 2.0) / 1000.0;
    let (x_m, y_m) = (middle(b.x_min_mm, b.x_max_mm), middle(b.y_min_mm, b.y_max_mm));
    let size = Vector3 {
        x: (b.x_max_mm - b.x_min_mm) / 1000.0,
        y: (b.y_max_mm - b.y_min_mm) / 1000.0,
        z: (defect.depth_mm.abs() / 1000.0).max(THINNEST_M),
    };
    let (r, g, b) = match defect.severity.as_str() {
        "severe" => (0.9, 0.1, 0.1),
        "moderate" => (0.95, 0.5, 0.1),
        _ => (0.95, 0.85, 0.2),
    };
    let words = format!("{} {}: {:.1} mm", defect.id, defect.kind.replace('_', " "), defect.depth_mm);
    let above_m = y_m - size.y / 2.0 - LETTERS_M;
    let value = |key: &str, value: String| KeyValuePair { key: key.into(), value };
    SceneEntity {
        timestamp: Some(timestamp),
        frame_id: frame_id.into(),
        id: format!("defect {}", defect.id),
        metadata: vec![
            value("kind", defect.kind.clone()),
            value("severity", defect.severity.clone()),
            value("chainage_mm", defect.chainage_mm.to_string()),
            value("depth_mm", defect.depth_mm.to_string()),
        ],
        cubes: vec![CubePrimitive {
            pose: Some(pose_at([x_m, y_m, z_m])),
            size: Some(size),
            color: Some(Color { r, g, b, a: 0.35 }),
        }],
        texts: vec![TextPrimitive {
            pose: Some(pose_at([x_m, above_m, z_m])),
            billboard: true,
            font_size: LETTERS_M,
            scale_invariant: false,
            color: Some(Color { r, g, b, a: 1.0 }),
            text: words,
        }],
        ..SceneEntity::default()
    }
}
