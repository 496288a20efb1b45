//! Where frames come from: video files, folders of images.

mod image;

pub use image::Image;

/// One image of a run.
pub struct Frame {
    /// Position in the run, from 0.
    pub index: u32,
    /// Capture time since the run's first frame, s; never falls.
    pub time_s: f64,
    /// The pixels.
    pub image: Image,
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
