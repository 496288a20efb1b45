//! Where frames come from: video files, folders of images, a run's segments in a folder that may still grow; one trait
//! over all.

mod encoded;
mod folder;
pub mod frame_file;
mod image;
pub mod segments;
mod still;
mod video;

use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Once;

pub use encoded::{EncodedFrames, encoded_frames};
pub(crate) use image::shrunk;
pub use image::{Image, PlaneView, Yuv};

use self::segments::{Records, SegmentKind, StoredFrames, StoredStream};
use crate::error::{Error, Result};

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
}

/// Opens a video file, a folder of images, or a run's segments (waiting for the first). `name` names it in messages; `fps` is for folders.
///
/// # Errors
/// [`Error::Input`] where it is neither, is empty, cannot be decoded or has sides outside 16 to
/// [`crate::rig::MAX_IMAGE_SIDE_PX`] px.
pub fn open(path: &Path, name: &str, fps: Option<f64>) -> Result<Box<dyn Source>> {
    if let Some(fps) = fps
        && !(0.01..=10_000.0).contains(&fps)
    {
        return Err(Error::field(name, "fps", format!("{fps}"), "0.01 to 10000 frames a second"));
    }
    let metadata = std::fs::metadata(path).map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => {
            Error::input(name, "no such file or folder", "a video file or a folder of images")
        }
        _ => Error::io(path, e),
    })?;
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
}

/// A frame as the source holds it, not decoded, in decoding order.
#[derive(Clone, Debug)]
pub struct EncodedFrame {
    /// Capture time since the run's first frame, s.
    pub time_s: f64,
    /// How it is packed.
    pub format: EncodedFormat,
    /// True where decoding can start.
    pub key: bool,
    /// The bytes.
    pub data: Vec<u8>,
}
