//! `--watch`: store and forward. Files wait in a folder, leave it oldest first, and only when the server has confirmed.

use std::collections::HashMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::super::progress::size;
use super::super::{Failed, Outcome, Success};
use super::Desk;
use super::backoff::{GiveUp, Patience};
use super::fields::Fields;
use super::sent::Shelves;
use super::trouble::Trouble;
use super::tus::{Sender, Sent, Source, modified_ns};

/// Pause between two looks at the folder.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// Pause between two looks at how much waits.
const WARN_EVERY: Duration = Duration::from_secs(10);
/// A file that could not be read, or at which the server failed, waits this long while others go.
const LATER: Duration = Duration::from_secs(300);
/// Held by the one process that watches the folder.
const LOCK: &str = ".stria-send.lock";

/// What a watched folder is told.
pub(super) struct Options {
    /// A file is whole when it has not changed for so long.
    pub(super) settle: Duration,
    /// Confirmed files that are kept, bytes.
    pub(super) keep_sent_bytes: u64,
    /// Confirmed files are deleted instead.
    pub(super) delete_sent: bool,
    /// Above this, a person should know, bytes.
    pub(super) spool_bytes: u64,
}

/// Sends what is in the folder and what comes, until asked to stop.
pub(super) async fn run(desk: &Desk, folder: &Path, options: &Options) -> Outcome {
    let _lock = lock(folder)?;
    tokio::select! {
        ended = send_until_stopped(desk, folder, options) => ended?,
        () = warn_of_much(desk, folder, options.spool_bytes) => {}
    }
    desk.report.idle();
    Ok(Success::Done)
}

async fn send_until_stopped(desk: &Desk, folder: &Path, options: &Options) -> Result<(), Failed> {
    let mut watch = Watch {
        desk,
        folder,
        options,
        shelves: Shelves::in_folder(folder),
        seen: HashMap::new(),
        later: HashMap::new(),
        denied: Patience::new(GiveUp::Never),
    };
    while !desk.stop.is_cancelled() {
        let pause = match watch.next() {
            Ok(Some(path)) => watch.send(&path).await?,
            Ok(None) => LOOK_EVERY,
            // A folder on a disk that is away comes back with it.
            Err(e) => {
                desk.report.warning(format!("{}: {e}", folder.display()));
                LATER.min(10 * LOOK_EVERY)
            }
        };
        tokio::select! {
            () = tokio::time::sleep(pause) => {}
            () = desk.stop.cancelled() => {}
        }
    }
    Ok(())
}

/// Says so each time that more begins to wait than a person should not know of; also while no server is there.
async fn warn_of_much(desk: &Desk, folder: &Path, spool_bytes: u64) {
    let mut was_over = false;
    loop {
        // Whoever sends meets the same fault, and says so.
        let files = list(folder).unwrap_or_default();
        let bytes: u64 = files.iter().map(|(_, look)| look.bytes).sum();
        let over = bytes > spool_bytes;
        if over && !was_over {
            desk.report.warning(format!(
                "{} in {} file(s) wait in {}, more than --spool-gb: they come in faster than they go out",
                size(bytes),
                files.len(),
                folder.display()
            ));
        }
        was_over = over;
        tokio::time::sleep(WARN_EVERY).await;
    }
}

fn lock(folder: &Path) -> Result<File, Failed> {
    let path = folder.join(LOCK);
    let unusable = |e: std::io::Error| Failed::Input(format!("{}: {e}; expected a folder to write to", path.display()));
    let file = File::create(&path).map_err(unusable)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(std::fs::TryLockError::WouldBlock) => {
            Err(Failed::Other(format!("{}: another stria watches this folder", folder.display())))
        }
        Err(std::fs::TryLockError::Error(e)) => Err(unusable(e)),
    }
}

/// What a file looks like from outside.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Look {
    bytes: u64,
    modified_ns: i128,
}

struct Watch<'a> {
    desk: &'a Desk,
    folder: &'a Path,
    options: &'a Options,
    shelves: Shelves,
    /// How each file looked, and since when. A robot's clock may be set meanwhile, so files' times do not tell.
    seen: HashMap<PathBuf, (Look, Instant)>,
    /// Files that have to wait while others go.
    later: HashMap<PathBuf, Instant>,
    denied: Patience,
}

