//! `cloud.ply`: the measured points as a binary little-endian PLY.
//!
//! Vertex: float x y z (world, mm), uchar red green blue, float confidence (0 to 1), int frame; 23 bytes. The
//! number of points is known only at the end and then written into the header, whose length a comment keeps
//! constant.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::export::new_file::NewFile;
use crate::surface::SurfacePoint;

/// Bytes of one point.
const POINT_BYTES: usize = 23;
/// Room for the digits of the number of points.
const COUNT_DIGITS: usize = 19;

/// Writes points one after the other.
pub struct CloudPlyWriter {
    file: NewFile,
    points: u64,
}

impl CloudPlyWriter {
    /// Starts the file.
    pub fn create(path: &Path) -> Result<CloudPlyWriter> {
        let mut file = NewFile::create(path)?;
        file.put(header(0).as_bytes())?;
        Ok(CloudPlyWriter { file, points: 0 })
    }

    /// Appends a point. Coordinates are stored as float32: to 0.06 mm at a kilometre from the start.
    pub fn push(&mut self, point: &SurfacePoint) -> Result<()> {
        let mut bytes = [0; POINT_BYTES];
        let position = point.point_in_world;
        bytes[0..4].copy_from_slice(&(position.x as f32).to_le_bytes());
        bytes[4..8].copy_from_slice(&(position.y as f32).to_le_bytes());
        bytes[8..12].copy_from_slice(&(position.z as f32).to_le_bytes());
        bytes[12..15].copy_from_slice(&point.rgb);
        bytes[15..19].copy_from_slice(&point.confidence.to_le_bytes());
        bytes[19..23].copy_from_slice(&(point.frame as i32).to_le_bytes());
        self.points += 1;
        self.file.put(&bytes)
    }

    /// Points so far.
    pub fn points(&self) -> u64 {
        self.points
    }

    /// Writes the number of points into the header and gives the file its name.
    pub fn finish(mut self) -> Result<()> {
        self.file.go_to(0)?;
        self.file.put(header(self.points).as_bytes())?;
        self.file.commit()
    }
}

fn header(points: u64) -> String {
    let count = points.to_string();
    // A comment takes what the number leaves: leading zeros or blanks would confuse some readers.
    let filler = ".".repeat(COUNT_DIGITS + 1 - count.len());
    format!(
        "ply\n\
         format binary_little_endian 1.0\n\
         comment stria: points of the wall in world coordinates, mm\n\
         comment x along the travel, y down, z into the wall\n\
         comment {filler}\n\
         element vertex {count}\n\
         property float x\n\
         property float y\n\
         property float z\n\
         property uchar red\n\
         property uchar green\n\
         property uchar blue\n\
         property float confidence\n\
         property int frame\n\
         end_header\n"
    )
}

/// Reads a cloud that [`CloudPlyWriter`] wrote, point by point.
pub struct CloudPlyReader {
    path: PathBuf,
    file: BufReader<File>,
    points: u64,
    left: u64,
}

impl CloudPlyReader {
    /// Opens a cloud.
    ///
    /// # Errors
    /// Another header; another number of points than the header says.
    pub fn open(path: &Path) -> Result<CloudPlyReader> {
        let file = File::open(path).map_err(|e| Error::io(path, e))?;
        let bytes = file.metadata().map_err(|e| Error::io(path, e))?.len();
        let bad = |found: &str| Error::input(path.display().to_string(), found, "a cloud.ply of stria");
        let mut file = BufReader::with_capacity(1 << 20, file);
        let mut head = vec![0; header(0).len()];
        file.read_exact(&mut head).map_err(|_| bad("no header"))?;
        let text = std::str::from_utf8(&head).map_err(|_| bad("no header"))?;
        let points: u64 = text
            .lines()
            .find_map(|line| line.strip_prefix("element vertex "))
            .and_then(|count| count.parse().ok())
            .ok_or_else(|| bad("no number of points"))?;
        if header(points) != text {
            return Err(bad("another header"));
        }
        if points.checked_mul(POINT_BYTES as u64) != bytes.checked_sub(head.len() as u64) {
            return Err(bad("another number of points than its header says"));
        }
        Ok(CloudPlyReader { path: path.to_path_buf(), file, points, left: points })
    }

    /// The points in the file.
    pub fn points(&self) -> u64 {
        self.points
    }
}

impl Iterator for CloudPlyReader {
    type Item = Result<SurfacePoint>;

    fn next(&mut self) -> Option<Self::Item> {
        self.left = self.left.checked_sub(1)?;
        let mut bytes = [0; POINT_BYTES];
        let read = self.file.read_exact(&mut bytes);
        Some(read.map(|()| point(&bytes)).map_err(|e| Error::io(&self.path, e)))
    }
}

/// Reads a whole cloud.
///
/// # Errors
/// As [`CloudPlyReader::open`].
pub fn read(path: &Path) -> Result<Vec<SurfacePoint>> {
    CloudPlyReader::open(path)?.collect()
}

fn point(bytes: &[u8]) -> SurfacePoint {
    let four = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
    let coordinate = |at: usize| f64::from(f32::from_le_bytes(four(at)));
    SurfacePoint {
        point_in_world: nalgebra::Point3::new(coordinate(0), coordinate(4), coordinate(8)),
        rgb: [bytes[12], bytes[13], bytes[14]],
        confidence: f32::from_le_bytes(four(15)),
        frame: i32::from_le_bytes(four(19)) as u32,
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    #[test]
    fn points_come_back() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("cloud.ply");
        let points: Vec<SurfacePoint> = (0..1234)
            .map(|i| SurfacePoint {
                point_in_world: Point3::new(f64::from(i) * 0.5, -f64::from(i), 850.25),
                rgb: [i as u8, 1, 255],
                confidence: i as f32 / 2048.0,
                frame: i as u32 / 10,
            })
            .collect();
        let mut writer = CloudPlyWriter::create(&path).expect("create");
        for point in &points {
            writer.push(point).expect("push");
        }
        assert_eq!(writer.points(), 1234);
        assert!(!path.exists(), "not before it is complete");
        writer.finish().expect("finish");
        let read = CloudPlyReader::open(&path).expect("opens");
        assert_eq!(read.points(), 1234);
        assert_eq!(read.collect::<Result<Vec<_>>>().expect("reads"), points);
    }

    #[test]
    fn the_header_never_changes_its_length() {
        for count in [1, 999_999_999, u64::MAX / 23] {
            assert_eq!(header(count).len(), header(0).len());
        }
    }

    #[test]
    fn a_cut_file_is_refused() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("cloud.ply");
        let mut writer = CloudPlyWriter::create(&path).expect("create");
        let point = SurfacePoint { point_in_world: Point3::origin(), rgb: [0; 3], confidence: 0.0, frame: 0 };
        writer.push(&point).expect("push");
        writer.finish().expect("finish");
        let bytes = std::fs::read(&path).expect("read");
        std::fs::write(&path, &bytes[..bytes.len() - 1]).expect("cut");
        let refused = CloudPlyReader::open(&path).map(drop).expect_err("cut").to_string();
        assert!(refused.contains("another number of points"), "{refused}");
    }
}
