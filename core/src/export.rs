//! One file per format, each with a reader in its tests.
//!
//! Every writer works under a temporary name beside the final one and renames at the end, so that no file
//! under its final name is ever incomplete. Every writer's memory is bounded whatever the length of the run:
//! maps are read in windows through [`crate::depth_map::MapReader`].

pub mod archive_mcap;
pub(crate) mod canvas;
pub mod change_list;
pub mod cloud_e57;
pub mod cloud_laz;
pub mod cloud_pcd;
pub mod cloud_ply;
pub mod defect_list;
pub mod depth_png;
pub mod depth_tif;
pub mod live_frame;
pub mod manifest;
pub mod mesh_glb;
pub mod new_file;
pub mod npy;
pub mod parts;
pub mod preview;
mod pyramid;
pub mod report;
pub mod residual_tif;
pub mod residual_tiles;
pub mod section_csv;
pub mod sections_csv;
pub mod texture;
pub mod tiles;
pub mod trajectory_csv;
