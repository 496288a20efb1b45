//! The disk guard: below a reserve nothing more is taken in and no job begins, so that what runs can end.

use std::path::{Path, PathBuf};

use crate::config::GB;
use crate::error::{Error, Result};

/// Watches the disk of a folder.
#[derive(Clone, Debug)]
pub struct DiskGuard {
    folder: PathBuf,
    reserve_bytes: u64,
}

/// A disk's room, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Room {
    /// Free for this process.
    pub free: u64,
    /// In all.
    pub total: u64,
}

impl DiskGuard {
    /// Keeps `reserve_bytes` free on the folder's disk.
    pub fn new(folder: &Path, reserve_bytes: u64) -> DiskGuard {
        DiskGuard { folder: folder.to_path_buf(), reserve_bytes }
    }

    /// The room there is; `None` where the system does not say.
    pub fn room(&self) -> Option<Room> {
        let facts = rustix::fs::statvfs(&self.folder).ok()?;
        let bytes = |blocks: u64| blocks.saturating_mul(facts.f_frsize);
        Some(Room { free: bytes(facts.f_bavail), total: bytes(facts.f_blocks) })
    }

    /// Room for `bytes` more, with the reserve left.
    pub fn check(&self, bytes: u64) -> Result<()> {
        match self.room() {
            Some(room) if room.free < self.reserve_bytes.saturating_add(bytes) => Err(Error::NoRoom(format!(
                "{} has {:.1} GB free; this needs {:.1} GB, and {:.1} GB are kept in reserve",
                self.folder.display(),
                in_gb(room.free),
                in_gb(bytes),
                in_gb(self.reserve_bytes)
            ))),
            _ => Ok(()),
        }
    }

    /// What is lacking, in words.
    pub fn lack(&self) -> Option<String> {
        self.check(0).err().map(|e| e.to_string())
    }
}

fn in_gb(bytes: u64) -> f64 {
    bytes as f64 / GB as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reserve_is_kept() {
        let folder = tempfile::tempdir().expect("folder");
        let room = DiskGuard::new(folder.path(), 0).room().expect("Linux says");
        assert!(room.free > 0 && room.free <= room.total);
        assert!(DiskGuard::new(folder.path(), 0).check(1).is_ok());
        let strict = DiskGuard::new(folder.path(), room.total);
        assert!(matches!(strict.check(1), Err(Error::NoRoom(_))) && strict.lack().is_some());
    }
}
