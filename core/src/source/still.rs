//! A whole JPEG, PNG or WebP file in memory → its pixels.

use ffmpeg_the_third as ffmpeg;

use ffmpeg::codec::Id;

use super::frame_file::still_format;
use super::video::{check_size, image};
use super::{EncodedFormat, Image};
use crate::error::{Error, Result};
use crate::rig::MAX_IMAGE_SIDE_PX;

/// Decodes stills one after the other, keeping the decoder of the latest format.
#[derive(Default)]
pub(super) struct StillDecoder {
    decoder: Option<(EncodedFormat, ffmpeg::decoder::Video)>,
}

impl StillDecoder {
    /// The pixels of one image; `name` names it in errors.
    ///
    /// # Errors
    /// [`Error::Input`] where the bytes are no such image, or its sides are out of range.
    pub(super) fn decode(&mut self, bytes: &[u8], name: &str) -> Result<Image> {
        let expected = format!("a whole JPEG, PNG or WebP image of 16 to {MAX_IMAGE_SIDE_PX} px a side");
        let not_an_image = |found: String| Error::input(name, found, expected.clone());
        let format = still_format(bytes).ok_or_else(|| not_an_image("bytes that begin as none".into()))?;
        let (_, mut decoder) = match self.decoder.take() {
            Some((kept, decoder)) if kept == format => (kept, decoder),
            _ => (format, open(format)?),
        };
        let mut frame = ffmpeg::frame::Video::empty();
        let packet = ffmpeg::Packet::copy(bytes);
        let decoded = decoder.send_packet(&packet).and_then(|()| match decoder.receive_frame(&mut frame) {
            Ok(()) => Ok(()),
            // Some decoders hand a picture out only when they hear that nothing follows.
            Err(_) => decoder.send_eof().and_then(|()| decoder.receive_frame(&mut frame)),
        });
        decoder.flush();
        decoded.map_err(|e| not_an_image(format!("an image that cannot be decoded ({e})")))?;
        self.decoder = Some((format, decoder));
        check_size(name, frame.width(), frame.height())?;
        image(frame)
    }
}

fn open(format: EncodedFormat) -> Result<ffmpeg::decoder::Video> {
    super::init_ffmpeg();
    let id = match format {
        EncodedFormat::Png => Id::PNG,
        EncodedFormat::Webp => Id::WEBP,
        _ => Id::MJPEG,
    };
    let failed = |e: ffmpeg::Error| Error::internal("decoder", e);
    let codec = ffmpeg::decoder::find(id).ok_or_else(|| Error::internal("decoder", format!("{id:?} is missing")))?;
    let mut context = ffmpeg::codec::context::Context::new_with_codec(codec);
    // One picture goes in and comes out: threads would keep pictures back.
    context.set_threading(ffmpeg::threading::Config::count(1));
    let decoder = context.decoder().open_as_with(codec, super::video::decoder_options());
    decoder.and_then(|opened| opened.video()).map_err(failed)
}
