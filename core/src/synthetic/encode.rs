//! Images → an MP4 file with H.264.

use std::path::Path;

use ffmpeg_the_third as ffmpeg;

use ffmpeg::format::Pixel;

use crate::error::{Error, Result};
use crate::source::Image;

/// How a video is packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quality {
    /// H.264, 4:2:0, BT.709, constant quality 18: as a good camera records. Needs even sides.
    Camera,
    /// H.264 in RGB without any loss. FFmpeg reads it, browsers do not.
    Lossless,
}

/// Writes a video, one frame after another. Frames lie in the file in the order of their times, a key frame
/// comes every second, and the index stands before the data: a file cut in half plays for its half.
pub struct VideoWriter {
    encoder: ffmpeg::encoder::video::Encoder,
    output: ffmpeg::format::context::Output,
    quality: Quality,
    size_px: (u32, u32),
    encoder_base: ffmpeg::Rational,
    stream_base: ffmpeg::Rational,
    frames: i64,
}

impl VideoWriter {
    /// Starts a video of `fps` frames a second (kept to a thousandth).
    ///
    /// # Errors
    /// Odd sides with [`Quality::Camera`]; a path that cannot be written; an FFmpeg without libx264.
    pub fn create(path: &Path, size_px: (u32, u32), fps: f64, quality: Quality) -> Result<VideoWriter> {
        if quality == Quality::Camera && (size_px.0 % 2 == 1 || size_px.1 % 2 == 1) {
            let found = format!("{}x{} px", size_px.0, size_px.1);
            return Err(Error::input("size", found, "even sides for an H.264 video (or images instead of a video)"));
        }
        ffmpeg::init().map_err(failed)?;
        ffmpeg::log::set_level(ffmpeg::log::Level::Error);
        // Opened by us first: FFmpeg's own words about a path are poor.
        std::fs::File::create(path).map_err(|e| Error::io(path, e))?;
        let mut url = std::ffi::OsString::from("file:");
        url.push(path.as_os_str());
        let mut output = ffmpeg::format::output_as(url, "mp4").map_err(failed)?;
        let rate = ffmpeg::Rational((fps * 1000.0).round() as i32, 1000).reduce();
        let encoder = open_encoder(size_px, rate, quality)?;
        let index = {
            let mut stream = output.add_stream(encoder.codec()).map_err(failed)?;
            stream.copy_parameters_from_context(&encoder);
            stream.set_time_base(rate.invert());
            stream.set_avg_frame_rate(rate);
            stream.index()
        };
        let mut options = ffmpeg::Dictionary::new();
        options.set("movflags", "+faststart");
        output.write_header_with(options).map_err(failed)?;
        let stream_base = output.stream(index).map_or(rate.invert(), |s| s.time_base());
        Ok(VideoWriter { encoder, output, quality, size_px, encoder_base: rate.invert(), stream_base, frames: 0 })
    }

    /// Appends a frame.
    ///
    /// # Panics
    /// With an image of another size than the video's.
    pub fn push(&mut self, image: &Image) -> Result<()> {
        assert_eq!((image.width_px(), image.height_px()), self.size_px, "an image of another size");
        // A new frame each time: the encoder may still be reading the last one.
        let mut frame = match self.quality {
            Quality::Camera => yuv_frame(image),
            Quality::Lossless => bgr_frame(image),
        };
        frame.set_pts(Some(self.frames));
        self.frames += 1;
        self.encoder.send_frame(&frame).map_err(failed)?;
        self.write_packets()
    }

    /// Ends the file.
    pub fn finish(mut self) -> Result<()> {
        self.encoder.send_eof().map_err(failed)?;
        self.write_packets()?;
        self.output.write_trailer().map_err(failed)
    }

    fn write_packets(&mut self) -> Result<()> {
        let mut packet = ffmpeg::Packet::empty();
        // Ends when the encoder wants more frames or has no more packets.
        while self.encoder.receive_packet(&mut packet).is_ok() {
            packet.set_stream(0);
            packet.set_duration(1);
            packet.rescale_ts(self.encoder_base, self.stream_base);
            packet.write_interleaved(&mut self.output).map_err(failed)?;
        }
        Ok(())
    }
}

fn failed(error: ffmpeg::Error) -> Error {
    Error::internal("video encoding", error)
}