impl Watch<'_> {
    /// The oldest file that is whole.
    fn next(&mut self) -> std::io::Result<Option<PathBuf>> {
        let files = list(self.folder)?;
        let now = Instant::now();
        let before = std::mem::take(&mut self.seen);
        for (path, look) in &files {
            let since = before.get(path).filter(|(old, _)| old == look).map_or(now, |(_, since)| *since);
            self.seen.insert(path.clone(), (*look, since));
        }
        self.later.retain(|path, until| *until > now && files.iter().any(|(file, _)| file == path));
        let whole = |path: &PathBuf| self.seen[path].1 + self.options.settle <= now;
        let ready = files.into_iter().filter(|(path, _)| whole(path) && !self.later.contains_key(path));
        Ok(ready.min_by(|(a, x), (b, y)| (x.modified_ns, a).cmp(&(y.modified_ns, b))).map(|(path, _)| path))
    }

    /// Sends one file and puts it where it belongs; how long to wait before the next look.
    async fn send(&mut self, path: &Path) -> Result<Duration, Failed> {
        let source = match Source::open(path) {
            Ok(source) => source,
            Err(Failed::Input(why) | Failed::Other(why)) => return Ok(self.put_off(path, &why)),
            Err(Failed::Cancelled) => return Ok(Duration::ZERO),
        };
        let sender = Sender { desk: self.desk, give_up: GiveUp::Never };
        match sender.send(&source, source.recorded_at()).await {
            Ok(sent) => {
                self.denied.progress();
                Ok(self.confirm(&source, &sent))
            }
            Err(Trouble::Refused { field: Some(field), words }) if Fields::is_ours(&field) || field == "server" => {
                // Every file would be refused for the same fault; none of them is moved for it.
                Err(Failed::Input(words))
            }
            Err(Trouble::Refused { words, .. } | Trouble::Gone(words)) => Ok(self.refuse(&source, &words)),
            Err(Trouble::Denied(why)) => {
                let pause = self.denied.next_wait(None).unwrap_or(LATER);
                self.desk.report.retry(&why, pause);
                Ok(pause)
            }
            Err(Trouble::Changed(_)) => {
                // It was not whole after all, or somebody took it away: it is looked at anew.
                self.desk.states.forget(&source);
                self.seen.remove(path);
                self.desk.report.idle();
                Ok(LOOK_EVERY)
            }
            Err(Trouble::GaveUp(why) | Trouble::Local(why) | Trouble::Passing { why, .. }) => {
                Ok(self.put_off(path, &why))
            }
            Err(Trouble::Stopped) => Ok(Duration::ZERO),
        }
    }

    fn confirm(&mut self, source: &Source, sent: &Sent) -> Duration {
        let page = self.desk.contact.page(&sent.run);
        if !source.is_unchanged() {
            // What was sent is safe; what lies there now is another file.
            self.desk.states.forget(source);
            self.seen.remove(&source.path);
            return Duration::ZERO;
        }
        let placed = if self.options.delete_sent {
            self.shelves.delete(source)
        } else {
            self.shelves.keep(source, sent, self.desk.contact.server().as_str(), page.as_str())
        };
        if let Err(e) = placed {
            // Its state stays: the next look finds the same run again.
            return self.put_off(&source.path, &format!("it is sent, but cannot be moved: {e}"));
        }
        self.desk.states.forget(source);
        self.desk.report.sent(&source.name, source.bytes, &sent.run, &sent.job, page.as_str());
        if let Err(e) = self.shelves.prune(self.options.keep_sent_bytes) {
            self.desk.report.warning(format!("{}/sent: {e}", self.folder.display()));
        }
        Duration::ZERO
    }

    fn refuse(&mut self, source: &Source, why: &str) -> Duration {
        match self.shelves.refuse(source, why) {
            Ok(place) => {
                self.desk.states.forget(source);
                self.desk.report.refused(&source.name, why, &place);
                Duration::ZERO
            }
            Err(e) => self.put_off(&source.path, &format!("{why}; and it cannot be moved aside: {e}")),
        }
    }

    /// Others go first.
    fn put_off(&mut self, path: &Path, why: &str) -> Duration {
        self.desk.report.idle();
        self.desk.report.warning(format!("{}: {why}; it waits while others go", path.display()));
        self.later.insert(path.to_path_buf(), Instant::now() + LATER);
        Duration::ZERO
    }
}

/// The files that may be sent some day.
fn list(folder: &Path) -> std::io::Result<Vec<(PathBuf, Look)>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with('.') || name.ends_with(".part") {
            continue;
        }
        // A file that went away since is no fault.
        let Ok(facts) = entry.metadata() else { continue };
        if facts.is_file() {
            files.push((entry.path(), Look { bytes: facts.len(), modified_ns: modified_ns(&facts) }));
        }
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_files_that_are_meant_are_listed() {
        let folder = tempfile::tempdir().expect("folder");
        for name in ["b.mp4", "a.mp4", ".hidden.mp4", "c.mp4.part", "no extension"] {
            std::fs::write(folder.path().join(name), name).expect("writes");
        }
        std::fs::create_dir(folder.path().join("sent")).expect("made");
        std::os::unix::fs::symlink("a.mp4", folder.path().join("link.mp4")).expect("made");
        let mut names: Vec<_> = list(folder.path())
            .expect("listed")
            .into_iter()
            .map(|(path, _)| path.file_name().expect("a name").to_string_lossy().into_owned())
            .collect();
        names.sort();
        assert_eq!(names, ["a.mp4", "b.mp4", "no extension"]);
    }
}
