//! `stria process`: one run in, its products out. A person uses it, and every worker does.

mod archived;

use std::io::{Read, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use clap::Args;
use stria_core::defects::Chainage;
use stria_core::export::manifest::Manifest;
use stria_core::pipeline::{self, Event, ProductGroup, Request};
use stria_core::recipe::{self, OptionInfo, Range, Recipe};
use stria_core::rig::Rig;

use self::archived::Archived;
use super::progress::{JobBar, duration, size};
use super::{Failed, Outcome, Success};
use crate::confinement;
use crate::wire::child::{End, Failure};

/// The exit code of a cancelled process.
const CANCELLED: i32 = 130;

/// Memory that is asked for at once from this size on goes back to the system as soon as it is free. Else the C library
/// keeps what is as large as a frame, once one was freed: a quarter more than is used at the end of a long run.
#[cfg(target_env = "gnu")]
const GIVEN_BACK_BYTES: i32 = 512 << 10;

/// Process a run: a video, a folder of images or an MCAP file, with its rig, into a folder of products
#[derive(Args)]
#[command(after_long_help = options_help())]
#[command(
    after_help = "Examples: stria process run.mp4 --rig rig.toml --out products\n          stria process products/archive.mcap --out again\n`stria process --help` lists the options for --set."
)]
pub(super) struct Process {
    /// A video file (whatever FFmpeg reads), a folder of images, sorted by name, or an MCAP file
    ///
    /// Of MCAP it reads archives of stria, Foxglove's CompressedVideo, CompressedImage and RawImage, and bags of ROS 2 with
    /// sensor_msgs Image or CompressedImage; their nav_msgs/Odometry helps to find the motion where /tf_static says how the
    /// camera sits on the robot. An archive of stria brings its rig, recipe and poses along: it needs no other option.
    source: PathBuf,
    /// The rig that it was recorded with: a TOML or JSON file; an archive of stria brings its own
    #[arg(long, value_name = "FILE", env = "STRIA_RIG")]
    rig: Option<PathBuf>,
    /// How to process: a built-in recipe's name, or a TOML file [default: metric, or an archive's own]
    #[arg(long, value_name = "NAME|FILE", env = "STRIA_RECIPE")]
    recipe: Option<String>,
    /// Change one value of the recipe; may be given several times
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// The folder for the products; it is made, or must be empty
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// A CSV of the camera's poses, e.g. from the robot's odometry; used instead of the image's motion
    ///
    /// Its first line names the columns, in any order: `frame` (from 0) or `time_s` (since the first frame), and `x_mm`,
    /// `y_mm`, `z_mm` (or `x_m` …); `roll_deg`, `pitch_deg`, `yaw_deg` if known. Other columns are ignored, empty fields are
    /// not known, times between two rows are interpolated. A trajectory.csv of stria is such a file. With --set
    /// pose.track=prior the poses only say where to look for the image's motion, and carry the pose on where it is lost.
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// Read this topic of an MCAP file (images, odometry); may be given several times. `stria inspect` lists them
    #[arg(long = "topic", value_name = "TOPIC")]
    topics: Vec<String>,
    /// Make only these product groups, separated by commas
    #[arg(long, value_name = "A,B", value_delimiter = ',', value_parser = product_group)]
    only: Vec<ProductGroup>,
    /// Print one JSON object a line (events, then the result) for programs
    #[arg(long)]
    json: bool,
    /// Frames a second of a folder of images
    #[arg(long, value_name = "F")]
    fps: Option<f64>,
    /// When the run was recorded (RFC 3339); when nothing is said, the time of the file
    #[arg(long, value_name = "TIME")]
    recorded_at: Option<jiff::Timestamp>,
    /// The name of the asset, for the report
    #[arg(long, value_name = "NAME", default_value = "", hide_default_value = true)]
    asset: String,
    /// Chainage of the run's first frame, mm
    #[arg(long, value_name = "MM", default_value_t = 0.0, allow_negative_numbers = true)]
    chainage_mm: f64,
    /// Which way the robot went along the asset: backward, the chainage falls
    #[arg(long, value_parser = ["forward", "backward"], default_value = "forward")]
    direction: String,
    /// The name of the source in messages and the manifest
    #[arg(long, hide = true)]
    name: Option<String>,
    /// Write numbered recording segments while the work goes on
    #[arg(long, hide = true)]
    live_segments: bool,
    /// End at once when stdin ends: the parent died, or wants an end
    #[arg(long, hide = true)]
    exit_with_stdin: bool,
    /// Give up every file but the source and this folder, and the network, before anything is read
    #[arg(long, value_name = "DIR", hide = true)]
    keep_to: Option<PathBuf>,
}

