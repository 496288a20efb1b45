//! The frames of a source as they are stored, not decoded: what the archive keeps.

use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};

use ffmpeg_the_third as ffmpeg;

use ffmpeg::codec::Id;

use super::folder::image_files;
use super::frame_file::still_format;
use super::mcap::{self, McapPackets};
use super::segments::{Records, SegmentFolder, SegmentKind, StreamPart};
use super::video::{display_name, open_container, open_pipe};
use super::{DEFAULT_FOLDER_FPS, EncodedFormat, EncodedFrame, VideoFacts, is_frame_file};
use crate::error::{Error, Result};

/// The frames of a source as stored, in decoding order.
pub struct EncodedFrames {
    name: String,
    kind: Kind,
}

enum Kind {
    Video(Box<VideoPackets>),
    Folder { files: Vec<PathBuf>, next: usize, fps: f64 },
    Records { records: Records, first_time_ns: Option<i64> },
    Parts(StreamParts),
    Mcap(Box<McapPackets>),
}

struct VideoPackets {
    input: ffmpeg::format::context::Input,
    stream: usize,
    time_base_s: f64,
    first_time_s: f64,
    frames_per_s: f64,
    facts: VideoFacts,
    /// How much later a frame is shown than decoded, ticks: the first packet says.
    delay: Option<i64>,
    packets: u32,
    last_order_s: f64,
    format: EncodedFormat,
    /// Set where packets carry length prefixes (MP4, MKV) instead of start codes.
    parameter_sets: Option<ParameterSets>,
}

/// Opens the source for its encoded frames.
///
/// # Errors
/// [`Error::Input`] where it cannot be opened, or is in a codec that archives have no schema for.
pub fn encoded_frames(path: &Path, name: &str, fps: Option<f64>, topics: &[String]) -> Result<EncodedFrames> {
    let kind = if let Some(segments) = SegmentFolder::recognise(path, name)? {
        match segments.kind {
            SegmentKind::Frames => Kind::Records { records: Records::of_folder(segments), first_time_ns: None },
            SegmentKind::TransportStream => Kind::Parts(StreamParts::new(segments, name)),
        }
    } else if is_frame_file(path)? {
        Kind::Records { records: Records::of_file(path, name), first_time_ns: None }
    } else if let Some(files) = mcap::files(path)? {
        Kind::Mcap(Box::new(McapPackets::open(&files, name, topics)?))
    } else if path.is_dir() {
        Kind::Folder { files: image_files(path, name)?, next: 0, fps: fps.unwrap_or(DEFAULT_FOLDER_FPS) }
    } else {
        Kind::Video(Box::new(VideoPackets::of_input(open_container(path, name)?, name)?))
    };
    Ok(EncodedFrames { name: name.to_string(), kind })
}

impl EncodedFrames {
    /// What the container says of its video beside the stream; `None` where it is none.
    pub fn video(&self) -> Option<VideoFacts> {
        match &self.kind {
            Kind::Video(packets) => packets.format.is_video().then(|| packets.facts.clone()),
            // A transport stream says all that there is to say in the stream itself.
            Kind::Folder { .. } | Kind::Records { .. } | Kind::Parts(_) => None,
            Kind::Mcap(packets) => packets.facts(),
        }
    }
}

impl Iterator for EncodedFrames {
    type Item = Result<EncodedFrame>;

    fn next(&mut self) -> Option<Self::Item> {
        match &mut self.kind {
            Kind::Video(packets) => packets.next().map(Ok),
            Kind::Records { records, first_time_ns } => next_stored(records, first_time_ns).transpose(),
            Kind::Parts(parts) => parts.next().transpose(),
            Kind::Mcap(packets) => packets.next(),
            Kind::Folder { files, next, fps } => {
                let file = files.get(*next)?;
                let index = *next;
                *next += 1;
                Some(image_file(file, index as f64 / *fps, &self.name))
            }
        }
    }
}

/// The next stored image of a known format; what was no image was left out of the frames as well.
fn next_stored(records: &mut Records, first_time_ns: &mut Option<i64>) -> Result<Option<EncodedFrame>> {
    while let Some(record) = records.next_record()? {
        let Some(format) = still_format(&record.image) else { continue };
        let first_ns = *first_time_ns.get_or_insert(record.capture_time_ns);
        let time_s = (record.capture_time_ns.saturating_sub(first_ns) as f64 / 1e9).max(0.0);
        return Ok(Some(EncodedFrame { time_s, order_s: time_s, format, key: true, data: record.image }));
    }
    Ok(None)
}

