//! Frames in the order of their arrival, in one file: what a live stream of images is stored as.
//!
//! A file is records one after the other, so that two files joined are a file, and a file that was cut (loss of power,
//! a full disk) holds every frame before the cut. A record, little endian:
//!
//! | bytes | what |
//! |---|---|
//! | 4 | `STRF` |
//! | 4 | bytes of the image |
//! | 8 | sequence number; grows from record to record, with gaps where frames were never received |
//! | 8 | capture time, ns since 1970, signed |
//! | 4 | CRC-32C of the image |
//! | 4 | CRC-32C of the 28 bytes before |
//! | … | the image: a whole JPEG, PNG or WebP file |

use std::fs::File;
use std::io::{BufReader, ErrorKind, Read};
use std::path::Path;

use super::EncodedFormat;
use crate::error::{Error, Result};

/// The extension of such files.
pub const EXTENSION: &str = "frames";

/// The first bytes of every record.
pub const MAGIC: [u8; 4] = *b"STRF";

/// Largest image of one record, bytes.
pub const MAX_IMAGE_BYTES: usize = 64 << 20;

/// Bytes of a record before its image.
pub const HEAD_BYTES: usize = 32;

/// One image as it was received.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameRecord {
    /// Its number in the stream.
    pub seq: u64,
    /// When it was captured, ns since 1970.
    pub capture_time_ns: i64,
    /// A whole JPEG, PNG or WebP file.
    pub image: Vec<u8>,
}

/// Which still image format some bytes begin as.
pub fn still_format(bytes: &[u8]) -> Option<EncodedFormat> {
    match bytes {
        [0xff, 0xd8, 0xff, ..] => Some(EncodedFormat::Jpeg),
        [0x89, b'P', b'N', b'G', ..] => Some(EncodedFormat::Png),
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => Some(EncodedFormat::Webp),
        _ => None,
    }
}

/// Appends a record of an image with its CRC-32C, which the caller has checked or made.
pub fn append_record(out: &mut Vec<u8>, seq: u64, capture_time_ns: i64, image: &[u8], image_crc32c: u32) {
    let start = out.len();
    out.extend(MAGIC);
    // The limit keeps every image far below 4 GiB.
    out.extend((image.len() as u32).to_le_bytes());
    out.extend(seq.to_le_bytes());
    out.extend(capture_time_ns.to_le_bytes());
    out.extend(image_crc32c.to_le_bytes());
    let head_crc = crc32c::crc32c(&out[start..]);
    out.extend(head_crc.to_le_bytes());
    out.extend(image);
}

/// What stands before an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecordHead {
    /// Size of the image, bytes; at most [`MAX_IMAGE_BYTES`].
    pub image_bytes: usize,
    /// Its number in the stream.
    pub seq: u64,
    /// When it was captured, ns since 1970.
    pub capture_time_ns: i64,
    /// The image's CRC-32C.
    pub image_crc32c: u32,
}

/// Reads a record's head.
///
/// # Errors
/// In words, where it is none.
pub fn read_head(head: &[u8; HEAD_BYTES]) -> std::result::Result<RecordHead, &'static str> {
    let u32_at = |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    let u64_at = |at: usize| u64::from(u32_at(at)) | u64::from(u32_at(at + 4)) << 32;
    if head[..4] != MAGIC || crc32c::crc32c(&head[..28]) != u32_at(28) {
        return Err("a record does not begin as one");
    }
    let image_bytes = u32_at(4) as usize;
    if image_bytes > MAX_IMAGE_BYTES {
        return Err("a record is larger than any frame may be");
    }
    Ok(RecordHead { image_bytes, seq: u64_at(8), capture_time_ns: u64_at(16) as i64, image_crc32c: u32_at(24) })
}

/// Reads the records of one file.
pub struct FrameFile {
    reader: BufReader<File>,
    name: String,
    ended: bool,
    /// Why reading ended before the file did, in words for people.
    pub damage: Option<String>,
}

