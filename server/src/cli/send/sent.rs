//! Where files of a watched folder go: `sent/` once the server has confirmed them, `refused/` with the reason.
//!
//! Beside each file in `sent/` lies `NAME.run.json`, which says what became of it. Only a file with such a confirmation,
//! and still the very file that was confirmed, is ever deleted.

use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::state::{sync_folder_of, write_whole};
use super::tus::{Sent, Source, modified_ns};

/// The end of a confirmation's name.
const CONFIRMATION: &str = ".run.json";

/// What the server confirmed.
#[derive(Debug, Serialize, Deserialize)]
struct Confirmation {
    run: String,
    job: String,
    page: String,
    server: String,
    sha256: String,
    bytes: u64,
    /// The file's own time, ns since 1970.
    modified_ns: i128,
    confirmed_at: jiff::Timestamp,
}

impl Confirmation {
    fn is_of(&self, file: &Path) -> bool {
        std::fs::symlink_metadata(file)
            .is_ok_and(|f| f.is_file() && f.len() == self.bytes && modified_ns(&f) == self.modified_ns)
    }
}

/// The two folders.
pub(super) struct Shelves {
    sent: PathBuf,
    refused: PathBuf,
}

impl Shelves {
    /// In a watched folder.
    pub(super) fn in_folder(folder: &Path) -> Shelves {
        Shelves { sent: folder.join("sent"), refused: folder.join("refused") }
    }

    /// Moves a confirmed file to `sent/`.
    pub(super) fn keep(&self, source: &Source, sent: &Sent, server: &str, page: &str) -> io::Result<()> {
        std::fs::create_dir_all(&self.sent)?;
        let place = free_place(&self.sent, &source.name);
        let confirmation = Confirmation {
            run: sent.run.clone(),
            job: sent.job.clone(),
            page: page.into(),
            server: server.into(),
            sha256: sent.sha256.clone(),
            bytes: source.bytes,
            modified_ns: source.modified_ns,
            confirmed_at: jiff::Timestamp::now(),
        };
        write_whole(&beside(&place, CONFIRMATION), &serde_json::to_vec_pretty(&confirmation)?)?;
        move_durably(&source.path, &place)
    }

    /// Deletes a confirmed file.
    pub(super) fn delete(&self, source: &Source) -> io::Result<()> {
        std::fs::remove_file(&source.path)?;
        sync_folder_of(&source.path)
    }

    /// Moves a refused file aside, with the reason; where it is now.
    pub(super) fn refuse(&self, source: &Source, why: &str) -> io::Result<PathBuf> {
        std::fs::create_dir_all(&self.refused)?;
        let place = free_place(&self.refused, &source.name);
        let text = format!("{why}\nRefused at {}. Nothing of it was kept by the server.\n", jiff::Timestamp::now());
        write_whole(&beside(&place, ".txt"), text.as_bytes())?;
        move_durably(&source.path, &place)?;
        Ok(place)
    }

    /// Deletes the oldest confirmed files until the rest is within the limit.
    pub(super) fn prune(&self, limit_bytes: u64) -> io::Result<()> {
        let mut kept = self.confirmed()?;
        kept.sort_by_key(|(_, confirmation)| (confirmation.confirmed_at, confirmation.modified_ns));
        let mut bytes: u64 = kept.iter().map(|(_, confirmation)| confirmation.bytes).sum();
        for (file, confirmation) in kept {
            if bytes <= limit_bytes {
                break;
            }
            std::fs::remove_file(&file)?;
            std::fs::remove_file(beside(&file, CONFIRMATION))?;
            bytes -= confirmation.bytes;
        }
        Ok(())
    }

    /// Files with a confirmation that is about them.
    fn confirmed(&self) -> io::Result<Vec<(PathBuf, Confirmation)>> {
        let entries = match std::fs::read_dir(&self.sent) {
            Ok(entries) => entries,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(e) => return Err(e),
        };
        let mut found = Vec::new();
        for path in entries.flatten().map(|entry| entry.path()) {
            let Some(file) = path.to_str().and_then(|text| text.strip_suffix(CONFIRMATION)) else { continue };
            let read = std::fs::read(&path).ok().and_then(|bytes| serde_json::from_slice::<Confirmation>(&bytes).ok());
            let file = PathBuf::from(file);
            found.extend(read.filter(|confirmation| confirmation.is_of(&file)).map(|c| (file, c)));
        }
        Ok(found)
    }
}

