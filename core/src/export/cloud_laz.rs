//! `cloud.laz`: the measured points as LAZ 1.4, in metres.
//!
//! Point format 7 with the wall's colour (16 bits a channel, the 8 bits repeated), the stripe's confidence as intensity
//! (65535 is 1), and two extra dimensions: `confidence` (16 bits, scaled to 0 to 1) and `frame`. Coordinates are the
//! world's, kept to [`STEP_M`]. There is no place on Earth: the coordinate system is a local one.

use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use las::point::Format;
use las::{Builder, PointDataBuilder, Transform, Vector, Version, Vlr, Writer};

use crate::error::{Error, Result};
use crate::export::new_file::NewFile;
use crate::surface::SurfacePoint;

/// Step of a coordinate, metres: a hundredth of a millimetre. 31 bits of it reach 21 km.
pub const STEP_M: f64 = 1e-5;

/// Points that wait, at most, before they are compressed.
const POINTS_WAIT: usize = 8192;
/// Bytes of a point: format 7's, then two of confidence and four of frame.
const POINT_BYTES: usize = 36 + EXTRA_BYTES;
const EXTRA_BYTES: usize = 6;
/// The only return of one pulse.
const ONE_OF_ONE: u8 = 0x11;
const CONFIDENCE_STEPS: f64 = 65_535.0;
const PLACE: &str = r#"LOCAL_CS["wall: x along the travel, y down, z into the wall",UNIT["metre",1]]"#;

/// Writes points one after the other.
pub struct CloudLazWriter {
    path: PathBuf,
    writer: Writer<Sink>,
    waiting: Vec<u8>,
}

impl CloudLazWriter {
    /// Starts the file.
    pub fn create(path: &Path) -> Result<CloudLazWriter> {
        let failed = |e| failed(path, e);
        let mut builder = Builder::from(Version::new(1, 4));
        builder.generating_software = concat!("stria ", env!("CARGO_PKG_VERSION")).into();
        builder.system_identifier = "camera and line laser".into();
        builder.has_wkt_crs = true;
        builder.point_format = Format::new(7).map_err(failed)?;
        builder.point_format.is_compressed = true;
        builder.point_format.extra_bytes = EXTRA_BYTES as u16;
        let step = Transform { scale: STEP_M, offset: 0.0 };
        builder.transforms = Vector { x: step, y: step, z: step };
        builder.vlrs = vec![extra_dimensions(), coordinate_system()];
        let header = builder.into_header().map_err(failed)?;
        let sink = Sink { file: NewFile::create(path)?, broken: false };
        let writer = Writer::new(sink, header).map_err(failed)?;
        Ok(CloudLazWriter { path: path.to_path_buf(), writer, waiting: Vec::with_capacity(POINTS_WAIT * POINT_BYTES) })
    }

    /// Appends a point.
    ///
    /// # Errors
    /// A point further from the start than the steps reach; where the disk is full.
    pub fn push(&mut self, point: &SurfacePoint) -> Result<()> {
        let position = point.point_in_world;
        for (name, value_mm) in [("x", position.x), ("y", position.y), ("z", position.z)] {
            let steps = (value_mm / (1000.0 * STEP_M)).round();
            if !(f64::from(i32::MIN)..=f64::from(i32::MAX)).contains(&steps) {
                let reach_km = f64::from(i32::MAX) * STEP_M / 1000.0;
                let found = format!("{value_mm} mm from the run's start");
                return Err(Error::field("cloud.laz", name, found, format!("within {reach_km:.0} km")));
            }
            self.waiting.extend((steps as i32).to_le_bytes());
        }
        let confidence = (f64::from(point.confidence.clamp(0.0, 1.0)) * CONFIDENCE_STEPS).round() as u16;
        self.waiting.extend(confidence.to_le_bytes());
        // Flags, classification (created, never classified), user data; scan angle; source; time.
        self.waiting.extend([ONE_OF_ONE, 0, 0, 0, 0, 0, 0, 0]);
        self.waiting.extend(0f64.to_le_bytes());
        for channel in point.rgb {
            self.waiting.extend((u16::from(channel) * 257).to_le_bytes());
        }
        self.waiting.extend(confidence.to_le_bytes());
        self.waiting.extend(point.frame.to_le_bytes());
        if self.waiting.len() >= POINTS_WAIT * POINT_BYTES { self.compress() } else { Ok(()) }
    }

    fn compress(&mut self) -> Result<()> {
        let bytes = std::mem::replace(&mut self.waiting, Vec::with_capacity(POINTS_WAIT * POINT_BYTES));
        let points = PointDataBuilder::new().for_header(self.writer.header()).build_from_bytes(bytes);
        points.and_then(|points| self.writer.write_points(&points)).map_err(|e| failed(&self.path, e))
    }

