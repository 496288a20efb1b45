//! A simulated run on disk: the video or its images, the rig, the truth.

use std::fs;
use std::io::Write;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use serde_json::{Value, json};

use super::{FrameTruth, Quality, Simulation, VideoWriter};
use crate::error::{Error, Result};
use crate::export::npy::{self, NpyWriter};
use crate::geometry::roll_pitch_yaw;
use crate::rig::LineDirection;
use crate::source::Image;

/// How the frames are kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Output {
    /// `video.mp4`.
    Video(Quality),
    /// `frames/000000.png` and so on.
    Images,
}

/// Frames that may wait for the encoder.
const QUEUE: usize = 3;

/// Nodes of the true surface's grid; a longer run gets a coarser grid.
const MAX_SURFACE_NODES: f64 = 16e6;

/// Renders a run into a folder: the frames, `rig.toml` and `truth/`.
///
/// The folder must be new or empty; it appears when it is whole, and not at all when something goes wrong.
/// `progress` hears (frames done, frames in all) after each frame and says whether to go on.
pub fn write_run(
    simulation: &Simulation,
    out_dir: &Path,
    output: Output,
    progress: &mut dyn FnMut(u32, u32) -> ControlFlow<()>,
) -> Result<()> {
    let parent = check_new(out_dir)?;
    let work = tempfile::Builder::new().prefix(".simulate-").tempdir_in(&parent).map_err(|e| Error::io(&parent, e))?;
    let truth_dir = make_dir(work.path().join("truth"))?;
    let rig_path = work.path().join("rig.toml");
    fs::write(&rig_path, simulation.rig().to_toml()).map_err(|e| Error::io(&rig_path, e))?;
    write_frames(simulation, work.path(), &truth_dir, output, progress)?;
    write_surface(simulation, &truth_dir)?;
    put_in_place(work, out_dir)
}

/// Gives a finished folder its name.
pub(super) fn put_in_place(work: tempfile::TempDir, out_dir: &Path) -> Result<()> {
    // An empty folder in the way: `rename` replaces it.
    let path = work.keep();
    fs::rename(&path, out_dir).map_err(|e| {
        let _ = fs::remove_dir_all(&path);
        Error::io(out_dir, e)
    })?;
    readable_for_others(out_dir)
}

/// Temporary folders are private; what a person asked for has the usual rights.
fn readable_for_others(folder: &Path) -> Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        fs::set_permissions(folder, fs::Permissions::from_mode(0o755)).map_err(|e| Error::io(folder, e))?;
    }
    Ok(())
}

pub(super) fn check_new(out_dir: &Path) -> Result<PathBuf> {
    let taken = match fs::read_dir(out_dir) {
        Ok(mut entries) => entries.next().is_some(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => false,
        Err(e) => return Err(Error::io(out_dir, e)),
    };
    if taken {
        return Err(Error::input(
            out_dir.display().to_string(),
            "a folder with files in it",
            "a new or an empty folder",
        ));
    }
    let parent = match out_dir.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent.to_path_buf(),
        _ => PathBuf::from("."),
    };
    make_dir(parent)
}

fn make_dir(path: PathBuf) -> Result<PathBuf> {
    fs::create_dir_all(&path).map_err(|e| Error::io(&path, e))?;
    Ok(path)
}

fn write_frames(
    simulation: &Simulation,
    folder: &Path,
    truth_dir: &Path,
    output: Output,
    progress: &mut dyn FnMut(u32, u32) -> ControlFlow<()>,
) -> Result<()> {
    let total = simulation.frames_total();
    let (to_encoder, images) = sync_channel(QUEUE);
    std::thread::scope(|scope| {
        let encoder = scope.spawn(move || encode(simulation, folder, output, images));
        let rendered = render_frames(simulation, truth_dir, &to_encoder, total, progress);
        drop(to_encoder);
        let encoded = encoder.join().unwrap_or_else(|_| Err(Error::internal("video encoding", "the encoder panicked")));
        // The encoder's error explains why the queue was closed.
        encoded.and(rendered)
    })
}

