//! The window of key frames: their poses and the landmarks' places, adjusted together.

use nalgebra::Isometry3;

use super::super::bundle::{self, Place, PlaceDepth, PlaceSight, View};
use super::super::pose::Sight;
use super::{Odometry, SIGMA_PX};

/// A frame whose pose is adjusted while it is in the window, and then fixed.
pub(super) struct Keyframe {
    pub number: u32,
    pub camera_from_world: Isometry3<f64>,
    pub fixed: bool,
}

impl Odometry {
    pub(super) fn add_keyframe(&mut self, pose: Isometry3<f64>, sights: &[Sight]) {
        let number = self.next_keyframe;
        self.next_keyframe += 1;
        self.keyframes.push_back(Keyframe { number, camera_from_world: pose, fixed: false });
        for sight in sights {
            let sigma = self.plain_sigma(sight);
            if let Some(landmark) = self.landmarks.get_mut(&sight.landmark) {
                landmark.sights.push((number, PlaceSight { view: 0, ray: sight.ray, sigma }));
            }
        }
        let keep = 2 * self.options.window as usize;
        while self.keyframes.len() > keep {
            self.keyframes.pop_front();
        }
        let oldest = self.keyframes.front().map_or(0, |k| k.number);
        for landmark in self.landmarks.values_mut() {
            landmark.sights.retain(|(n, _)| *n >= oldest);
            // A depth is worth keeping: it is carried on by the place itself once its key frame is gone.
            landmark.depths.retain(|(n, _)| *n >= oldest);
        }
        let free = self.options.window as usize;
        let count = self.keyframes.len();
        for keyframe in self.keyframes.iter_mut().take(count.saturating_sub(free)) {
            keyframe.fixed = true;
        }
    }

    /// A sight's own error, without that of the place.
    pub(super) fn plain_sigma(&self, sight: &Sight) -> f64 {
        sight.sigma.clamp(SIGMA_PX.0 / self.rig.camera.fx_px, self.noise * 0.15 / self.rig.camera.fx_px)
    }

    /// The free key frames and what ties them, for the adjustment; and whose places the latter are.
    fn window(&self) -> (Vec<View>, Vec<Place>, Vec<u32>) {
        let oldest = self.keyframes.front().map_or(0, |k| k.number);
        let index = |number: u32| (number - oldest) as usize;
        let views: Vec<View> =
            self.keyframes.iter().map(|k| View { camera_from_world: k.camera_from_world, free: !k.fixed }).collect();
        let newest_fixed = self.keyframes.iter().rev().find(|k| k.fixed).map_or(0, |k| k.number);
        let (mut ids, mut places) = (Vec::new(), Vec::new());
        for (id, landmark) in self.landmarks.iter().filter(|(_, l)| !l.dead) {
            // What no free key frame saw cannot change.
            let recent = landmark.sights.last().is_some_and(|(n, _)| *n > newest_fixed);
            if !recent || landmark.sights.len() + landmark.depths.len() < 2 {
                continue;
            }
            ids.push(*id);
            places.push(Place {
                world: landmark.world,
                sights: landmark.sights.iter().map(|(n, s)| PlaceSight { view: index(*n), ..*s }).collect(),
                depths: landmark.depths.iter().map(|(n, d)| PlaceDepth { view: index(*n), ..*d }).collect(),
                covariance: landmark.covariance,
            });
        }
        (views, places, ids)
    }

    pub(super) fn adjust(&mut self, rounds: usize) {
        let (mut views, mut places, ids) = self.window();
        bundle::adjust(&mut views, &mut places, rounds);
        for (keyframe, view) in self.keyframes.iter_mut().zip(views) {
            keyframe.camera_from_world = view.camera_from_world;
        }
        for (id, place) in ids.into_iter().zip(places) {
            if let Some(landmark) = self.landmarks.get_mut(&id) {
                landmark.world = place.world;
                landmark.covariance = place.covariance;
            }
        }
    }

    /// Adds up what the newest key frame is open by, `window` key frames after it was last added or later.
    pub(super) fn add_drift(&mut self, window: u32) {
        let (Some(newest), Some(added)) = (self.keyframes.back(), &self.added) else { return };
        if !added.is_due(newest.number, window) {
            return;
        }
        let (number, pose) = (newest.number, newest.camera_from_world);
        let (views, places, _) = self.window();
        let own = bundle::last_covariance(&views, &places);
        self.added = self.added.take().zip(own).map(|(mut added, own)| {
            added.add(number, &pose, &own);
            added
        });
    }
}
