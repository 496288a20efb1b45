//! A track of poses given with the source, such as a robot's odometry: read from a CSV, asked frame by frame.
//!
//! The first line names the columns, in any order; columns with other names are ignored. A `trajectory.csv` of Stria's
//! own is such a file.
//!
//! | Columns | |
//! |---|---|
//! | `frame` or `time_s` | the source's frame, from 0, or the time since its first frame; `frame` counts where both are there |
//! | `x_mm`, `y_mm`, `z_mm` | where the camera is; or `x_m`, `y_m`, `z_m` in metres |
//! | `roll_deg`, `pitch_deg`, `yaw_deg` | how it is turned, `world_from_camera`: R = Ry(yaw)·Rx(pitch)·Rz(roll); may be missing |
//!
//! Empty fields are not known. A position without angles keeps the rotation of the row before; in a file without any
//! angles that is the rotation of the run's start, and the track's axes are taken for the world's.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::start_pose;
use crate::error::{Error, Result};
use crate::geometry::{WorldFromCamera, world_from_camera};
use crate::rig::LineDirection;

/// Largest file that is read, bytes.
pub const MAX_FILE_BYTES: u64 = 256 << 20;
/// Longest line, bytes.
pub const MAX_LINE_BYTES: u64 = 64 << 10;
/// Neighbouring rows further apart in time than this say nothing about what lies between them, s.
pub const MAX_STEP_S: f64 = 1.0;
/// How far from the first position another one may be, mm: further away the unit is wrong, and the map has no room.
pub const MAX_REACH_MM: f64 = 10e6;
/// Files round their times: a frame this little before the first row or after the last one is still theirs, s.
const TIME_SLACK_S: f64 = 0.000_6;
/// Rotations closer to half a turn than this have no way between them, radians.
const HALF_TURN_RAD: f64 = 1e-6;

const POSITION_MM: [&str; 3] = ["x_mm", "y_mm", "z_mm"];
const POSITION_M: [&str; 3] = ["x_m", "y_m", "z_m"];
const ANGLES: [&str; 3] = ["roll_deg", "pitch_deg", "yaw_deg"];

/// What the poses given with a source are for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TrackUse {
    /// They are the camera's poses; the image's motion is not looked for.
    #[default]
    Instead,
    /// They say where to look for the image's motion, and carry the pose on where it is lost.
    Prior,
}

/// A pose that the track gives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GivenPose {
    /// Where the camera is, in the track's own world.
    pub world_from_camera: WorldFromCamera,
    /// 6, or 3 where the track gives no angles.
    pub degrees_of_freedom: u8,
}

impl GivenPose {
    /// The way from `before` to `between` (1) `after`; `None` where they are half a turn apart.
    fn between(before: &GivenPose, after: &GivenPose, share: f64) -> Option<GivenPose> {
        let pose = before.world_from_camera.try_lerp_slerp(&after.world_from_camera, share, HALF_TURN_RAD)?;
        let degrees_of_freedom = before.degrees_of_freedom.min(after.degrees_of_freedom);
        Some(GivenPose { world_from_camera: pose, degrees_of_freedom })
    }
}

/// Poses over frames or over time.
#[derive(Clone, Debug)]
pub struct PoseTrack {
    by_frame: bool,
    rows: Vec<Row>,
}

#[derive(Clone, Debug)]
struct Row {
    /// The frame or the time, s.
    at: f64,
    pose: Option<GivenPose>,
}

impl PoseTrack {
    /// Reads a track of at most `max_rows` rows; `line` says how the run starts (lib.rs).
    ///
    /// # Errors
    /// A file that is too large or no text; a column that is missing or named twice; a field that is no number, a frame
    /// that does not rise, a time that falls, a position out of reach, half a position or half the angles; a file
    /// without any pose. The message names line, column, value and what was expected.
    pub fn read(path: &Path, line: LineDirection, max_rows: u32) -> Result<PoseTrack> {
        let name = path.display().to_string();
        let facts = std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
        if !facts.is_file() {
            return Err(Error::input(name, "no file", "a CSV file of poses"));
        }
        if facts.len() > MAX_FILE_BYTES {
            return Err(Error::input(
                name,
                format!("{} bytes", facts.len()),
                format!("at most {MAX_FILE_BYTES} bytes"),
            ));
        }
        let file = File::open(path).map_err(|e| Error::io(path, e))?;
        PoseTrack::parse(BufReader::new(file.take(MAX_FILE_BYTES)), &name, line, max_rows)
    }