impl Process {
    pub(super) fn run(self) -> Outcome {
        // First of all: threads that are there already would not be fenced.
        if let Some(folder) = &self.keep_to {
            confinement::keep_to(&[&self.source], &[folder]).map_err(Failed::Other)?;
        }
        give_memory_back();
        let stop = Arc::new(AtomicBool::new(false));
        stop_on_signals(stop.clone())?;
        if self.exit_with_stdin {
            exit_with_stdin()?;
        }
        let begun = Instant::now();
        let result = self.process(&stop);
        match result {
            Ok(manifest) => {
                let warned = !manifest.warnings.is_empty();
                if self.json {
                    say_json(&End::Result { manifest: Box::new(manifest) })?;
                } else {
                    summary(&manifest, &self.out, begun.elapsed().as_secs_f64());
                }
                Ok(if warned { Success::DoneWithWarnings } else { Success::Done })
            }
            Err(error) => {
                if self.json {
                    say_json(&End::Error(Failure::from(&error)))?;
                }
                Err(error.into())
            }
        }
    }

    fn process(&self, stop: &AtomicBool) -> stria_core::Result<Manifest> {
        let archived = Archived::of(&self.source)?;
        let request = self.request(&archived)?;
        let bar = (!self.json).then(JobBar::new);
        let result = pipeline::process(&request, &mut |event| {
            self.show(bar.as_ref(), event);
            if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        if let Some(bar) = &bar {
            bar.clear();
        }
        result
    }

    fn request(&self, archived: &Archived) -> stria_core::Result<Request> {
        let rig = match (&self.rig, &archived.rig) {
            (Some(path), _) => Rig::load(path)?,
            (None, Some(rig)) => rig.clone(),
            (None, None) => {
                let source = self.source.display().to_string();
                return Err(stria_core::Error::input(
                    source,
                    "no rig given with --rig",
                    "the rig that it was recorded with",
                ));
            }
        };
        let mut recipe = match (&self.recipe, &archived.recipe) {
            (Some(name), _) => Recipe::load(name)?,
            (None, Some(recipe)) => recipe.clone(),
            (None, None) => Recipe::load(recipe::BUILT_IN[0])?,
        };
        for change in &self.set {
            recipe.set_pair(change)?;
        }
        let name = self.source.file_name().map(|n| n.to_string_lossy().into_owned());
        let name = self.name.clone().or(name).unwrap_or_else(|| self.source.display().to_string());
        let captured_at = stria_core::source::captured_at_ns(&self.source, &name, &self.topics)?
            .and_then(|ns| jiff::Timestamp::from_nanosecond(i128::from(ns)).ok());
        let only = if self.only.is_empty() { ProductGroup::ALL.to_vec() } else { self.only.clone() };
        Ok(Request {
            source: self.source.clone(),
            topics: self.topics.clone(),
            source_name: name,
            fps: self.fps,
            recorded_at: self.recorded_at.or(captured_at).unwrap_or_else(|| time_of(&self.source)),
            asset: self.asset.clone(),
            chainage: Chainage { start_mm: self.chainage_mm, falls: self.direction == "backward" },
            rig,
            recipe,
            poses: self.poses.clone().or_else(|| archived.poses()),
            out_dir: self.out.clone(),
            products: only,
            live_segments: self.live_segments,
        })
    }

    fn show(&self, bar: Option<&JobBar>, event: Event) {
        let Some(bar) = bar else {
            // Whoever read this has gone: nobody wants the result any more.
            if say_json(&event).is_err() {
                std::process::exit(CANCELLED);
            }
            return;
        };
        match event {
            Event::Progress { stage, fraction, frames, frames_total, frames_per_s, time_left_s } => {
                bar.show(&stage, fraction, frames, frames_total, frames_per_s, time_left_s);
            }
            Event::Warning { message } => bar.say(&format!("warning: {message}")),
            Event::Segment { .. } | Event::Files { .. } => {}
        }
    }
}

/// When a file was last written; now, where nobody knows.
fn time_of(path: &Path) -> jiff::Timestamp {
    let written = std::fs::metadata(path).and_then(|facts| facts.modified()).ok();
    written.and_then(|time| jiff::Timestamp::try_from(time).ok()).unwrap_or_else(jiff::Timestamp::now)
}

fn say_json(line: &impl serde::Serialize) -> Result<(), Failed> {
    let text = serde_json::to_string(line).map_err(|e| Failed::Other(format!("a line is not JSON: {e}")))?;
    let mut out = std::io::stdout().lock();
    writeln!(out, "{text}").and_then(|()| out.flush()).map_err(|e| Failed::Other(format!("stdout: {e}")))
}

/// Other C libraries give it back by themselves.
fn give_memory_back() {
    #[cfg(target_env = "gnu")]
    // SAFETY: it sets a number of the C library's own, before any other thread is there.
    #[allow(unsafe_code)]
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, GIVEN_BACK_BYTES);
    }
}

