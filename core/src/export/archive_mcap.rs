//! `archive.mcap`: everything needed to keep, replay and re-derive a run, in one file of open schemas.
//!
//! | topic | schema | what |
//! |---|---|---|
//! | `/camera/video` | foxglove.CompressedVideo | the frames as received, in decoding order |
//! | `/camera/image` | foxglove.CompressedImage | the same for sources of single images |
//! | `/camera/calibration` | foxglove.CameraCalibration | once, at the start |
//! | `/camera/raw` | foxglove.RawImage | the same for sources of pixels that are not packed |
//! | `/tf` | foxglove.FrameTransforms | `camera` in `world`, where it is known |
//! | `/tf_static` | foxglove.FrameTransforms | `world` upright in the root of rerun's space, once |
//! | `/profile` | foxglove.PointCloud | each frame's profile, in `camera` |
//! | `/surface` | foxglove.PointCloud | the surface in `world`, in chunks of some frames |
//! | `/surface/overview` | foxglove.PointCloud | all of it, thinned to one message, at the end |
//! | `/measurement` | JSON | dx, dy, scale, residual, rows found, where on the wall |
//! | `/log` | foxglove.Log | warnings |
//! | `/defects` | foxglove.SceneUpdate | a box around each defect, where defects were looked for |
//! | `/depth_map` | foxglove.Grid | the finished map, in pieces of bounded size |
//! | `/depth_map/overview` | foxglove.Grid | the same, sampled to one piece, where there are several |
//! | `/depth_map/image` | foxglove.RawImage | the map as a 32FC1 image in metres; sampled where it is large |
//!
//! Lengths are metres, as the schemas want them; image positions and shifts are pixels. Every message's log time is
//! its capture time: the run's start plus the frame's own time; a chunk of the surface has its last frame's. Only of
//! a video with B-frames a frame's log time is that of its decoding, since players take messages by their log time and
//! decoders want that order; the capture time is the message's `timestamp`. Messages come in the order of the work,
//! which readers sort by the file's index. `rig.toml`, `recipe.toml` and what the caller adds are attachments: with the
//! frames they are enough to run the job again.
//!
//! The messages and their schemas are the `foxglove` crate's. They are written with `mcap`'s own writer, not with
//! that crate's, which tells nobody when the disk is full.

mod cut;
mod grid;
mod overview;
mod points;
mod scene;

use std::collections::{BTreeMap, HashMap};
use std::f64::consts::FRAC_PI_2;
use std::path::{Path, PathBuf};

use foxglove::messages::{
    CameraCalibration, CompressedImage, CompressedVideo, FrameTransform, FrameTransforms, Log, Quaternion, RawImage,
    Timestamp, Vector3, log::Level,
};
use foxglove::{Encode, Schema};
use mcap::records::MessageHeader;
use mcap::{Attachment, Compression, McapError, WriteOptions, Writer};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use serde::Serialize;

use crate::depth_map::{MapGeometry, MapWindow};
use crate::error::{Error, Result};
use crate::export::new_file::NewFile;
use crate::geometry::WorldFromCamera;
use crate::motion::Shift;
use crate::recipe::Recipe;
use crate::rig::Rig;
use crate::source::{EncodedFormat, EncodedFrame, VIDEO_METADATA, VideoFacts};
use crate::stripe::Stripe;
use crate::surface::SurfacePoint;
use crate::triangulation::Profile;

use overview::SurfaceOverview;
use points::cloud;

pub use cut::{ArchiveCut, ArchiveSource, cut};

/// Grows when something in an archive changes its meaning.
const ARCHIVE_VERSION: &str = "2";
/// A chunk of the surface holds at most about this many points ...
const CHUNK_POINTS: usize = 32_768;
/// ... and at most this long a stretch of the run, s.
const CHUNK_S: f64 = 0.5;

/// The topics that other parts of this room look for.
mod topic {
    pub(super) const VIDEO: &str = "/camera/video";
    pub(super) const IMAGE: &str = "/camera/image";
    pub(super) const RAW: &str = "/camera/raw";
    pub(super) const TRANSFORMS: &str = "/tf";
    pub(super) const PROFILE: &str = "/profile";
    pub(super) const SURFACE: &str = "/surface";
    pub(super) const SURFACE_OVERVIEW: &str = "/surface/overview";
    pub(super) const MEASUREMENT: &str = "/measurement";
    pub(super) const DEPTH_MAP: &str = "/depth_map";
}

/// Frame of reference of the profiles.
const CAMERA: &str = "camera";
/// Frame of reference of the surface and the map.
const WORLD: &str = "world";
/// What rerun calls the frame of its space's root: a recording that it makes of an archive shows in 3D what is tied to it.
/// There, as in Foxglove's space, z points up.
const RERUN_ROOT: &str = "tf#/";

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
    /// Middle of the frame's points.
    #[serde(skip_serializing_if = "Option::is_none")]
    x_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    z_mm: Option<f64>,
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
    "residual_px": {"type": "number", "description": "median distance of the corners from the fitted motion"},
    "x_mm": {"type": "number", "description": "middle of the frame's points along the travel, world"},
    "z_mm": {"type": "number", "description": "middle of the frame's points into the wall, world"}
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
    writer: Writer<NewFile>,
    channels: HashMap<&'static str, Channel>,
    start_ns: u64,
    latest_s: f64,
    chunk: Chunk,
    overview: SurfaceOverview,
    buffer: Vec<u8>,
}