fn render_frames(
    simulation: &Simulation,
    truth_dir: &Path,
    to_encoder: &SyncSender<Image>,
    total: u32,
    progress: &mut dyn FnMut(u32, u32) -> ControlFlow<()>,
) -> Result<()> {
    let mut truth = TruthWriter::create(truth_dir, simulation)?;
    for frame in 0..total {
        let (image, frame_truth) = simulation.render(frame);
        truth.push(frame, &frame_truth)?;
        if to_encoder.send(image).is_err() || progress(frame + 1, total).is_break() {
            return Err(Error::Cancelled);
        }
    }
    truth.finish()
}

fn encode(simulation: &Simulation, folder: &Path, output: Output, images: Receiver<Image>) -> Result<()> {
    let camera = &simulation.rig().camera;
    match output {
        Output::Video(quality) => {
            let size_px = (camera.width_px, camera.height_px);
            let mut video = VideoWriter::create(&folder.join("video.mp4"), size_px, simulation.fps(), quality)?;
            images.iter().try_for_each(|image| video.push(&image))?;
            video.finish()
        }
        Output::Images => {
            let frames = make_dir(folder.join("frames"))?;
            images.iter().enumerate().try_for_each(|(i, image)| write_png(&frames.join(format!("{i:06}.png")), &image))
        }
    }
}

/// Writes one image as PNG.
///
/// # Errors
/// What the disk says.
pub fn write_png(path: &Path, image: &Image) -> Result<()> {
    let file = fs::File::create(path).map_err(|e| Error::io(path, e))?;
    let mut encoder = png::Encoder::new(std::io::BufWriter::new(file), image.width_px(), image.height_px());
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let rgb: Vec<u8> = image.bgr().chunks_exact(3).flat_map(|p| [p[2], p[1], p[0]]).collect();
    let failed = |e: png::EncodingError| match e {
        png::EncodingError::IoError(e) => Error::io(path, e),
        e => Error::internal("png", e),
    };
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(&rgb).map_err(failed)?;
    writer.finish().map_err(failed)
}

/// `stripes.npy`, `measurable.npy` and `trajectory.csv`.
struct TruthWriter {
    folder: PathBuf,
    stripes: NpyWriter,
    measurable: Vec<bool>,
    positions: usize,
    trajectory: std::io::BufWriter<fs::File>,
}

impl TruthWriter {
    fn create(folder: &Path, simulation: &Simulation) -> Result<TruthWriter> {
        let camera = &simulation.rig().camera;
        let positions = match simulation.rig().laser.line {
            LineDirection::Vertical => camera.height_px as usize,
            LineDirection::Horizontal => camera.width_px as usize,
        };
        let path = folder.join("trajectory.csv");
        let mut writer = TruthWriter {
            folder: folder.to_path_buf(),
            stripes: NpyWriter::create(&folder.join("stripes.npy"), positions)?,
            measurable: Vec::new(),
            positions,
            trajectory: std::io::BufWriter::new(fs::File::create(&path).map_err(|e| Error::io(&path, e))?),
        };
        writer.line("frame,time_s,dx_px,dy_px,scale,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg")?;
        Ok(writer)
    }

    fn push(&mut self, frame: u32, truth: &FrameTruth) -> Result<()> {
        self.stripes.push_row(&truth.stripe_across_px)?;
        self.measurable.extend(&truth.measurable);
        let t = &truth.world_from_camera.translation.vector;
        let (roll, pitch, yaw) = roll_pitch_yaw(&truth.world_from_camera);
        self.line(&format!(
            "{frame},{:.6},{:.4},{:.4},{:.6},{:.4},{:.4},{:.4},{:.5},{:.5},{:.5}",
            truth.time_s,
            truth.dx_px,
            truth.dy_px,
            truth.scale,
            t.x,
            t.y,
            t.z,
            // Adding 0 turns -0 into 0.
            roll.to_degrees() + 0.0,
            pitch.to_degrees() + 0.0,
            yaw.to_degrees() + 0.0
        ))
    }