    fn parse(mut text: impl BufRead, name: &str, line: LineDirection, max_rows: u32) -> Result<PoseTrack> {
        let mut lines = Lines { number: 0, text: String::new(), name };
        lines.next(&mut text)?;
        let columns = Columns::of(lines.text.trim_start_matches('\u{feff}').trim(), name)?;
        let mut reader = RowReader { columns, last_frame: None, last_time_s: None, first_position: None };
        let mut rows = Vec::new();
        while lines.next(&mut text)? {
            if lines.text.trim().is_empty() {
                continue;
            }
            if rows.len() == max_rows as usize {
                return Err(Error::input(name, format!("more than {max_rows} rows"), "no more (limits.max_frames)"));
            }
            let row = reader.row(lines.text.trim_end_matches(['\n', '\r']));
            rows.push(row.map_err(|problem| problem.at(name, lines.number))?);
        }
        if reader.first_position.is_none() {
            return Err(Error::input(name, format!("no pose in {} rows", rows.len()), "a row with a position"));
        }
        Ok(PoseTrack { by_frame: reader.columns.frame.is_some(), rows: with_rotations(rows, line) })
    }

    /// A track of poses at times since the run's first frame, s, which must not fall.
    pub fn from_times(poses: impl IntoIterator<Item = (f64, WorldFromCamera)>) -> PoseTrack {
        let row =
            |(at, world_from_camera)| Row { at, pose: Some(GivenPose { world_from_camera, degrees_of_freedom: 6 }) };
        PoseTrack { by_frame: false, rows: poses.into_iter().map(row).collect() }
    }

    /// The pose at a frame that was captured `time_s` after the first one; `None` where the track does not know it.
    ///
    /// By number exactly; by time between the rows before and after, the position on the straight way and the
    /// rotation on the shortest, where they are no further apart than [`MAX_STEP_S`].
    pub fn at(&self, frame: u32, time_s: f64) -> Option<GivenPose> {
        if self.by_frame {
            let found = self.rows.binary_search_by(|row| row.at.total_cmp(&f64::from(frame))).ok()?;
            return self.rows[found].pose;
        }
        let next = self.rows.partition_point(|row| row.at <= time_s);
        let known = |row: &Row| row.pose.map(|pose| (row.at, pose));
        let before = next.checked_sub(1).and_then(|i| known(&self.rows[i]));
        let after = self.rows.get(next).and_then(known);
        if let (Some((from_s, before)), Some((to_s, after))) = (before, after)
            && to_s - from_s <= MAX_STEP_S
        {
            return GivenPose::between(&before, &after, (time_s - from_s) / (to_s - from_s));
        }
        let near = |known: Option<(f64, GivenPose)>| known.filter(|(at_s, _)| (at_s - time_s).abs() <= TIME_SLACK_S);
        near(before).or(near(after)).map(|(_, pose)| pose)
    }

    /// From where to where it goes, in words.
    pub fn reach(&self) -> String {
        let known = || self.rows.iter().filter(|row| row.pose.is_some()).map(|row| row.at);
        let (first, last) = (known().next().unwrap_or_default(), known().next_back().unwrap_or_default());
        if self.by_frame { format!("frames {first} to {last}") } else { format!("{first:.3} s to {last:.3} s") }
    }
}

/// The lines of a file, counted.
struct Lines<'a> {
    number: usize,
    text: String,
    name: &'a str,
}

