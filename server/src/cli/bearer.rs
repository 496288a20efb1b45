//! The token with which a command comes to a server.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use clap::Args;

use super::Failed;

/// Which token.
#[derive(Args)]
pub(super) struct TokenArgs {
    /// A file with the server's token, which only its owner may read [default: ~/.config/stria/token where it exists;
    /// STRIA_TOKEN holds the token itself]
    #[arg(long, value_name = "FILE", env = "STRIA_TOKEN_FILE")]
    token_file: Option<PathBuf>,
}

impl TokenArgs {
    /// The token, where there is one.
    pub(super) fn token(&self) -> Result<Option<String>, Failed> {
        if let Some(path) = &self.token_file {
            return read(path).map(Some);
        }
        if let Ok(token) = std::env::var("STRIA_TOKEN")
            && !token.trim().is_empty()
        {
            return Ok(Some(token.trim().into()));
        }
        let usual = std::env::var_os("HOME").map(|home| Path::new(&home).join(".config/stria/token"));
        usual.filter(|path| path.is_file()).map(|path| read(&path)).transpose()
    }

    /// The headers of every request.
    pub(super) fn headers(&self) -> Result<reqwest::header::HeaderMap, Failed> {
        let mut headers = reqwest::header::HeaderMap::new();
        if let Some(token) = self.token()? {
            let mut value = reqwest::header::HeaderValue::from_str(&format!("Bearer {token}"))
                .map_err(|_| Failed::Input("the token has characters that no token has".into()))?;
            value.set_sensitive(true);
            headers.insert(reqwest::header::AUTHORIZATION, value);
        }
        Ok(headers)
    }
}

fn read(path: &Path) -> Result<String, Failed> {
    let unreadable =
        |e: std::io::Error| Failed::Input(format!("{}: {e}; expected a file with a token", path.display()));
    let mode = std::fs::metadata(path).map_err(unreadable)?.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        let path = path.display();
        return Err(Failed::Input(format!("{path}: its mode is {mode:04o}, others can use the token; expected 0600")));
    }
    let text = std::fs::read_to_string(path).map_err(unreadable)?;
    let token = text.trim();
    if token.is_empty() {
        return Err(Failed::Input(format!("{}: is empty; expected a token", path.display())));
    }
    Ok(token.into())
}
