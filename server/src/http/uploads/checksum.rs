//! `Upload-Checksum`: one piece, checked as it comes.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use sha1::Sha1;
use sha2::{Digest, Sha256};

use crate::error::{Error, Result};
use crate::store::hex;

/// The algorithms that there are.
pub(super) const CHECKSUMS: &str = "sha1,sha256";

/// The checksum that a piece shall have.
pub(super) enum Checksum {
    Sha1(Sha1, Vec<u8>),
    Sha256(Sha256, Vec<u8>),
}

impl Checksum {
    /// Reads `Upload-Checksum`.
    pub(super) fn announced(header: Option<&str>) -> Result<Option<Checksum>> {
        let Some(header) = header else { return Ok(None) };
        let wrong = || {
            let found = format!("Upload-Checksum is {header:?}");
            Error::field("Upload-Checksum", found, format!("one of {CHECKSUMS}, a space, and the checksum in base64"))
        };
        let (algorithm, encoded) = header.split_once(' ').ok_or_else(wrong)?;
        let expected = BASE64_STANDARD.decode(encoded.trim()).map_err(|_| wrong())?;
        match algorithm {
            "sha1" => Ok(Some(Checksum::Sha1(Sha1::new(), expected))),
            "sha256" => Ok(Some(Checksum::Sha256(Sha256::new(), expected))),
            _ => Err(wrong()),
        }
    }

    /// Takes a chunk of the piece.
    pub(super) fn update(&mut self, chunk: &[u8]) {
        match self {
            Checksum::Sha1(hash, _) => hash.update(chunk),
            Checksum::Sha256(hash, _) => hash.update(chunk),
        }
    }

    /// The whole piece is there.
    pub(super) fn check(self) -> Result<()> {
        let (found, expected) = match self {
            Checksum::Sha1(hash, expected) => (hash.finalize().to_vec(), expected),
            Checksum::Sha256(hash, expected) => (hash.finalize().to_vec(), expected),
        };
        if found == expected {
            return Ok(());
        }
        let (found, expected) = (hex(&found), hex(&expected));
        Err(Error::Checksum(format!("the piece arrived with the checksum {found}; expected {expected}; send it again")))
    }
}