impl Lines<'_> {
    /// Reads the next line into `text`; false at the end.
    fn next(&mut self, from: &mut impl BufRead) -> Result<bool> {
        self.number += 1;
        self.text.clear();
        let (name, number) = (self.name, self.number);
        let bad = |found: String| Err(Error::input(format!("{name}, line {number}"), found, "lines of a CSV file"));
        match from.take(MAX_LINE_BYTES).read_line(&mut self.text) {
            Ok(bytes) if bytes as u64 == MAX_LINE_BYTES => bad(format!("{bytes} bytes or more in one line")),
            Ok(bytes) => Ok(bytes > 0),
            Err(e) if e.kind() == std::io::ErrorKind::InvalidData => bad("no UTF-8 text".into()),
            Err(e) => Err(Error::io(self.name, e)),
        }
    }
}

/// A named column's place in each line.
#[derive(Clone, Copy, Debug)]
struct Column {
    name: &'static str,
    at: usize,
}

/// Where the columns are.
#[derive(Clone, Debug)]
struct Columns {
    count: usize,
    frame: Option<Column>,
    time_s: Option<Column>,
    position: [Column; 3],
    mm_per_unit: f64,
    angles: Option<[Column; 3]>,
}

impl Columns {
    fn of(header: &str, file: &str) -> Result<Columns> {
        let names: Vec<&str> = header.split(',').map(str::trim).collect();
        let place = format!("{file}, line 1");
        let find = |name: &'static str| -> Result<Option<Column>> {
            let mut found = names.iter().enumerate().filter(|(_, n)| **n == name).map(|(at, _)| Column { name, at });
            let first = found.next();
            match found.next() {
                Some(_) => Err(Error::field(&place, name, "there twice", "each column once")),
                None => Ok(first),
            }
        };
        // All three, none, or an error that names the first that is missing.
        let three = |wanted: [&'static str; 3]| -> Result<Option<[Column; 3]>> {
            match [find(wanted[0])?, find(wanted[1])?, find(wanted[2])?] {
                [Some(a), Some(b), Some(c)] => Ok(Some([a, b, c])),
                [None, None, None] => Ok(None),
                some => {
                    let missing =
                        wanted.iter().zip(some).find(|(_, found)| found.is_none()).map_or("", |(name, _)| name);
                    Err(Error::field(&place, missing, "missing", format!("the columns {}", wanted.join(", "))))
                }
            }
        };
        let (position, mm_per_unit) = match (three(POSITION_MM)?, three(POSITION_M)?) {
            (Some(mm), _) => (mm, 1.0),
            (None, Some(m)) => (m, 1000.0),
            (None, None) => {
                let expected = "a header line with x_mm, y_mm, z_mm (or x_m, y_m, z_m) and frame or time_s";
                return Err(Error::input(place, format!("`{}`", shortened(header)), expected));
            }
        };
        let (frame, time_s) = (find("frame")?, find("time_s")?);
        if frame.is_none() && time_s.is_none() {
            return Err(Error::input(place, "neither frame nor time_s", "one of them, to say when each pose was"));
        }
        Ok(Columns { count: names.len(), frame, time_s, position, mm_per_unit, angles: three(ANGLES)? })
    }
}

/// What is wrong in a line.
struct Problem {
    column: &'static str,
    found: String,
    expected: String,
}

impl Problem {
    fn new(column: &'static str, found: impl Into<String>, expected: impl Into<String>) -> Problem {
        Problem { column, found: found.into(), expected: expected.into() }
    }

    fn at(self, file: &str, line: usize) -> Error {
        let place = format!("{file}, line {line}");
        match self.column {
            "" => Error::input(place, self.found, self.expected),
            column => Error::field(place, column, self.found, self.expected),
        }
    }
}

/// Reads row after row.
struct RowReader {
    columns: Columns,
    last_frame: Option<u32>,
    last_time_s: Option<f64>,
    first_position: Option<Vector3<f64>>,
}

