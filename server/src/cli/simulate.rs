//! `stria simulate`: a known wall or pipe, a rig and a motion → a video, its rig and its truth.

use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use stria_core::rig::{LaserColour, LineDirection};
use stria_core::synthetic::{
    BoardScene, Motion, Output, Quality, SCENES, Scene, Simulation, write_board_photos, write_run,
};
use stria_core::{Error, Result};

use super::Failed;
use super::process::stop_on_signals;

/// Makes a run with known truth: a video, its rig, its truth
#[derive(Args, Clone, Debug)]
#[command(after_help = scene_list())]
pub(super) struct SimulateArgs {
    /// What to show; the list is below
    scene: String,
    /// The folder to write: new or empty
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Length of the run, s (at most 3600)
    #[arg(long, value_name = "S", default_value_t = 4.0)]
    seconds: f64,
    /// Frames a second (0.1 to 240)
    #[arg(long, value_name = "F", default_value_t = 30.0)]
    fps: f64,
    /// Width and height of the image, px (16 to 8192 a side; even for a video)
    #[arg(long, value_name = "WxH", default_value = "1280x720")]
    size: String,
    /// What makes one run differ from another; the same seed gives the same run
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// What makes one wall differ from another, where it is not the seed: two runs along the same wall
    #[arg(long, value_name = "N")]
    wall_seed: Option<u64>,
    /// The wall some time later: one dent is 2 mm deeper, and there is a new one
    #[arg(long)]
    later: bool,
    /// Colour of the laser instead of the scene's
    #[arg(long, value_enum)]
    laser: Option<ColourArg>,
    /// Direction of the line in the image instead of the scene's
    #[arg(long, value_enum)]
    line: Option<LineArg>,
    /// Motion of the robot instead of the scene's
    #[arg(long, value_enum)]
    motion: Option<MotionArg>,
    /// No noise, saturation, speckle or uneven light, texture only away from the line, lossless video
    #[arg(long)]
    exact: bool,
    /// PNG images in DIR/frames instead of a video
    #[arg(long)]
    frames: bool,
}

/// A laser's colour on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(super) enum ColourArg {
    Green,
    Red,
    Blue,
}

/// The line's direction on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(super) enum LineArg {
    /// Along the image's columns; the robot moves along its rows
    Vertical,
    /// Along the image's rows; the robot moves along its columns
    Horizontal,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum MotionArg {
    /// A rail: constant speed and nothing else
    Steady,
    /// Wheels: constant speed and small smooth deviations
    Wheels,
    /// Four legs: jitter along and about all axes
    Gait,
    /// Wheels that stand still for a part and go back some way
    Stop,
}

impl From<ColourArg> for LaserColour {
    fn from(colour: ColourArg) -> LaserColour {
        match colour {
            ColourArg::Green => LaserColour::Green,
            ColourArg::Red => LaserColour::Red,
            ColourArg::Blue => LaserColour::Blue,
        }
    }
}

impl From<LineArg> for LineDirection {
    fn from(line: LineArg) -> LineDirection {
        match line {
            LineArg::Vertical => LineDirection::Vertical,
            LineArg::Horizontal => LineDirection::Horizontal,
        }
    }
}

fn scene_list() -> String {
    let lines: Vec<String> = SCENES.iter().map(|(name, text)| format!("  {name:<12} {text}")).collect();
    format!(
        "Scenes:\n{}\n  {BOARD:<12} {BOARD_PHOTOS} photos of a 9x6 checkerboard (25 mm), for `stria calibrate`; of the options\n{:15}only --size, --seed, --laser and --line count\n\nDIR gets video.mp4, rig.toml and truth/ (stripes.npy, measurable.npy, trajectory.csv,\nsurface_z_mm.npy, surface.json).",
        lines.join("\n"),
        ""
    )
}

/// The scene that is no run but photos for a calibration.
const BOARD: &str = "board";

/// How many of them.
const BOARD_PHOTOS: u32 = 15;

