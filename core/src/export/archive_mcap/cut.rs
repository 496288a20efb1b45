//! A smaller archive out of a whole one, streamed: without the frames, every n-th frame, a stretch of the wall.

use std::io::Write;
use std::ops::RangeInclusive;
use std::path::Path;

use foxglove::messages::{Grid, PointCloud};
use foxglove::{Decode, Encode};
use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, Compression, McapError, WriteOptions, Writer};
use serde::Deserialize;

use super::points::STRIDE;
use super::topic;
use crate::error::{Error, Result};
use crate::mcap_file::{Message, Record, Records};
use crate::source::{EncodedFormat, is_key};

/// What to keep of an archive.
#[derive(Clone, Debug, PartialEq)]
pub struct ArchiveCut {
    /// The camera's frames.
    pub frames: bool,
    /// Only every n-th frame with what was measured in it, and every n-th point of the surface; of a video, which cannot be
    /// thinned, the frames at which decoding can start. At least 1.
    pub every: u32,
    /// Only the frames whose points lie there on average, the surface and the map there: world x, mm.
    pub x_mm: Option<RangeInclusive<f64>>,
}

impl Default for ArchiveCut {
    fn default() -> Self {
        ArchiveCut { frames: true, every: 1, x_mm: None }
    }
}

/// Where an archive is read from, from its start, as often as it is opened.
pub trait ArchiveSource {
    /// Its name in messages.
    fn name(&self) -> String;

    /// Opens it at its start.
    ///
    /// # Errors
    /// Where it cannot be read.
    fn open(&mut self) -> Result<Records>;
}

impl ArchiveSource for &Path {
    fn name(&self) -> String {
        self.display().to_string()
    }

    fn open(&mut self) -> Result<Records> {
        Records::open(&[self.to_path_buf()], &self.name())
    }
}

/// Writes the part of an archive that `how` keeps, from start to end and without going back: `out` may be a
/// connection. `out_name` names it in messages.
///
/// # Errors
/// What is no archive of Stria, or is damaged; where `out` takes no more.
pub fn cut(mut source: impl ArchiveSource, how: &ArchiveCut, out: impl Write, out_name: &str) -> Result<()> {
    if how.every == 0 {
        return Err(Error::field(out_name, "every", "0", "1 or more"));
    }
    let plan = Plan::read(&mut source, how)?;
    let options = WriteOptions::new()
        .compression(Some(Compression::Zstd))
        .compression_level(1)
        .compression_threads(0)
        .disable_seeking(true)
        .library(concat!("stria ", env!("CARGO_PKG_VERSION")));
    let writer = options.create(NoSeek::new(out)).map_err(|e| failed(out_name, e))?;
    let mut copy = PartWriter { writer, how, plan, name: out_name, channels: Vec::new() };
    copy.say_what()?;
    let mut records = source.open()?;
    while let Some(record) = records.next(|_| true)? {
        copy.take(record)?;
    }
    whole(&records, &source.name())?;
    copy.writer.finish().map(drop).map_err(|e| failed(out_name, e))?;
    copy.writer.into_inner().get_mut().flush().map_err(|e| Error::io(out_name, e))
}

/// A part of a damaged archive would pass for the whole of it.
fn whole(records: &Records, name: &str) -> Result<()> {
    match records.damage() {
        None => Ok(()),
        Some(damage) => Err(Error::input(name, damage, "a whole archive")),
    }
}

fn failed(name: &str, error: McapError) -> Error {
    match error {
        McapError::Io(e) => Error::io(name, e),
        other => Error::internal("archive", other),
    }
}

/// What of `/measurement` matters here.
#[derive(Deserialize)]
struct Place {
    x_mm: Option<f64>,
}

/// Which times are kept.
struct Plan {
    /// Log times of the frames that are kept, rising; `None`: all of them.
    frames_ns: Option<Vec<u64>>,
    /// Stretches of the video, from a frame at which decoding can start; `None`: all of it.
    video_ns: Option<Vec<RangeInclusive<u64>>>,
}

/// Two clocks that mean the same frame may differ by their rounding, ns.
const SAME_FRAME_NS: u64 = 1000;