/// Points of the surface that wait for being a message.
#[derive(Default)]
struct Chunk {
    points: Vec<SurfacePoint>,
    first_s: f64,
    last_s: f64,
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
        let file = NewFile::create(path)?;
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
            chunk: Chunk::default(),
            overview: SurfaceOverview::new(),
            buffer: Vec::new(),
        };
        archive.metadata("stria", &[("version", env!("CARGO_PKG_VERSION")), ("archive_version", ARCHIVE_VERSION)])?;
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
        let upright = UnitQuaternion::from_axis_angle(&nalgebra::Vector3::x_axis(), -FRAC_PI_2);
        let root = archive.transform(0.0, RERUN_ROOT, WORLD, &Isometry3::from_parts(Translation3::identity(), upright));
        archive.write("/tf_static", 0.0, &root)?;
        Ok(archive)
    }

    /// Says what the source's container says of its video; before the first frame.
    ///
    /// # Errors
    /// Where the file cannot be written; so for all that follow.
    pub fn video(&mut self, facts: &VideoFacts) -> Result<()> {
        let values = facts.metadata();
        let values: Vec<(&str, &str)> = values.iter().map(|(name, value)| (name.as_str(), value.as_str())).collect();
        self.metadata(VIDEO_METADATA, &values)
    }

    /// Adds a frame as the source holds it.
    ///
    /// # Errors
    /// As [`ArchiveWriter::video`].
    pub fn frame(&mut self, frame: &EncodedFrame) -> Result<()> {
        let format = match frame.format {
            EncodedFormat::H264 => "h264",
            EncodedFormat::H265 => "h265",
            EncodedFormat::Vp9 => "vp9",
            EncodedFormat::Av1 => "av1",
            EncodedFormat::Jpeg => "jpeg",
            EncodedFormat::Png => "png",
            EncodedFormat::Webp => "webp",
            EncodedFormat::Raw(layout) => layout.encoding.name(),
        };
        let timestamp = Some(self.timestamp(frame.time_s));
        let (frame_id, format, data) = (CAMERA.to_string(), format.to_string(), frame.data.clone().into());
        match frame.format {
            video if video.is_video() => {
                self.write(topic::VIDEO, frame.order_s, &CompressedVideo { timestamp, frame_id, data, format })
            }
            EncodedFormat::Raw(layout) => {
                let (width, height, step) = (layout.width_px, layout.height_px, layout.step_bytes);
                let image = RawImage { timestamp, frame_id, width, height, encoding: format, step, data };
                self.write(topic::RAW, frame.time_s, &image)
            }
            _ => self.write(topic::IMAGE, frame.time_s, &CompressedImage { timestamp, frame_id, data, format }),
        }
    }

    /// Adds where the camera was.
    ///
    /// # Errors
    /// As [`ArchiveWriter::video`].
    pub fn pose(&mut self, time_s: f64, world_from_camera: &WorldFromCamera) -> Result<()> {
        let transform = self.transform(time_s, WORLD, CAMERA, world_from_camera);
        self.write(topic::TRANSFORMS, time_s, &transform)
    }

    /// Where a frame of reference lies in another.
    fn transform(&self, time_s: f64, parent: &str, child: &str, pose: &Isometry3<f64>) -> FrameTransforms {
        let t = pose.translation.vector / 1000.0;
        let q = pose.rotation.coords;
        let transform = FrameTransform {
            timestamp: Some(self.timestamp(time_s)),
            parent_frame_id: parent.into(),
            child_frame_id: child.into(),
            translation: Some(Vector3 { x: t.x, y: t.y, z: t.z }),
            rotation: Some(Quaternion { x: q.x, y: q.y, z: q.z, w: q.w }),
        };
        FrameTransforms { transforms: vec![transform] }
    }

    /// Adds a frame's profile, in the camera's frame.
    ///
    /// # Errors
    /// As [`ArchiveWriter::video`].
    pub fn profile(&mut self, time_s: f64, profile: &Profile, placed: &[SurfacePoint]) -> Result<()> {
        let points = profile.points.iter().zip(placed).map(|(p, s)| (p.point_in_camera, s.rgb, p.confidence));
        let cloud = cloud(self.timestamp(time_s), CAMERA, points);
        self.write(topic::PROFILE, time_s, &cloud)
    }

    /// Adds a frame's part of the surface, in the world; several frames become one message.
    ///
    /// # Errors
    /// As [`ArchiveWriter::video`].
    pub fn surface(&mut self, time_s: f64, points: &[SurfacePoint]) -> Result<()> {
        if self.chunk.points.is_empty() {
            self.chunk.first_s = time_s;
        }
        self.chunk.points.extend_from_slice(points);
        self.overview.add(points);
        self.chunk.last_s = time_s;
        self.latest_s = self.latest_s.max(time_s);
        let full = self.chunk.points.len() >= CHUNK_POINTS || time_s - self.chunk.first_s >= CHUNK_S;
        if full { self.write_chunk() } else { Ok(()) }
    }

    fn write_chunk(&mut self) -> Result<()> {
        if self.chunk.points.is_empty() {
            return Ok(());
        }
        let mut points = std::mem::take(&mut self.chunk.points);
        let time_s = self.chunk.last_s;
        let of = points.iter().map(|p| (p.point_in_world, p.rgb, p.confidence));
        let cloud = cloud(self.timestamp(time_s), WORLD, of);
        points.clear();
        self.chunk.points = points;
        self.write(topic::SURFACE, time_s, &cloud)
    }

    /// Adds what was measured in a frame.
    ///
    /// # Errors
    /// As [`ArchiveWriter::video`].
    pub fn measurement(
        &mut self,
        frame: u32,
        time_s: f64,
        stripe: &Stripe,
        shift: &Shift,
        points: &[SurfacePoint],
    ) -> Result<()> {
        let mean = |value: fn(&SurfacePoint) -> f64| {
            (!points.is_empty()).then(|| points.iter().map(value).sum::<f64>() / points.len() as f64)
        };
        let measurement = Measurement {
            frame,
            rows_found: stripe.found(),
            dx_px: shift.dx_px,
            dy_px: shift.dy_px,
            scale: shift.scale,
            residual_px: shift.residual_px,
            x_mm: mean(|p| p.point_in_world.x),
            z_mm: mean(|p| p.point_in_world.z),
        };
        let json = serde_json::to_vec(&measurement).map_err(|e| Error::internal("archive", e))?;
        let schema = || Some(Schema::new("stria.Measurement", "jsonschema", MEASUREMENT_SCHEMA.as_bytes()));
        self.put(topic::MEASUREMENT, time_s, schema, "json", &json)
    }

    /// Adds something a person should know, at the time of the latest message.
    ///
    /// # Errors
    /// As [`ArchiveWriter::video`].
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
    /// What `window` gives, and as [`ArchiveWriter::video`].
    pub fn depth_map(
        &mut self,
        geometry: &MapGeometry,
        mut window: impl FnMut(usize, usize, usize, usize) -> Result<MapWindow>,
    ) -> Result<()> {
        self.write_chunk()?;
        let (time_s, timestamp) = (self.latest_s, self.timestamp(self.latest_s));
        let mut overview = grid::Overview::new(geometry);
        let pieces = grid::pieces(geometry);
        for piece in &pieces {
            let content = window(piece.column_px, piece.row_px, piece.width_px, piece.height_px)?;
            overview.add(piece, &content);
            self.write(
                topic::DEPTH_MAP,
                time_s,
                &grid::message(timestamp, WORLD, &piece.geometry(geometry), &content),
            )?;
        }
        let (geometry, content) = overview.finish();
        if pieces.len() > 1 {
            self.write("/depth_map/overview", time_s, &grid::message(timestamp, WORLD, &geometry, &content))?;
        }
        self.write("/depth_map/image", time_s, &grid::image(timestamp, WORLD, &content))?;
        let (pieces, step) = (pieces.len().to_string(), geometry.mm_per_px.to_string());
        self.metadata("depth_map", &[("pieces", &pieces), ("image_mm_per_px", &step)])
    }

    /// Adds the defects that a `defects.json` lists, to be seen where they are, at the time of the latest message.
    ///
    /// # Errors
    /// Another text; as [`ArchiveWriter::video`].
    pub fn defects(&mut self, defects_json: &[u8]) -> Result<()> {
        let scene: scene::DefectScene = serde_json::from_slice(defects_json)
            .map_err(|e| Error::input("defects.json", e.to_string(), "a list of defects"))?;
        let update = scene::update(self.timestamp(self.latest_s), WORLD, &scene);
        self.write("/defects", self.latest_s, &update)
    }

    /// Adds a file.
    ///
    /// # Errors
    /// As [`ArchiveWriter::video`].
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
    /// As [`ArchiveWriter::video`].
    pub fn metadata(&mut self, name: &str, values: &[(&str, &str)]) -> Result<()> {
        let metadata = values.iter().map(|(k, v)| (k.to_string(), v.to_string())).collect();
        let record = mcap::records::Metadata { name: name.into(), metadata };
        self.writer.write_metadata(&record).map_err(|e| failed(&self.path, e))
    }

    /// Completes the file with its index and puts it in its place. Without this call, nothing is left at the path.
    ///
    /// # Errors
    /// As [`ArchiveWriter::video`].
    pub fn finish(mut self) -> Result<()> {
        self.write_chunk()?;
        if !self.overview.points().is_empty() {
            let of = self.overview.points().iter().map(|p| (p.point_in_world, p.rgb, p.confidence));
            let overview = cloud(self.timestamp(self.latest_s), WORLD, of);
            self.write(topic::SURFACE_OVERVIEW, self.latest_s, &overview)?;
        }
        self.writer.finish().map_err(|e| failed(&self.path, e))?;
        self.writer.into_inner().commit()
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
