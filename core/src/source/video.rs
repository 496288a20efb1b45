//! A video file, or a single image, through FFmpeg.

use std::os::fd::RawFd;
use std::path::{Path, PathBuf};

use ffmpeg_the_third as ffmpeg;

use ffmpeg::format::Pixel;
use ffmpeg::software::scaling;
use ffmpeg::util::{chroma, color};

use super::image::{Image, Matrix, YuvFormat};
use super::{Frame, Source, SourceInfo};
use crate::error::{Error, Result};
use crate::rig::MAX_IMAGE_SIDE_PX;

/// Containers that hold their own data. Play lists and other formats that name further files or
/// addresses stay out: a hostile upload must not make the decoder open anything else.
const CONTAINERS: &str = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo,h264,hevc,m4v,ivf,obu,flv,asf,\
ogg,nut,mjpeg,mpjpeg,y4m,yuv4mpegpipe,image2,jpeg_pipe,png_pipe,webp_pipe,tiff_pipe,bmp_pipe,pgm_pipe,ppm_pipe,gif,apng";

/// How much of a live stream is looked at before its frames are handed out, µs: people wait for them.
const LIVE_PROBE_US: &str = "500000";

/// Undecodable packets in a row after which the rest of the file is given up.
const MAX_BAD_PACKETS_IN_A_ROW: u32 = 300;

/// A decoded picture with its place in the stream.
pub(super) struct Picture {
    /// Presentation time in the stream's own clock, s; `None` where the file gives none.
    pub time_s: Option<f64>,
    /// The pixels.
    pub image: Image,
}

/// An open video file.
pub(super) struct Video {
    name: String,
    input: ffmpeg::format::context::Input,
    stream: usize,
    time_base_s: f64,
    decoder: ffmpeg::decoder::Video,
    bad_packets: u64,
    bad_in_a_row: u32,
    read_error: Option<String>,
    at_end: bool,
    /// Frames that the file announces.
    pub frames_announced: Option<u64>,
    /// Frames a second that the file announces.
    pub frames_per_s: Option<f64>,
    /// Columns that the file announces.
    pub width_px: u32,
    /// Rows that the file announces.
    pub height_px: u32,
}

/// Opens a container without decoding; `name` names it in errors.
pub(super) fn open_container(path: &Path, name: &str) -> Result<ffmpeg::format::context::Input> {
    super::init_ffmpeg();
    let metadata = std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
    if metadata.len() == 0 {
        return Err(Error::input(name, "an empty file (0 bytes)", "a video or an image"));
    }
    let mut options = input_options("file", CONTAINERS);
    // An image's name is a name, not a pattern that could match other files.
    options.set("pattern_type", "none");
    // FFmpeg reads names with a colon as an address: always hand it a file's path.
    let mut url = std::ffi::OsString::from("file:");
    url.push(path.as_os_str());
    ffmpeg::format::input_with_dictionary(url, options).map_err(|e| {
        let hint = match head_kind(path) {
            Head::Mp4WithoutIndex => {
                "; its index (moov) is missing: the recording was cut off before the camera wrote it"
            }
            Head::Text => "; it looks like text",
            Head::Other => "",
        };
        Error::input(
            name,
            format!("not readable as video or image ({e}{hint})"),
            "a video file that FFmpeg reads (MP4, MKV, AVI, MPEG-TS, …) or an image",
        )
    })
}

/// A transport stream from the reading end of a pipe.
pub(super) fn open_pipe(descriptor: RawFd, name: &str) -> Result<ffmpeg::format::context::Input> {
    super::init_ffmpeg();
    let mut options = input_options("pipe", "mpegts");
    options.set("analyzeduration", LIVE_PROBE_US);
    ffmpeg::format::input_with_dictionary(format!("pipe:{descriptor}"), options).map_err(|e| {
        Error::input(name, format!("not readable as MPEG-TS ({e})"), "an MPEG transport stream with video")
    })
}

fn input_options(protocols: &str, containers: &str) -> ffmpeg::Dictionary {
    let mut options = ffmpeg::Dictionary::new();
    options.set("protocol_whitelist", protocols);
    options.set("format_whitelist", containers);
    options
}

