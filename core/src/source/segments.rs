//! A run's source as numbered segments in a folder, which may still grow: how a live run is read, and how any run is
//! read again that came as segments.
//!
//! Who fills the folder (a worker, from the store) writes, each under its final name only once it is whole:
//!
//! | file | what |
//! |---|---|
//! | `segments` | `frames` or `ts`: what the segments hold |
//! | `000000.frames` … | images with their times ([the form](super::frame_file)) |
//! | `000000.ts` … | an MPEG transport stream, cut anywhere |
//! | `000007.part` | segment 7 begins a new stream (the sender came back): its time of arrival, ns since 1970 |
//! | `closed` | no further segments come |

use std::fs::File;
use std::io::{ErrorKind, Write};
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use super::frame_file::{self, FrameFile, FrameRecord};
use super::still::StillDecoder;
use super::video::{Video, open_pipe};
use super::{Frame, Source, SourceInfo};
use crate::error::{Error, Result};

/// How often an open folder is looked at for the next segment.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// What segments hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SegmentKind {
    /// Images with their times.
    Frames,
    /// An MPEG transport stream.
    TransportStream,
}

impl SegmentKind {
    /// The extension of the segments' files, and the word in the file `segments`.
    pub fn extension(self) -> &'static str {
        match self {
            SegmentKind::Frames => frame_file::EXTENSION,
            SegmentKind::TransportStream => "ts",
        }
    }

    /// The kind of an extension.
    pub fn of_extension(extension: &str) -> Option<SegmentKind> {
        [SegmentKind::Frames, SegmentKind::TransportStream].into_iter().find(|kind| kind.extension() == extension)
    }
}

/// The names inside such a folder.
pub mod names {
    use super::SegmentKind;

    /// Says what the segments hold.
    pub const KIND: &str = "segments";
    /// Says that no further segments come.
    pub const CLOSED: &str = "closed";

    /// A segment, from 0.
    pub fn segment(number: u32, kind: SegmentKind) -> String {
        format!("{number:06}.{}", kind.extension())
    }

    /// Says that a segment begins a new stream.
    pub fn part(number: u32) -> String {
        format!("{number:06}.part")
    }
}

/// The segments of a folder, in order.
#[derive(Clone)]
pub(super) struct SegmentFolder {
    path: PathBuf,
    name: String,
    pub(super) kind: SegmentKind,
    next: u32,
}

/// One segment.
pub(super) struct Segment {
    pub(super) path: PathBuf,
    /// Where it begins a new stream: when that arrived, ns since 1970.
    part_arrival_ns: Option<i64>,
}

impl SegmentFolder {
    /// The folder as one of segments; `None` where it is none. `name` names it in messages.
    pub(super) fn recognise(path: &Path, name: &str) -> Result<Option<SegmentFolder>> {
        let marker = path.join(names::KIND);
        let word = match std::fs::read_to_string(&marker) {
            Ok(word) => word,
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => return Ok(None),
            Err(e) => return Err(Error::io(&marker, e)),
        };
        let kind = SegmentKind::of_extension(word.trim())
            .ok_or_else(|| Error::field(name, names::KIND, format!("{word:?}"), "frames or ts"))?;
        Ok(Some(SegmentFolder { path: path.to_path_buf(), name: name.into(), kind, next: 0 }))
    }

    /// The next segment if it is there already.
    fn present(&self) -> Result<Option<Segment>> {
        let path = self.path.join(names::segment(self.next, self.kind));
        if !path.exists() {
            return Ok(None);
        }
        let part = self.path.join(names::part(self.next));
        let part_arrival_ns = match std::fs::read_to_string(&part) {
            Ok(text) => Some(text.trim().parse().map_err(|_| {
                Error::field(&self.name, names::part(self.next), format!("{text:?}"), "a time in ns since 1970")
            })?),
            Err(e) if e.kind() == ErrorKind::NotFound => None,
            Err(e) => return Err(Error::io(&part, e)),
        };
        Ok(Some(Segment { path, part_arrival_ns }))
    }

