//! How the robot moves: the camera's pose at every moment.

use nalgebra::Vector3;

use super::noise::Stream;
use crate::geometry::{WorldFromCamera, world_from_camera};

/// A way of moving along the wall.
#[derive(Clone, Debug, PartialEq)]
pub enum Motion {
    /// A rail: constant speed and nothing else.
    Steady,
    /// Wheels: constant speed, small smooth deviations along y and z (± 0.5 mm) and about all axes (± 0.03°).
    Wheels,
    /// Four legs: ± 6 mm along y at 2 Hz, ± 8 mm along z at 1.5 Hz, ± 0.5° of roll and yaw, ± 2 mm along x.
    Gait,
    /// Wheels that drive 1.2 s, stand still for 0.8 s, go back for 0.6 s and drive on; again every 4 s.
    Stop,
    /// One pose for each frame; the last one holds from there on.
    Poses(Vec<WorldFromCamera>),
}

/// The camera's path of one run.
#[derive(Clone, Debug)]
pub(super) struct Trajectory {
    motion: Motion,
    speed_mm_s: f64,
    fps: f64,
    /// Turn of the camera about its axis that lays the rig's laser line across the travel, radians.
    base_roll_rad: f64,
    /// One sum of sines for x, y, z (mm), roll, pitch, yaw (radians).
    sways: [Vec<Sine>; 6],
}

#[derive(Clone, Copy, Debug)]
struct Sine {
    height: f64,
    rad_per_s: f64,
    phase_rad: f64,
}

impl Trajectory {
    pub(super) fn new(motion: &Motion, speed_mm_s: f64, fps: f64, base_roll_rad: f64, seed: u64) -> Trajectory {
        let mut stream = Stream::at(seed ^ 0x6a17, 0, 0);
        let sways = match motion {
            Motion::Steady | Motion::Poses(_) => Default::default(),
            Motion::Gait => gait(&mut stream),
            Motion::Wheels | Motion::Stop => wheels(&mut stream),
        };
        Trajectory { motion: motion.clone(), speed_mm_s, fps, base_roll_rad, sways }
    }

    /// The pose at a frame; frame 0 is at the world's origin.
    pub(super) fn pose(&self, frame: u32) -> WorldFromCamera {
        if let Motion::Poses(poses) = &self.motion {
            let last = poses.len().saturating_sub(1);
            return poses.get((frame as usize).min(last)).copied().unwrap_or_default();
        }
        let time_s = f64::from(frame) / self.fps;
        // A robot that stands still does not sway: its deviations belong to the way, not to the clock.
        let way_mm = match self.motion {
            Motion::Stop => self.speed_mm_s * stop_and_go_s(time_s),
            _ => self.speed_mm_s * time_s,
        };
        let sway_s = if self.speed_mm_s > 0.0 { way_mm / self.speed_mm_s } else { 0.0 };
        let sway = |axis: usize| -> f64 {
            let at =
                |t: f64| self.sways[axis].iter().map(|s| s.height * (s.rad_per_s * t + s.phase_rad).sin()).sum::<f64>();
            at(sway_s) - at(0.0)
        };
        let position_mm = Vector3::new(way_mm + sway(0), sway(1), sway(2));
        world_from_camera(position_mm, sway(3) + self.base_roll_rad, sway(4), sway(5))
    }
}

fn gait(stream: &mut Stream) -> [Vec<Sine>; 6] {
    let mut sine = |height: f64, hz: f64| {
        vec![Sine {
            height,
            rad_per_s: std::f64::consts::TAU * hz,
            phase_rad: stream.between(0.0, std::f64::consts::TAU),
        }]
    };
    let half_degree = 0.5f64.to_radians();
    [
        sine(2.0, 2.0),
        sine(6.0, 2.0),
        sine(8.0, 1.5),
        sine(half_degree, 1.0),
        sine(0.05f64.to_radians(), 3.0),
        sine(half_degree, 1.3),
    ]
}

fn wheels(stream: &mut Stream) -> [Vec<Sine>; 6] {
    let mut sway = |height: f64| -> Vec<Sine> {
        (0..4)
            .map(|_| Sine {
                height: height * 0.4,
                rad_per_s: std::f64::consts::TAU * stream.between(0.4, 3.0),
                phase_rad: stream.between(0.0, std::f64::consts::TAU),
            })
            .collect()
    };
    let angle = 0.03f64.to_radians();
    [vec![], sway(0.5), sway(0.5), sway(angle), sway(angle), sway(angle)]
}

/// How long a steady drive would have taken to where stop-and-go is after `time_s`, s.
fn stop_and_go_s(time_s: f64) -> f64 {
    // (end of the phase in s, speed at its end in shares of full speed); linear in between.
    const PHASES: [(f64, f64); 9] =
        [(0.0, 1.0), (1.2, 1.0), (1.4, 0.0), (2.2, 0.0), (2.3, -0.5), (2.8, -0.5), (2.9, 0.0), (3.0, 0.0), (3.2, 1.0)];
    const CYCLE_S: f64 = 4.0;
    let way_until = |t: f64| {
        let mut way = 0.0;
        let mut last = PHASES[0];
        for phase in PHASES[1..].iter().chain([&(CYCLE_S, 1.0)]) {
            let share = ((t - last.0) / (phase.0 - last.0)).clamp(0.0, 1.0);
            let reached = last.1 + share * (phase.1 - last.1);
            way += 0.5 * (last.1 + reached) * share * (phase.0 - last.0);
            last = *phase;
        }
        way
    };
    (time_s / CYCLE_S).floor() * way_until(CYCLE_S) + way_until(time_s % CYCLE_S)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_motion_starts_at_the_origin() {
        for motion in [Motion::Steady, Motion::Wheels, Motion::Gait, Motion::Stop] {
            let pose = Trajectory::new(&motion, 200.0, 30.0, 0.0, 3).pose(0);
            assert!(pose.translation.vector.norm() < 1e-12 && pose.rotation.angle() < 1e-12, "{motion:?}");
        }
    }

    #[test]
    fn stop_stands_still_goes_back_and_arrives() {
        let trajectory = Trajectory::new(&Motion::Stop, 200.0, 100.0, 0.0, 3);
        let x = |frame| trajectory.pose(frame).translation.vector.x;
        assert_eq!(trajectory.pose(150), trajectory.pose(210), "stands still, without any sway");
        assert!(x(280) < x(220) - 40.0, "goes back");
        assert!(x(400) > x(150) + 100.0, "drives on");
        for frame in 1..800 {
            assert!((x(frame) - x(frame - 1)).abs() < 2.0 + 1e-9, "no jump at {frame}");
        }
    }

    #[test]
    fn gait_has_the_named_size() {
        let trajectory = Trajectory::new(&Motion::Gait, 200.0, 60.0, 0.0, 9);
        let span = |axis: usize| {
            let values: Vec<f64> = (0..600).map(|i| trajectory.pose(i).translation.vector[axis]).collect();
            values.iter().fold(f64::MIN, |a, b| a.max(*b)) - values.iter().fold(f64::MAX, |a, b| a.min(*b))
        };
        assert!((span(1) - 12.0).abs() < 0.2 && (span(2) - 16.0).abs() < 0.2, "{} {}", span(1), span(2));
    }
}
