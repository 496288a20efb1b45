//! Secrets: 256 random bits, shown once, kept as their hash.

use std::io::Read;

use base64::Engine;
use base64::prelude::BASE64_URL_SAFE_NO_PAD;

use crate::error::{Error, Result};
use crate::store::sha256_of;

/// What every token begins with, so that people and scanners know it for one.
const TOKEN_PREFIX: &str = "stria_";

/// A secret that is shown once.
pub(super) struct Secret(String);

impl Secret {
    /// A new token's.
    pub(super) fn for_token() -> Result<Secret> {
        Ok(Secret(format!("{TOKEN_PREFIX}{}", random_text()?)))
    }

    /// A new session's, or a login code.
    pub(super) fn new() -> Result<Secret> {
        Ok(Secret(random_text()?))
    }

    /// As it is shown.
    pub(super) fn into_text(self) -> String {
        self.0
    }

    /// As it is kept.
    pub(super) fn hash(&self) -> String {
        sha256_of(&self.0)
    }
}

fn random_text() -> Result<String> {
    let mut bytes = [0u8; 32];
    let source = "/dev/urandom";
    let read = std::fs::File::open(source).and_then(|mut file| file.read_exact(&mut bytes));
    read.map_err(|e| Error::io(source, e))?;
    Ok(BASE64_URL_SAFE_NO_PAD.encode(bytes))
}
