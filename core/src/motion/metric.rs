//! The camera's pose in millimetres, from the image tracked against the surface that the laser has measured.
//!
//! *Landmarks* are small patches of the wall. The laser gives a landmark its depth when its line passes over it; until
//! then the depth comes from its neighbours, loosely, and from how the landmark moves. Each frame's pose is the one
//! that puts the landmarks where their patches are found (`pose`). At *key frames*, a tenth of the view apart, the
//! poses of the last few and the places of all landmarks are adjusted together (`bundle`), so that what the laser
//! measures later also corrects the way before it. A frame is handed out when its key frames are settled.
//!
//! Every patch is compared with how it looked when it was chosen, not with the frame before: a robot that stands still
//! does not creep, and one that comes back finds the same places.

mod bundle;
mod depth;
mod image;
mod landmark;
mod odometry;
mod patch;
mod pose;
mod view;

pub use odometry::{Drift, Motion, Odometry, SettledPose};
