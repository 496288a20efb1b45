//! The messages that a run is read from: Foxglove's, and ROS 2's.

use foxglove::Decode;
use foxglove::messages::{CameraCalibration, CompressedImage, CompressedVideo, RawImage, Timestamp};

use super::cdr::{BadCdr, Cdr};
use crate::mcap_file::{Message, Topic};
use crate::source::frame_file::still_format;
use crate::source::{EncodedFormat, RawEncoding, RawLayout};

/// What a topic can give.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    /// The frames.
    Images(Packing),
    /// The camera's own calibration.
    Camera,
    /// Where the robot thinks it is.
    Odometry,
    /// How the robot's parts are fixed to each other.
    FixedTransforms,
}

/// How a topic's images are packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Packing {
    FoxgloveVideo,
    FoxgloveImage,
    FoxgloveRaw,
    /// `foxglove_msgs`: Foxglove's schemas as ROS 2 messages.
    RosFoxgloveVideo,
    RosFoxgloveImage,
    RosCompressed,
    RosRaw,
}

/// What a topic can give; `None` where it is of no use here.
pub(super) fn role(topic: &Topic) -> Option<Role> {
    let role = match (topic.encoding.as_str(), topic.schema.as_str()) {
        ("protobuf", "foxglove.CompressedVideo") => Role::Images(Packing::FoxgloveVideo),
        ("protobuf", "foxglove.CompressedImage") => Role::Images(Packing::FoxgloveImage),
        ("protobuf", "foxglove.RawImage") => Role::Images(Packing::FoxgloveRaw),
        ("protobuf", "foxglove.CameraCalibration") => Role::Camera,
        ("cdr", "foxglove_msgs/msg/CompressedVideo") => Role::Images(Packing::RosFoxgloveVideo),
        ("cdr", "foxglove_msgs/msg/CompressedImage") => Role::Images(Packing::RosFoxgloveImage),
        ("cdr", "sensor_msgs/msg/CompressedImage") => Role::Images(Packing::RosCompressed),
        ("cdr", "sensor_msgs/msg/Image") => Role::Images(Packing::RosRaw),
        ("cdr", "sensor_msgs/msg/CameraInfo") => Role::Camera,
        ("cdr", "nav_msgs/msg/Odometry") => Role::Odometry,
        ("cdr", "tf2_msgs/msg/TFMessage") if topic.name.ends_with("tf_static") => Role::FixedTransforms,
        _ => return None,
    };
    Some(role)
}

/// An image as a message brings it.
pub(super) struct ImageMessage {
    /// When it was captured, ns since the epoch; the message's log time where its own header does not say.
    pub time_ns: u64,
    /// The camera's frame of reference.
    pub frame_id: String,
    /// How it is packed.
    pub format: EncodedFormat,
    /// Its bytes.
    pub data: Vec<u8>,
}

/// Why a message is of no use, in words.
pub(super) type Unusable = String;

/// Reads an image out of its message.
pub(super) fn image(packing: Packing, message: &Message) -> Result<ImageMessage, Unusable> {
    let (time_ns, frame_id, format, data) = match packing {
        Packing::FoxgloveVideo => {
            let m = CompressedVideo::decode(&message.data[..]).map_err(|e| e.to_string())?;
            (stamp_ns(m.timestamp), m.frame_id, video_format(&m.format)?, m.data.to_vec())
        }
        Packing::FoxgloveImage => {
            let m = CompressedImage::decode(&message.data[..]).map_err(|e| e.to_string())?;
            (stamp_ns(m.timestamp), m.frame_id, image_format(&m.data)?, m.data.to_vec())
        }
        Packing::FoxgloveRaw => {
            let m = RawImage::decode(&message.data[..]).map_err(|e| e.to_string())?;
            let (layout, data) = raw(m.width, m.height, m.step, &m.encoding, false, m.data.to_vec())?;
            (stamp_ns(m.timestamp), m.frame_id, EncodedFormat::Raw(layout), data)
        }
        Packing::RosFoxgloveVideo | Packing::RosFoxgloveImage | Packing::RosCompressed | Packing::RosRaw => {
            ros_image(packing, &message.data).map_err(|BadCdr(what)| what.to_string())??
        }
    };
    Ok(ImageMessage { time_ns: time_ns.unwrap_or(message.log_time_ns), frame_id, format, data })
}

type Parts = (Option<u64>, String, EncodedFormat, Vec<u8>);