/// Runs the command; the progress goes to the terminal's error stream.
///
/// # Errors
/// Unknown scenes, sizes, lengths and rates out of range, a folder that is not empty or cannot be written; Ctrl-C,
/// after which nothing is left behind.
pub(super) fn run(args: &SimulateArgs) -> std::result::Result<(), Failed> {
    let stop = Arc::new(AtomicBool::new(false));
    stop_on_signals(stop.clone())?;
    if args.scene == BOARD {
        return board_photos(args, &stop);
    }
    let simulation = Simulation::new(scene(args)?, parse_size(&args.size)?, args.fps, args.seconds, args.seed)?;
    let output = match (args.frames, args.exact) {
        (true, _) => Output::Images,
        (false, true) => Output::Video(Quality::Lossless),
        (false, false) => Output::Video(Quality::Camera),
    };
    let bar = progress_bar(u64::from(simulation.frames_total()));
    write_run(&simulation, &args.out, output, &mut |done, _| {
        bar.set_position(u64::from(done));
        if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    bar.finish_and_clear();
    let frames = if args.frames { "frames/" } else { "video.mp4" };
    println!(
        "{}: {} frames of {} in {frames}, with rig.toml and truth/",
        args.out.display(),
        simulation.frames_total(),
        args.size
    );
    Ok(())
}

/// Photos of a checkerboard under the laser's line, and the rig that took them, through a lens with distortion.
fn board_photos(args: &SimulateArgs, stop: &AtomicBool) -> std::result::Result<(), Failed> {
    let size = parse_size(&args.size)?;
    let rig = scene(&SimulateArgs { scene: "lens".into(), ..args.clone() })?.rig(size.0, size.1);
    let bar = progress_bar(u64::from(BOARD_PHOTOS));
    write_board_photos(&BoardScene::new(rig, args.seed)?, &args.out, BOARD_PHOTOS, |done| {
        bar.set_position(u64::from(done));
        if stop.load(Ordering::Relaxed) { Err(Error::Cancelled) } else { Ok(()) }
    })?;
    bar.finish_and_clear();
    println!("{}: {BOARD_PHOTOS} photos of a 9x6 board of 25 mm squares, with rig.toml", args.out.display());
    Ok(())
}

fn scene(args: &SimulateArgs) -> Result<Scene> {
    let mut scene = Scene::named(&args.scene)?;
    scene.wall_seed = args.wall_seed;
    scene.later = args.later;
    if let Some(colour) = args.laser {
        scene.colour = colour.into();
    }
    if let Some(line) = args.line {
        scene.line = line.into();
    }
    if let Some(motion) = args.motion {
        scene.motion = match motion {
            MotionArg::Steady => Motion::Steady,
            MotionArg::Wheels => Motion::Wheels,
            MotionArg::Gait => Motion::Gait,
            MotionArg::Stop => Motion::Stop,
        };
    }
    Ok(if args.exact { scene.exact_with_texture() } else { scene })
}

/// `1280x720` → (1280, 720). The range is the simulation's to check.
fn parse_size(text: &str) -> Result<(u32, u32)> {
    let sides = text.split_once(['x', 'X', '×']);
    let parsed = sides.and_then(|(w, h)| Some((w.trim().parse().ok()?, h.trim().parse().ok()?)));
    parsed.ok_or_else(|| Error::input("size", format!("'{text}'"), "width and height in px, as in 1280x720"))
}

fn progress_bar(frames: u64) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} frames, {per_sec}, {eta} left")
        .unwrap_or_else(|e| unreachable!("the template is fixed: {e}"));
    ProgressBar::new(frames).with_style(style)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_or_refused() {
        assert_eq!(parse_size("640x360").expect("plain"), (640, 360));
        for text in ["640", "x", "640x-3", "axb", "640x360x2", "99999999999x2"] {
            let message = parse_size(text).expect_err(text).to_string();
            assert!(message.contains(text) && message.contains("1280x720"), "{message}");
        }
    }
}
