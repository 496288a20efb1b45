//! A cloud as PCD 0.7, binary, in metres: x y z, `rgb` as the Point Cloud Library packs it, confidence, frame.

use std::path::Path;

use crate::error::{Error, Result};
use crate::export::new_file::NewFile;
use crate::surface::SurfacePoint;

/// Writes as many points as `count` says.
///
/// # Errors
/// Another number of points; what their reading or the disk says.
pub fn write(path: &Path, count: u64, points: impl Iterator<Item = Result<SurfacePoint>>) -> Result<()> {
    let mut file = NewFile::create(path)?;
    file.put(
        format!(
            "# .PCD v0.7 - stria: points of the wall, metres; x along the travel, y down, z into the wall\n\
             VERSION 0.7\n\
             FIELDS x y z rgb confidence frame\n\
             SIZE 4 4 4 4 4 4\n\
             TYPE F F F U F U\n\
             COUNT 1 1 1 1 1 1\n\
             WIDTH {count}\n\
             HEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\n\
             POINTS {count}\n\
             DATA binary\n"
        )
        .as_bytes(),
    )?;
    let mut written = 0;
    for point in points {
        let point = point?;
        let [red, green, blue] = point.rgb;
        let mut bytes = [0; 24];
        for (place, value_mm) in bytes.chunks_exact_mut(4).zip(point.point_in_world.iter()) {
            place.copy_from_slice(&((value_mm / 1000.0) as f32).to_le_bytes());
        }
        bytes[12..16].copy_from_slice(&[blue, green, red, 0]);
        bytes[16..20].copy_from_slice(&point.confidence.to_le_bytes());
        bytes[20..24].copy_from_slice(&point.frame.to_le_bytes());
        file.put(&bytes)?;
        written += 1;
    }
    if written != count {
        return Err(Error::internal("PCD", format!("{written} points, announced were {count}")));
    }
    file.commit()
}
