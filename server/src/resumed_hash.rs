//! A SHA-256 that is put down and taken up again: its state as text, kept in the records with the bytes it is of.

use sha2_resumable::Sha256;
use sha2_resumable::digest::Digest;
use sha2_resumable::digest::common::hazmat::{SerializableState, SerializedState};

use crate::error::{Error, Result};
use crate::store::hex;

/// The hash as it was put down; empty text is the hash of nothing yet.
pub fn read(state: &str) -> Result<Sha256> {
    if state.is_empty() {
        return Ok(Sha256::new());
    }
    let broken = || Error::Internal("the state of a hash cannot be read".into());
    let digit = |i: usize| u8::from_str_radix(state.get(i..i + 2)?, 16).ok();
    let bytes: Option<Vec<u8>> = (0..state.len()).step_by(2).map(digit).collect();
    let state = SerializedState::<Sha256>::try_from(bytes.ok_or_else(broken)?.as_slice()).map_err(|_| broken())?;
    Sha256::deserialize(&state).map_err(|_| broken())
}

/// Puts the hash down.
pub fn write(hash: &Sha256) -> String {
    hex(hash.serialize().as_ref())
}

/// The hash of all bytes, lower-case hex, from its last state.
pub fn finish(state: &str) -> Result<String> {
    Ok(hex(&read(state)?.finalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hash_goes_on_where_it_was_put_down() {
        let data: Vec<u8> = (0..1000u32).map(|i| (i * 7) as u8).collect();
        let whole = hex(&Sha256::digest(&data));
        for cut in [0, 1, 63, 64, 65, 640, 999, 1000] {
            let mut first = Sha256::new();
            first.update(&data[..cut]);
            let mut second = read(&write(&first)).expect("a state");
            second.update(&data[cut..]);
            assert_eq!(finish(&write(&second)).expect("a state"), whole, "cut at {cut}");
        }
        assert_eq!(finish("").expect("empty"), hex(&Sha256::digest(b"")));
        assert!(read("00").is_err() && read("zz").is_err());
    }
}
