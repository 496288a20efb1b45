//! The product folder while it is being filled: empty before, whole or gone after.

use std::fs;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// Says that a folder's files are an unfinished job's; what was interrupted may be started again over it.
const UNFINISHED: &str = ".unfinished";

/// A folder that belongs to one job.
pub(super) struct ProductFolder {
    path: PathBuf,
    made: bool,
}

impl ProductFolder {
    /// Takes a folder: a new or empty one, or one that an interrupted job left behind, which is emptied.
    pub(super) fn claim(path: &Path) -> Result<ProductFolder> {
        if path.exists() && !path.is_dir() {
            return Err(Error::input(
                path.display().to_string(),
                "not a folder",
                "an empty or new folder for the products",
            ));
        }
        let made = !path.exists();
        fs::create_dir_all(path).map_err(|e| Error::io(path, e))?;
        let folder = ProductFolder { path: path.to_path_buf(), made };
        let occupied = fs::read_dir(path).map_err(|e| Error::io(path, e))?.next().is_some();
        if occupied {
            if !path.join(UNFINISHED).exists() {
                return Err(Error::input(
                    path.display().to_string(),
                    "a folder that is not empty",
                    "an empty or new folder for the products",
                ));
            }
            folder.empty()?;
        }
        let marker = path.join(UNFINISHED);
        fs::write(&marker, "A job is filling this folder, or was interrupted. It can be started again.\n")
            .map_err(|e| Error::io(marker, e))?;
        Ok(folder)
    }

    /// Ends the job: its folder is whole, or it is as it was before.
    pub(super) fn settle<T>(self, result: Result<T>) -> Result<T> {
        match result {
            Ok(value) => {
                let marker = self.path.join(UNFINISHED);
                fs::remove_file(&marker).map_err(|e| Error::io(marker, e))?;
                Ok(value)
            }
            Err(error) => {
                // The first error is the one to tell; what cannot be removed keeps its marker.
                let _ = self.empty();
                if self.made {
                    let _ = fs::remove_dir(&self.path);
                }
                Err(error)
            }
        }
    }

    fn empty(&self) -> Result<()> {
        for entry in fs::read_dir(&self.path).map_err(|e| Error::io(&self.path, e))? {
            let path = entry.map_err(|e| Error::io(&self.path, e))?.path();
            if path.file_name().is_some_and(|name| name == UNFINISHED) {
                continue;
            }
            let removed = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            removed.map_err(|e| Error::io(&path, e))?;
        }
        let marker = self.path.join(UNFINISHED);
        match fs::remove_file(&marker) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(marker, e)),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_with_other_files_is_refused_and_untouched() {
        let folder = tempfile::tempdir().expect("temporary folder");
        fs::write(folder.path().join("mine.txt"), "keep").expect("write");
        assert!(ProductFolder::claim(folder.path()).is_err());
        assert_eq!(fs::read_to_string(folder.path().join("mine.txt")).expect("kept"), "keep");
    }

    #[test]
    fn a_file_is_no_folder() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("mine.txt");
        fs::write(&path, "keep").expect("write");
        let refused = ProductFolder::claim(&path).map(drop).expect_err("a file").to_string();
        assert!(refused.contains("not a folder"), "{refused}");
        assert_eq!(fs::read_to_string(path).expect("kept"), "keep");
    }

    #[test]
    fn a_failure_leaves_nothing_and_an_interruption_can_be_repeated() {
        let parent = tempfile::tempdir().expect("temporary folder");
        let path = parent.path().join("out");
        let folder = ProductFolder::claim(&path).expect("claim");
        fs::write(path.join("half.tif"), "half").expect("write");
        drop(folder); // as after kill -9: the marker stays
        let folder = ProductFolder::claim(&path).expect("claim again");
        assert!(!path.join("half.tif").exists());
        let result: Result<()> = folder.settle(Err(Error::Cancelled));
        assert!(matches!(result, Err(Error::Cancelled)));
        assert_eq!(fs::read_dir(&path).expect("was there before").count(), 0);
    }
}
