//! Points as foxglove.PointCloud messages.

use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::{PackedElementField, PointCloud, Pose, Quaternion, Timestamp, Vector3};
use nalgebra::Point3;

/// Bytes of a point; its x stands first.
pub(super) const STRIDE: usize = 20;

/// A point cloud in metres: x y z (float32), red green blue alpha (uint8), confidence (float32).
pub(super) fn cloud(
    timestamp: Timestamp,
    frame_id: &str,
    points: impl ExactSizeIterator<Item = (Point3<f64>, [u8; 3], f32)>,
) -> PointCloud {
    let mut data = Vec::with_capacity(STRIDE * points.len());
    for (point, [r, g, b], confidence) in points {
        metres(&point).iter().for_each(|v| data.extend(v.to_le_bytes()));
        data.extend([r, g, b, 255]);
        data.extend(confidence.to_le_bytes());
    }
    PointCloud {
        timestamp: Some(timestamp),
        frame_id: frame_id.into(),
        pose: Some(pose_at([0.0; 3])),
        point_stride: STRIDE as u32,
        fields: fields(&[
            ("x", 0, NumericType::Float32),
            ("y", 4, NumericType::Float32),
            ("z", 8, NumericType::Float32),
            ("red", 12, NumericType::Uint8),
            ("green", 13, NumericType::Uint8),
            ("blue", 14, NumericType::Uint8),
            ("alpha", 15, NumericType::Uint8),
            ("confidence", 16, NumericType::Float32),
        ]),
        data: data.into(),
    }
}

pub(super) fn fields(of: &[(&str, u32, NumericType)]) -> Vec<PackedElementField> {
    let field = |(name, offset, kind): &(&str, u32, NumericType)| PackedElementField {
        name: (*name).into(),
        offset: *offset,
        r#type: i32::from(*kind),
    };
    of.iter().map(field).collect()
}

/// Not turned, at a position in metres.
pub(super) fn pose_at([x, y, z]: [f64; 3]) -> Pose {
    Pose { position: Some(Vector3 { x, y, z }), orientation: Some(Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }) }
}

/// The schemas' unit of length.
fn metres(point_mm: &Point3<f64>) -> [f32; 3] {
    [point_mm.x, point_mm.y, point_mm.z].map(|v| (v / 1000.0) as f32)
}
