//! The folder of one attempt: its rig, its recipe, what the child writes. Gone after the attempt, whatever its end.

use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::queue::{Lease, Queue};

/// Tries to remove a folder that a dying child may still be writing to.
const TRIES: u32 = 10;

/// An attempt's folder.
pub(super) struct Scratch(PathBuf);

impl Scratch {
    /// Makes it, with rig and recipe in it.
    pub(super) async fn make(root: &Path, lease: &Lease) -> Result<Scratch> {
        let scratch = Scratch(root.join(name(lease)));
        let write = async {
            tokio::fs::create_dir_all(&scratch.0).await?;
            tokio::fs::write(scratch.rig(), &lease.rig_toml).await?;
            tokio::fs::write(scratch.recipe(), &lease.recipe_toml).await
        };
        write.await.map_err(|e: std::io::Error| Error::io(&scratch.0, e))?;
        Ok(scratch)
    }

    /// The folder.
    pub(super) fn folder(&self) -> &Path {
        &self.0
    }

    /// The rig file.
    pub(super) fn rig(&self) -> PathBuf {
        self.0.join("rig.toml")
    }

    /// The recipe file.
    pub(super) fn recipe(&self) -> PathBuf {
        self.0.join("recipe.toml")
    }

    /// The product folder.
    pub(super) fn out(&self) -> PathBuf {
        self.0.join("out")
    }

    /// Removes an attempt's folder; says so in the log where it cannot.
    pub(super) async fn remove(root: &Path, lease: &Lease) {
        remove(&root.join(name(lease))).await;
    }
}

fn name(lease: &Lease) -> String {
    format!("{}.{}", lease.job, lease.fence)
}

async fn remove(folder: &Path) {
    for attempt in 1..=TRIES {
        match tokio::fs::remove_dir_all(folder).await {
            Ok(()) => return,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return,
            Err(error) if attempt == TRIES => {
                tracing::warn!(folder = %folder.display(), %error, "a scratch folder could not be removed");
            }
            Err(_) => tokio::time::sleep(std::time::Duration::from_millis(50 * u64::from(attempt))).await,
        }
    }
}

/// Removes the folders of attempts that have no lease any more. What does not look like one of ours stays.
pub(super) async fn remove_leftovers(root: &Path, queue: &Queue) -> Result<()> {
    let mut entries = tokio::fs::read_dir(root).await.map_err(|e| Error::io(root, e))?;
    while let Some(entry) = entries.next_entry().await.map_err(|e| Error::io(root, e))? {
        let path = entry.path();
        let Some((job, fence)) = path.file_name().and_then(|n| n.to_str()).and_then(|n| n.split_once('.')) else {
            continue;
        };
        let Ok(fence) = fence.parse::<i64>() else { continue };
        if uuid::Uuid::parse_str(job).is_ok() && !queue.is_leased(job, fence).await? {
            remove(&path).await;
        }
    }
    Ok(())
}
