//! `archive.mcap`: everything needed to keep, replay and re-derive a run, in one file of open schemas.
//!
//! | topic | schema | what |
//! |---|---|---|
//! | `/camera/video` | foxglove.CompressedVideo | the frames as received, in decoding order |
//! | `/camera/image` | foxglove.CompressedImage | the same for sources of single images |
//! | `/camera/calibration` | foxglove.CameraCalibration | once, at the start |
//! | `/tf` | foxglove.FrameTransform | `camera` in `world`, where it is known |
//! | `/profile` | foxglove.PointCloud | each frame's profile, in `camera` |
//! | `/surface` | foxglove.PointCloud | each frame's part of the surface, in `world` |
//! | `/measurement` | JSON | dx, dy, scale, residual, rows found |
//! | `/log` | foxglove.Log | warnings |
//! | `/depth_map` | foxglove.Grid | the finished map, in pieces of bounded size |
//! | `/depth_map/overview` | foxglove.Grid | the same, sampled to one piece, where there are several |
//!
//! Lengths are metres, as the schemas want them; image positions and shifts are pixels. Every message's log time is
//! its capture time: the run's start plus the frame's own time. Messages come in the order of the work, which readers
//! sort by the file's index. `rig.toml`, `recipe.toml` and what the caller adds are attachments.
//!
//! The messages and their schemas are the `foxglove` crate's. They are written with `mcap`'s own writer, not with
//! that crate's, which tells nobody when the disk is full.

mod grid;

use std::collections::{BTreeMap, HashMap};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::{
    CameraCalibration, CompressedImage, CompressedVideo, FrameTransform, Log, PackedElementField, PointCloud, Pose,
    Quaternion, Timestamp, Vector3, log::Level,
};
use foxglove::{Encode, Schema};
use mcap::records::MessageHeader;
use mcap::{Attachment, Compression, McapError, WriteOptions, Writer};
use nalgebra::Point3;
use serde::Serialize;
use tempfile::NamedTempFile;

use crate::depth_map::{MapGeometry, MapWindow};
use crate::error::{Error, Result};
use crate::geometry::WorldFromCamera;
use crate::motion::Shift;
use crate::recipe::Recipe;
use crate::rig::Rig;
use crate::source::{EncodedFormat, EncodedFrame};
use crate::stripe::Stripe;
use crate::surface::SurfacePoint;
use crate::triangulation::Profile;

/// Frame of reference of the profiles.
const CAMERA: &str = "camera";
/// Frame of reference of the surface and the map.
const WORLD: &str = "world";

/// What `/measurement` holds of a frame; a value that is not known is absent.
#[derive(Serialize)]
struct Measurement {
    frame: u32,
    rows_found: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    dx_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    dy_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    scale: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    residual_px: Option<f64>,
}

const MEASUREMENT_SCHEMA: &str = r#"{
  "title": "stria.Measurement",
  "type": "object",
  "properties": {
    "frame": {"type": "integer", "description": "place of the frame in the run, from 0"},
    "rows_found": {"type": "integer", "description": "line positions with a spot"},
    "dx_px": {"type": "number", "description": "shift of the image since the previous frame, columns"},
    "dy_px": {"type": "number", "description": "shift of the image since the previous frame, rows"},
    "scale": {"type": "number", "description": "scale of the image since the previous frame; above 1: came closer"},
    "residual_px": {"type": "number", "description": "median distance of the corners from the fitted motion"}
  },
  "required": ["frame", "rows_found"]
}"#;

/// A channel that has been announced, and how many messages it has.
struct Channel {
    id: u16,
    messages: u32,
}

/// Writes one archive.
pub struct ArchiveWriter {
    path: PathBuf,
    writer: Writer<BufWriter<NamedTempFile>>,
    channels: HashMap<&'static str, Channel>,
    start_ns: u64,
    latest_s: f64,
    buffer: Vec<u8>,
}