/// The first Ctrl-C (or SIGTERM) stops between two frames, the second one at once.
pub(super) fn stop_on_signals(stop: Arc<AtomicBool>) -> Result<(), Failed> {
    let failed = |e: std::io::Error| Failed::Other(format!("signals cannot be heard: {e}"));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().map_err(failed)?;
    let mut signals = {
        let _inside = runtime.enter();
        super::engine::StopSignals::listen().map_err(failed)?
    };
    let listen = move || {
        runtime.block_on(async {
            signals.next().await;
            stop.store(true, Ordering::Relaxed);
            signals.next().await;
            std::process::exit(CANCELLED);
        });
    };
    std::thread::Builder::new().name("signals".into()).spawn(listen).map_err(failed)?;
    Ok(())
}

/// The parent holds the other end of stdin. When it closes, this process must not go on alone.
fn exit_with_stdin() -> Result<(), Failed> {
    let wait = || {
        let mut byte = [0u8; 64];
        let mut stdin = std::io::stdin().lock();
        while !matches!(stdin.read(&mut byte), Ok(0) | Err(_)) {}
        std::process::exit(CANCELLED);
    };
    let thread = std::thread::Builder::new().name("stdin".into()).spawn(wait);
    thread.map(|_| ()).map_err(|e| Failed::Other(format!("stdin cannot be watched: {e}")))
}

fn summary(manifest: &Manifest, out: &Path, seconds: f64) {
    let q = &manifest.quality;
    let bytes: u64 = manifest.products.iter().map(|p| p.bytes).sum();
    println!(
        "Done in {}: {} frames, {:.1} frames/s",
        duration(seconds),
        q.frames,
        q.frames as f64 / seconds.max(0.001)
    );
    println!("  products  {} files, {} in {}", manifest.products.len(), size(bytes), out.display());
    println!(
        "  stripe    {} of {} frames, {:.1} % of their rows",
        q.frames_with_stripe,
        q.frames,
        100.0 * q.rows_found
    );
    println!(
        "  motion    {} of {} frames, {:.1} mm in {:.1} s",
        q.frames_tracked,
        q.frames.saturating_sub(1),
        q.travel_mm,
        q.duration_s
    );
    if let Some(d) = &q.drift {
        println!("  drift     ±{:.1} mm along, ±{:.1} mm across, ±{:.1} mm deep at the end", d.x_mm, d.y_mm, d.z_mm);
    }
    println!("  surface   {} points, {:.1} % of the map", q.points, 100.0 * q.coverage);
    if let Some(r) = &manifest.resolution {
        println!(
            "  one px    {:.2} mm deep at {:.0} mm, {:.2} mm along the line",
            r.r_depth_mm, r.distance_mm, r.r_vertical_mm
        );
    }
    for warning in &manifest.warnings {
        println!("  warning   {warning}");
    }
}

fn product_group(text: &str) -> Result<ProductGroup, String> {
    serde_json::from_value(text.trim().into()).map_err(|_| format!("expected {}", group_names().join(", ")))
}

fn group_names() -> Vec<String> {
    let name = |group| serde_json::to_value(group).ok()?.as_str().map(String::from);
    ProductGroup::ALL.iter().filter_map(name).collect()
}

/// Every option of the recipes, for `--help`.
fn options_help() -> String {
    let mut text = format!(
        "Built-in recipes: {} (the first is the default)\nProduct groups for --only: {}\n\n\
         Options for --set (key = default, range):\n",
        recipe::BUILT_IN.join(", "),
        group_names().join(", ")
    );
    for OptionInfo { key, unit, default, range, doc } in recipe::options() {
        let range = match range {
            Range::Number { min, max, .. } => format!("{min} to {max} {unit}"),
            Range::Flag => "true or false".into(),
            Range::Choice { of } => of.join(", "),
            Range::Text { max_chars } => format!("at most {max_chars} characters"),
        };
        text += &format!("  {key} = {default}, {}\n          {doc}\n", range.trim_end());
    }
    text + "\nExit codes: 0 done, 1 failed, 2 wrong usage or input, 3 done with warnings, 130 cancelled."
}
