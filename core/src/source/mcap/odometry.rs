//! A robot's own odometry in the file → poses of the camera.

use std::collections::{HashMap, HashSet, VecDeque};
use std::path::PathBuf;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use super::cdr::{BadCdr, Cdr};
use super::messages::{CameraFacts, Role, camera, role};
use crate::error::{Error, Result};
use crate::mcap_file::{Record, Records};
use crate::source::TimedPose;

/// Poses that are read, at most: at 200 a second, an hour and a half.
const MAX_POSES: usize = 1 << 20;
/// Fixed transforms that are read, at most.
const MAX_TRANSFORMS: usize = 10_000;

/// What lies beside the images.
#[derive(Default)]
pub(super) struct Found {
    pub poses: Vec<TimedPose>,
    pub camera: Option<CameraFacts>,
    pub warnings: Vec<String>,
}

/// Where to look.
pub(super) struct Wanted<'a> {
    pub odometry: Option<&'a str>,
    pub camera: Option<&'a str>,
    /// The camera's frame of reference.
    pub camera_frame: &'a str,
    /// Capture time of the first image, ns: times count from there.
    pub start_ns: u64,
}

/// Reads the file through for them.
pub(super) fn read(paths: &[PathBuf], name: &str, wanted: &Wanted<'_>) -> Result<Found> {
    let mut found = Found::default();
    if wanted.odometry.is_none() && wanted.camera.is_none() {
        return Ok(found);
    }
    let mut records = Records::open(paths, name)?;
    let mut fixed = Fixed::default();
    let mut track = Track { start_ns: wanted.start_ns, ..Track::default() };
    let mut camera_found = wanted.camera.is_none();
    while let Some(record) = records.next(|topic| match role(topic) {
        Some(Role::Odometry) => wanted.odometry == Some(topic.name.as_str()),
        Some(Role::FixedTransforms) => wanted.odometry.is_some(),
        Some(Role::Camera) => wanted.camera == Some(topic.name.as_str()),
        _ => false,
    })? {
        let Record::Message(message) = record else { continue };
        let outcome = match role(&message.topic) {
            Some(Role::Odometry) => track.add(&message.data).map_err(|BadCdr(what)| what.to_string()),
            Some(Role::FixedTransforms) => fixed.add(&message.data).map_err(|BadCdr(what)| what.to_string()),
            Some(Role::Camera) if !camera_found => {
                camera_found = true;
                camera(&message).map(|facts| found.camera = Some(facts))
            }
            _ => Ok(()),
        };
        if let Err(what) = outcome
            && found.warnings.is_empty()
        {
            found.warnings.push(format!("{name}: a message of {} cannot be read: {what}", message.topic.name));
        }
        if camera_found && wanted.odometry.is_none() {
            return Ok(found);
        }
    }
    if let Some(topic) = wanted.odometry {
        match track.in_camera(&fixed, wanted.camera_frame) {
            Ok(poses) => found.poses = poses,
            Err(why) => found.warnings.push(format!("{name}: the odometry of {topic} was not used: {why}")),
        }
    }
    Ok(found)
}

const CSV_HEADER: &str = "time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw";

/// Poses as text, from which every bit comes back.
pub(crate) fn to_csv(poses: &[TimedPose]) -> String {
    let mut text = format!("{CSV_HEADER}\n");
    for TimedPose { time_s, world_from_camera } in poses {
        let (t, q) = (world_from_camera.translation.vector, world_from_camera.rotation.coords);
        text += &format!("{time_s},{},{},{},{},{},{},{}\n", t.x, t.y, t.z, q.x, q.y, q.z, q.w);
    }
    text
}

/// Reads what [`to_csv`] wrote.
pub(super) fn from_csv(text: &[u8], name: &str) -> Result<Vec<TimedPose>> {
    let bad = |what: &str| Error::input(format!("{name}, odometry.csv"), what.to_string(), CSV_HEADER);
    let text = std::str::from_utf8(text).map_err(|_| bad("no text"))?;
    let mut lines = text.lines();
    if lines.next() != Some(CSV_HEADER) {
        return Err(bad("another first line"));
    }
    let pose = |line: &str| {
        let values: Vec<f64> = line.split(',').map_while(|field| field.parse().ok()).collect();
        let [time_s, x, y, z, i, j, k, w] = values[..] else { return Err(bad(line)) };
        let rotation = UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k));
        let world_from_camera = Isometry3::from_parts(Translation3::new(x, y, z), rotation);
        Ok(TimedPose { time_s, world_from_camera })
    };
    lines.take(MAX_POSES).map(pose).collect()
}

/// The odometry as the robot gives it.
#[derive(Default)]
struct Track {
    start_ns: u64,
    /// Of the first message: whose pose it is.
    child_frame: String,
    /// Time since the start, s, and where the child frame is in the odometry's own world, metres.
    poses: Vec<(f64, Isometry3<f64>)>,
}

