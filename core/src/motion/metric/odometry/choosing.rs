//! New landmarks where the image has none.

use nalgebra::{Isometry3, Matrix3, Point3, Vector3};

use super::super::bundle::{PlaceDepth, PlaceSight};
use super::super::depth::{self, Known};
use super::super::landmark::{Landmark, best_place};
use super::super::view::FrameView;
use super::{Odometry, SIGMA_PX};
use crate::geometry::RawPixel;
use crate::rig::LineDirection;
use crate::triangulation::Profile;

/// A depth known better than this share is one that neighbours may rely on.
const SURE_SHARE: f64 = 0.01;

impl Odometry {
    /// New landmarks where the image has none.
    pub(super) fn choose_landmarks(&mut self, view: &FrameView<'_>, profile: &Profile, pose: &Isometry3<f64>) {
        let camera = self.rig.camera.clone();
        let (width, height) = (view.gray.width, view.gray.height);
        let side = ((width * height) as f64 / f64::from(self.options.landmarks)).sqrt().max(24.0);
        let (columns, rows) = ((width as f64 / side).round() as usize, (height as f64 / side).round() as usize);
        let (columns, rows) = (columns.max(1), rows.max(1));
        let mut taken = vec![false; columns * rows];
        let mut known = self.known_depths(profile, pose);
        for landmark in self.landmarks.values().filter(|l| !l.dead) {
            let Some((x, y)) = landmark.seen_at(&camera, pose) else { continue };
            if x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64 {
                let cell = (y as usize * rows / height) * columns + x as usize * columns / width;
                taken[cell.min(columns * rows - 1)] = true;
            }
        }
        if known.len() > 400 {
            let step = known.len() / 400 + 1;
            known = known.into_iter().step_by(step).collect();
        }
        let along = match self.rig.laser.line {
            LineDirection::Vertical => 1,
            LineDirection::Horizontal => 0,
        };
        let number = self.keyframes.back().map_or(0, |k| k.number);
        let world_from_camera = pose.inverse();
        for cell in (0..columns * rows).filter(|cell| !taken[*cell]) {
            let (column, row) = (cell % columns, cell / columns);
            let across = column * width / columns..(column + 1) * width / columns;
            let down = row * height / rows..(row + 1) * height / rows;
            let clear = |x: usize, y: usize| !view.line.covers((x as f64, y as f64));
            let least = self.options.texture_min as f32;
            let Some((x, y)) = best_place(view.small(), across, down, least, clear) else { continue };
            let ray = camera.undistort(RawPixel { u_px: x as f64, v_px: y as f64 });
            let ray = [ray.x, ray.y];
            let Some(guess) = depth::guess(&known, ray, along) else { continue };
            let inverse_at = |r: [f64; 2]| {
                let slope = guess.slopes[0] * (r[0] - ray[0]) + guess.slopes[1] * (r[1] - ray[1]);
                (guess.inverse_mm + slope).max(0.3 * guess.inverse_mm)
            };
            let chosen = Landmark::choose(view.gray, view.small(), (x, y), &camera, &world_from_camera, inverse_at);
            let Some(mut landmark) = chosen else { continue };
            let z_mm = 1.0 / guess.inverse_mm;
            let sigma_mm = guess.sigma_share * z_mm;
            let sight_sigma = SIGMA_PX.0 / camera.fx_px;
            let direction = world_from_camera.rotation * Vector3::new(ray[0], ray[1], 1.0);
            landmark.covariance = direction * direction.transpose() * (sigma_mm * sigma_mm)
                + Matrix3::identity() * (sight_sigma * z_mm).powi(2);
            landmark.sights.push((number, PlaceSight { view: 0, ray, sigma: sight_sigma }));
            let depth = PlaceDepth { guess: true, view: 0, direction: Vector3::z(), distance_mm: z_mm, sigma_mm };
            landmark.depths.push((number, depth));
            landmark.last_frame = view.frame;
            self.landmarks.insert(self.next_landmark, landmark);
            self.next_landmark += 1;
        }
    }

    /// Depths in this view: the profile's, and those of landmarks that are sure.
    pub(super) fn known_depths(&self, profile: &Profile, pose: &Isometry3<f64>) -> Vec<Known> {
        let of = |p: &Point3<f64>| Known { ray: [p.x / p.z, p.y / p.z], inverse_mm: 1.0 / p.z };
        let step = (profile.points.len() / 60).max(1);
        let mut known: Vec<Known> = profile.points.iter().step_by(step).map(|p| of(&p.point_in_camera)).collect();
        for landmark in self.landmarks.values().filter(|l| !l.dead) {
            let p = pose * landmark.world;
            if p.z > 1.0 && landmark.covariance.trace().sqrt() < SURE_SHARE * p.z {
                known.push(of(&p));
            }
        }
        known
    }
}
