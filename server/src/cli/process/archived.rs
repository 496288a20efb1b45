//! What an archive of Stria brings along, so that its job can be run again.

use std::path::{Path, PathBuf};

use stria_core::recipe::Recipe;
use stria_core::rig::Rig;
use stria_core::{Error, Result, mcap_file};

/// The attachments of an archive; all missing for any other source.
#[derive(Default)]
pub(super) struct Archived {
    pub rig: Option<Rig>,
    pub recipe: Option<Recipe>,
    /// Keeps the poses as a file, under the name that they had in the archive.
    poses: Option<tempfile::TempDir>,
}

const POSES: &str = "poses.csv";

impl Archived {
    /// Looks into a source.
    pub(super) fn of(source: &Path) -> Result<Archived> {
        if !source.is_file() || !mcap_file::is_mcap(source) {
            return Ok(Archived::default());
        }
        let text = |name: &str| -> Result<Option<(String, String)>> {
            let Some(bytes) = mcap_file::attachment(source, name)? else { return Ok(None) };
            let subject = format!("{}, {name}", source.display());
            let text = String::from_utf8(bytes).map_err(|_| Error::input(&subject, "no UTF-8 text", "a text"))?;
            Ok(Some((subject, text)))
        };
        let rig = text("rig.toml")?.map(|(subject, text)| Rig::from_toml(&subject, &text)).transpose()?;
        let recipe = text("recipe.toml")?.map(|(subject, text)| Recipe::from_toml(&subject, &text)).transpose()?;
        let poses = match text(POSES)? {
            None => None,
            Some((_, text)) => {
                let folder = tempfile::tempdir().map_err(|e| Error::io(std::env::temp_dir(), e))?;
                let path = folder.path().join(POSES);
                std::fs::write(&path, text).map_err(|e| Error::io(path, e))?;
                Some(folder)
            }
        };
        Ok(Archived { rig, recipe, poses })
    }

    /// The poses that were given with the run.
    pub(super) fn poses(&self) -> Option<PathBuf> {
        self.poses.as_ref().map(|folder| folder.path().join(POSES))
    }
}