fn beside(file: &Path, ending: &str) -> PathBuf {
    let mut name = file.as_os_str().to_owned();
    name.push(ending);
    name.into()
}

/// A name that nobody has: robots use the same names again.
fn free_place(folder: &Path, name: &str) -> PathBuf {
    let (stem, extension) = match name.rsplit_once('.') {
        Some((stem, extension)) if !stem.is_empty() => (stem, format!(".{extension}")),
        _ => (name, String::new()),
    };
    let first = folder.join(name);
    let others = (2u64..).map(|n| folder.join(format!("{stem}-{n}{extension}")));
    // Names do not run out before numbers do.
    std::iter::once(first.clone()).chain(others).find(|path| !path.exists()).unwrap_or(first)
}

fn move_durably(from: &Path, to: &Path) -> io::Result<()> {
    std::fs::rename(from, to)?;
    sync_folder_of(to)?;
    sync_folder_of(from)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sent() -> Sent {
        Sent { run: "r".into(), job: "j".into(), sha256: "00".into() }
    }

    fn source(folder: &Path, name: &str, text: &str) -> Source {
        std::fs::write(folder.join(name), text).expect("writes");
        Source::open(&folder.join(name)).ok().expect("opens")
    }

    #[test]
    fn the_same_name_finds_another_place() {
        let folder = tempfile::tempdir().expect("folder");
        let shelves = Shelves::in_folder(folder.path());
        for text in ["one", "two", "three"] {
            let source = source(folder.path(), "run.tar.mp4", text);
            shelves.keep(&source, &sent(), "http://a/", "http://a/runs/r").expect("kept");
            assert!(!source.path.exists());
        }
        for (name, text) in [("run.tar.mp4", "one"), ("run.tar-2.mp4", "two"), ("run.tar-3.mp4", "three")] {
            let found = std::fs::read_to_string(folder.path().join("sent").join(name)).expect(name);
            assert_eq!(found, text);
            assert!(folder.path().join("sent").join(format!("{name}{CONFIRMATION}")).exists());
        }
    }

    #[test]
    fn only_what_was_confirmed_is_deleted_and_the_oldest_first() {
        let folder = tempfile::tempdir().expect("folder");
        let shelves = Shelves::in_folder(folder.path());
        for name in ["a.mp4", "b.mp4", "c.mp4", "d.mp4"] {
            let source = source(folder.path(), name, "ten bytes!");
            shelves.keep(&source, &sent(), "http://a/", "http://a/runs/r").expect("kept");
        }
        let at = |name: &str| folder.path().join("sent").join(name);
        // A stranger's file, and one that is not any more what was confirmed.
        std::fs::write(at("stranger.mp4"), "a stranger's, never sent").expect("writes");
        std::fs::write(at("a.mp4"), "another content").expect("writes");
        shelves.prune(10).expect("pruned");
        let left: Vec<_> =
            ["a.mp4", "b.mp4", "c.mp4", "d.mp4", "stranger.mp4"].into_iter().filter(|name| at(name).exists()).collect();
        assert_eq!(left, ["a.mp4", "d.mp4", "stranger.mp4"]);
        assert!(!at("b.mp4.run.json").exists() && at("d.mp4.run.json").exists());
    }

    #[test]
    fn a_refused_file_lies_beside_its_reason() {
        let folder = tempfile::tempdir().expect("folder");
        let source = source(folder.path(), "bad", "x");
        let place = Shelves::in_folder(folder.path()).refuse(&source, "no frames").expect("moved");
        assert!(place.exists() && !source.path.exists());
        let why = std::fs::read_to_string(folder.path().join("refused/bad.txt")).expect("the reason");
        assert!(why.starts_with("no frames\n"), "{why}");
    }
}
