//! What must survive a reboot: where each upload stands. One small file per file that is being sent.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};

use super::super::Failed;
use super::tus::Source;
use crate::store::sha256_of;

/// What nobody asked for in this time belongs to a file that went away; the server has forgotten it, too.
const KEPT: Duration = Duration::from_secs(60 * 86_400);

/// An upload on its way.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Resume {
    /// For people who look into the file.
    pub(super) file: String,
    /// The fields it was begun with, as a digest: with others it is another upload.
    pub(super) fields: String,
    /// SHA-256 of the whole file, hex.
    pub(super) sha256: String,
    /// Makes the creation safe to repeat.
    pub(super) key: String,
    /// The upload's path at the server, once it is known.
    pub(super) upload: Option<String>,
}

/// The folder of these files, as far as they are about one server.
pub(super) struct States {
    root: PathBuf,
    server: String,
}

impl States {
    /// `$XDG_STATE_HOME/stria`, else `~/.local/state/stria`.
    pub(super) fn open(server: &reqwest::Url) -> Result<States, Failed> {
        let variable = |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let base = variable("XDG_STATE_HOME").or_else(|| variable("HOME").map(|home| home.join(".local/state")));
        let base = base.ok_or_else(|| {
            Failed::Input("neither XDG_STATE_HOME nor HOME names a folder; expected one for what must survive".into())
        })?;
        let states = States { root: base.join("stria"), server: server.to_string() };
        states.make(&states.root.join("send"))?;
        states.sweep();
        Ok(states)
    }

    fn make(&self, folder: &Path) -> Result<(), Failed> {
        let made = std::fs::create_dir_all(folder);
        made.map_err(|e| Failed::Input(format!("{}: {e}; expected a folder to write to", folder.display())))
    }

    /// The folder of a live stream.
    pub(super) fn stream(&self, stream: &str) -> Result<PathBuf, Failed> {
        let hash = sha256_of(&format!("{}\n{stream}", self.server));
        let folder = self.root.join("live").join(format!("{stream}-{}", &hash[..16]));
        self.make(&folder)?;
        Ok(folder)
    }

    fn path(&self, source: &Source) -> PathBuf {
        let what = format!("{}\n{}\n{}\n{}", self.server, source.path.display(), source.bytes, source.modified_ns);
        self.root.join("send").join(format!("{}.json", &sha256_of(&what)[..32]))
    }

    /// Where the file's upload stands; `None` where it was not begun, or what is known of it cannot be read.
    pub(super) fn load(&self, source: &Source) -> Option<Resume> {
        serde_json::from_slice(&std::fs::read(self.path(source)).ok()?).ok()
    }

    /// Keeps it, so that it survives the loss of power.
    pub(super) fn save(&self, source: &Source, resume: &Resume) -> std::io::Result<()> {
        write_whole(&self.path(source), &serde_json::to_vec_pretty(resume)?)
    }

    /// The upload is over.
    pub(super) fn forget(&self, source: &Source) {
        // What stays behind is swept away later, and asked for by nobody.
        let _ = std::fs::remove_file(self.path(source));
    }

    fn sweep(&self) {
        let Ok(entries) = std::fs::read_dir(self.root.join("send")) else { return };
        for entry in entries.flatten() {
            let modified = entry.metadata().and_then(|facts| facts.modified());
            if modified.is_ok_and(|time| SystemTime::now().duration_since(time).is_ok_and(|age| age > KEPT)) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

/// Writes a file that is there whole or not at all, whatever happens to the power.
pub(super) fn write_whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let half = path.with_extension("half");
    let mut file = File::create(&half)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    std::fs::rename(&half, path)?;
    sync_folder_of(path)
}

/// Makes names in a folder durable.
pub(super) fn sync_folder_of(path: &Path) -> std::io::Result<()> {
    File::open(path.parent().unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_saved_is_found_again_by_the_same_file_only() {
        let folder = tempfile::tempdir().expect("folder");
        let states = |server: &str| States { root: folder.path().join("state"), server: server.into() };
        std::fs::create_dir_all(folder.path().join("state/send")).expect("made");
        let path = folder.path().join("a.mp4");
        std::fs::write(&path, "one").expect("writes");
        let Ok(source) = Source::open(&path) else { panic!("it opens") };
        let resume = Resume { file: "a".into(), fields: "f".into(), sha256: "s".into(), key: "k".into(), upload: None };
        assert_eq!(states("http://a/").load(&source), None);
        states("http://a/").save(&source, &resume).expect("saved");
        assert_eq!(states("http://a/").load(&source), Some(resume));
        assert_eq!(states("http://b/").load(&source), None, "another server");
        std::fs::write(&path, "another").expect("writes");
        let Ok(changed) = Source::open(&path) else { panic!("it opens") };
        assert_eq!(states("http://a/").load(&changed), None, "another content");
        std::fs::write(states("http://a/").path(&source), "{half").expect("writes");
        assert_eq!(states("http://a/").load(&source), None, "damage is no news");
        states("http://a/").forget(&source);
        assert!(!states("http://a/").path(&source).exists());
    }
}