/// The packets of a transport stream in segments, one uninterrupted part after the other.
struct StreamParts {
    name: String,
    /// Where the next part begins.
    rest: Option<SegmentFolder>,
    open: Option<(VideoPackets, StreamPart, f64)>,
    first_arrival_ns: Option<i64>,
}

impl StreamParts {
    fn new(folder: SegmentFolder, name: &str) -> StreamParts {
        StreamParts { name: name.into(), rest: Some(folder), open: None, first_arrival_ns: None }
    }

    fn next(&mut self) -> Result<Option<EncodedFrame>> {
        loop {
            if let Some((packets, _, start_s)) = &mut self.open
                && let Some(frame) = packets.next()
            {
                let (time_s, order_s) = (*start_s + frame.time_s, *start_s + frame.order_s);
                return Ok(Some(EncodedFrame { time_s, order_s, ..frame }));
            }
            if let Some((packets, part, _)) = self.open.take() {
                drop(packets);
                self.rest = Some(part.end()?);
            }
            let Some(folder) = self.rest.take() else { return Ok(None) };
            let Some(part) = StreamPart::begin(folder)? else { return Ok(None) };
            let input = open_pipe(part.reader.as_raw_fd(), &self.name);
            match input.and_then(|input| VideoPackets::of_input(input, &self.name)) {
                Ok(packets) => {
                    let first_ns = self.first_arrival_ns.or(part.arrival_ns);
                    self.first_arrival_ns = first_ns;
                    let later_ns = part.arrival_ns.zip(first_ns).map_or(0, |(now, first)| now.saturating_sub(first));
                    self.open = Some((packets, part, (later_ns as f64 / 1e9).max(0.0)));
                }
                Err(Error::Input { .. }) => self.rest = Some(part.end()?),
                Err(error) => return Err(error),
            }
        }
    }
}

fn image_file(file: &Path, time_s: f64, name: &str) -> Result<EncodedFrame> {
    let data = std::fs::read(file).map_err(|e| Error::io(file, e))?;
    let format = still_format(&data).ok_or_else(|| {
        let subject = format!("{name}/{}", display_name(file));
        Error::input(subject, "an image format archives cannot hold", "JPEG, PNG or WebP")
    })?;
    Ok(EncodedFrame { time_s, order_s: time_s, format, key: true, data })
}

impl VideoPackets {
    fn of_input(input: ffmpeg::format::context::Input, name: &str) -> Result<VideoPackets> {
        let stream = input
            .streams()
            .best(ffmpeg::media::Type::Video)
            .ok_or_else(|| Error::input(name, "no video stream", "a file with a video stream"))?;
        let parameters = stream.parameters();
        let format = match parameters.id() {
            Id::H264 => EncodedFormat::H264,
            Id::HEVC => EncodedFormat::H265,
            Id::VP9 => EncodedFormat::Vp9,
            Id::AV1 => EncodedFormat::Av1,
            Id::MJPEG => EncodedFormat::Jpeg,
            Id::PNG => EncodedFormat::Png,
            Id::WEBP => EncodedFormat::Webp,
            other => {
                return Err(Error::input(
                    name,
                    format!("codec {other:?}"),
                    "H.264, H.265, VP9, AV1, MJPEG or PNG: archives have no schema for others",
                ));
            }
        };
        let parameter_sets = match format {
            EncodedFormat::H264 => ParameterSets::from_avcc(extradata(&stream)),
            EncodedFormat::H265 => ParameterSets::from_hvcc(extradata(&stream)),
            _ => None,
        };
        let base = stream.time_base();
        let time_base_s = f64::from(base.0) / f64::from(base.1.max(1));
        let start = stream.start_time();
        let first_time_s = if start == i64::MIN { 0.0 } else { start as f64 * time_base_s };
        let rate = stream.avg_frame_rate();
        let known = rate.0 > 0 && rate.1 > 0;
        let facts = VideoFacts {
            colour_space: parameters.color_space().name().map(String::from),
            colour_range: parameters.color_range().name().map(String::from),
            chroma_location: parameters.chroma_location().name().map(String::from),
            reordered: parameters.video_delay() > 0,
        };
        Ok(VideoPackets {
            stream: stream.index(),
            time_base_s,
            first_time_s,
            frames_per_s: if known { f64::from(rate.0) / f64::from(rate.1) } else { DEFAULT_FOLDER_FPS },
            facts,
            delay: None,
            packets: 0,
            last_order_s: 0.0,
            format,
            parameter_sets,
            input,
        })
    }