    fn finish(mut self) -> Result<()> {
        npy::write_bool(&self.folder.join("measurable.npy"), self.positions, &self.measurable)?;
        self.stripes.finish()?;
        self.trajectory.flush().map_err(|e| Error::io(self.folder.join("trajectory.csv"), e))
    }

    fn line(&mut self, text: &str) -> Result<()> {
        writeln!(self.trajectory, "{text}").map_err(|e| Error::io(self.folder.join("trajectory.csv"), e))
    }
}

/// `surface_z_mm.npy` and `surface.json`: all of the wall that the run shows.
fn write_surface(simulation: &Simulation, folder: &Path) -> Result<()> {
    let wall = &simulation.scene().wall;
    let ((x0, x1), (y0, y1)) = simulation.seen_mm();
    let mut step = if wall.has_edges() { 1.0 } else { 2.0 };
    while (x1 - x0) * (y1 - y0) / (step * step) > MAX_SURFACE_NODES {
        step *= 2.0;
    }
    let (x0, y0) = ((x0 / step).floor() * step, (y0 / step).floor() * step);
    let count = |low: f64, high: f64| ((high - low) / step).ceil() as usize + 1;
    let (columns, rows) = (count(x0, x1), count(y0, y1));
    let window = wall.window(x0, x1 + step);
    let mut surface = NpyWriter::create(&folder.join("surface_z_mm.npy"), columns)?;
    for row in 0..rows {
        let y = y0 + row as f64 * step;
        let z =
            |column: usize| if wall.exists(y) { window.z_mm(x0 + column as f64 * step, y) as f32 } else { f32::NAN };
        surface.push_row(&(0..columns).map(z).collect::<Vec<f32>>())?;
    }
    surface.finish()?;
    let path = folder.join("surface.json");
    let text = serde_json::to_string_pretty(&surface_json(simulation, (x0, x1), y0, step))
        .map_err(|e| Error::internal("surface.json", e))?;
    fs::write(&path, text).map_err(|e| Error::io(&path, e))
}

fn surface_json(simulation: &Simulation, (x0, x1): (f64, f64), y0: f64, step: f64) -> Value {
    let wall = &simulation.scene().wall;
    let with_kind = |kind: &str, mut feature: Value| {
        feature["kind"] = json!(kind);
        feature
    };
    let bumps = wall.bumps_between(x0, x1).into_iter().map(|b| with_kind("bump", json!(b)));
    let steps = wall.steps.iter().map(|s| with_kind("step", json!(s)));
    let blocks = wall.blocks.iter().filter(|b| b.x + b.half_x >= x0 && b.x - b.half_x <= x1);
    let blocks = blocks.map(|b| with_kind("block", json!(b)));
    let rig = simulation.rig();
    let n = rig.laser.plane.normal;
    // The plane in the paper's form X − Z/tan β = d, along the axis that the laser lies on.
    let across = match rig.laser.line {
        LineDirection::Vertical => n.x,
        LineDirection::Horizontal => n.y,
    };
    let baseline_mm = rig.laser.plane.offset_mm / across;
    json!({
        "x0_mm": x0,
        "y0_mm": y0,
        "step_mm": step,
        "features": bumps.chain(steps).chain(blocks).collect::<Vec<Value>>(),
        "C1": rig.camera.fx_px * baseline_mm,
        "baseline_mm": baseline_mm,
        "angle_deg": across.atan2(-n.z).to_degrees(),
        "z_nominal_mm": wall.distance_mm,
        "ovality": wall.ovality,
        "scene": simulation.scene().name,
        "seed": wall.seed,
    })
}
