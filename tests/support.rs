//! What the tests of the service share: the real binary, simulated runs, a server of their own.

pub mod cluster;
pub mod dice;
pub mod form;
pub mod postgres;
pub mod readers;
pub mod s3;
pub mod server;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use tempfile::TempDir;

/// The binary under test, beside this test's own executable.
///
/// # Panics
/// Where it was not built.
pub fn stria() -> PathBuf {
    let own = std::env::current_exe().expect("a test has a path");
    let folder = own.parent().and_then(Path::parent).expect("tests lie in target/PROFILE/deps");
    let binary = folder.join("stria");
    assert!(binary.exists(), "{} is missing: run `cargo build --release` first", binary.display());
    binary
}

/// Runs the binary to its end.
///
/// # Panics
/// Where it cannot be started.
pub fn run_stria(arguments: &[&str]) -> Output {
    Command::new(stria()).args(arguments).output().expect("the binary starts")
}

/// Runs the binary to its end, with variables in its environment.
///
/// # Panics
/// Where it cannot be started.
pub fn run_stria_with(arguments: &[&str], variables: &[(String, String)]) -> Output {
    let variables = variables.iter().map(|(name, value)| (name, value));
    Command::new(stria()).args(arguments).envs(variables).output().expect("the binary starts")
}

/// A simulated run: its video and its rig.
pub struct Run {
    /// The video.
    pub video: PathBuf,
    /// The rig file.
    pub rig: PathBuf,
    _folder: TempDir,
}

impl Run {
    /// A run along a wall.
    ///
    /// # Panics
    /// Where it cannot be simulated.
    pub fn simulate(seconds: &str, fps: &str, size: &str) -> Run {
        Run::simulate_with(&["--seconds", seconds, "--fps", fps, "--size", size])
    }

    /// A run along a wall, with more said about it.
    ///
    /// # Panics
    /// Where it cannot be simulated.
    pub fn simulate_with(options: &[&str]) -> Run {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let out = folder.path().join("run");
        let text = out.to_str().expect("a plain path");
        let made = run_stria(&[&["simulate", "wall", "--out", text], options].concat());
        assert!(made.status.success(), "stria simulate: {}", String::from_utf8_lossy(&made.stderr));
        Run { video: out.join("video.mp4"), rig: out.join("rig.toml"), _folder: folder }
    }

    /// The video's bytes.
    ///
    /// # Panics
    /// Where it cannot be read.
    pub fn video_bytes(&self) -> Vec<u8> {
        std::fs::read(&self.video).expect("the video was made")
    }

    /// The rig's text.
    ///
    /// # Panics
    /// Where it cannot be read.
    pub fn rig_text(&self) -> String {
        std::fs::read_to_string(&self.rig).expect("the rig was made")
    }
}

/// A run that is processed in about a second.
pub fn short_run() -> &'static Run {
    static RUN: OnceLock<Run> = OnceLock::new();
    RUN.get_or_init(|| Run::simulate("1", "8", "320x240"))
}

/// A run that is processed in some seconds: long enough to stop it in the middle.
pub fn long_run() -> &'static Run {
    static RUN: OnceLock<Run> = OnceLock::new();
    RUN.get_or_init(|| Run::simulate("2", "30", "640x480"))
}

/// All files below a folder, by their paths in it.
///
/// # Panics
/// Where it cannot be read.
pub fn files_below(folder: &Path) -> Vec<String> {
    let mut files = Vec::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(next) = folders.pop() {
        let Ok(entries) = std::fs::read_dir(&next) else { continue };
        for entry in entries.flatten() {
            match entry.path() {
                path if path.is_dir() => folders.push(path),
                path => files.push(path.strip_prefix(folder).unwrap_or(&path).display().to_string()),
            }
        }
    }
    files.sort();
    files
}

/// Waits for what follows an answer a moment later, such as clean-up.
///
/// # Panics
/// Where it does not come.
pub fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !condition() {
        assert!(begun.elapsed() < Duration::from_secs(20), "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}
