//! A cloud as E57 (ASTM E2807), in metres: coordinates as doubles, colour, the confidence as intensity (0 to 1), and the
//! frame as the column of a scan whose columns are frames.

use std::path::Path;

use e57::{E57Writer, Record, RecordDataType, RecordName, RecordValue};

use crate::error::{Error, Result};
use crate::export::manifest::sha256_of_bytes;
use crate::export::new_file::NewFile;
use crate::surface::SurfacePoint;

/// Writes the points; `name` is the scan's for people, and with `count` what its identity is made from.
///
/// # Errors
/// What the reading of the points or the disk says.
pub fn write(path: &Path, name: &str, count: u64, points: impl Iterator<Item = Result<SurfacePoint>>) -> Result<()> {
    let failed = |e: e57::Error| failed(path, e);
    let mut file = NewFile::create(path)?;
    let mut writer = E57Writer::new(&mut file, &identity("file", name, count)).map_err(failed)?;
    let mut cloud = writer.add_pointcloud(&identity("scan", name, count), prototype()).map_err(failed)?;
    cloud.set_name(Some(name.into()));
    cloud.set_description(Some("x along the travel, y down, z into the wall; one column a camera frame".into()));
    for point in points {
        let point = point?;
        let [x, y, z] = [0, 1, 2].map(|axis| RecordValue::Double(point.point_in_world[axis] / 1000.0));
        let [red, green, blue] = point.rgb.map(|channel| RecordValue::Integer(i64::from(channel)));
        let confidence = RecordValue::Single(point.confidence.clamp(0.0, 1.0));
        let frame = RecordValue::Integer(i64::from(point.frame));
        cloud.add_point(vec![x, y, z, red, green, blue, confidence, frame]).map_err(failed)?;
    }
    cloud.finalize().map_err(failed)?;
    writer.finalize().map_err(failed)?;
    drop(writer);
    file.commit()
}

fn prototype() -> Vec<Record> {
    let double = RecordDataType::Double { min: None, max: None };
    let channel = RecordDataType::Integer { min: 0, max: 255 };
    [
        (RecordName::CartesianX, double.clone()),
        (RecordName::CartesianY, double.clone()),
        (RecordName::CartesianZ, double),
        (RecordName::ColorRed, channel.clone()),
        (RecordName::ColorGreen, channel.clone()),
        (RecordName::ColorBlue, channel),
        (RecordName::Intensity, RecordDataType::Single { min: Some(0.0), max: Some(1.0) }),
        (RecordName::ColumnIndex, RecordDataType::Integer { min: 0, max: i64::from(u32::MAX) }),
    ]
    .map(|(name, data_type)| Record { name, data_type })
    .to_vec()
}

/// A GUID that is the same for the same cloud.
fn identity(what: &str, name: &str, count: u64) -> String {
    let hash = sha256_of_bytes(format!("stria {what} {name} {count}").as_bytes());
    format!("{{{}-{}-{}-{}-{}}}", &hash[..8], &hash[8..12], &hash[12..16], &hash[16..20], &hash[20..32])
}

fn failed(path: &Path, error: e57::Error) -> Error {
    Error::internal("E57", format!("{}: {error}", path.display()))
}