impl ArchiveWriter {
    /// Starts an archive that will be at `path`, of a run that began at `recorded_at`.
    ///
    /// # Errors
    /// Where the file cannot be written.
    pub fn create(
        path: &Path,
        rig: &Rig,
        recipe: &Recipe,
        run_name: &str,
        recorded_at: jiff::Timestamp,
    ) -> Result<ArchiveWriter> {
        let file = BufWriter::new(super::part_file(path)?);
        // One thread: the chunks are small, and the cores are busy with frames.
        let options = WriteOptions::new()
            .compression(Some(Compression::Zstd))
            .compression_level(1)
            .compression_threads(0)
            .library(concat!("stria ", env!("CARGO_PKG_VERSION")));
        let mut archive = ArchiveWriter {
            path: path.to_path_buf(),
            writer: options.create(file).map_err(|e| failed(path, e))?,
            channels: HashMap::new(),
            start_ns: u64::try_from(recorded_at.as_nanosecond()).unwrap_or(0),
            latest_s: 0.0,
            buffer: Vec::new(),
        };
        archive.metadata("stria", &[("version", env!("CARGO_PKG_VERSION")), ("archive_version", "1")])?;
        archive.metadata("run", &[("name", run_name), ("recorded_at", &recorded_at.to_string())])?;
        archive.metadata(
            "units",
            &[
                ("length", "m"),
                ("image", "px; (0, 0) is the centre of the first pixel"),
                ("time", "ns since 1970-01-01 UTC, capture time"),
                ("camera", "x right, y down, z forward"),
                ("world", "x along the travel, z into the wall"),
                ("depth_map.elevation", "world z, m; NaN where nothing was measured"),
            ],
        )?;
        archive.attach("rig.toml", "application/toml", rig.to_toml().as_bytes())?;
        archive.attach("recipe.toml", "application/toml", recipe.to_toml().as_bytes())?;
        archive.calibration(rig)?;
        Ok(archive)
    }

    /// Adds a frame as the source holds it.
    ///
    /// # Errors
    /// Where the file cannot be written; so for all that follow.
    pub fn frame(&mut self, frame: &EncodedFrame) -> Result<()> {
        let format = match frame.format {
            EncodedFormat::H264 => "h264",
            EncodedFormat::H265 => "h265",
            EncodedFormat::Vp9 => "vp9",
            EncodedFormat::Av1 => "av1",
            EncodedFormat::Jpeg => "jpeg",
            EncodedFormat::Png => "png",
            EncodedFormat::Webp => "webp",
        };
        let timestamp = Some(self.timestamp(frame.time_s));
        let (frame_id, format, data) = (CAMERA.to_string(), format.to_string(), frame.data.clone().into());
        match frame.format {
            EncodedFormat::H264 | EncodedFormat::H265 | EncodedFormat::Vp9 | EncodedFormat::Av1 => {
                self.write("/camera/video", frame.time_s, &CompressedVideo { timestamp, frame_id, data, format })
            }
            EncodedFormat::Jpeg | EncodedFormat::Png | EncodedFormat::Webp => {
                self.write("/camera/image", frame.time_s, &CompressedImage { timestamp, frame_id, data, format })
            }
        }
    }

    /// Adds where the camera was.
    ///
    /// # Errors
    /// As [`ArchiveWriter::frame`].
    pub fn pose(&mut self, time_s: f64, world_from_camera: &WorldFromCamera) -> Result<()> {
        let t = world_from_camera.translation.vector / 1000.0;
        let q = world_from_camera.rotation.coords;
        let transform = FrameTransform {
            timestamp: Some(self.timestamp(time_s)),
            parent_frame_id: WORLD.into(),
            child_frame_id: CAMERA.into(),
            translation: Some(Vector3 { x: t.x, y: t.y, z: t.z }),
            rotation: Some(Quaternion { x: q.x, y: q.y, z: q.z, w: q.w }),
        };
        self.write("/tf", time_s, &transform)
    }

    /// Adds a frame's profile, in the camera's frame.
    ///
    /// # Errors
    /// As [`ArchiveWriter::frame`].
    pub fn profile(&mut self, time_s: f64, profile: &Profile) -> Result<()> {
        let points = profile.points.iter().map(|p| (p.point_in_camera, p.rgb, p.confidence));
        let cloud = cloud(self.timestamp(time_s), CAMERA, points);
        self.write("/profile", time_s, &cloud)
    }

    /// Adds a frame's part of the surface, in the world.
    ///
    /// # Errors
    /// As [`ArchiveWriter::frame`].
    pub fn surface(&mut self, time_s: f64, points: &[SurfacePoint]) -> Result<()> {
        let points = points.iter().map(|p| (p.point_in_world, p.rgb, p.confidence));
        let cloud = cloud(self.timestamp(time_s), WORLD, points);
        self.write("/surface", time_s, &cloud)
    }