enum Head {
    Mp4WithoutIndex,
    Text,
    Other,
}

fn head_kind(path: &Path) -> Head {
    use std::io::Read;
    let mut head = [0u8; 64];
    let read = std::fs::File::open(path).and_then(|mut f| f.read(&mut head)).unwrap_or(0);
    let head = &head[..read];
    if head.get(4..8) == Some(b"ftyp") {
        Head::Mp4WithoutIndex
    } else if !head.is_empty() && head.iter().all(|b| matches!(b, b'\t' | b'\n' | b'\r' | 0x20..=0x7e)) {
        Head::Text
    } else {
        Head::Other
    }
}

impl Video {
    /// Opens a file; `name` names it in errors.
    pub(super) fn open(path: &Path, name: &str) -> Result<Video> {
        Video::of_input(open_container(path, name)?, name)
    }

    /// The video of an open container.
    pub(super) fn of_input(input: ffmpeg::format::context::Input, name: &str) -> Result<Video> {
        let no_video = || Error::input(name, "no video stream", "a file with a video stream");
        let stream = input.streams().best(ffmpeg::media::Type::Video).ok_or_else(no_video)?;
        let parameters = stream.parameters();
        let (width_px, height_px) = (parameters.width(), parameters.height());
        check_size(name, width_px, height_px)?;
        let mut context = ffmpeg::codec::context::Context::from_parameters(parameters)
            .map_err(|e| Error::input(name, format!("an unusable video stream ({e})"), "a stream FFmpeg decodes"))?;
        context.set_threading(ffmpeg::threading::Config::kind(ffmpeg::threading::Type::Frame));
        let codec = ffmpeg::decoder::find(stream.parameters().id()).ok_or(ffmpeg::Error::DecoderNotFound);
        let opened = codec.and_then(|codec| context.decoder().open_as_with(codec, decoder_options()));
        let decoder = opened.and_then(|opened| opened.video()).map_err(|e| {
            Error::input(name, format!("a video stream without decoder ({e})"), "a stream FFmpeg decodes")
        })?;
        let base = stream.time_base();
        let rate = stream.avg_frame_rate();
        let frames_per_s = (rate.1 > 0 && rate.0 > 0).then(|| f64::from(rate.0) / f64::from(rate.1));
        Ok(Video {
            name: name.to_string(),
            stream: stream.index(),
            time_base_s: f64::from(base.0) / f64::from(base.1.max(1)),
            frames_announced: u64::try_from(stream.frames()).ok().filter(|n| *n > 0),
            frames_per_s,
            width_px,
            height_px,
            decoder,
            bad_packets: 0,
            bad_in_a_row: 0,
            read_error: None,
            at_end: false,
            input,
        })
    }

    /// The next picture; `None` at the end of what can be read.
    pub(super) fn next_picture(&mut self) -> Result<Option<Picture>> {
        loop {
            let mut decoded = ffmpeg::frame::Video::empty();
            match self.decoder.receive_frame(&mut decoded) {
                Ok(()) => {
                    self.bad_in_a_row = 0;
                    check_size(&self.name, decoded.width(), decoded.height())?;
                    let time_s = decoded.timestamp().or(decoded.pts()).map(|t| t as f64 * self.time_base_s);
                    return Ok(Some(Picture { time_s, image: image(decoded)? }));
                }
                Err(ffmpeg::Error::Eof) => return Ok(None),
                // The decoder wants more; anything else is a broken picture that is counted where it was sent.
                Err(_) if self.at_end => return Ok(None),
                Err(_) => self.feed(),
            }
        }
    }

