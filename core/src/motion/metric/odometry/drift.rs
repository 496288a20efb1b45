//! How far the poses may have drifted since the start of the way.
//!
//! Each window of key frames is tied to the ones before by the landmarks that both saw; how loosely, the adjustment tells
//! (the covariance of the window's last pose with all before it held). Window by window these add up, and an error of
//! the heading becomes one of the place as the way goes on.

use nalgebra::{Isometry3, Matrix3, Matrix6};
use serde::{Deserialize, Serialize};

/// How much further off simulated runs of 1 to 8 m end than sights without anything in common would explain: a patch that
/// is found a little beside its place in one window is so in the next one too.
const IN_COMMON: f64 = 2.0;

/// Standard deviations of the last pose against the first one, as far as the image's noise explains them: a rig that is
/// not as it says, or a bias of the line, adds to it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Drift {
    /// Along the travel, mm.
    pub x_mm: f64,
    /// Across the travel, along the wall, mm.
    pub y_mm: f64,
    /// In depth, mm.
    pub z_mm: f64,
    /// The camera's direction, degrees.
    pub turn_deg: f64,
}

/// What has added up so far.
pub(super) struct Added {
    at: Isometry3<f64>,
    /// Of the pose `at`: rotation, then translation, in the camera's frame (rad, mm).
    covariance: Matrix6<f64>,
    /// The number of the key frame at `at`.
    keyframe: u32,
}

impl Added {
    /// At a key frame that is where it says.
    pub(super) fn from(keyframe: u32, camera_from_world: Isometry3<f64>) -> Added {
        Added { at: camera_from_world, covariance: Matrix6::zeros(), keyframe }
    }

    /// Whether a window has passed since the last addition.
    pub(super) fn is_due(&self, keyframe: u32, window: u32) -> bool {
        keyframe >= self.keyframe + window
    }

    /// Adds what a later pose is open by against those before it.
    pub(super) fn add(&mut self, keyframe: u32, camera_from_world: &Isometry3<f64>, own: &Matrix6<f64>) {
        let carried = adjoint(&(camera_from_world * self.at.inverse()));
        self.covariance = carried * self.covariance * carried.transpose() + own;
        (self.at, self.keyframe) = (*camera_from_world, keyframe);
    }

    /// In the world's directions; `None` before anything was added: a first key frame alone tells nothing.
    pub(super) fn drift(&self) -> Option<Drift> {
        if self.covariance == Matrix6::zeros() {
            return None;
        }
        let rotation = self.at.rotation.to_rotation_matrix();
        let own: Matrix3<f64> = self.covariance.fixed_view::<3, 3>(3, 3).into();
        let in_world = rotation.transpose() * own * rotation.matrix();
        let sigma = |axis: usize| in_world[(axis, axis)].max(0.0).sqrt() * IN_COMMON;
        let turn: f64 = (0..3).map(|i| self.covariance[(i, i)].max(0.0)).sum();
        let turn_deg = turn.sqrt().to_degrees() * IN_COMMON;
        Some(Drift { x_mm: sigma(0), y_mm: sigma(1), z_mm: sigma(2), turn_deg })
    }
}

/// What a small move (rotation, then translation) in one frame is in another.
fn adjoint(to_from: &Isometry3<f64>) -> Matrix6<f64> {
    let rotation = *to_from.rotation.to_rotation_matrix().matrix();
    let mut whole = Matrix6::zeros();
    whole.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    whole.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
    whole.fixed_view_mut::<3, 3>(3, 0).copy_from(&(to_from.translation.vector.cross_matrix() * rotation));
    whole
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3, Vector6};

    use super::super::super::pose::{difference, moved};
    use super::*;

    #[test]
    fn a_small_move_is_the_same_seen_from_another_frame() {
        let step = Vector6::new(1e-4, -2e-4, 3e-4, 0.01, 0.02, -0.03);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -0.2, 0.5));
        let to_from = Isometry3::from_parts(Vector3::new(300.0, -20.0, 50.0).into(), turn);
        let at = Isometry3::translation(7.0, 8.0, 9.0);
        let there = difference(&(to_from * at), &(to_from * moved(&at, &step)));
        assert!((there - adjoint(&to_from) * step).norm() < 1e-4, "{there} for {}", adjoint(&to_from) * step);
    }

    #[test]
    fn an_error_of_the_heading_grows_to_one_of_the_place() {
        let mut added = Added::from(0, Isometry3::identity());
        assert_eq!(added.drift(), None, "nothing is known yet, which is not 0 mm");
        let mut own = Matrix6::zeros();
        own[(1, 1)] = 1e-6;
        added.add(5, &Isometry3::translation(-100.0, 0.0, 0.0), &own);
        assert!(added.drift().expect("added").z_mm < 1e-9 && added.is_due(10, 5) && !added.is_due(9, 5));
        added.add(10, &Isometry3::translation(-1100.0, 0.0, 0.0), &Matrix6::zeros());
        let drift = added.drift().expect("added");
        assert!((drift.z_mm - IN_COMMON).abs() < 1e-9, "a thousandth over a metre is a millimetre: {drift:?}");
        assert!(drift.x_mm < 1e-9 && (drift.turn_deg - IN_COMMON * 1e-3_f64.to_degrees()).abs() < 1e-9);
    }
}