    fn next(&mut self) -> Option<EncodedFrame> {
        let mut packet = ffmpeg::Packet::empty();
        loop {
            match packet.read(&mut self.input) {
                Ok(()) if packet.stream() == self.stream => {}
                Ok(()) => continue,
                // A cut file ends here; the frames' own reading says so in its warnings.
                Err(_) => return None,
            }
            let Some(data) = packet.data() else { continue };
            let data = match &self.parameter_sets {
                Some(sets) => sets.annex_b(data, packet.is_key()),
                None => data.to_vec(),
            };
            let (time_s, order_s) = self.times(packet.pts(), packet.dts());
            return Some(EncodedFrame { time_s, order_s, format: self.format, key: packet.is_key(), data });
        }
    }

    /// Capture time and decoding time of the next packet, s; counted where the file has no stamps.
    fn times(&mut self, shown: Option<i64>, decoded: Option<i64>) -> (f64, f64) {
        let since_first_s = |ticks: i64| ticks as f64 * self.time_base_s - self.first_time_s;
        let counted_s = f64::from(self.packets) / self.frames_per_s;
        self.packets += 1;
        let time_s = shown.or(decoded).map_or(counted_s, since_first_s);
        let order_s = match (self.facts.reordered, decoded) {
            (false, _) => time_s,
            (true, Some(decoded)) => {
                let delay = *self.delay.get_or_insert(shown.map_or(0, |shown| shown - decoded));
                since_first_s(decoded + delay)
            }
            (true, None) => counted_s,
        };
        self.last_order_s = order_s.max(self.last_order_s);
        (time_s, self.last_order_s)
    }
}

/// Whether decoding can start at a frame: always for single images; for video by its own bytes, and never where these
/// do not say.
pub fn is_key(format: EncodedFormat, data: &[u8]) -> bool {
    match format {
        EncodedFormat::H264 => nal_heads(data).any(|head| head & 0x1f == 5),
        EncodedFormat::H265 => nal_heads(data).any(|head| (16..=21).contains(&(head >> 1 & 0x3f))),
        // A frame marker, two bits of profile, "shows a frame seen before", then 0 for a key frame.
        EncodedFormat::Vp9 => data.first().is_some_and(|b| b >> 6 == 0b10 && b & 0b0000_1100 == 0),
        // A sequence header among the units, which encoders repeat at key frames.
        EncodedFormat::Av1 => {
            data.first().is_some_and(|b| b >> 3 & 0xf == 1) || data.get(2).is_some_and(|b| b >> 3 & 0xf == 1)
        }
        EncodedFormat::Jpeg | EncodedFormat::Png | EncodedFormat::Webp | EncodedFormat::Raw(_) => true,
    }
}

/// The first byte of each unit of an Annex B frame.
fn nal_heads(data: &[u8]) -> impl Iterator<Item = u8> + '_ {
    data.windows(4).filter(|w| w[..3] == [0, 0, 1]).map(|w| w[3])
}

/// The codec's set-up bytes of a stream.
#[expect(
    unsafe_code,
    reason = "the FFmpeg wrapper has no accessor for extradata; pointer and size are FFmpeg's own pair"
)]
fn extradata<'a>(stream: &'a ffmpeg::format::stream::Stream<'_>) -> &'a [u8] {
    let parameters = stream.parameters();
    // SAFETY: FFmpeg keeps `extradata` valid for `extradata_size` bytes as long as the stream lives, and
    // the returned borrow cannot outlive the stream.
    unsafe {
        let raw = parameters.as_ptr();
        let (data, size) = ((*raw).extradata, (*raw).extradata_size);
        match usize::try_from(size) {
            Ok(size) if size > 0 && !data.is_null() => std::slice::from_raw_parts(data, size),
            _ => &[],
        }
    }
}