    /// What went wrong on the way, in words for people.
    pub(super) fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if let Some(error) = &self.read_error {
            warnings.push(format!("{}: reading stopped early ({error}); what was read is processed", self.name));
        }
        if self.bad_packets > 0 {
            warnings.push(format!("{}: {} damaged packets were left out", self.name, self.bad_packets));
        }
        warnings
    }

    /// Reads one packet of our stream into the decoder, or tells it that the file has ended.
    fn feed(&mut self) {
        let mut packet = ffmpeg::Packet::empty();
        loop {
            match packet.read(&mut self.input) {
                Ok(()) if packet.stream() == self.stream => break,
                Ok(()) => {}
                Err(ffmpeg::Error::Eof) => return self.end(None),
                Err(e) => return self.end(Some(e.to_string())),
            }
        }
        if packet.is_corrupt() || self.decoder.send_packet(&packet).is_err() {
            self.bad_packets += 1;
            self.bad_in_a_row += 1;
            if self.bad_in_a_row > MAX_BAD_PACKETS_IN_A_ROW {
                self.end(Some(format!("{MAX_BAD_PACKETS_IN_A_ROW} damaged packets in a row")));
            }
        }
    }

    fn end(&mut self, read_error: Option<String>) {
        self.at_end = true;
        self.read_error = read_error;
        // Fails only when the decoder was told so before, which `at_end` rules out.
        let _ = self.decoder.send_eof();
    }
}

/// The colours of a decoded frame.
pub(super) fn image(frame: ffmpeg::frame::Video) -> Result<Image> {
    let (width, height) = (frame.width() as usize, frame.height() as usize);
    if let Some((chroma_shift_x, chroma_shift_y)) = planar_shifts(frame.format()) {
        let format = YuvFormat {
            width_px: width,
            height_px: height,
            chroma_shift_x,
            chroma_shift_y,
            chroma_left: chroma_left(&frame),
            matrix: matrix(&frame),
            full_range: full_range(&frame),
        };
        return Ok(Image::from_frame(format, frame));
    }
    let target = if is_rgb(frame.format()) { Pixel::BGR24 } else { Pixel::YUV444P };
    let mut converted = convert(&frame, target)?;
    if target == Pixel::YUV444P {
        converted.set_color_space(frame.color_space());
        converted.set_color_range(frame.color_range());
        return image(converted);
    }
    let stride = converted.stride(0);
    let bgr = (0..height).flat_map(|r| &converted.data(0)[r * stride..][..3 * width]).copied().collect();
    Ok(Image::from_bgr(width as u32, height as u32, bgr))
}

/// Converts an unusual pixel format without touching its colour matrix. The converter is made anew for
/// each frame, since it may not move between threads; the formats that cameras send never come here.
fn convert(frame: &ffmpeg::frame::Video, target: Pixel) -> Result<ffmpeg::frame::Video> {
    let failed = |e: ffmpeg::Error| Error::internal("colour conversion", e);
    let (width, height) = (frame.width(), frame.height());
    let flags = scaling::Flags::BILINEAR | scaling::Flags::ACCURATE_RND | scaling::Flags::FULL_CHR_H_INT;
    let mut converter =
        scaling::Context::get(frame.format(), width, height, target, width, height, flags).map_err(failed)?;
    let mut converted = ffmpeg::frame::Video::empty();
    converter.run(frame, &mut converted).map_err(failed)?;
    Ok(converted)
}

/// A video file as the frames of a run.
pub(super) struct VideoFile {
    info: SourceInfo,
    video: Video,
    first_time_s: Option<f64>,
    last_time_s: f64,
    next: u32,
    ended: bool,
}

impl VideoFile {
    pub(super) fn open(path: &Path, name: &str) -> Result<VideoFile> {
        let video = Video::open(path, name)?;
        let info = SourceInfo {
            width_px: video.width_px,
            height_px: video.height_px,
            frames_announced: video.frames_announced,
            frames_per_s: video.frames_per_s,
            files: vec![path.to_path_buf()],
            still_open: false,
        };
        Ok(VideoFile { info, video, first_time_s: None, last_time_s: 0.0, next: 0, ended: false })
    }

    /// Capture time since the first frame: the file's own time stamp, or the frame rate where it has none.
    fn time_s(&mut self, stamp_s: Option<f64>) -> f64 {
        let counted_s = f64::from(self.next) / self.info.frames_per_s.unwrap_or(super::DEFAULT_FOLDER_FPS);
        let stamp_s = stamp_s.unwrap_or(counted_s);
        let since_first_s = stamp_s - *self.first_time_s.get_or_insert(stamp_s);
        self.last_time_s = since_first_s.max(self.last_time_s);
        self.last_time_s
    }
}