impl RowReader {
    fn row(&mut self, line: &str) -> std::result::Result<Row, Problem> {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        if fields.len() != self.columns.count {
            let expected = format!("{} fields as the first line has", self.columns.count);
            return Err(Problem::new("", format!("{} fields", fields.len()), expected));
        }
        let time_s = self.time_s(&fields)?;
        let at = match (self.columns.frame, time_s) {
            (Some(column), _) => f64::from(self.frame(column, fields[column.at])?),
            (None, Some(time_s)) => time_s,
            (None, None) => return Err(Problem::new("time_s", "empty", "a time since the source's first frame, s")),
        };
        let Some(position) = three(&fields, &self.columns.position)? else { return Ok(Row { at, pose: None }) };
        let position_mm = Vector3::from(position) * self.columns.mm_per_unit;
        self.check_reach(position_mm)?;
        let angles = match &self.columns.angles {
            Some(columns) => three(&fields, columns)?,
            None => None,
        };
        let [roll, pitch, yaw] = angles.unwrap_or_default().map(f64::to_radians);
        let pose = GivenPose {
            world_from_camera: world_from_camera(position_mm, roll, pitch, yaw),
            degrees_of_freedom: if angles.is_some() { 6 } else { 3 },
        };
        Ok(Row { at, pose: Some(pose) })
    }

    fn frame(&mut self, column: Column, field: &str) -> std::result::Result<u32, Problem> {
        let bad = |_| Problem::new(column.name, format!("`{}`", shortened(field)), "a frame's number, from 0");
        let frame: u32 = field.parse().map_err(bad)?;
        if let Some(last) = self.last_frame.replace(frame).filter(|last| frame <= *last) {
            return Err(Problem::new(column.name, format!("{frame} after {last}"), "rising numbers"));
        }
        Ok(frame)
    }

    fn time_s(&mut self, fields: &[&str]) -> std::result::Result<Option<f64>, Problem> {
        let Some(column) = self.columns.time_s else { return Ok(None) };
        let Some(time_s) = number(fields, column)? else { return Ok(None) };
        if let Some(last) = self.last_time_s.replace(time_s).filter(|last| time_s < *last) {
            return Err(Problem::new(column.name, format!("{time_s} s after {last} s"), "times that never fall"));
        }
        Ok(Some(time_s))
    }

    fn check_reach(&mut self, position_mm: Vector3<f64>) -> std::result::Result<(), Problem> {
        let first = *self.first_position.get_or_insert(position_mm);
        let Some(axis) = (0..3).find(|axis| (position_mm[*axis] - first[*axis]).abs() > MAX_REACH_MM) else {
            return Ok(());
        };
        let expected = format!("within {} km of the first position, {} mm", MAX_REACH_MM / 1e6, first[axis]);
        Err(Problem::new(self.columns.position[axis].name, format!("{} mm", position_mm[axis]), expected))
    }
}

/// A field as a number; `None` where it is empty.
fn number(fields: &[&str], column: Column) -> std::result::Result<Option<f64>, Problem> {
    let field = fields[column.at];
    if field.is_empty() {
        return Ok(None);
    }
    let value = field.parse().ok().filter(|value: &f64| value.is_finite());
    value.map(Some).ok_or_else(|| Problem::new(column.name, format!("`{}`", shortened(field)), "a number, or nothing"))
}

/// Three fields that are known together or not at all.
fn three(fields: &[&str], columns: &[Column; 3]) -> std::result::Result<Option<[f64; 3]>, Problem> {
    let values = [number(fields, columns[0])?, number(fields, columns[1])?, number(fields, columns[2])?];
    match values {
        [Some(a), Some(b), Some(c)] => Ok(Some([a, b, c])),
        [None, None, None] => Ok(None),
        _ => {
            let empty =
                columns.iter().zip(values).find(|(_, value)| value.is_none()).map_or("", |(column, _)| column.name);
            let names = columns.map(|column| column.name).join(", ");
            Err(Problem::new(empty, "empty", format!("a number, or nothing in all of {names}")))
        }
    }
}

/// Gives positions without angles the rotation of the row before (before the first angles: those; without any: the
/// start's).
fn with_rotations(mut rows: Vec<Row>, line: LineDirection) -> Vec<Row> {
    let angles = |row: &Row| row.pose.filter(|p| p.degrees_of_freedom == 6).map(|p| p.world_from_camera.rotation);
    let mut rotation: UnitQuaternion<f64> =
        rows.iter().find_map(angles).unwrap_or_else(|| start_pose(line).inverse().rotation);
    for row in &mut rows {
        match (angles(row), &mut row.pose) {
            (Some(own), _) => rotation = own,
            (None, Some(pose)) => pose.world_from_camera.rotation = rotation,
            (None, None) => {}
        }
    }
    rows
}