    /// Adds what was measured in a frame.
    ///
    /// # Errors
    /// As [`ArchiveWriter::frame`].
    pub fn measurement(&mut self, frame: u32, time_s: f64, stripe: &Stripe, shift: &Shift) -> Result<()> {
        let measurement = Measurement {
            frame,
            rows_found: stripe.found(),
            dx_px: shift.dx_px,
            dy_px: shift.dy_px,
            scale: shift.scale,
            residual_px: shift.residual_px,
        };
        let json = serde_json::to_vec(&measurement).map_err(|e| Error::internal("archive", e))?;
        let schema = || Some(Schema::new("stria.Measurement", "jsonschema", MEASUREMENT_SCHEMA.as_bytes()));
        self.put("/measurement", time_s, schema, "json", &json)
    }

    /// Adds something a person should know, at the time of the latest message.
    ///
    /// # Errors
    /// As [`ArchiveWriter::frame`].
    pub fn warning(&mut self, text: &str) -> Result<()> {
        let log = Log {
            timestamp: Some(self.timestamp(self.latest_s)),
            level: Level::Warning.into(),
            message: text.into(),
            name: "stria".into(),
            ..Log::default()
        };
        self.write("/log", self.latest_s, &log)
    }

    /// Adds the finished map, at the time of the latest message. `window` reads a rectangle of it: column, row,
    /// width, height, px. No more than one piece of the map is in memory.
    ///
    /// # Errors
    /// What `window` gives, and as [`ArchiveWriter::frame`].
    pub fn depth_map(
        &mut self,
        geometry: &MapGeometry,
        mut window: impl FnMut(usize, usize, usize, usize) -> Result<MapWindow>,
    ) -> Result<()> {
        let (time_s, timestamp) = (self.latest_s, self.timestamp(self.latest_s));
        let mut overview = grid::Overview::new(geometry);
        let pieces = grid::pieces(geometry);
        for piece in &pieces {
            let content = window(piece.column_px, piece.row_px, piece.width_px, piece.height_px)?;
            overview.add(piece, &content);
            self.write("/depth_map", time_s, &grid::message(timestamp, WORLD, &piece.geometry(geometry), &content))?;
        }
        if pieces.len() > 1 {
            let (geometry, content) = overview.finish();
            self.write("/depth_map/overview", time_s, &grid::message(timestamp, WORLD, &geometry, &content))?;
        }
        self.metadata("depth_map", &[("pieces", &pieces.len().to_string())])
    }

    /// Adds a file.
    ///
    /// # Errors
    /// As [`ArchiveWriter::frame`].
    pub fn attach(&mut self, name: &str, media_type: &str, bytes: &[u8]) -> Result<()> {
        let time = self.log_time(self.latest_s);
        let attachment = Attachment {
            log_time: time,
            create_time: time,
            name: name.into(),
            media_type: media_type.into(),
            data: bytes.into(),
        };
        self.writer.attach(&attachment).map_err(|e| failed(&self.path, e))
    }

    /// Adds named values: hashes, versions.
    ///
    /// # Errors
    /// As [`ArchiveWriter::frame`].
    pub fn metadata(&mut self, name: &str, values: &[(&str, &str)]) -> Result<()> {
        let metadata = values.iter().map(|(k, v)| (k.to_string(), v.to_string())).collect();
        let record = mcap::records::Metadata { name: name.into(), metadata };
        self.writer.write_metadata(&record).map_err(|e| failed(&self.path, e))
    }

    /// Completes the file with its index and puts it in its place. Without this call, nothing is left at the path.
    ///
    /// # Errors
    /// As [`ArchiveWriter::frame`].
    pub fn finish(mut self) -> Result<()> {
        self.writer.finish().map_err(|e| failed(&self.path, e))?;
        let part = self.writer.into_inner().into_inner().map_err(|e| Error::io(&self.path, e.into_error()))?;
        part.as_file().sync_all().map_err(|e| Error::io(&self.path, e))?;
        part.persist(&self.path).map_err(|e| Error::io(&self.path, e.error))?;
        Ok(())
    }