impl FrameFile {
    /// Opens a file; `name` names it in messages.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub fn open(path: &Path, name: &str) -> Result<FrameFile> {
        let file = File::open(path).map_err(|e| Error::io(path, e))?;
        Ok(FrameFile { reader: BufReader::with_capacity(1 << 18, file), name: name.into(), ended: false, damage: None })
    }

    /// The next record; `None` at the end, or where the file is damaged: [`FrameFile::damage`] tells which.
    pub fn next_record(&mut self) -> Option<FrameRecord> {
        if self.ended {
            return None;
        }
        let record = self.read();
        self.ended = record.is_none();
        record
    }

    fn read(&mut self) -> Option<FrameRecord> {
        let mut head = [0u8; HEAD_BYTES];
        match self.fill(&mut head) {
            0 => return None,
            HEAD_BYTES => {}
            _ => return self.damaged("it ends within a record"),
        }
        let head = match read_head(&head) {
            Ok(head) => head,
            Err(how) => return self.damaged(how),
        };
        let mut image = vec![0; head.image_bytes];
        if self.fill(&mut image) < head.image_bytes {
            return self.damaged("it ends within a frame");
        }
        if crc32c::crc32c(&image) != head.image_crc32c {
            return self.damaged("a frame's checksum does not fit");
        }
        Some(FrameRecord { seq: head.seq, capture_time_ns: head.capture_time_ns, image })
    }

    /// Reads until the buffer is full or the file ends.
    fn fill(&mut self, buffer: &mut [u8]) -> usize {
        let mut filled = 0;
        while filled < buffer.len() {
            match self.reader.read(&mut buffer[filled..]) {
                Ok(0) => break,
                Ok(n) => filled += n,
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                // What was read stands; the caller hears that the rest is missing.
                Err(_) => break,
            }
        }
        filled
    }

    fn damaged(&mut self, how: &str) -> Option<FrameRecord> {
        self.damage = Some(format!("{}: {how}; the frames before were used", self.name));
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const JPEG: &[u8] = &[0xff, 0xd8, 0xff, 0xe0, 1, 2, 3];

    fn three_records() -> Vec<u8> {
        let mut bytes = Vec::new();
        for (seq, time_ns) in [(0, -5), (1, 40), (7, i64::MAX)] {
            append_record(&mut bytes, seq, time_ns, JPEG, crc32c::crc32c(JPEG));
        }
        bytes
    }

    fn read(bytes: &[u8]) -> (Vec<(u64, i64)>, Option<String>) {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("a.frames");
        std::fs::write(&path, bytes).expect("writes");
        let mut file = FrameFile::open(&path, "a.frames").expect("opens");
        let mut found = Vec::new();
        while let Some(record) = file.next_record() {
            assert_eq!(record.image, JPEG);
            found.push((record.seq, record.capture_time_ns));
        }
        assert!(file.next_record().is_none(), "the end stays the end");
        (found, file.damage)
    }

    #[test]
    fn records_come_back_and_a_cut_file_gives_what_it_holds() {
        let bytes = three_records();
        let all = [(0, -5), (1, 40), (7, i64::MAX)];
        assert_eq!(read(&bytes), (all.to_vec(), None));
        let one = HEAD_BYTES + JPEG.len();
        for cut in 0..bytes.len() {
            let (found, damage) = read(&bytes[..cut]);
            assert_eq!(found, all[..cut / one], "cut at {cut}");
            assert_eq!(damage.is_none(), cut % one == 0, "cut at {cut}");
        }
    }

    #[test]
    fn a_flipped_bit_anywhere_is_seen() {
        let bytes = three_records();
        for at in 0..HEAD_BYTES + JPEG.len() {
            let mut broken = bytes.clone();
            broken[at] ^= 4;
            let (found, damage) = read(&broken);
            assert!(found.is_empty() && damage.is_some(), "byte {at}");
        }
    }
}
