//! One file per format.

pub mod manifest;
pub mod npy;
