//! Profiles side by side, as the image moved.
//!
//! The publication's way (METHOD.md, "Jitter and the depth image"): the image's shift carries the strips
//! along, and the carried scale removes the jitter in distance. The scale's running product is a random
//! walk on a steady run, so its slow part, what a window of `motion.scale_window_s` sees as a straight
//! line, is removed. That needs frames from after the one being placed: at most a window's half waits.

use std::collections::VecDeque;

use nalgebra::Vector3;

use crate::geometry::{WorldFromCamera, world_from_camera};
use crate::recipe::MotionOptions;
use crate::rig::{LineDirection, Rig};
use crate::surface::{Measured, Placed};

/// Most frames that wait for the ones after them, whatever the frame rate.
const MAX_WAITING_FRAMES: usize = 600;

/// Where a frame's strip lies in the publication's map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StripPlace {
    /// Travel since the first frame along the image's travel axis, px of the image; grows towards +x.
    pub travel_px: f64,
    /// The same for the frame after this one: the end of this frame's strip.
    pub travel_end_px: f64,
    /// Shift across the travel since the first frame, px of the image; grows towards +y.
    pub across_px: f64,
    /// What the frame's depths are multiplied by against jitter.
    pub depth_factor: f64,
}

/// Places frames along the travel.
pub struct Placement<T> {
    options: MotionOptions,
    line: LineDirection,
    f_px: f64,
    waiting: VecDeque<Waiting<T>>,
    /// Frames before the first waiting one, that its window still needs: (time, log scale).
    passed: VecDeque<(f64, f64)>,
    travel_px: f64,
    across_px: f64,
    position_mm: Vector3<f64>,
    log_scale: f64,
    last_z_mm: Option<f64>,
    last_step_px: f64,
}

struct Waiting<T> {
    measured: Measured<T>,
    travel_px: f64,
    across_px: f64,
    position_mm: Vector3<f64>,
    log_scale: f64,
}

impl<T> Placement<T> {
    /// A placement that starts at the world's origin.
    pub fn new(rig: &Rig, options: &MotionOptions) -> Placement<T> {
        let f_px = match rig.laser.line {
            LineDirection::Vertical => rig.camera.fx_px,
            LineDirection::Horizontal => rig.camera.fy_px,
        };
        Placement {
            options: options.clone(),
            line: rig.laser.line,
            f_px,
            waiting: VecDeque::new(),
            passed: VecDeque::new(),
            travel_px: 0.0,
            across_px: 0.0,
            position_mm: Vector3::zeros(),
            log_scale: 0.0,
            last_z_mm: None,
            last_step_px: 0.0,
        }
    }

    /// Takes the next frame; hands out those whose window is complete.
    pub fn push(&mut self, measured: Measured<T>) -> Vec<Placed<T>> {
        self.advance(&measured);
        self.waiting.push_back(Waiting {
            measured,
            travel_px: self.travel_px,
            across_px: self.across_px,
            position_mm: self.position_mm,
            log_scale: self.log_scale,
        });
        let mut ready = Vec::new();
        while self.waiting.len() > MAX_WAITING_FRAMES || self.window_complete() {
            ready.extend(self.place_first());
        }
        ready
    }

    /// Hands out what still waits.
    pub fn finish(&mut self) -> Vec<Placed<T>> {
        let mut ready = Vec::new();
        while !self.waiting.is_empty() {
            ready.extend(self.place_first());
        }
        ready
    }

    /// Carries the travel on by one frame. A lost frame keeps its place: a gap is declared, not bridged.
    fn advance(&mut self, measured: &Measured<T>) {
        self.last_z_mm = measured.profile.median_z_mm().or(self.last_z_mm);
        let (travel, across) = (measured.shift.travel_px(self.line), measured.shift.across_px(self.line));
        self.travel_px += travel;
        self.across_px += across;
        self.last_step_px = travel;
        let mm_per_px = self.last_z_mm.unwrap_or(0.0) / self.f_px;
        self.position_mm += Vector3::new(travel, across, 0.0) * mm_per_px;
        self.log_scale += measured.shift.scale.unwrap_or(1.0).ln();
    }

    fn half_window_s(&self) -> f64 {
        self.options.scale_window_s / 2.0
    }

    /// True when the first waiting frame has all it needs behind it, and one frame to end its strip at.
    fn window_complete(&self) -> bool {
        match (self.waiting.front(), self.waiting.back()) {
            (Some(first), Some(last)) => {
                self.waiting.len() > 1 && last.measured.time_s >= first.measured.time_s + self.half_window_s()
            }
            _ => false,
        }
    }

    fn place_first(&mut self) -> Option<Placed<T>> {
        let depth_factor = self.depth_factor();
        let first = self.waiting.pop_front()?;
        // The last frame has no next one: its strip is as wide as the one before.
        let travel_end_px = self.waiting.front().map_or(first.travel_px + self.last_step_px, |next| next.travel_px);
        self.passed.push_back((first.measured.time_s, first.log_scale));
        let oldest_s = self.waiting.front().map_or(f64::MAX, |w| w.measured.time_s) - self.half_window_s();
        while self.passed.front().is_some_and(|(time_s, _)| *time_s < oldest_s)
            || self.passed.len() > MAX_WAITING_FRAMES
        {
            self.passed.pop_front();
        }
        let jitter_mm = first.measured.profile.median_z_mm().map_or(0.0, |z_mm| z_mm * (depth_factor - 1.0));
        let position_mm = first.position_mm + Vector3::z() * jitter_mm;
        let strip = StripPlace { travel_px: first.travel_px, travel_end_px, across_px: first.across_px, depth_factor };
        Some(Placed {
            world_from_camera: Some(starting_pose(self.line, position_mm)),
            degrees_of_freedom: 3,
            part: 0,
            strip: Some(strip),
            measured: first.measured,
        })
    }

