//! Programs that we did not write, which read what Stria writes: Python's, Node's and Debian's.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

fn tests() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A program of the readers' Python environment.
///
/// # Panics
/// Where it is not there.
pub fn python_program(name: &str) -> PathBuf {
    let program = tests().join("../target/python/bin").join(name);
    assert!(program.exists(), "{} is missing: `make setup` installs it", program.display());
    program
}

/// Runs `tests/readers/<script>` and parses the JSON that it prints.
///
/// # Panics
/// Where the script is missing, fails, or prints something else.
pub fn read(script: &str, arguments: &[&Path]) -> Value {
    let mut command = Command::new(python_program("python"));
    command.arg(tests().join("readers").join(script)).args(arguments);
    json(command, script)
}

/// Runs `tests/browser/readers/<script>` with Node and parses the JSON that it prints.
///
/// # Panics
/// As [`read`].
pub fn read_with_node(script: &str, file: &Path) -> Value {
    let modules = tests().join("browser/node_modules/.installed");
    assert!(modules.exists(), "{} is missing: `make setup` installs what the Node readers need", modules.display());
    let mut command = Command::new("node");
    command.arg(tests().join("browser/readers").join(script)).arg(file);
    json(command, script)
}

fn json(mut command: Command, script: &str) -> Value {
    let output = command.output().unwrap_or_else(|e| panic!("{script} does not start ({e}): `make setup` installs it"));
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{script} refuses {:?}:\n{errors}", command.get_args());
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{script} prints no JSON ({e})"))
}

/// Runs a program to its success and gives its standard output.
///
/// # Panics
/// Where it is missing or fails.
pub fn run(program: impl AsRef<Path>, arguments: &[&str]) -> Vec<u8> {
    let program = program.as_ref();
    let output = Command::new(program).args(arguments).output();
    let output =
        output.unwrap_or_else(|e| panic!("{} does not start ({e}): `make setup` installs it", program.display()));
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{} {arguments:?}:\n{errors}", program.display());
    output.stdout
}
