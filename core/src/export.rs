//! One file per format, each with a reader in its tests.
//!
//! Every writer works under a temporary name beside the final one and renames at the end, so that no file
//! under its final name is ever incomplete. Every writer's memory is bounded whatever the length of the run:
//! maps are read in windows through [`crate::depth_map::MapReader`].

use std::path::Path;
use tempfile::NamedTempFile;
use crate::error::{Error, Result};

pub mod archive_mcap;
pub mod cloud_ply;
pub mod depth_png;
pub mod depth_tif;
pub mod manifest;
pub mod new_file;
pub mod npy;
pub mod parts;
pub mod preview;
mod pyramid;
pub mod texture;
pub mod tiles;
pub mod trajectory_csv;


/// A temporary file beside `path`, to be persisted there once it is complete; it goes away when it is dropped. It
/// has the permissions of an ordinary new file.
pub(crate) fn part_file(path: &Path) -> Result<NamedTempFile> {
    let dir = path.parent().filter(|d| !d.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut builder = tempfile::Builder::new();
    let prefix = format!(".{name}.");
    builder.prefix(&prefix).suffix(".part");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(dir).map_err(|e| Error::io(path, e))
}