    /// exp(log scale − its slow part) of the first waiting frame: the image's scale grows as the camera
    /// comes closer, so depths are multiplied by it.
    fn depth_factor(&self) -> f64 {
        let Some(first) = self.waiting.front() else { return 1.0 };
        if !self.options.scale_correction {
            return 1.0;
        }
        let (now_s, half_s) = (first.measured.time_s, self.half_window_s());
        let near = |time_s: &f64| (time_s - now_s).abs() <= half_s;
        let after = self.waiting.iter().map(|w| (w.measured.time_s, w.log_scale));
        let window = self.passed.iter().copied().chain(after).filter(|(time_s, _)| near(time_s));
        (first.log_scale - line_at(window, now_s)).exp()
    }
}

/// Where the camera starts, moved by `position_mm`: for a horizontal line world x is the image's y.
fn starting_pose(line: LineDirection, position_mm: Vector3<f64>) -> WorldFromCamera {
    let roll_rad = match line {
        LineDirection::Vertical => 0.0,
        LineDirection::Horizontal => -std::f64::consts::FRAC_PI_2,
    };
    world_from_camera(position_mm, roll_rad, 0.0, 0.0)
}

/// The least-squares line through (time, value) pairs, at one time.
fn line_at(pairs: impl Iterator<Item = (f64, f64)>, at_s: f64) -> f64 {
    let (mut n, mut t, mut v, mut tt, mut tv) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (time_s, value) in pairs {
        let time_s = time_s - at_s;
        (n, t, v) = (n + 1.0, t + time_s, v + value);
        (tt, tv) = (tt + time_s * time_s, tv + time_s * value);
    }
    let spread = n * tt - t * t;
    if spread.abs() < 1e-12 { v / f64::max(n, 1.0) } else { (v * tt - t * tv) / spread }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Shift;
    use crate::rig::LaserColour;
    use crate::triangulation::{Profile, ProfilePoint};
    use nalgebra::Point3;

    const FPS: f64 = 60.0;

    fn rig() -> Rig {
        Rig::from_paper(1280, 720, 1.2, 150.0, 1.6, LaserColour::Green)
    }

    fn measured(frame: u32, z_mm: f64, shift: Shift) -> Measured<()> {
        let point_in_camera = Point3::new(0.0, 0.0, z_mm);
        let pixel = crate::geometry::RawPixel { u_px: 0.0, v_px: 0.0 };
        let profile =
            Profile { points: vec![ProfilePoint { line_position: 0, pixel, point_in_camera, confidence: 1.0 }] };
        Measured { frame, time_s: f64::from(frame) / FPS, profile, shift, cargo: () }
    }

    fn strip(placed: &Placed<()>) -> StripPlace {
        placed.strip.expect("paper's place")
    }

    fn run(frames: u32, z_mm: impl Fn(u32) -> f64, dx_px: f64) -> Vec<Placed<()>> {
        let mut placement = Placement::new(&rig(), &MotionOptions::default());
        let mut placed = Vec::new();
        for frame in 0..frames {
            let shift = match frame {
                0 => Shift::default(),
                _ => Shift {
                    dx_px: Some(dx_px),
                    dy_px: Some(0.0),
                    scale: Some(z_mm(frame - 1) / z_mm(frame)),
                    ..Shift::default()
                },
            };
            placed.extend(placement.push(measured(frame, z_mm(frame), shift)));
        }
        placed.extend(placement.finish());
        placed
    }

    #[test]
    fn gait_jitter_is_taken_out_of_the_depths() {
        let z_mm = |frame: u32| 450.0 + 8.0 * (std::f64::consts::TAU * 1.5 * f64::from(frame) / FPS).sin();
        let placed = run(400, z_mm, -4.0);
        assert_eq!(placed.len(), 400);
        for p in &placed[60..340] {
            let corrected = z_mm(p.measured.frame) * strip(p).depth_factor;
            assert!((corrected - 450.0).abs() < 1.5, "frame {}: {corrected} mm", p.measured.frame);
        }
    }

    #[test]
    fn strips_join_without_gap_and_travel_is_in_mm() {
        let placed = run(100, |_| 500.0, -4.0);
        for pair in placed.windows(2) {
            assert_eq!(strip(&pair[0]).travel_end_px, strip(&pair[1]).travel_px);
        }
        let last = placed.last().expect("placed");
        assert_eq!(strip(last).travel_end_px - strip(last).travel_px, 4.0);
        let expected_mm = 99.0 * 4.0 * 500.0 / rig().camera.fx_px;
        let pose = last.world_from_camera.expect("placed");
        assert!((pose.translation.x - expected_mm).abs() < 1e-6);
    }

    #[test]
    fn few_frames_wait() {
        let mut placement = Placement::new(&rig(), &MotionOptions::default());
        for frame in 0..2000 {
            placement.push(measured(frame, 500.0, Shift::default()));
            assert!(placement.waiting.len() <= 62 && placement.passed.len() <= 62);
        }
    }
}