    /// Completes the file and gives it its name.
    pub fn finish(mut self) -> Result<()> {
        self.compress()?;
        let sink = self.writer.into_inner().map_err(|e| failed(&self.path, e))?;
        sink.file.commit()
    }
}

fn failed(path: &Path, error: las::Error) -> Error {
    match error {
        las::Error::Io(e) => Error::io(path, e),
        other => Error::internal("cloud.laz", other),
    }
}

/// The file being written. The LAZ writer ends its file when it is dropped, and panics where that fails; so after a
/// first error, which was told, the others are not.
struct Sink {
    file: NewFile,
    broken: bool,
}

impl Write for Sink {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.broken {
            return Ok(bytes.len());
        }
        let written = self.file.write(bytes);
        self.broken = written.as_ref().is_err_and(|e| e.kind() != io::ErrorKind::Interrupted);
        written
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.broken { Ok(()) } else { self.file.flush() }
    }
}

impl Seek for Sink {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        if self.broken {
            return Ok(0);
        }
        let place = self.file.seek(position);
        self.broken = place.is_err();
        place
    }
}

/// LAS 1.4's table of the bytes after each point.
fn extra_dimensions() -> Vlr {
    let mut data = extra_dimension("confidence", "of the laser's spot, 0 to 1", 3, Some(1.0 / CONFIDENCE_STEPS));
    data.extend(extra_dimension("frame", "that measured it, from 0", 5, None));
    Vlr { user_id: "LASF_Spec".into(), record_id: 4, description: "Extra bytes".into(), data }
}

/// An entry of that table: `kind` 3 is 16 bits, 5 is 32 bits without sign.
fn extra_dimension(name: &str, description: &str, kind: u8, scale: Option<f64>) -> Vec<u8> {
    const HAS_SCALE: u8 = 8;
    let mut entry = vec![0; 192];
    entry[2] = kind;
    entry[4..4 + name.len()].copy_from_slice(name.as_bytes());
    if let Some(scale) = scale {
        entry[3] = HAS_SCALE;
        entry[112..120].copy_from_slice(&scale.to_le_bytes());
    }
    entry[160..160 + description.len()].copy_from_slice(description.as_bytes());
    entry
}

fn coordinate_system() -> Vlr {
    let mut data = PLACE.as_bytes().to_vec();
    data.push(0);
    Vlr { user_id: "LASF_Projection".into(), record_id: 2112, description: "Local system".into(), data }
}

#[cfg(test)]
mod tests {
    use las::Reader;
    use nalgebra::Point3;

    use super::*;

    fn point(i: u32) -> SurfacePoint {
        SurfacePoint {
            point_in_world: Point3::new(f64::from(i) * 0.7, -f64::from(i) / 3.0, 850.123),
            rgb: [i as u8, 7, 255],
            confidence: (i % 100) as f32 / 100.0,
            frame: i / 50,
        }
    }

    #[test]
    fn points_come_back() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("cloud.laz");
        let mut writer = CloudLazWriter::create(&path).expect("create");
        for i in 0..20_000 {
            writer.push(&point(i)).expect("push");
        }
        assert!(!path.exists(), "not before it is complete");
        writer.finish().expect("finish");
        let mut reader = Reader::from_path(&path).expect("opens");
        assert_eq!(reader.header().number_of_points(), 20_000);
        let points = reader.read_all().expect("reads");
        for (i, read) in points.points().enumerate() {
            let (read, written) = (read.expect("a point"), point(i as u32));
            assert!((read.x * 1000.0 - written.point_in_world.x).abs() <= 0.005_001);
            assert!((read.y * 1000.0 - written.point_in_world.y).abs() <= 0.005_001);
            assert_eq!(read.color.map(|c| c.red / 257), Some(u16::from(written.rgb[0])));
            assert_eq!(read.extra_bytes[2..], written.frame.to_le_bytes());
        }
    }

    #[test]
    fn one_given_up_leaves_nothing_and_far_points_are_refused() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let mut writer = CloudLazWriter::create(&folder.path().join("cloud.laz")).expect("create");
        let far = SurfacePoint { point_in_world: Point3::new(3e7, 0.0, 0.0), ..point(0) };
        let refused = writer.push(&far).expect_err("too far").to_string();
        assert!(refused.contains("within 21 km"), "{refused}");
        drop(writer);
        assert_eq!(std::fs::read_dir(folder.path()).expect("list").count(), 0);
    }
}
