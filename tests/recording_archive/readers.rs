//! Runs the Python readers of the tests.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// Runs `tests/readers/<script>` and parses the JSON that it prints.
pub(super) fn read(script: &str, arguments: &[&Path]) -> Value {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python: PathBuf = tests.join("../target/python/bin/python");
    assert!(python.exists(), "the readers' Python is missing: `make setup` installs it");
    let output = Command::new(&python)
        .arg(tests.join("readers").join(script))
        .args(arguments)
        .output()
        .expect("target/python starts (`make setup` installs it)");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{script} refuses {arguments:?}:\n{errors}");
    serde_json::from_slice(&output.stdout).expect("the reader prints JSON")
}

/// Runs a Debian program and gives its standard output.
pub(super) fn run(program: &str, arguments: &[&str]) -> Vec<u8> {
    let output = Command::new(program).args(arguments).output();
    let output = output.unwrap_or_else(|e| panic!("{program} does not start ({e}): `make setup` installs it"));
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{program} {arguments:?}:\n{errors}");
    output.stdout
}