impl Source for VideoFile {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Frame>> {
        let Some(picture) = self.video.next_picture()? else {
            self.ended = true;
            return Ok(None);
        };
        let frame = Frame { index: self.next, time_s: self.time_s(picture.time_s), image: picture.image };
        self.next += 1;
        Ok(Some(frame))
    }

    fn warnings(&self) -> Vec<String> {
        let mut warnings = self.video.warnings();
        match self.info.frames_announced {
            Some(announced) if self.ended && u64::from(self.next) < announced => warnings.push(format!(
                "{}: the file announces {announced} frames but holds {}; it was cut off or damaged, what is there was processed",
                self.video.name, self.next
            )),
            _ => {}
        }
        warnings
    }
}

/// A picture larger than the largest that is taken is refused before memory is asked for.
pub(super) fn decoder_options() -> ffmpeg::Dictionary {
    let mut options = ffmpeg::Dictionary::new();
    options.set("max_pixels", (u64::from(MAX_IMAGE_SIDE_PX) * u64::from(MAX_IMAGE_SIDE_PX)).to_string());
    options
}

pub(super) fn check_size(name: &str, width_px: u32, height_px: u32) -> Result<()> {
    let fits = |side: u32| (16..=MAX_IMAGE_SIDE_PX).contains(&side);
    if fits(width_px) && fits(height_px) {
        return Ok(());
    }
    let found = match (width_px, height_px) {
        (0, 0) => "unknown: 0x0 px, or more than the decoder takes".to_string(),
        _ => format!("{width_px}x{height_px} px"),
    };
    Err(Error::field(name, "image size", found, format!("16 to {MAX_IMAGE_SIDE_PX} px a side")))
}

fn planar_shifts(format: Pixel) -> Option<(u32, u32)> {
    match format {
        Pixel::YUV420P | Pixel::YUVJ420P => Some((1, 1)),
        Pixel::YUV422P | Pixel::YUVJ422P => Some((1, 0)),
        Pixel::YUV444P | Pixel::YUVJ444P => Some((0, 0)),
        Pixel::YUV440P | Pixel::YUVJ440P => Some((0, 1)),
        _ => None,
    }
}

fn is_rgb(format: Pixel) -> bool {
    let Some(descriptor) = format.descriptor() else { return false };
    let name = descriptor.name();
    ["rgb", "bgr", "gbr", "pal8", "gray", "mono", "argb", "abgr", "ya8", "0rgb", "0bgr"]
        .iter()
        .any(|p| name.starts_with(p))
}

fn is_jpeg_range(format: Pixel) -> bool {
    matches!(format, Pixel::YUVJ420P | Pixel::YUVJ422P | Pixel::YUVJ444P | Pixel::YUVJ440P)
}

fn full_range(frame: &ffmpeg::frame::Video) -> bool {
    is_jpeg_range(frame.format()) || frame.color_range() == color::Range::JPEG
}

fn chroma_left(frame: &ffmpeg::frame::Video) -> bool {
    match frame.chroma_location() {
        chroma::Location::Center | chroma::Location::Top | chroma::Location::Bottom => false,
        chroma::Location::Left | chroma::Location::TopLeft | chroma::Location::BottomLeft => true,
        // Not said: JPEG samples between the columns, MPEG on them.
        _ => !is_jpeg_range(frame.format()),
    }
}

fn matrix(frame: &ffmpeg::frame::Video) -> Matrix {
    match frame.color_space() {
        color::Space::BT709 => Matrix::Bt709,
        color::Space::BT2020NCL | color::Space::BT2020CL => Matrix::Bt2020,
        color::Space::Unspecified if frame.height() >= 720 && !full_range(frame) => Matrix::Bt709,
        _ => Matrix::Bt601,
    }
}

/// The path of a file that this room was given, for messages.
pub(super) fn display_name(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |n| PathBuf::from(n).display().to_string())
}