fn ros_image(packing: Packing, bytes: &[u8]) -> Result<Result<Parts, Unusable>, BadCdr> {
    let mut cdr = Cdr::new(bytes)?;
    let (time_ns, frame_id) = (cdr.time_ns()?, cdr.text()?);
    let found = match packing {
        Packing::RosRaw => {
            let (height, width, encoding) = (cdr.u32()?, cdr.u32()?, cdr.text()?);
            let (big_endian, step, data) = (cdr.u8()? != 0, cdr.u32()?, cdr.bytes()?.to_vec());
            raw(width, height, step, &encoding, big_endian, data)
                .map(|(layout, data)| (EncodedFormat::Raw(layout), data))
        }
        Packing::RosCompressed => {
            // Its format says "jpeg", or "bgr8; jpeg compressed bgr8", or what some driver makes of it: the bytes know.
            let (_format, data) = (cdr.text()?, cdr.bytes()?);
            image_format(data).map(|format| (format, data.to_vec()))
        }
        _ => {
            let (data, format) = (cdr.bytes()?, cdr.text()?);
            let format = match packing {
                Packing::RosFoxgloveVideo => video_format(&format),
                _ => image_format(data),
            };
            format.map(|format| (format, data.to_vec()))
        }
    };
    Ok(found.map(|(format, data)| (time_ns, frame_id, format, data)))
}

fn stamp_ns(stamp: Option<Timestamp>) -> Option<u64> {
    stamp.map(|t| u64::from(t.sec()) * 1_000_000_000 + u64::from(t.nsec())).filter(|ns| *ns > 0)
}

fn video_format(name: &str) -> Result<EncodedFormat, Unusable> {
    match name {
        "h264" => Ok(EncodedFormat::H264),
        "h265" => Ok(EncodedFormat::H265),
        "vp9" => Ok(EncodedFormat::Vp9),
        "av1" => Ok(EncodedFormat::Av1),
        other => Err(format!("video of format `{other}`; expected h264, h265, vp9 or av1")),
    }
}

fn image_format(data: &[u8]) -> Result<EncodedFormat, Unusable> {
    still_format(data).ok_or_else(|| "an image that is neither JPEG, PNG nor WebP by its first bytes".to_string())
}

/// Checks that the pixels are all there.
fn raw(
    width_px: u32,
    height_px: u32,
    step_bytes: u32,
    encoding: &str,
    big_endian: bool,
    mut data: Vec<u8>,
) -> Result<(RawLayout, Vec<u8>), Unusable> {
    let encoding = RawEncoding::named(encoding).ok_or_else(|| {
        let known: Vec<&str> = RawEncoding::ALL.iter().map(|known| known.name()).collect();
        format!("an image of encoding `{encoding}`; expected one of {}", known.join(", "))
    })?;
    let layout = RawLayout { width_px, height_px, step_bytes, encoding };
    let row_bytes = u64::from(width_px) * u64::from(encoding.pixel_bytes());
    if u64::from(step_bytes) < row_bytes || (data.len() as u64) < u64::from(step_bytes) * u64::from(height_px) {
        return Err(format!(
            "an image of {width_px} x {height_px} px in {} bytes, {step_bytes} a row: too few",
            data.len()
        ));
    }
    if big_endian && encoding == RawEncoding::Mono16 {
        data.chunks_exact_mut(2).for_each(|pair| pair.swap(0, 1));
    }
    Ok((layout, data))
}

/// What a camera says of its own calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraFacts {
    /// The topic that says so.
    pub topic: String,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Focal lengths, px: across, down; zero where it is not calibrated.
    pub focal_px: [f64; 2],
    /// Principal point, px.
    pub centre_px: [f64; 2],
}

/// Reads a camera's calibration.
pub(super) fn camera(message: &Message) -> Result<CameraFacts, Unusable> {
    let (width_px, height_px, k) = if message.topic.encoding == "cdr" {
        ros_camera(&message.data).map_err(|BadCdr(what)| what.to_string())?
    } else {
        let m = CameraCalibration::decode(&message.data[..]).map_err(|e| e.to_string())?;
        let k: [f64; 9] = m.k.try_into().map_err(|_| "a matrix K without nine values".to_string())?;
        (m.width, m.height, k)
    };
    let topic = message.topic.name.clone();
    Ok(CameraFacts { topic, width_px, height_px, focal_px: [k[0], k[4]], centre_px: [k[2], k[5]] })
}

fn ros_camera(bytes: &[u8]) -> Result<(u32, u32, [f64; 9]), BadCdr> {
    let mut cdr = Cdr::new(bytes)?;
    let _stamp = cdr.time_ns()?;
    let _frame_id = cdr.text()?;
    let (height, width) = (cdr.u32()?, cdr.u32()?);
    let _model = cdr.text()?;
    for _ in 0..cdr.u32()? {
        cdr.f64()?;
    }
    Ok((width, height, cdr.f64s()?))
}