fn open_encoder(
    (width_px, height_px): (u32, u32),
    rate: ffmpeg::Rational,
    quality: Quality,
) -> Result<ffmpeg::encoder::video::Encoder> {
    let name = match quality {
        Quality::Camera => "libx264",
        Quality::Lossless => "libx264rgb",
    };
    let codec = ffmpeg::encoder::find_by_name(name)
        .ok_or_else(|| Error::internal("video encoding", format!("this FFmpeg has no encoder {name}")))?;
    let mut context = ffmpeg::codec::Context::new_with_codec(codec);
    // MP4 keeps the parameter sets in its header.
    context.set_flags(ffmpeg::codec::Flags::GLOBAL_HEADER | ffmpeg::codec::Flags::CLOSED_GOP);
    let mut encoder = context.encoder().video().map_err(failed)?;
    encoder.set_width(width_px);
    encoder.set_height(height_px);
    encoder.set_time_base(rate.invert());
    encoder.set_frame_rate(Some(rate));
    encoder.set_gop((f64::from(rate.0) / f64::from(rate.1)).round().max(1.0) as u32);
    encoder.set_max_b_frames(0);
    let mut options = ffmpeg::Dictionary::new();
    match quality {
        Quality::Camera => {
            encoder.set_format(Pixel::YUV420P);
            for (key, value) in [
                ("preset", "fast"),
                ("crf", "18"),
                ("colorspace", "bt709"),
                ("color_primaries", "bt709"),
                ("color_trc", "bt709"),
                ("color_range", "tv"),
                ("chroma_sample_location", "left"),
            ] {
                options.set(key, value);
            }
        }
        Quality::Lossless => {
            encoder.set_format(Pixel::BGR24);
            options.set("preset", "ultrafast");
            options.set("qp", "0");
        }
    }
    encoder.open_as_with(codec, options).map_err(failed)
}

fn bgr_frame(image: &Image) -> ffmpeg::frame::Video {
    let mut frame = ffmpeg::frame::Video::new(Pixel::BGR24, image.width_px(), image.height_px());
    let (stride, row_bytes) = (frame.stride(0), 3 * image.width_px() as usize);
    for (to, from) in frame.data_mut(0).chunks_mut(stride).zip(image.bgr().chunks_exact(row_bytes)) {
        to[..row_bytes].copy_from_slice(from);
    }
    frame
}

/// BT.709's luma and chroma, limited range, 16 fractional bits: for blue, green, red.
const LUMA: [i32; 3] = [4063, 40253, 11966];
const BLUE_DIFFERENCE: [i32; 3] = [28784, -22188, -6596];
const RED_DIFFERENCE: [i32; 3] = [-2641, -26143, 28784];

/// 4:2:0 with the chroma samples on the even columns and between two rows, where H.264 has them by default.
fn yuv_frame(image: &Image) -> ffmpeg::frame::Video {
    let row_bytes = 3 * image.width_px() as usize;
    let mut frame = ffmpeg::frame::Video::new(Pixel::YUV420P, image.width_px(), image.height_px());
    let stride = frame.stride(0);
    for (out, row) in frame.data_mut(0).chunks_mut(stride).zip(image.bgr().chunks_exact(row_bytes)) {
        for (y, bgr) in out.iter_mut().zip(row.chunks_exact(3)) {
            let bgr = [i32::from(bgr[0]), i32::from(bgr[1]), i32::from(bgr[2])];
            *y = (16 + ((weigh(&LUMA, bgr) + 32768) >> 16)) as u8;
        }
    }
    for (plane, weights) in [(1, &BLUE_DIFFERENCE), (2, &RED_DIFFERENCE)] {
        let stride = frame.stride(plane);
        for (out, rows) in frame.data_mut(plane).chunks_mut(stride).zip(image.bgr().chunks_exact(2 * row_bytes)) {
            chroma_row(weights, rows.split_at(row_bytes), out);
        }
    }
    frame
}

/// A row of chroma from two rows of the image: weights 1 2 1 along them, 1 1 across.
fn chroma_row(weights: &[i32; 3], (upper, lower): (&[u8], &[u8]), out: &mut [u8]) {
    let both = |a: &[u8], b: &[u8]| -> [i32; 3] { std::array::from_fn(|c| i32::from(a[c]) + i32::from(b[c])) };
    let mut left = both(upper, lower);
    for ((chroma, a), b) in out.iter_mut().zip(upper.chunks_exact(6)).zip(lower.chunks_exact(6)) {
        let (here, right) = (both(a, b), both(&a[3..], &b[3..]));
        let colour = std::array::from_fn(|c| left[c] + 2 * here[c] + right[c]);
        // Eight times the colour: three more bits.
        *chroma = (128 + ((weigh(weights, colour) + 262_144) >> 19)) as u8;
        left = right;
    }
}

fn weigh(weights: &[i32; 3], bgr: [i32; 3]) -> i32 {
    weights[0] * bgr[0] + weights[1] * bgr[1] + weights[2] * bgr[2]
}
