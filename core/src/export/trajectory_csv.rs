//! `trajectory.csv`: one line a frame; what was not determined is empty.

use std::fmt::Write;
use std::path::Path;

use nalgebra::Vector3;

use crate::error::{Error, Result};
use crate::export::new_file::NewFile;
use crate::geometry::{WorldFromCamera, roll_pitch_yaw, world_from_camera};

/// The first line.
pub const HEADER: &str = "frame,time_s,dx_px,dy_px,scale,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg,\
                          rows_found,tracked,residual_px";

/// One frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrajectoryRow {
    /// Position in the run, from 0.
    pub frame: u32,
    /// Capture time since the first frame, s.
    pub time_s: f64,
    /// Shift of the image's content along the columns since the previous frame, px.
    pub dx_px: Option<f64>,
    /// Shift along the rows, px.
    pub dy_px: Option<f64>,
    /// Scale of the image since the previous frame.
    pub scale: Option<f64>,
    /// Where the camera was.
    pub world_from_camera: Option<WorldFromCamera>,
    /// Whether the pose's rotation was measured; else its angles stay empty.
    pub rotation_determined: bool,
    /// Line positions where the laser line was found.
    pub rows_found: u32,
    /// Corners that were followed from the previous frame; 0 on the first frame and where the motion was lost.
    pub tracked: u32,
    /// Median distance of the corners from the fitted motion, px.
    pub residual_px: Option<f64>,
}

/// Writes rows one after the other.
pub struct TrajectoryWriter {
    file: NewFile,
}

impl TrajectoryWriter {
    /// Starts the file.
    pub fn create(path: &Path) -> Result<TrajectoryWriter> {
        let mut file = NewFile::create(path)?;
        file.put(HEADER.as_bytes())?;
        file.put(b"\n")?;
        Ok(TrajectoryWriter { file })
    }

    /// Appends a row.
    pub fn push(&mut self, row: &TrajectoryRow) -> Result<()> {
        self.file.put(line(row).as_bytes())
    }

    /// Gives the file its name.
    pub fn finish(self) -> Result<()> {
        self.file.commit()
    }
}

fn line(row: &TrajectoryRow) -> String {
    let mut line = format!("{},{:.6}", row.frame, row.time_s);
    for (value, decimals) in [(row.dx_px, 4), (row.dy_px, 4), (row.scale, 8)] {
        push_value(&mut line, value, decimals);
    }
    let position = row.world_from_camera.map(|pose| pose.translation.vector);
    for axis in 0..3 {
        push_value(&mut line, position.map(|p| p[axis]), 4);
    }
    let angles_deg = row.world_from_camera.filter(|_| row.rotation_determined).map(|pose| {
        let (roll, pitch, yaw) = roll_pitch_yaw(&pose);
        [roll, pitch, yaw].map(f64::to_degrees)
    });
    for angle in 0..3 {
        push_value(&mut line, angles_deg.map(|a| a[angle]), 6);
    }
    let _ = write!(line, ",{},{}", row.rows_found, row.tracked);
    push_value(&mut line, row.residual_px, 4);
    line.push('\n');
    line
}

/// A comma and the value; without trailing minus zero, and empty where it is not a number.
fn push_value(line: &mut String, value: Option<f64>, decimals: usize) {
    line.push(',');
    if let Some(value) = value.filter(|v| v.is_finite()) {
        let text = format!("{value:.decimals$}");
        let is_zero = text.bytes().all(|b| matches!(b, b'-' | b'0' | b'.'));
        line.push_str(if is_zero { text.trim_start_matches('-') } else { &text });
    }
}

/// Reads a trajectory back, to the decimals that the file holds.
///
/// # Errors
/// Another first line; a line with another number of fields, or a field that is not a number: the message
/// names the line and the column.
pub fn read(path: &Path) -> Result<Vec<TrajectoryRow>> {
    let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, e))?;
    let mut lines = text.lines();
    if lines.next() != Some(HEADER) {
        return Err(Error::input(path.display().to_string(), "another first line", format!("`{HEADER}`")));
    }
    lines.enumerate().map(|(index, line)| parse(line, &format!("{}, line {}", path.display(), index + 2))).collect()
}

