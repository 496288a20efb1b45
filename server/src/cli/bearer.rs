//! The token with which a command comes to a server.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use super::Failed;

/// The token: of the file that was named, else of STRIA_TOKEN, else of the usual file where there is one.
pub(super) fn token(file: Option<&Path>) -> Result<Option<String>, Failed> {
    if let Some(path) = file {
        return read(path).map(Some);
    }
    if let Ok(token) = std::env::var("STRIA_TOKEN")
        && !token.trim().is_empty()
    {
        return check(token.trim(), "STRIA_TOKEN").map(Some);
    }
    let usual = std::env::var_os("HOME").map(|home| Path::new(&home).join(".config/stria/token"));
    usual.filter(|path| path.is_file()).map(|path| read(&path)).transpose()
}

/// A file that its owner alone may read.
fn read(path: &Path) -> Result<String, Failed> {
    let unreadable =
        |e: std::io::Error| Failed::Input(format!("{}: {e}; expected a file with a token", path.display()));
    let mode = std::fs::metadata(path).map_err(unreadable)?.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        let path = path.display();
        return Err(Failed::Input(format!("{path}: its mode is {mode:04o}, others can use the token; expected 0600")));
    }
    let text = std::fs::read_to_string(path).map_err(unreadable)?;
    check(text.trim(), &path.display().to_string())
}

fn check(token: &str, place: &str) -> Result<String, Failed> {
    if token.is_empty() {
        return Err(Failed::Input(format!("{place}: is empty; expected a token")));
    }
    if !token.bytes().all(|b| b.is_ascii_graphic()) {
        let expected = "one line of letters, digits and signs";
        return Err(Failed::Input(format!("{place}: holds more than a token; expected {expected}")));
    }
    Ok(token.into())
}