impl Plan {
    fn read(source: &mut impl ArchiveSource, how: &ArchiveCut) -> Result<Plan> {
        if how.every == 1 && how.x_mm.is_none() {
            return Ok(Plan { frames_ns: None, video_ns: None });
        }
        let (mut frames_ns, mut stretches, mut keys_ns) = (Vec::new(), Vec::new(), Vec::new());
        let (mut inside_before, mut inside_frames, mut measured) = (false, 0_u32, false);
        let mut records = source.open()?;
        let needed = |name: &str| name == topic::MEASUREMENT || (how.frames && name == topic::VIDEO);
        while let Some(record) = records.next(|topic| needed(&topic.name))? {
            let Record::Message(message) = record else { continue };
            if message.topic.name == topic::VIDEO {
                if video_key(&message)? {
                    keys_ns.push(message.log_time_ns);
                }
                continue;
            }
            measured = true;
            let place: Place = serde_json::from_slice(&message.data)
                .map_err(|e| Error::input(source.name(), e.to_string(), "a measurement of Stria"))?;
            let inside = how.x_mm.as_ref().is_none_or(|range| place.x_mm.is_some_and(|x_mm| range.contains(&x_mm)));
            if inside {
                let now_ns = message.log_time_ns;
                match stretches.last_mut() {
                    Some(stretch) if inside_before => *stretch = *RangeInclusive::start(stretch)..=now_ns,
                    _ => stretches.push(now_ns..=now_ns),
                }
                if inside_frames.is_multiple_of(how.every) {
                    frames_ns.push(now_ns);
                }
                inside_frames += 1;
            }
            inside_before = inside;
        }
        whole(&records, &source.name())?;
        if !measured {
            return Err(Error::input(source.name(), "no measurements in it", "an archive of Stria"));
        }
        let video_ns = stretches.into_iter().map(|stretch| {
            let before = keys_ns.partition_point(|key_ns| *key_ns <= *stretch.start() + SAME_FRAME_NS);
            let start_ns = before.checked_sub(1).map_or(*stretch.start(), |key| keys_ns[key]);
            start_ns.min(*stretch.start())..=*stretch.end() + SAME_FRAME_NS
        });
        Ok(Plan { frames_ns: Some(frames_ns), video_ns: Some(video_ns.collect()) })
    }

    fn keeps_frame(&self, time_ns: u64) -> bool {
        let Some(frames_ns) = &self.frames_ns else { return true };
        let next = frames_ns.partition_point(|frame_ns| *frame_ns + SAME_FRAME_NS < time_ns);
        frames_ns.get(next).is_some_and(|frame_ns| frame_ns.abs_diff(time_ns) <= SAME_FRAME_NS)
    }

    fn keeps_video(&self, time_ns: u64) -> bool {
        self.video_ns.as_ref().is_none_or(|stretches| stretches.iter().any(|stretch| stretch.contains(&time_ns)))
    }
}

fn video_key(message: &Message) -> Result<bool> {
    let video: foxglove::messages::CompressedVideo = decoded(message)?;
    let format = match video.format.as_str() {
        "h264" => EncodedFormat::H264,
        "h265" => EncodedFormat::H265,
        "vp9" => EncodedFormat::Vp9,
        _ => EncodedFormat::Av1,
    };
    Ok(is_key(format, &video.data))
}

fn decoded<T: Decode>(message: &Message) -> Result<T> {
    T::decode(&message.data[..])
        .map_err(|e| Error::input(&message.topic.name, e.to_string(), "a message of its schema"))
}

/// The archive that is being written.
struct PartWriter<'a, W: Write> {
    writer: Writer<NoSeek<W>>,
    how: &'a ArchiveCut,
    plan: Plan,
    name: &'a str,
    /// Topics with their channels' numbers.
    channels: Vec<(String, u16)>,
}