    /// The next segment, waited for; `None` once the folder is closed, or when nobody wants it any more.
    fn peek(&self, stop: &AtomicBool) -> Result<Option<Segment>> {
        let closed = self.path.join(names::CLOSED);
        loop {
            // Closed comes after the last segment: look for it first.
            let ended = closed.exists() || stop.load(Ordering::Relaxed);
            if let Some(segment) = self.present()? {
                return Ok(Some(segment));
            }
            if ended {
                return Ok(None);
            }
            std::thread::sleep(LOOK_EVERY);
        }
    }

    /// Whether more may come.
    fn is_open(&self) -> bool {
        !self.path.join(names::CLOSED).exists()
    }

    fn advance(&mut self) {
        self.next += 1;
    }

    /// All files that there are, for their hashes.
    pub(super) fn files(&self) -> Result<Vec<PathBuf>> {
        let mut all = SegmentFolder { next: 0, ..self.clone() };
        let mut files = Vec::new();
        while let Some(segment) = all.present()? {
            files.push(segment.path);
            all.advance();
        }
        Ok(files)
    }
}

/// The records of frame files, one after the other.
pub(super) struct Records {
    files: RecordFiles,
    open: Option<FrameFile>,
    damage: Vec<String>,
    name: String,
}

enum RecordFiles {
    One(Option<PathBuf>),
    Folder(SegmentFolder),
}

impl Records {
    /// Of one file.
    pub(super) fn of_file(path: &Path, name: &str) -> Records {
        Records { files: RecordFiles::One(Some(path.into())), open: None, damage: Vec::new(), name: name.into() }
    }

    /// Of a folder, waiting for what is still to come.
    pub(super) fn of_folder(folder: SegmentFolder) -> Records {
        let name = folder.name.clone();
        Records { files: RecordFiles::Folder(folder), open: None, damage: Vec::new(), name }
    }

    /// The next record; `None` at the end of the last file.
    pub(super) fn next_record(&mut self) -> Result<Option<FrameRecord>> {
        loop {
            if let Some(file) = &mut self.open {
                if let Some(record) = file.next_record() {
                    return Ok(Some(record));
                }
                self.damage.extend(file.damage.take());
                self.open = None;
            }
            let path = match &mut self.files {
                RecordFiles::One(path) => path.take(),
                RecordFiles::Folder(folder) => {
                    let segment = folder.peek(&AtomicBool::new(false))?;
                    folder.advance();
                    segment.map(|s| s.path)
                }
            };
            let Some(path) = path else { return Ok(None) };
            self.open = Some(FrameFile::open(&path, &self.name)?);
        }
    }
}

/// Stored images as the frames of a run.
pub(super) struct StoredFrames {
    info: SourceInfo,
    records: Records,
    decoder: StillDecoder,
    /// The first frame, which had to be decoded to know its size.
    first: Option<Frame>,
    next: u32,
    first_time_ns: Option<i64>,
    last_time_s: f64,
    last_seq: Option<u64>,
    never_received: u64,
    left_out: u64,
    first_left_out: Option<String>,
}

impl StoredFrames {
    /// Waits for the first frame that can be decoded.
    pub(super) fn open(records: Records, files: Vec<PathBuf>) -> Result<StoredFrames> {
        let still_open = matches!(&records.files, RecordFiles::Folder(folder) if folder.is_open());
        let info =
            SourceInfo { width_px: 0, height_px: 0, frames_announced: None, frames_per_s: None, files, still_open };
        let mut frames = StoredFrames {
            info,
            records,
            decoder: StillDecoder::default(),
            first: None,
            next: 0,
            first_time_ns: None,
            last_time_s: 0.0,
            last_seq: None,
            never_received: 0,
            left_out: 0,
            first_left_out: None,
        };
        let Some(first) = frames.decode_next()? else {
            let found = frames.first_left_out.unwrap_or_else(|| "no frame".into());
            return Err(Error::input(frames.records.name, found, "at least one whole image"));
        };
        (frames.info.width_px, frames.info.height_px) = (first.image.width_px(), first.image.height_px());
        frames.first = Some(first);
        Ok(frames)
    }

