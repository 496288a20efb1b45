//! Where frames come from: video files, folders of images, MCAP files, a run's segments in a folder that may still grow;
//! one trait over all.

mod encoded;
mod folder;
pub mod frame_file;
mod image;
mod mcap;
pub mod segments;
mod still;
mod video;

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Once;

use nalgebra::Isometry3;

pub use encoded::{EncodedFrames, encoded_frames, is_key};
pub(crate) use image::shrunk;
pub use image::{Image, PlaneView, Yuv};

use self::segments::{Records, SegmentKind, StoredFrames, StoredStream};
pub use mcap::CameraFacts;
pub(crate) use mcap::{ODOMETRY_CSV, VIDEO_METADATA, odometry_csv};

use crate::error::{Error, Result};
use crate::mcap_file::Topic;

/// Frames a second of a folder of images when nothing is said.
pub const DEFAULT_FOLDER_FPS: f64 = 30.0;

/// One image of a run.
pub struct Frame {
    /// Position in the run, from 0.
    pub index: u32,
    /// Capture time since the run's first frame, s; never falls.
    pub time_s: f64,
    /// The pixels.
    pub image: Image,
}

/// What a source says of itself before it is read.
#[derive(Clone, Debug, PartialEq)]
pub struct SourceInfo {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Frames, where the source announces them; a file that was cut holds fewer.
    pub frames_announced: Option<u64>,
    /// Frames a second, where the source announces them.
    pub frames_per_s: Option<f64>,
    /// The files it is made of, in order; empty for segments, which [`files`] lists at the end.
    pub files: Vec<PathBuf>,
    /// More frames may come than there are now: the robot is still walking.
    pub still_open: bool,
}

/// A run's images in order.
pub trait Source: Send {
    /// What the source says of itself.
    fn info(&self) -> &SourceInfo;

    /// The next frame; `None` at the end of what can be read.
    fn next_frame(&mut self) -> Result<Option<Frame>>;

    /// What went wrong so far without ending the run, in words for people.
    fn warnings(&self) -> Vec<String>;

    /// What the source brings beside its frames.
    fn beside(&self) -> Beside {
        Beside::default()
    }
}

/// What a source may bring beside its frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Beside {
    /// Where the camera was, by the robot's own odometry, in the order of time.
    pub poses: Vec<TimedPose>,
    /// What the camera says of its own calibration.
    pub camera: Option<CameraFacts>,
}

/// Where the camera was at a time, in a world of the odometry's own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPose {
    /// Since the run's first frame, s; may be negative.
    pub time_s: f64,
    /// `world_from_camera`, mm.
    pub world_from_camera: Isometry3<f64>,
}

/// Opens a video file, a folder of images, an MCAP file, or a run's segments (waiting for the first). `name` names it in
/// messages; `fps` is for folders.
///
/// # Errors
/// [`Error::Input`] where it is none of these, is empty, cannot be decoded or has sides outside 16 to
/// [`crate::rig::MAX_IMAGE_SIDE_PX`] px.
pub fn open(path: &Path, name: &str, fps: Option<f64>) -> Result<Box<dyn Source>> {
    open_topics(path, name, fps, &[])
}

/// As [`open()`]; of an MCAP file the named topics are read, and for the rest a guess.
///
/// # Errors
/// As [`open()`]; a topic that is not there or of no use, or topics of something that is no MCAP file.
pub fn open_topics(path: &Path, name: &str, fps: Option<f64>, topics: &[String]) -> Result<Box<dyn Source>> {
    if let Some(fps) = fps
        && !(0.01..=10_000.0).contains(&fps)
    {
        return Err(Error::field(name, "fps", format!("{fps}"), "0.01 to 10000 frames a second"));
    }
    let metadata = std::fs::metadata(path).map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => {
            Error::input(name, "no such file or folder", "a video file, a folder of images or an MCAP file")
        }
        _ => Error::io(path, e),
    })?;
    if let Some(files) = mcap::files(path)? {
        return Ok(Box::new(mcap::McapFile::open(files, name, topics)?));
    }
    if let Some(topic) = topics.first() {
        return Err(Error::field(name, "--topic", format!("`{topic}` of what is no MCAP file"), "an MCAP file"));
    }
    if let Some(segments) = segments::SegmentFolder::recognise(path, name)? {
        return Ok(match segments.kind {
            SegmentKind::Frames => Box::new(StoredFrames::open(Records::of_folder(segments), Vec::new())?),
            SegmentKind::TransportStream => Box::new(StoredStream::open(segments)?),
        });
    }
    if is_frame_file(path)? {
        return Ok(Box::new(StoredFrames::open(Records::of_file(path, name), vec![path.to_path_buf()])?));
    }
    if metadata.is_dir() {
        Ok(Box::new(folder::Folder::open(path, name, fps.unwrap_or(DEFAULT_FOLDER_FPS))?))
    } else {
        Ok(Box::new(video::VideoFile::open(path, name)?))
    }
}