/// The beginning of a text that may be anything.
fn shortened(text: &str) -> String {
    const LONGEST: usize = 80;
    if text.chars().count() <= LONGEST { text.into() } else { text.chars().take(LONGEST).chain(['…']).collect() }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    fn track(text: &str) -> Result<PoseTrack> {
        PoseTrack::parse(text.as_bytes(), "track.csv", LineDirection::Vertical, 100)
    }

    fn message(text: &str) -> String {
        track(text).expect_err(text).to_string()
    }

    fn position(track: &PoseTrack, frame: u32, time_s: f64) -> Option<[f64; 3]> {
        track.at(frame, time_s).map(|pose| pose.world_from_camera.translation.vector.into())
    }

    #[test]
    fn frames_are_found_by_their_number_and_holes_stay_holes() {
        let text = "frame,time_s,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n\
                    0,0.0,1,2,3,0,0,90\n1,0.1,,,,,,\n2,0.2,4,5,6,10,-20,30\n\n5,0.5,7,8,9,,,\n";
        let track = track(text).expect("a track");
        assert_eq!(position(&track, 0, 9.0), Some([1.0, 2.0, 3.0]), "the time does not count");
        let pose = track.at(2, 0.2).expect("known");
        let expected =
            world_from_camera(Vector3::new(4.0, 5.0, 6.0), 10f64.to_radians(), -20f64.to_radians(), 30f64.to_radians());
        assert!(pose.world_from_camera.rotation.angle_to(&expected.rotation) < 1e-12);
        for frame in [1, 3, 4, 6] {
            assert_eq!(track.at(frame, 0.0), None, "frame {frame}");
        }
        let without_angles = track.at(5, 0.5).expect("known");
        assert_eq!((pose.degrees_of_freedom, without_angles.degrees_of_freedom), (6, 3));
        assert_eq!(without_angles.world_from_camera.rotation, pose.world_from_camera.rotation);
        assert_eq!(track.reach(), "frames 0 to 5");
    }

    #[test]
    fn columns_come_in_any_order_and_others_are_ignored() {
        let text = "\u{feff}yaw_deg, battery ,z_mm,x_mm,pitch_deg,frame,y_mm,roll_deg\r\n0,full,3,1,0,7,2,90\r\n";
        let track = track(text).expect("a track");
        assert_eq!(position(&track, 7, 0.0), Some([1.0, 2.0, 3.0]));
        let pose = track.at(7, 0.0).expect("known").world_from_camera;
        assert!((pose.rotation.angle() - FRAC_PI_2).abs() < 1e-12);
        assert!((pose.rotation * Vector3::x() - Vector3::y()).norm() < 1e-12, "roll is about z");
    }

    #[test]
    fn between_times_the_way_is_straight_and_the_turn_even() {
        let text = "time_s,x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n\
                    -0.5,0,0,0,0,0,350\n0.5,0.1,0.02,-0.004,0,0,10\n2.0,1,0,0,0,0,0\n2.5,,,,,,\n3.0,1,0,0,0,0,0\n";
        let track = track(text).expect("a track");
        let middle = track.at(0, 0.25).expect("between").world_from_camera;
        assert!((middle.translation.vector - Vector3::new(75.0, 15.0, -3.0)).norm() < 1e-9, "metres become mm");
        assert!((middle.rotation.angle() - 5f64.to_radians()).abs() < 1e-9, "the short way, through 0");
        assert_eq!(position(&track, 0, 1.0), None, "the neighbours are 1.5 s apart");
        assert_eq!(position(&track, 0, 2.0), Some([1000.0, 0.0, 0.0]), "a row's own time");
        assert_eq!(position(&track, 0, 2.2), None, "the row after is not known");
        assert_eq!(position(&track, 0, 3.0 + 0.000_4), Some([1000.0, 0.0, 0.0]), "rounded times");
        assert_eq!(position(&track, 0, 3.1), None, "after the end");
        assert_eq!(track.reach(), "-0.500 s to 3.000 s");
    }

    #[test]
    fn without_angles_the_camera_stays_turned_as_at_the_start() {
        for line in [LineDirection::Vertical, LineDirection::Horizontal] {
            let track = PoseTrack::parse("frame,x_mm,y_mm,z_mm\n0,0,0,0\n1,5,0,0\n".as_bytes(), "t", line, 10);
            let pose = track.expect("a track").at(1, 0.0).expect("known");
            assert_eq!(pose.world_from_camera.rotation, start_pose(line).inverse().rotation);
            assert_eq!(pose.degrees_of_freedom, 3);
        }
    }

    #[test]
    fn errors_name_line_column_value_and_what_was_expected() {
        let head = "time_s,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n";
        for (rows, expected) in [
            ("0,0,0,0,0,0,0\n0.1,1,two,0,0,0,0\n", "line 3: y_mm is `two`; expected a number"),
            ("0,inf,0,0,0,0,0\n", "line 2: x_mm is `inf`; expected a number"),
            ("NaN,0,0,0,0,0,0\n", "line 2: time_s is `NaN`; expected a number"),
            (
                "0.2,0,0,0,0,0,0\n\n0.1,0,0,0,0,0,0\n",
                "line 4: time_s is 0.1 s after 0.2 s; expected times that never fall",
            ),
            (",0,0,0,0,0,0\n", "line 2: time_s is empty; expected a time"),
            ("0,0,,0,0,0,0\n", "line 2: y_mm is empty; expected a number, or nothing in all of x_mm, y_mm, z_mm"),
            ("0,0,0,0,0,0,\n", "line 2: yaw_deg is empty"),
            ("0,0,0,0\n", "line 2: 4 fields; expected 7 fields"),
            ("0,0,0,0,0,0,0\n1,0,0,2e7,0,0,0\n", "line 3: z_mm is 20000000 mm; expected within 10 km"),
            ("0,,,,,,\n", "no pose in 1 rows"),
        ] {
            let message = message(&format!("{head}{rows}"));
            assert!(message.starts_with("track.csv") && message.contains(expected), "{message}");
        }
    }

    #[test]
    fn headers_that_do_not_do_are_refused() {
        for (text, expected) in [
            ("", "expected a header line"),
            ("1,2,3,4\n", "line 1: `1,2,3,4`; expected a header line with x_mm"),
            ("frame,x_mm,z_mm\n", "line 1: y_mm is missing; expected the columns x_mm, y_mm, z_mm"),
            ("x_mm,y_mm,z_mm\n", "neither frame nor time_s"),
            ("frame,x_mm,y_mm,z_mm,yaw_deg\n", "roll_deg is missing"),
            ("frame,x_mm,y_mm,z_mm,x_mm\n", "x_mm is there twice"),
        ] {
            let message = message(text);
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn frames_rise_and_rows_are_bounded() {
        let head = "frame,x_mm,y_mm,z_mm\n";
        let falling = message(&format!("{head}3,0,0,0\n3,0,0,0\n"));
        assert!(falling.contains("line 3: frame is 3 after 3; expected rising numbers"), "{falling}");
        let negative = message(&format!("{head}-1,0,0,0\n"));
        assert!(negative.contains("frame is `-1`"), "{negative}");
        let rows: String = (0..101).map(|frame| format!("{frame},0,0,0\n")).collect();
        let many = message(&format!("{head}{rows}"));
        assert!(many.contains("more than 100 rows") && many.contains("limits.max_frames"), "{many}");
    }

    #[test]
    fn what_is_no_text_is_refused() {
        let refused = PoseTrack::parse(&b"frame,x_mm\xff\n"[..], "video.mp4", LineDirection::Vertical, 10);
        assert!(refused.expect_err("no text").to_string().contains("no UTF-8 text"));
        let long = message(&",".repeat(1 << 20));
        assert!(long.contains("line 1: 65536 bytes or more in one line"), "{long}");
        let folder = tempfile::tempdir().expect("temporary folder");
        let refused = PoseTrack::read(folder.path(), LineDirection::Vertical, 10).expect_err("a folder");
        assert_eq!(refused.kind(), "bad_input", "{refused}");
    }
}
