//! A stream of JPEG images → its frames: bare images one after the other, or a multipart body as cameras and FFmpeg send
//! it. Images are found by their own markers, so that the boundary, declared or not, needs no reading; of a part's head
//! only `X-Timestamp` and `X-Seq` are.

use bytes::{Bytes, BytesMut};

use crate::error::{Error, Result};

/// Most bytes between two images: heads and boundaries.
const BETWEEN_BYTES: usize = 64 * 1024;

/// One image of the stream.
#[derive(Clone, Debug, PartialEq)]
pub struct JpegFrame {
    /// A whole JPEG file.
    pub image: Bytes,
    /// `X-Timestamp`: when it was captured, ns since 1970.
    pub capture_time_ns: Option<i64>,
    /// `X-Seq`: its number in the stream.
    pub seq: Option<u64>,
}

/// Cuts a stream into frames.
pub struct JpegSplitter {
    waiting: BytesMut,
    /// What came before the image.
    head: Vec<u8>,
    /// How far the image was read, once it has begun.
    inside: Option<Cursor>,
    most_bytes: usize,
}

/// A place inside an image.
#[derive(Clone, Copy)]
enum Cursor {
    /// At a marker.
    Marker(usize),
    /// In the compressed pixels.
    Pixels(usize),
}

const START: [u8; 3] = [0xff, 0xd8, 0xff];

impl JpegSplitter {
    /// For images of at most so many bytes.
    pub fn new(most_bytes: usize) -> JpegSplitter {
        JpegSplitter { waiting: BytesMut::new(), head: Vec::new(), inside: None, most_bytes }
    }

    /// Takes what arrived.
    pub fn push(&mut self, bytes: &[u8]) {
        self.waiting.extend_from_slice(bytes);
    }

    /// The next whole frame, if it is there.
    ///
    /// # Errors
    /// [`Error::Input`] where what comes is no stream of JPEG images.
    pub fn next_frame(&mut self) -> Result<Option<JpegFrame>> {
        if self.inside.is_none() {
            self.find_start()?;
        }
        let Some(cursor) = self.inside else { return Ok(None) };
        match self.find_end(cursor)? {
            Ok(end) => {
                let image = self.waiting.split_to(end).freeze();
                self.inside = None;
                let head = std::mem::take(&mut self.head);
                let (capture_time_ns, seq) = read_head(&head);
                Ok(Some(JpegFrame { image, capture_time_ns, seq }))
            }
            Err(reached) => {
                self.inside = Some(reached);
                if self.waiting.len() > self.most_bytes {
                    let found = format!("an image of more than {} bytes", self.waiting.len());
                    return Err(Error::field("body", found, format!("frames of at most {} bytes", self.most_bytes)));
                }
                Ok(None)
            }
        }
    }

    fn find_start(&mut self) -> Result<()> {
        let found = self.waiting.windows(START.len()).position(|w| w == START);
        // The last two bytes may be the beginning of one.
        let before = found.unwrap_or(self.waiting.len().saturating_sub(START.len() - 1));
        self.head.extend_from_slice(&self.waiting.split_to(before));
        if found.is_some() {
            self.inside = Some(Cursor::Marker(2));
        }
        if self.head.len() > BETWEEN_BYTES {
            let found = format!("{} bytes without a JPEG image", self.head.len());
            return Err(Error::field("body", found, "JPEG images, bare or as multipart, or MPEG-TS"));
        }
        Ok(())
    }

    /// Where the image ends, or how far it could be read.
    fn find_end(&self, mut cursor: Cursor) -> Result<std::result::Result<usize, Cursor>> {
        let bytes = &self.waiting[..];
        loop {
            match cursor {
                Cursor::Marker(at) => {
                    let Some([0xff, marker]) = bytes.get(at..at + 2) else {
                        return match bytes.get(at) {
                            Some(other) if *other != 0xff => Err(not_jpeg(at)),
                            _ => Ok(Err(cursor)),
                        };
                    };
                    cursor = match marker {
                        0xd9 => return Ok(Ok(at + 2)),
                        // Fill bytes, and markers without content.
                        0xff => Cursor::Marker(at + 1),
                        0x01 | 0xd0..=0xd8 => Cursor::Marker(at + 2),
                        _ => {
                            let Some([high, low]) = bytes.get(at + 2..at + 4) else { return Ok(Err(cursor)) };
                            let length = usize::from(u16::from_be_bytes([*high, *low]));
                            if length < 2 {
                                return Err(not_jpeg(at));
                            }
                            let after = at + 2 + length;
                            if after > bytes.len() {
                                return Ok(Err(cursor));
                            }
                            if *marker == 0xda { Cursor::Pixels(after) } else { Cursor::Marker(after) }
                        }
                    };
                }
                Cursor::Pixels(from) => {
                    // Inside the pixels 0xff stands before 0x00 (a stuffed byte) or a restart marker, else it is a marker.
                    let rest = bytes.get(from..).unwrap_or_default();
                    let is_end = |w: &[u8]| w[0] == 0xff && !matches!(w[1], 0x00 | 0xd0..=0xd7);
                    match rest.windows(2).position(is_end) {
                        Some(at) => cursor = Cursor::Marker(from + at),
                        None => return Ok(Err(Cursor::Pixels(from + rest.len().saturating_sub(1)))),
                    }
                }
            }
        }
    }
}