/// The files of a source that has been read to its end, in order; `info` is what it said of itself.
///
/// # Errors
/// Where a folder of segments cannot be listed.
pub fn files(path: &Path, name: &str, info: &SourceInfo) -> Result<Vec<PathBuf>> {
    match segments::SegmentFolder::recognise(path, name)? {
        Some(segments) => segments.files(),
        None => Ok(info.files.clone()),
    }
}

/// Whether a file is one of stored frames.
fn is_frame_file(path: &Path) -> Result<bool> {
    if path.is_dir() {
        return Ok(false);
    }
    let mut head = Vec::new();
    let file = std::fs::File::open(path).map_err(|e| Error::io(path, e))?;
    file.take(frame_file::MAGIC.len() as u64).read_to_end(&mut head).map_err(|e| Error::io(path, e))?;
    Ok(head == frame_file::MAGIC)
}

/// When an MCAP file's first image was captured, ns since the epoch; `None` for other sources.
///
/// # Errors
/// As [`open_topics()`].
pub fn captured_at_ns(path: &Path, name: &str, topics: &[String]) -> Result<Option<u64>> {
    match mcap::files(path)? {
        Some(files) => mcap::start_ns(&files, name, topics),
        None => Ok(None),
    }
}

/// The MCAP files that a path names: the file itself, or those of a bag's folder; `None` where there are none.
///
/// # Errors
/// Where the path cannot be read.
pub fn mcap_files(path: &Path) -> Result<Option<Vec<PathBuf>>> {
    mcap::files(path)
}

/// What a topic of an MCAP file can give a run, in a word; `None` where it is of no use.
pub fn use_of_topic(topic: &Topic) -> Option<&'static str> {
    mcap::use_of(topic)
}

/// FFmpeg is set up once; its own messages stay off the screen, since ours say more.
fn init_ffmpeg() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // Fails only where FFmpeg was built without its registry, which opening then reports.
        let _ = ffmpeg_the_third::init();
        ffmpeg_the_third::log::set_level(ffmpeg_the_third::log::Level::Quiet);
    });
}

/// How an encoded frame is packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EncodedFormat {
    /// H.264, Annex B, parameter sets before every key frame.
    H264,
    /// H.265, Annex B, parameter sets before every key frame.
    H265,
    /// VP9.
    Vp9,
    /// AV1, low-overhead bitstream.
    Av1,
    /// A whole JPEG file.
    Jpeg,
    /// A whole PNG file.
    Png,
    /// A whole WebP file.
    Webp,
    /// Pixels that are not packed at all.
    Raw(RawLayout),
}

impl EncodedFormat {
    /// Whether a frame may need others before it to be decoded.
    pub fn is_video(self) -> bool {
        matches!(self, EncodedFormat::H264 | EncodedFormat::H265 | EncodedFormat::Vp9 | EncodedFormat::Av1)
    }
}

/// How the pixels of an image lie that is not packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RawLayout {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// From one row's start to the next one's, bytes.
    pub step_bytes: u32,
    /// What a pixel holds.
    pub encoding: RawEncoding,
}

/// What a pixel of an image holds that is not packed; 16-bit values are little endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "they are ROS's names")]
pub enum RawEncoding {
    Rgb8,
    Bgr8,
    Rgba8,
    Bgra8,
    Mono8,
    Mono16,
    Yuyv,
    Uyvy,
    BayerRggb8,
    BayerBggr8,
    BayerGbrg8,
    BayerGrbg8,
}

impl RawEncoding {
    /// All of them.
    pub const ALL: [RawEncoding; 12] = [
        RawEncoding::Rgb8,
        RawEncoding::Bgr8,
        RawEncoding::Rgba8,
        RawEncoding::Bgra8,
        RawEncoding::Mono8,
        RawEncoding::Mono16,
        RawEncoding::Yuyv,
        RawEncoding::Uyvy,
        RawEncoding::BayerRggb8,
        RawEncoding::BayerBggr8,
        RawEncoding::BayerGbrg8,
        RawEncoding::BayerGrbg8,
    ];