    fn calibration(&mut self, rig: &Rig) -> Result<()> {
        let camera = &rig.camera;
        let plumb_bob = camera.distortion[5..].iter().all(|d| *d == 0.0);
        let (fx, fy, cx, cy) = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px);
        let calibration = CameraCalibration {
            timestamp: Some(self.timestamp(0.0)),
            frame_id: CAMERA.into(),
            width: camera.width_px,
            height: camera.height_px,
            distortion_model: if plumb_bob { "plumb_bob" } else { "rational_polynomial" }.into(),
            d: camera.distortion[..if plumb_bob { 5 } else { 8 }].to_vec(),
            k: vec![fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: vec![fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        };
        self.write("/camera/calibration", 0.0, &calibration)
    }

    fn write<T: Encode>(&mut self, topic: &'static str, time_s: f64, message: &T) -> Result<()> {
        let mut buffer = std::mem::take(&mut self.buffer);
        buffer.clear();
        let written = match message.encode(&mut buffer) {
            Ok(()) => self.put(topic, time_s, T::get_schema, &T::get_message_encoding(), &buffer),
            Err(e) => Err(Error::internal("archive", e)),
        };
        self.buffer = buffer;
        written
    }

    fn put(
        &mut self,
        topic: &'static str,
        time_s: f64,
        schema: impl Fn() -> Option<Schema>,
        encoding: &str,
        data: &[u8],
    ) -> Result<()> {
        let log_time = self.log_time(time_s);
        self.latest_s = self.latest_s.max(time_s);
        if !self.channels.contains_key(topic) {
            let id = self.announce(topic, schema(), encoding).map_err(|e| failed(&self.path, e))?;
            self.channels.insert(topic, Channel { id, messages: 0 });
        }
        let Some(channel) = self.channels.get_mut(topic) else { unreachable!("just announced") };
        let header =
            MessageHeader { channel_id: channel.id, sequence: channel.messages, log_time, publish_time: log_time };
        channel.messages = channel.messages.wrapping_add(1);
        self.writer.write_to_known_channel(&header, data).map_err(|e| failed(&self.path, e))
    }

    fn announce(&mut self, topic: &str, schema: Option<Schema>, encoding: &str) -> std::result::Result<u16, McapError> {
        let schema_id = match schema {
            Some(schema) => self.writer.add_schema(&schema.name, &schema.encoding, &schema.data)?,
            None => 0,
        };
        self.writer.add_channel(schema_id, topic, encoding, &BTreeMap::new())
    }

    fn log_time(&self, time_s: f64) -> u64 {
        self.start_ns.saturating_add((time_s.max(0.0) * 1e9).round() as u64)
    }

    fn timestamp(&self, time_s: f64) -> Timestamp {
        let ns = self.log_time(time_s);
        Timestamp::new(u32::try_from(ns / 1_000_000_000).unwrap_or(u32::MAX), (ns % 1_000_000_000) as u32)
    }
}

fn failed(path: &Path, error: McapError) -> Error {
    match error {
        McapError::Io(e) => Error::io(path, e),
        other => Error::internal("archive", other),
    }
}

/// A point cloud in metres: x y z (float32), red green blue alpha (uint8), confidence (float32).
fn cloud(
    timestamp: Timestamp,
    frame_id: &str,
    points: impl ExactSizeIterator<Item = (Point3<f64>, [u8; 3], f32)>,
) -> PointCloud {
    const STRIDE: usize = 20;
    let mut data = Vec::with_capacity(STRIDE * points.len());
    for (point, [r, g, b], confidence) in points {
        metres(&point).iter().for_each(|v| data.extend(v.to_le_bytes()));
        data.extend([r, g, b, 255]);
        data.extend(confidence.to_le_bytes());
    }
    PointCloud {
        timestamp: Some(timestamp),
        frame_id: frame_id.into(),
        pose: Some(pose_at([0.0; 3])),
        point_stride: STRIDE as u32,
        fields: fields(&[
            ("x", 0, NumericType::Float32),
            ("y", 4, NumericType::Float32),
            ("z", 8, NumericType::Float32),
            ("red", 12, NumericType::Uint8),
            ("green", 13, NumericType::Uint8),
            ("blue", 14, NumericType::Uint8),
            ("alpha", 15, NumericType::Uint8),
            ("confidence", 16, NumericType::Float32),
        ]),
        data: data.into(),
    }
}

fn fields(of: &[(&str, u32, NumericType)]) -> Vec<PackedElementField> {
    let field = |(name, offset, kind): &(&str, u32, NumericType)| PackedElementField {
        name: (*name).into(),
        offset: *offset,
        r#type: i32::from(*kind),
    };
    of.iter().map(field).collect()
}

/// Not turned, at a position in metres.
fn pose_at([x, y, z]: [f64; 3]) -> Pose {
    Pose { position: Some(Vector3 { x, y, z }), orientation: Some(Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }) }
}

/// The schemas' unit of length.
fn metres(point_mm: &Point3<f64>) -> [f32; 3] {
    [point_mm.x, point_mm.y, point_mm.z].map(|v| (v / 1000.0) as f32)
}