impl Track {
    fn add(&mut self, bytes: &[u8]) -> std::result::Result<(), BadCdr> {
        let mut cdr = Cdr::new(bytes)?;
        let Some(time_ns) = cdr.time_ns()? else { return Err(BadCdr("a pose without a time stamp")) };
        let (_frame, child) = (cdr.text()?, cdr.text()?);
        let pose = isometry(&mut cdr)?;
        let time_s = (i128::from(time_ns) - i128::from(self.start_ns)) as f64 / 1e9;
        if self.poses.last().is_some_and(|(before_s, _)| time_s < *before_s) || self.poses.len() == MAX_POSES {
            return Ok(());
        }
        if self.poses.is_empty() {
            self.child_frame = child;
        }
        self.poses.push((time_s, pose));
        Ok(())
    }

    fn in_camera(self, fixed: &Fixed, camera_frame: &str) -> std::result::Result<Vec<TimedPose>, String> {
        let Some(child_from_camera) = fixed.between(&self.child_frame, camera_frame) else {
            return Err(format!(
                "no fixed transform leads from `{}` to the camera's `{camera_frame}`; expected one in /tf_static",
                self.child_frame
            ));
        };
        let pose = |(time_s, odom_from_child): (f64, Isometry3<f64>)| {
            let mut world_from_camera = odom_from_child * child_from_camera;
            world_from_camera.translation.vector *= 1000.0;
            TimedPose { time_s, world_from_camera }
        };
        Ok(self.poses.into_iter().map(pose).collect())
    }
}

/// How the robot's parts are fixed to each other: parent from child, metres.
#[derive(Default)]
struct Fixed {
    links: Vec<(String, String, Isometry3<f64>)>,
}

impl Fixed {
    fn add(&mut self, bytes: &[u8]) -> std::result::Result<(), BadCdr> {
        let mut cdr = Cdr::new(bytes)?;
        for _ in 0..cdr.u32()? {
            let _stamp = cdr.time_ns()?;
            let (parent, child) = (plain(&cdr.text()?), plain(&cdr.text()?));
            let parent_from_child = isometry(&mut cdr)?;
            if self.links.len() < MAX_TRANSFORMS {
                self.links.push((parent, child, parent_from_child));
            }
        }
        Ok(())
    }

    /// `to` in `from`, over any number of links.
    fn between(&self, from: &str, to: &str) -> Option<Isometry3<f64>> {
        let (from, to) = (plain(from), plain(to));
        let mut next: HashMap<&str, Vec<(&str, Isometry3<f64>)>> = HashMap::new();
        for (parent, child, parent_from_child) in &self.links {
            next.entry(parent).or_default().push((child, *parent_from_child));
            next.entry(child).or_default().push((parent, parent_from_child.inverse()));
        }
        let mut seen = HashSet::from([from.as_str()]);
        let mut waiting = VecDeque::from([(from.as_str(), Isometry3::identity())]);
        while let Some((here, from_here)) = waiting.pop_front() {
            if here == to {
                return Some(from_here);
            }
            for (there, here_from_there) in next.get(here).into_iter().flatten() {
                if seen.insert(there) {
                    waiting.push_back((there, from_here * here_from_there));
                }
            }
        }
        None
    }
}

/// A frame's name without ROS 1's leading stroke.
fn plain(frame: &str) -> String {
    frame.trim_start_matches('/').to_string()
}

/// `geometry_msgs/Pose` and `geometry_msgs/Transform`: a position, then a quaternion x y z w.
fn isometry(cdr: &mut Cdr<'_>) -> std::result::Result<Isometry3<f64>, BadCdr> {
    let [x, y, z] = cdr.f64s()?;
    let [i, j, k, w] = cdr.f64s()?;
    let rotation = Quaternion::new(w, i, j, k);
    let sane = [x, y, z, i, j, k, w].iter().all(|v| v.is_finite()) && rotation.norm() > 1e-6;
    if !sane {
        return Err(BadCdr("a pose that is no number, or without a rotation"));
    }
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(rotation)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn every_bit_of_a_pose_comes_back_from_its_text() {
        let pose = |i: f64| TimedPose {
            time_s: i / 3.0 - 0.1,
            world_from_camera: Isometry3::new(Vector3::new(0.1 * i, 1e7 / 7.0, -1e-9), Vector3::new(0.1, i, 0.3)),
        };
        let poses: Vec<TimedPose> = (0..50).map(f64::from).map(pose).collect();
        assert_eq!(from_csv(to_csv(&poses).as_bytes(), "run").expect("reads"), poses);
        assert!(from_csv(b"time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw\n1,2,3\n", "run").is_err());
    }

    #[test]
    fn fixed_transforms_lead_over_several_links_both_ways() {
        let link = |x: f64| Isometry3::translation(x, 0.0, 0.0);
        let turned = Isometry3::rotation(Vector3::z() * std::f64::consts::FRAC_PI_2);
        let links = vec![
            ("base".to_string(), "mast".to_string(), link(1.0)),
            ("mast".into(), "optical".into(), turned),
            ("mast".into(), "lamp".into(), link(7.0)),
        ];
        let fixed = Fixed { links };
        let found = fixed.between("/base", "optical").expect("a way");
        assert!((found.translation.vector - Vector3::x()).norm() < 1e-12);
        let back = fixed.between("optical", "base").expect("a way");
        assert!(((found * back).translation.vector).norm() < 1e-12);
        assert!(fixed.between("base", "elsewhere").is_none());
        assert_eq!(fixed.between("only", "only"), Some(Isometry3::identity()));
    }
}
