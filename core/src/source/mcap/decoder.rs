//! Packed images, one a message → pictures.

use std::collections::VecDeque;

use ffmpeg_the_third as ffmpeg;

use ffmpeg::codec::Id;
use ffmpeg::format::Pixel;

use super::messages::ImageMessage;
use crate::error::{Error, Result};
use crate::source::encoded::is_key;
use crate::source::video::{check_size, image};
use crate::source::{EncodedFormat, Image, RawEncoding, RawLayout, VideoFacts, init_ffmpeg};

/// A picture with its capture time.
pub(super) struct TimedPicture {
    /// ns since the epoch.
    pub time_ns: u64,
    pub image: Image,
}

/// Decodes a run's messages in their order.
pub(super) struct Pictures {
    name: String,
    facts: VideoFacts,
    decoder: Option<(Id, ffmpeg::decoder::Video)>,
    ready: VecDeque<TimedPicture>,
    /// Messages that gave no picture.
    bad: u64,
    first_problem: Option<String>,
}

impl Pictures {
    /// `facts` is what the file says of its video beside the stream.
    pub(super) fn new(name: &str, facts: VideoFacts) -> Pictures {
        init_ffmpeg();
        Pictures { name: name.into(), facts, decoder: None, ready: VecDeque::new(), bad: 0, first_problem: None }
    }

    /// The next picture that is there.
    pub(super) fn pop(&mut self) -> Option<TimedPicture> {
        self.ready.pop_front()
    }

    /// Takes a message in; what it holds may come out a few messages later.
    pub(super) fn push(&mut self, message: ImageMessage) -> Result<()> {
        let (time_ns, data) = (message.time_ns, message.data);
        let id = match message.format {
            EncodedFormat::H264 => Id::H264,
            EncodedFormat::H265 => Id::HEVC,
            EncodedFormat::Vp9 => Id::VP9,
            EncodedFormat::Av1 => Id::AV1,
            EncodedFormat::Jpeg => Id::MJPEG,
            EncodedFormat::Png => Id::PNG,
            EncodedFormat::Webp => Id::WEBP,
            EncodedFormat::Raw(layout) => {
                check_size(&self.name, layout.width_px, layout.height_px)?;
                self.ready.push_back(TimedPicture { time_ns, image: image(raw_frame(layout, &data))? });
                return Ok(());
            }
        };
        if self.decoder.as_ref().is_none_or(|(known, _)| *known != id) {
            self.end()?;
            self.decoder = Some((id, self.open(id)?));
        }
        let Some((_, decoder)) = &mut self.decoder else { unreachable!("just opened") };
        let mut packet = ffmpeg::Packet::copy(&data);
        packet.set_pts(i64::try_from(time_ns).ok());
        // FFmpeg adds a PNG that is not marked as a key frame to the one before.
        if is_key(message.format, &data) {
            packet.set_flags(ffmpeg::packet::Flags::KEY);
        }
        if decoder.send_packet(&packet).is_err() {
            self.refuse("the decoder refused it");
        }
        self.receive()
    }

    /// Counts a message that cannot be used.
    pub(super) fn refuse(&mut self, why: &str) {
        self.bad += 1;
        self.first_problem.get_or_insert_with(|| why.to_string());
    }

    /// There are no more messages: what the decoder still holds comes out.
    pub(super) fn end(&mut self) -> Result<()> {
        let Some((_, decoder)) = &mut self.decoder else { return Ok(()) };
        // Fails only when it was told so before.
        let _ = decoder.send_eof();
        self.receive()?;
        self.decoder = None;
        Ok(())
    }

    /// What went wrong, in words for people.
    pub(super) fn warning(&self) -> Option<String> {
        let problem = self.first_problem.as_ref()?;
        Some(format!("{}: {} messages gave no picture and were left out; the first: {problem}", self.name, self.bad))
    }

    fn open(&self, id: Id) -> Result<ffmpeg::decoder::Video> {
        let failed =
            |e: ffmpeg::Error| Error::input(&self.name, format!("no decoder for {id:?} ({e})"), "H.264 or JPEG");
        let codec = ffmpeg::decoder::find(id).ok_or_else(|| failed(ffmpeg::Error::DecoderNotFound))?;
        let mut context = ffmpeg::codec::Context::new_with_codec(codec);
        context.set_threading(ffmpeg::threading::Config::kind(ffmpeg::threading::Type::Frame));
        // What the container said, where the stream says nothing itself.
        let mut options = ffmpeg::Dictionary::new();
        for (key, value) in self.facts.decoder_options() {
            options.set(key, value);
        }
        context.decoder().open_as_with(codec, options).and_then(|opened| opened.video()).map_err(failed)
    }

    fn receive(&mut self) -> Result<()> {
        let Some((_, decoder)) = &mut self.decoder else { return Ok(()) };
        loop {
            let mut decoded = ffmpeg::frame::Video::empty();
            match decoder.receive_frame(&mut decoded) {
                Ok(()) => {}
                // It wants more, it has ended, or a picture was broken: the next one is asked for with the next message.
                Err(_) => return Ok(()),
            }
            check_size(&self.name, decoded.width(), decoded.height())?;
            let time_ns = decoded.timestamp().or(decoded.pts()).and_then(|t| u64::try_from(t).ok()).unwrap_or(0);
            self.ready.push_back(TimedPicture { time_ns, image: image(decoded)? });
        }
    }
}

/// Pixels as they are → a frame of FFmpeg's.
fn raw_frame(layout: RawLayout, data: &[u8]) -> ffmpeg::frame::Video {
    let format = match layout.encoding {
        RawEncoding::Rgb8 => Pixel::RGB24,
        RawEncoding::Bgr8 => Pixel::BGR24,
        RawEncoding::Rgba8 => Pixel::RGBA,
        RawEncoding::Bgra8 => Pixel::BGRA,
        RawEncoding::Mono8 => Pixel::GRAY8,
        RawEncoding::Mono16 => Pixel::GRAY16LE,
        RawEncoding::Yuyv => Pixel::YUYV422,
        RawEncoding::Uyvy => Pixel::UYVY422,
        RawEncoding::BayerRggb8 => Pixel::BAYER_RGGB8,
        RawEncoding::BayerBggr8 => Pixel::BAYER_BGGR8,
        RawEncoding::BayerGbrg8 => Pixel::BAYER_GBRG8,
        RawEncoding::BayerGrbg8 => Pixel::BAYER_GRBG8,
    };
    let mut frame = ffmpeg::frame::Video::new(format, layout.width_px, layout.height_px);
    let row_bytes = layout.width_px as usize * layout.encoding.pixel_bytes() as usize;
    let stride = frame.stride(0);
    let rows = data.chunks(layout.step_bytes as usize).take(layout.height_px as usize);
    for (to, from) in frame.data_mut(0).chunks_mut(stride).zip(rows) {
        to[..row_bytes].copy_from_slice(&from[..row_bytes]);
    }
    frame
}