/// The parameter sets of an MP4 or MKV stream, and how long its length prefixes are.
struct ParameterSets {
    length_bytes: usize,
    /// The sets in Annex B form.
    annex_b: Vec<u8>,
}

const START_CODE: [u8; 4] = [0, 0, 0, 1];

impl ParameterSets {
    /// From an AVCDecoderConfigurationRecord (ISO/IEC 14496-15); `None` where it is not one.
    fn from_avcc(extradata: &[u8]) -> Option<ParameterSets> {
        if extradata.first() != Some(&1) {
            return None;
        }
        let length_bytes = usize::from(extradata.get(4)? & 3) + 1;
        let mut rest = extradata.get(5..)?;
        let mut annex_b = Vec::new();
        for mask in [0x1f, 0xff] {
            let count = rest.first()? & mask;
            rest = &rest[1..];
            for _ in 0..count {
                rest = take_set(rest, &mut annex_b)?;
            }
        }
        Some(ParameterSets { length_bytes, annex_b })
    }

    /// From an HEVCDecoderConfigurationRecord (ISO/IEC 14496-15); `None` where it is not one.
    fn from_hvcc(extradata: &[u8]) -> Option<ParameterSets> {
        if extradata.first() != Some(&1) {
            return None;
        }
        let length_bytes = usize::from(extradata.get(21)? & 3) + 1;
        let arrays = *extradata.get(22)?;
        let mut rest = extradata.get(23..)?;
        let mut annex_b = Vec::new();
        for _ in 0..arrays {
            let count = u16::from_be_bytes([*rest.get(1)?, *rest.get(2)?]);
            rest = &rest[3..];
            for _ in 0..count {
                rest = take_set(rest, &mut annex_b)?;
            }
        }
        Some(ParameterSets { length_bytes, annex_b })
    }

    /// A packet with start codes instead of lengths, the parameter sets before a key frame.
    fn annex_b(&self, packet: &[u8], key: bool) -> Vec<u8> {
        let mut out = if key { self.annex_b.clone() } else { Vec::new() };
        let mut rest = packet;
        while rest.len() > self.length_bytes {
            let (length, tail) = rest.split_at(self.length_bytes);
            let size = length.iter().fold(0usize, |n, b| (n << 8) | usize::from(*b)).min(tail.len());
            out.extend(START_CODE);
            out.extend(&tail[..size]);
            rest = &tail[size..];
        }
        out
    }
}

fn take_set<'a>(bytes: &'a [u8], annex_b: &mut Vec<u8>) -> Option<&'a [u8]> {
    let size = usize::from(u16::from_be_bytes([*bytes.first()?, *bytes.get(1)?]));
    annex_b.extend(START_CODE);
    annex_b.extend(bytes.get(2..2 + size)?);
    bytes.get(2 + size..)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn length_prefixes_become_start_codes() {
        let avcc = [1, 0x64, 0, 31, 0xff, 0xe1, 0, 2, 0x67, 0xaa, 1, 0, 1, 0x68];
        let sets = ParameterSets::from_avcc(&avcc).expect("avcC");
        assert_eq!(sets.length_bytes, 4);
        let packet = [0, 0, 0, 2, 0x65, 0x88, 0, 0, 0, 1, 0x06];
        let expected = [0, 0, 0, 1, 0x67, 0xaa, 0, 0, 0, 1, 0x68, 0, 0, 0, 1, 0x65, 0x88, 0, 0, 0, 1, 0x06];
        assert_eq!(sets.annex_b(&packet, true), expected);
        assert_eq!(sets.annex_b(&packet, false), expected[11..]);
        // A length past the packet's end takes what is there.
        assert_eq!(sets.annex_b(&[0, 0, 0, 9, 0x41], false), [0, 0, 0, 1, 0x41]);
    }

    #[test]
    fn broken_records_are_not_records() {
        assert!(ParameterSets::from_avcc(&[1, 2, 3]).is_none());
        assert!(ParameterSets::from_avcc(&[1, 0, 0, 0, 0xff, 0xe1, 0xff, 0xff]).is_none());
        assert!(ParameterSets::from_hvcc(&[0; 30]).is_none());
    }
}
