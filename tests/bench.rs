//! The bench's accuracy evaluation (`tests/bench/accuracy.py`) held against errors that are known.

use std::path::Path;
use std::process::Command;

#[test]
fn known_errors_give_known_figures() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let python = root.join("target/python/bin/python");
    assert!(python.exists(), "{} is missing: `make setup` installs it", python.display());
    let script = root.join("tests/bench/test_accuracy.py");
    let output = Command::new(&python).arg("-B").arg(&script).output().expect("Python starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{}{}", text(&output.stdout), text(&output.stderr));
    assert!(text(&output.stdout).contains("test_alignment_finds_a_known_motion holds"), "it checked nothing");
}
