//! A long run's exports need no more memory than a short one's.

use std::path::Path;
use std::process::{Command, Stdio};

use stria_tests::support::stria;

use super::{text, write_cloud};

/// Peak resident memory of a command of the binary, MB; it ends well, or with warnings.
pub(super) fn peak_mb(arguments: &[String]) -> f64 {
    let mut process =
        Command::new(stria()).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
    let status = format!("/proc/{}/status", process.id());
    let mut peak_kb = 0.0_f64;
    while process.try_wait().expect("waits").is_none() {
        // The kernel keeps the peak itself: the last look before the end is enough.
        let text = std::fs::read_to_string(&status).unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kb = line.and_then(|line| line.trim().trim_end_matches("kB").trim().parse().ok());
        peak_kb = peak_kb.max(kb.unwrap_or(0.0));
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    let code = process.wait().expect("ends").code();
    assert!(matches!(code, Some(0 | 3)), "{arguments:?} ended with {code:?}");
    assert!(peak_kb > 0.0, "{arguments:?}: its memory was never seen");
    peak_kb / 1024.0
}

fn export(folder: &Path, format: &str) -> Vec<String> {
    let out = folder.join(format!("out.{format}"));
    ["export", text(folder), "--format", format, "--out", text(&out)].map(String::from).to_vec()
}

#[test]
fn clouds_of_any_length_are_exported_in_the_same_memory() {
    let short = tempfile::tempdir().expect("a folder");
    let long = tempfile::tempdir().expect("a folder");
    write_cloud(short.path(), 500_000);
    write_cloud(long.path(), 5_000_000);
    for format in ["ply", "laz", "pcd", "e57"] {
        let (few, many) = (peak_mb(&export(short.path(), format)), peak_mb(&export(long.path(), format)));
        println!("{format}: {few:.0} MB for half a million points, {many:.0} MB for five millions");
        assert!(many < 200.0 && many < few + 20.0, "{format}: {few:.0} MB became {many:.0} MB");
    }
}