    fn decode_next(&mut self) -> Result<Option<Frame>> {
        while let Some(record) = self.records.next_record()? {
            let expected = self.last_seq.map_or(record.seq, |last| last.saturating_add(1));
            self.never_received += record.seq.saturating_sub(expected);
            self.last_seq = Some(record.seq);
            let label = format!("{} frame {}", self.records.name, record.seq);
            match self.decoder.decode(&record.image, &label).and_then(|image| self.of_size(image, &label)) {
                Ok(image) => {
                    let first_ns = *self.first_time_ns.get_or_insert(record.capture_time_ns);
                    let since_first_s = record.capture_time_ns.saturating_sub(first_ns) as f64 / 1e9;
                    // Clocks jump; the order of arrival does not.
                    self.last_time_s = since_first_s.max(self.last_time_s);
                    let frame = Frame { index: self.next, time_s: self.last_time_s, image };
                    self.next += 1;
                    return Ok(Some(frame));
                }
                Err(error @ Error::Input { .. }) => {
                    self.left_out += 1;
                    self.first_left_out.get_or_insert(error.to_string());
                }
                Err(error) => return Err(error),
            }
        }
        Ok(None)
    }

    fn of_size(&self, image: super::Image, label: &str) -> Result<super::Image> {
        let (width, height) = (self.info.width_px, self.info.height_px);
        if self.next == 0 || (image.width_px(), image.height_px()) == (width, height) {
            return Ok(image);
        }
        let found = format!("{}x{} px", image.width_px(), image.height_px());
        Err(Error::field(label, "image size", found, format!("{width}x{height} px like the first image")))
    }
}

impl Source for StoredFrames {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Frame>> {
        match self.first.take() {
            Some(first) => Ok(Some(first)),
            None => self.decode_next(),
        }
    }

    fn warnings(&self) -> Vec<String> {
        let name = &self.records.name;
        let mut warnings = self.records.damage.clone();
        if self.never_received > 0 {
            warnings.push(format!("{name}: {} frames were never received", self.never_received));
        }
        if let Some(first) = &self.first_left_out {
            warnings.push(format!("{name}: {} images were left out; the first: {first}", self.left_out));
        }
        warnings
    }
}

/// One uninterrupted transport stream of a folder, fed through a pipe by a thread of its own.
pub(super) struct StreamPart {
    /// The end that the demuxer reads.
    pub(super) reader: OwnedFd,
    /// When the stream began to arrive, ns since 1970, where that is known.
    pub(super) arrival_ns: Option<i64>,
    stop: Arc<AtomicBool>,
    feeder: Option<JoinHandle<Result<SegmentFolder>>>,
}

impl StreamPart {
    /// Begins at the folder's next segment; `None` where no more come.
    pub(super) fn begin(folder: SegmentFolder) -> Result<Option<StreamPart>> {
        let stop = Arc::new(AtomicBool::new(false));
        let Some(first) = folder.peek(&stop)? else { return Ok(None) };
        let (reader, writer) = std::io::pipe().map_err(|e| Error::internal("source", format!("no pipe: {e}")))?;
        let told = stop.clone();
        let feeder = std::thread::Builder::new()
            .name("segments".into())
            .spawn(move || feed(folder, writer, &told))
            .map_err(|e| Error::internal("source", format!("no thread: {e}")))?;
        Ok(Some(StreamPart { reader: reader.into(), arrival_ns: first.part_arrival_ns, stop, feeder: Some(feeder) }))
    }

    /// The folder where this stream ends: the next part begins there.
    pub(super) fn end(mut self) -> Result<SegmentFolder> {
        let feeder = self.feeder.take();
        drop(self);
        match feeder.map(JoinHandle::join) {
            Some(Ok(folder)) => folder,
            _ => Err(Error::internal("source", "the thread that feeds segments panicked")),
        }
    }
}