fn parse(line: &str, place: &str) -> Result<TrajectoryRow> {
    let names: Vec<&str> = HEADER.split(',').collect();
    let fields: Vec<&str> = line.split(',').collect();
    if fields.len() != names.len() {
        return Err(Error::input(place, format!("{} fields", fields.len()), format!("{} fields", names.len())));
    }
    let optional = |at: usize| -> Result<Option<f64>> {
        if fields[at].is_empty() {
            return Ok(None);
        }
        let bad = |_| Error::field(place, names[at], format!("`{}`", fields[at]), "a number, or nothing");
        fields[at].parse().map(Some).map_err(bad)
    };
    let whole = |at: usize| -> Result<u32> {
        fields[at].parse().map_err(|_| Error::field(place, names[at], format!("`{}`", fields[at]), "a whole number"))
    };
    let mut pose = [None; 6];
    for (slot, at) in pose.iter_mut().zip(5..11) {
        *slot = optional(at)?;
    }
    let known = pose[..3].iter().all(Option::is_some);
    let rotation_determined = known && pose[3..].iter().all(Option::is_some);
    let [x, y, z, roll, pitch, yaw] = pose.map(Option::unwrap_or_default);
    Ok(TrajectoryRow {
        frame: whole(0)?,
        time_s: optional(1)?.unwrap_or_default(),
        dx_px: optional(2)?,
        dy_px: optional(3)?,
        scale: optional(4)?,
        world_from_camera: known
            .then(|| world_from_camera(Vector3::new(x, y, z), roll.to_radians(), pitch.to_radians(), yaw.to_radians())),
        rotation_determined,
        rows_found: whole(11)?,
        tracked: whole(12)?,
        residual_px: optional(13)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_come_back_and_what_is_unknown_stays_empty() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("trajectory.csv");
        let first = TrajectoryRow { frame: 0, rows_found: 700, ..TrajectoryRow::default() };
        let second = TrajectoryRow {
            frame: 1,
            time_s: 0.033_333,
            dx_px: Some(-12.25),
            dy_px: Some(-0.000_01),
            scale: Some(1.000_5),
            world_from_camera: Some(world_from_camera(Vector3::new(6.5, -1.0, 2.0), 0.01, -0.02, 0.03)),
            rotation_determined: true,
            rows_found: 699,
            tracked: 98,
            residual_px: Some(0.125),
        };
        let mut writer = TrajectoryWriter::create(&path).expect("create");
        writer.push(&first).expect("push");
        writer.push(&second).expect("push");
        writer.finish().expect("finish");

        let text = std::fs::read_to_string(&path).expect("read");
        assert_eq!(text.lines().nth(1), Some("0,0.000000,,,,,,,,,,700,0,"));
        assert!(text.lines().nth(2).expect("line").starts_with("1,0.033333,-12.2500,0.0000,1.00050000,6.5000,"));
        let rows = read(&path).expect("read");
        assert_eq!(rows[0], first);
        let (pose, truth) = (rows[1].world_from_camera.expect("pose"), second.world_from_camera.expect("pose"));
        assert!((pose.translation.vector - truth.translation.vector).norm() < 1e-4);
        assert!(pose.rotation.angle_to(&truth.rotation) < 1e-7);
        assert_eq!((rows[1].dx_px, rows[1].tracked, rows[1].residual_px), (Some(-12.25), 98, Some(0.125)));
    }

    #[test]
    fn a_broken_field_is_named() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("trajectory.csv");
        std::fs::write(&path, format!("{HEADER}\n0,0.0,left,,,,,,,,,1,2,\n")).expect("write");
        let message = read(&path).expect_err("not a number").to_string();
        assert!(message.contains("line 2") && message.contains("dx_px is `left`"), "{message}");
    }
}
