//! Images to geometry: from the video of a camera and a line laser to a measured surface.
//!
//! The way of the data, one file per stage, each with one typed input and output:
//!
//! ```text
//! source ▶ Frame ▶ stripe ▶ Stripe ▶ triangulation ▶ Profile ─┐
//!             └──▶ motion ▶ Shift ▶ Pose ─────────────────────┴▶ surface ▶ depth map + texture ▶ defects ▶ export
//! ```
//!
//! Frames stream: every buffer has a bound, and the finished map waits in tiles on disk.
//! Only [`pipeline`] knows the order; a stage may use an earlier stage's output type, never its
//! functions.
//!
//! # Coordinate frames and units
//!
//! Lengths are millimetres, angles radians inside and degrees at the edges, times seconds. The camera's
//! frame is OpenCV's: x right, y down, z forward, pixel centres at integers. The world is the camera's
//! frame at the run's first frame, turned about z so that x lies along the travel that the rig's laser
//! line implies: along the image's x for a vertical line, along its y for a horizontal one.

pub mod calibration;
pub mod defects;
pub mod depth_map;
pub mod error;
pub mod export;
pub mod geometry;
pub mod mcap_file;
pub mod motion;
pub mod pipeline;
pub mod recipe;
pub mod recording;
pub mod rig;
pub mod source;
pub mod stripe;
pub mod surface;
pub mod synthetic;
pub mod triangulation;

pub use error::{Error, Result};