impl<W: Write> PartWriter<'_, W> {
    fn say_what(&mut self) -> Result<()> {
        let how = self.how;
        let mut values = vec![("frames".to_string(), how.frames.to_string()), ("every".into(), how.every.to_string())];
        if let Some(range) = &how.x_mm {
            values.push(("from_x_mm".into(), range.start().to_string()));
            values.push(("to_x_mm".into(), range.end().to_string()));
        }
        self.metadata("cut", values.into_iter().collect())
    }

    fn take(&mut self, record: Record) -> Result<()> {
        match record {
            Record::Metadata { name, values } => self.metadata(&name, values),
            Record::Attachment(file) => {
                let attachment = Attachment {
                    log_time: file.log_time_ns,
                    create_time: file.log_time_ns,
                    name: file.name,
                    media_type: file.media_type,
                    data: file.data.into(),
                };
                self.writer.attach(&attachment).map_err(|e| failed(self.name, e))
            }
            Record::Message(message) => match self.part_of(message)? {
                Some(message) => self.message(&message),
                None => Ok(()),
            },
        }
    }

    /// What is kept of a message.
    fn part_of(&self, message: Message) -> Result<Option<Message>> {
        let (how, time_ns) = (self.how, message.log_time_ns);
        let kept = match message.topic.name.as_str() {
            topic::VIDEO => how.frames && self.plan.keeps_video(time_ns) && (how.every == 1 || video_key(&message)?),
            topic::IMAGE | topic::RAW => how.frames && self.plan.keeps_frame(time_ns),
            topic::TRANSFORMS | topic::PROFILE | topic::MEASUREMENT => self.plan.keeps_frame(time_ns),
            topic::SURFACE | topic::SURFACE_OVERVIEW => return self.part_of_surface(message),
            topic::DEPTH_MAP => self.piece_is_there(&message)?,
            _ => true,
        };
        Ok(kept.then_some(message))
    }

    fn part_of_surface(&self, message: Message) -> Result<Option<Message>> {
        if self.how.every == 1 && self.how.x_mm.is_none() {
            return Ok(Some(message));
        }
        let cloud: PointCloud = decoded(&message)?;
        let there = |point: &&[u8]| match (&self.how.x_mm, point) {
            (Some(range), [a, b, c, d, ..]) => {
                range.contains(&(f64::from(f32::from_le_bytes([*a, *b, *c, *d])) * 1000.0))
            }
            _ => true,
        };
        let points = cloud.data.chunks_exact(STRIDE).filter(there).step_by(self.how.every as usize);
        let data: Vec<u8> = points.flatten().copied().collect();
        if data.is_empty() {
            return Ok(None);
        }
        let mut packed = Vec::with_capacity(data.len() + 1024);
        let part = PointCloud { data: data.into(), ..cloud };
        part.encode(&mut packed).map_err(|e| Error::internal("archive", e))?;
        Ok(Some(Message { data: packed, ..message }))
    }

    fn piece_is_there(&self, message: &Message) -> Result<bool> {
        let Some(range) = &self.how.x_mm else { return Ok(true) };
        let grid: Grid = decoded(message)?;
        let (Some(pose), Some(cell)) = (grid.pose.and_then(|pose| pose.position), grid.cell_size) else {
            return Ok(true);
        };
        let (start_mm, width_mm) = (pose.x * 1000.0, f64::from(grid.column_count) * cell.x * 1000.0);
        Ok(start_mm <= *range.end() && start_mm + width_mm >= *range.start())
    }

    fn message(&mut self, message: &Message) -> Result<()> {
        let known = self.channels.iter().find(|(name, _)| *name == message.topic.name).map(|(_, id)| *id);
        let channel_id = match known {
            Some(id) => id,
            None => {
                let id = self.announce(message).map_err(|e| failed(self.name, e))?;
                self.channels.push((message.topic.name.clone(), id));
                id
            }
        };
        let header = MessageHeader {
            channel_id,
            sequence: message.sequence,
            log_time: message.log_time_ns,
            publish_time: message.publish_time_ns,
        };
        self.writer.write_to_known_channel(&header, &message.data).map_err(|e| failed(self.name, e))
    }

    fn announce(&mut self, message: &Message) -> std::result::Result<u16, McapError> {
        let topic = &message.topic;
        let schema = match topic.schema.as_str() {
            "" => 0,
            name => self.writer.add_schema(name, &topic.schema_encoding, &topic.schema_data)?,
        };
        self.writer.add_channel(schema, &topic.name, &topic.encoding, &topic.metadata)
    }

    fn metadata(&mut self, name: &str, values: std::collections::BTreeMap<String, String>) -> Result<()> {
        let record = Metadata { name: name.into(), metadata: values };
        self.writer.write_metadata(&record).map_err(|e| failed(self.name, e))
    }
}