fn not_jpeg(at: usize) -> Error {
    Error::field("body", format!("an image that is no JPEG after {at} bytes"), "JPEG images, bare or as multipart")
}

/// Capture time and number, where a part's head gives them.
fn read_head(head: &[u8]) -> (Option<i64>, Option<u64>) {
    let text = String::from_utf8_lossy(head);
    let (mut time_ns, mut seq) = (None, None);
    for (name, value) in text.lines().filter_map(|line| line.split_once(':')) {
        match name.trim().to_ascii_lowercase().as_str() {
            "x-timestamp" => time_ns = read_seconds(value.trim()),
            "x-seq" => seq = value.trim().parse().ok(),
            _ => {}
        }
    }
    (time_ns, seq)
}

/// Seconds since 1970 with up to nine decimals → ns, without the rounding of a float.
fn read_seconds(text: &str) -> Option<i64> {
    let (whole, part) = text.split_once('.').unwrap_or((text, ""));
    let plain = |t: &str| t.bytes().all(|b| b.is_ascii_digit());
    if whole.is_empty() || !plain(whole) || !plain(part) {
        return None;
    }
    let nanos = format!("{part:0<9}").get(..9)?.parse::<i64>().ok()?;
    whole.parse::<i64>().ok()?.checked_mul(1_000_000_000)?.checked_add(nanos)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A JPEG in form: a comment that holds a whole small image, a scan with stuffed bytes and a restart, a second scan.
    fn image(tag: u8) -> Vec<u8> {
        let mut bytes = vec![0xff, 0xd8, 0xff, 0xe1, 0, 10, 0xff, 0xd8, 0xff, 0xe0, 0xff, 0xd9, tag, 0];
        bytes.extend([
            0xff, 0xda, 0, 4, 1, 2, tag, 0xff, 0x00, 7, 0xff, 0xd3, 9, 0xff, 0xff, 0xda, 0, 3, 1, 5, 0xff, 0xd9,
        ]);
        bytes
    }

    fn split(stream: &[u8], piece: usize) -> Vec<JpegFrame> {
        let mut splitter = JpegSplitter::new(1000);
        let mut frames = Vec::new();
        for part in stream.chunks(piece) {
            splitter.push(part);
            while let Some(frame) = splitter.next_frame().expect("JPEG") {
                frames.push(frame);
            }
        }
        frames
    }

    #[test]
    fn frames_come_out_whole_however_the_stream_is_cut() {
        let mut stream = b"--ffmpeg\r\nContent-type: image/jpeg\r\nX-Seq: 5\r\n\r\n".to_vec();
        stream.extend(image(1));
        stream.extend(b"\r\n--ffmpeg\r\nContent-type: image/jpeg\r\nX-Timestamp: 1700000000.25\r\n\r\n");
        stream.extend(image(2));
        stream.extend(image(3));
        for piece in [1, 2, 3, 7, 64, 1000] {
            let frames = split(&stream, piece);
            let images: Vec<&[u8]> = frames.iter().map(|f| &f.image[..]).collect();
            assert_eq!(images, [&image(1)[..], &image(2), &image(3)], "pieces of {piece}");
            assert_eq!(frames[0].seq, Some(5));
            assert_eq!(frames[1].capture_time_ns, Some(1_700_000_000_250_000_000));
            assert_eq!((frames[2].seq, frames[2].capture_time_ns), (None, None));
        }
    }

    #[test]
    fn what_is_no_jpeg_is_refused_and_nothing_grows() {
        let mut splitter = JpegSplitter::new(1000);
        splitter.push(&vec![b'x'; BETWEEN_BYTES + 10]);
        assert!(splitter.next_frame().is_err());
        let mut splitter = JpegSplitter::new(1000);
        splitter.push(&[0xff, 0xd8, 0xff, 0xda, 0, 2]);
        splitter.push(&[1; 2000]);
        assert!(splitter.next_frame().is_err());
        let mut splitter = JpegSplitter::new(1000);
        splitter.push(&[0xff, 0xd8, 0xff, 0xe0, 0, 1, 0, 0]);
        assert!(splitter.next_frame().is_err());
    }

    #[test]
    fn times_are_read_to_the_nanosecond() {
        for (text, ns) in [
            ("1700000000", Some(1_700_000_000_000_000_000)),
            ("1700000000.1", Some(1_700_000_000_100_000_000)),
            ("1700000000.123456789999", Some(1_700_000_000_123_456_789)),
            ("-1", None),
            ("now", None),
            ("99999999999999999999", None),
        ] {
            assert_eq!(read_seconds(text), ns, "{text}");
        }
    }
}