impl Drop for StreamPart {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// Copies segments into the pipe until a new stream begins, the folder is closed, or nobody reads.
fn feed(mut folder: SegmentFolder, mut pipe: std::io::PipeWriter, stop: &AtomicBool) -> Result<SegmentFolder> {
    let mut first = true;
    while let Some(segment) = folder.peek(stop)? {
        if !first && segment.part_arrival_ns.is_some() {
            break;
        }
        first = false;
        let mut file = File::open(&segment.path).map_err(|e| Error::io(&segment.path, e))?;
        match std::io::copy(&mut file, &mut pipe).and_then(|_| pipe.flush()) {
            Ok(()) => folder.advance(),
            // The demuxer gave this stream up; what follows in it is skipped, a new stream is not.
            Err(e) if e.kind() == ErrorKind::BrokenPipe => {
                folder.advance();
                while let Some(segment) = folder.present()?.filter(|s| s.part_arrival_ns.is_none()) {
                    drop(segment);
                    folder.advance();
                }
                break;
            }
            Err(e) => return Err(Error::io(&segment.path, e)),
        }
    }
    Ok(folder)
}

/// A transport stream in segments as the frames of a run.
pub(super) struct StoredStream {
    info: SourceInfo,
    name: String,
    part: Option<(Video, StreamPart)>,
    first_arrival_ns: Option<i64>,
    /// Where the present part's times begin, s since the run's first frame, and its own first time stamp.
    part_start_s: f64,
    part_first_s: Option<f64>,
    last_time_s: f64,
    next: u32,
    warnings: Vec<String>,
}

impl StoredStream {
    /// Waits for the first part that holds video.
    pub(super) fn open(folder: SegmentFolder) -> Result<StoredStream> {
        let mut stream = StoredStream {
            info: SourceInfo {
                width_px: 0,
                height_px: 0,
                frames_announced: None,
                frames_per_s: None,
                files: Vec::new(),
                still_open: folder.is_open(),
            },
            name: folder.name.clone(),
            part: None,
            first_arrival_ns: None,
            part_start_s: 0.0,
            part_first_s: None,
            last_time_s: 0.0,
            next: 0,
            warnings: Vec::new(),
        };
        stream.begin_part(folder)?;
        let Some((video, _)) = &stream.part else {
            let found = stream.warnings.pop().unwrap_or_else(|| "no data".into());
            return Err(Error::input(stream.name, found, "an MPEG transport stream with video"));
        };
        (stream.info.width_px, stream.info.height_px) = (video.width_px, video.height_px);
        stream.info.frames_per_s = video.frames_per_s;
        Ok(stream)
    }

    /// Opens the next part that can be read.
    fn begin_part(&mut self, mut folder: SegmentFolder) -> Result<()> {
        while let Some(part) = StreamPart::begin(folder)? {
            let opened = open_pipe(part.reader.as_raw_fd(), &self.name).and_then(|i| Video::of_input(i, &self.name));
            match opened {
                Ok(video) => {
                    let first_ns = self.first_arrival_ns.or(part.arrival_ns);
                    let since_first_ns =
                        part.arrival_ns.zip(first_ns).map_or(0, |(now, first)| now.saturating_sub(first));
                    self.first_arrival_ns = first_ns;
                    self.part_start_s = (since_first_ns as f64 / 1e9).max(self.last_time_s);
                    self.part_first_s = None;
                    self.part = Some((video, part));
                    return Ok(());
                }
                Err(error @ Error::Input { .. }) => self.warnings.push(error.to_string()),
                Err(error) => return Err(error),
            }
            folder = part.end()?;
        }
        Ok(())
    }

    fn time_s(&mut self, stamp_s: Option<f64>) -> f64 {
        let counted_s = f64::from(self.next) / self.info.frames_per_s.unwrap_or(super::DEFAULT_FOLDER_FPS);
        let stamp_s = stamp_s.unwrap_or(counted_s);
        let in_part_s = stamp_s - *self.part_first_s.get_or_insert(stamp_s);
        self.last_time_s = (self.part_start_s + in_part_s).max(self.last_time_s);
        self.last_time_s
    }
}

impl Source for StoredStream {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Frame>> {
        while let Some((video, _)) = &mut self.part {
            if let Some(picture) = video.next_picture()? {
                let frame = Frame { index: self.next, time_s: self.time_s(picture.time_s), image: picture.image };
                self.next += 1;
                return Ok(Some(frame));
            }
            let Some((video, part)) = self.part.take() else { break };
            self.warnings.extend(video.warnings());
            drop(video);
            let folder = part.end()?;
            self.begin_part(folder)?;
        }
        Ok(None)
    }

    fn warnings(&self) -> Vec<String> {
        let mut warnings = self.warnings.clone();
        warnings.extend(self.part.iter().flat_map(|(video, _)| video.warnings()));
        warnings
    }
}