    /// Its name in messages.
    pub fn name(self) -> &'static str {
        match self {
            RawEncoding::Rgb8 => "rgb8",
            RawEncoding::Bgr8 => "bgr8",
            RawEncoding::Rgba8 => "rgba8",
            RawEncoding::Bgra8 => "bgra8",
            RawEncoding::Mono8 => "mono8",
            RawEncoding::Mono16 => "mono16",
            RawEncoding::Yuyv => "yuyv",
            RawEncoding::Uyvy => "uyvy",
            RawEncoding::BayerRggb8 => "bayer_rggb8",
            RawEncoding::BayerBggr8 => "bayer_bggr8",
            RawEncoding::BayerGbrg8 => "bayer_gbrg8",
            RawEncoding::BayerGrbg8 => "bayer_grbg8",
        }
    }

    /// The encoding of that name, or of one that means the same in ROS.
    pub fn named(name: &str) -> Option<RawEncoding> {
        match name {
            "8UC1" => Some(RawEncoding::Mono8),
            "8UC3" => Some(RawEncoding::Bgr8),
            "8UC4" => Some(RawEncoding::Bgra8),
            "16UC1" => Some(RawEncoding::Mono16),
            "yuv422_yuy2" => Some(RawEncoding::Yuyv),
            "yuv422" => Some(RawEncoding::Uyvy),
            _ => RawEncoding::ALL.into_iter().find(|known| known.name() == name),
        }
    }

    /// Bytes of one pixel.
    pub fn pixel_bytes(self) -> u32 {
        match self {
            RawEncoding::Rgb8 | RawEncoding::Bgr8 => 3,
            RawEncoding::Rgba8 | RawEncoding::Bgra8 => 4,
            RawEncoding::Mono16 | RawEncoding::Yuyv | RawEncoding::Uyvy => 2,
            _ => 1,
        }
    }
}

/// What a container says of its video beside the stream.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct VideoFacts {
    /// FFmpeg's name of the colour matrix (`bt709`), where the container says.
    pub colour_space: Option<String>,
    /// `tv` or `pc`, where the container says.
    pub colour_range: Option<String>,
    /// Where the chroma samples lie (`left`), where the container says.
    pub chroma_location: Option<String>,
    /// Frames are decoded in another order than they were captured in (B-frames).
    pub reordered: bool,
}

impl VideoFacts {
    const NAMES: [(&'static str, &'static [&'static str]); 3] = [
        ("color_space", &["bt709", "bt470bg", "smpte170m", "smpte240m", "fcc", "ycgco", "bt2020nc", "bt2020c"]),
        ("color_range", &["tv", "pc"]),
        ("chroma_location", &["left", "center", "topleft", "top", "bottomleft", "bottom"]),
    ];

    /// As named values; what is not known is left out.
    pub fn metadata(&self) -> BTreeMap<String, String> {
        let values = [&self.colour_space, &self.colour_range, &self.chroma_location];
        let known = VideoFacts::NAMES.iter().zip(values).filter_map(|((name, _), value)| Some((*name, value.clone()?)));
        let order = if self.reordered { "decoding" } else { "capture" };
        known.chain([("order", order.to_string())]).map(|(name, value)| (name.to_string(), value)).collect()
    }

    /// From named values; those that mean nothing here are left out.
    pub fn from_metadata(values: &BTreeMap<String, String>) -> VideoFacts {
        let [colour_space, colour_range, chroma_location] = VideoFacts::NAMES
            .map(|(name, known)| values.get(name).filter(|value| known.contains(&value.as_str())).cloned());
        let reordered = values.get("order").is_some_and(|order| order == "decoding");
        VideoFacts { colour_space, colour_range, chroma_location, reordered }
    }

    /// What a decoder is told of a stream that may not say so itself.
    fn decoder_options(&self) -> impl Iterator<Item = (&'static str, &str)> {
        let values = [
            ("colorspace", &self.colour_space),
            ("color_range", &self.colour_range),
            ("chroma_sample_location", &self.chroma_location),
        ];
        values.into_iter().filter_map(|(name, value)| Some((name, value.as_deref()?)))
    }
}

/// A frame as the source holds it, not decoded, in decoding order.
#[derive(Clone, Debug)]
pub struct EncodedFrame {
    /// Capture time since the run's first frame, s.
    pub time_s: f64,
    /// Its place in the order of decoding as a time since the run's first frame, s; never falls. It is `time_s` unless
    /// frames are decoded in another order than they were captured in.
    pub order_s: f64,
    /// How it is packed.
    pub format: EncodedFormat,
    /// True where decoding can start.
    pub key: bool,
    /// The bytes.
    pub data: Vec<u8>,
}
