//! `stria calibrate`: photos of a checkerboard, or of flat walls at known distances → a rig.

mod report;

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use stria_core::Error;
use stria_core::calibration::{
    Attempt, Board, FlatOptions, FlatResult, FlatView, FlatWall, Options, calibrate, calibrate_flat, read_photos,
};
use stria_core::export::new_file;
use stria_core::rig::{LineDirection, Rig};

use super::process::stop_on_signals;
use super::simulate::{ColourArg, LineArg};
use super::{Outcome, Success};

const LONG_HELP: &str = "\
With a checkerboard (measures camera, lens and laser plane):
  1. Print a checkerboard and glue it to something stiff and flat. Measure its squares with a ruler.
  2. Fix camera and laser to each other as they will be used; switch off zoom, autofocus and image stabilisation.
  3. Take 12 to 20 photos of the whole board, sharp and at rest, with the laser on and its line across the board:
     - at different distances, from the nearest to the farthest wall that will be measured;
     - tilted by 15° to 40° to the left, to the right, up and down, some turned by 90°;
     - also near the corners of the image (photos without the line, or with the laser off, count for the camera).
     A second photo of the same pose with the laser off is subtracted; it helps in bright light.
  4. stria calibrate photos/ --board 9x6 --square-mm 25 --out rig.toml
--board counts inner corners, as OpenCV does: where four squares meet. A board of 10x7 squares is 9x6.

Without a board (measures the laser only; the camera's field of view must be known, the lens is taken as free of
distortion): photos of a flat wall, seen squarely, with the laser on, at three or better five distances from the lens:
     stria calibrate --flat wall_300.png=300 --flat wall_500.png=500 --flat wall_800.mp4=800 --fov-deg 65.4 --out rig.toml
The field of view cannot come from such photos: a longer lens and a longer baseline look the same in them.

Beside the rig, a picture NAME.coverage.png shows where the boards were and how well the camera explains them. Photos
that do not suffice are refused, with what to photograph next; no rig is written then.";

/// Measure a rig: photos of a checkerboard with the laser's line, or flat walls at known distances
#[derive(Args)]
#[command(
    after_help = "Example: stria calibrate photos/ --board 9x6 --square-mm 25 --out rig.toml\n`stria calibrate --help` says which photos to take, and how to do without a board."
)]
#[command(after_long_help = LONG_HELP)]
pub(super) struct Calibrate {
    /// Photos of the board: image files, folders of images, a short video; with and without the laser's line
    #[arg(required_unless_present = "flat", conflicts_with = "flat")]
    images: Vec<PathBuf>,
    /// Inner corners of the board a row x a column, one less than squares: a board of 10x7 squares is 9x6
    #[arg(long, value_name = "CxR", required_unless_present = "flat")]
    board: Option<String>,
    /// Side of a square of the board, mm
    #[arg(long, value_name = "S", required_unless_present = "flat")]
    square_mm: Option<f64>,
    /// Instead of a board: a photo, video or folder of a flat wall seen squarely, and its distance in mm; three or more
    #[arg(long, value_name = "SOURCE=DISTANCE_MM")]
    flat: Vec<String>,
    /// With --flat: the camera's horizontal field of view, degrees
    #[arg(long, value_name = "A", requires = "flat")]
    fov_deg: Option<f64>,
    /// With --flat, instead of --fov-deg: the camera's focal length, px
    #[arg(long, value_name = "F", requires = "flat", conflicts_with = "fov_deg")]
    fx_px: Option<f64>,
    /// The rig file to write (TOML)
    #[arg(long, value_name = "RIG")]
    out: PathBuf,
    /// Replace the rig file if there is one
    #[arg(long)]
    overwrite: bool,
    /// The rig's name; when nothing is said, the file's
    #[arg(long)]
    name: Option<String>,
    /// Colour of the laser
    #[arg(long, value_enum, default_value = "green")]
    laser: ColourArg,
    /// How the laser's line lies in the image; when nothing is said, as the photos show (--flat: vertical)
    #[arg(long, value_enum)]
    line: Option<LineArg>,
    /// Print one JSON object a line (photos or walls, warnings, result) for programs
    #[arg(long)]
    json: bool,
}

impl Calibrate {
    pub(super) fn run(self) -> Outcome {
        let stop = Arc::new(AtomicBool::new(false));
        stop_on_signals(stop.clone())?;
        let result = if self.flat.is_empty() { self.by_board(&stop) } else { self.by_walls(&stop) };
        if self.json
            && let Err(error) = &result
        {
            report::error_json(error);
        }
        Ok(result?)
    }

    fn by_board(&self, stop: &AtomicBool) -> stria_core::Result<Success> {
        self.check_out()?;
        let (board, square_mm) = (self.board.as_deref().unwrap_or_default(), self.square_mm.unwrap_or(f64::NAN));
        let options = Options {
            board: Board::new(board, square_mm)?,
            colour: self.laser.into(),
            line: self.line.map(LineDirection::from),
            name: self.name(),
        };
        let bar = progress_bar("photos");
        let (photos, mut warnings) = read_photos(&self.images, |_| go_on(stop))?;
        let mut attempt = calibrate(&photos, &options, &mut |done, total| {
            bar.set_length(total as u64);
            bar.set_position(done as u64);
            go_on(stop)
        })?;
        bar.finish_and_clear();
        warnings.append(&mut attempt.warnings);
        attempt.warnings = warnings;
        if self.json {
            report::photos_json(&attempt)
        } else {
            report::photos(&attempt)
        }
        let picture = self.write_picture(&attempt)?;
        match &attempt.result {
            Ok(found) => {
                self.write_rig(&found.rig)?;
                if self.json {
                    report::board_json(found, &attempt.warnings, &self.out, &picture);
                } else {
                    report::board(found, &attempt.warnings, &self.out, &picture);
                }
                Ok(done(&attempt.warnings))
            }
            Err(_) => {
                if !self.json {
                    eprintln!("What the photos cover is shown in {}", picture.display());
                }
                attempt.result.map(|_| Success::Done)
            }
        }
    }

    fn by_walls(&self, stop: &AtomicBool) -> stria_core::Result<Success> {
        self.check_out()?;
        let walls = self.flat.iter().map(|text| parse_wall(text)).collect::<stria_core::Result<Vec<FlatWall>>>()?;
        let options = FlatOptions {
            view: self.view()?,
            colour: self.laser.into(),
            line: self.line.map_or(LineDirection::Vertical, LineDirection::from),
            name: self.name(),
        };
        let bar = progress_bar("walls");
        let found: FlatResult = calibrate_flat(&walls, &options, &mut |done, total| {
            bar.set_length(total as u64);
            bar.set_position(done as u64);
            go_on(stop)
        })?;
        bar.finish_and_clear();
        self.write_rig(&found.rig)?;
        if self.json {
            report::walls_json(&found, &self.out)
        } else {
            report::walls(&found, &self.out)
        }
        Ok(done(&found.warnings))
    }

    /// Known before any work: where the rig goes.
    fn check_out(&self) -> stria_core::Result<()> {
        let subject = format!("--out {}", self.out.display());
        if self.out.is_dir() {
            return Err(Error::input(subject, "a folder", "a file to write, as in rig.toml"));
        }
        if self.out.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
            return Err(Error::input(subject, "named as JSON", "a TOML file, as in rig.toml"));
        }
        if self.out.exists() && !self.overwrite {
            return Err(Error::input(subject, "already there", "a new file, or --overwrite to replace this one"));
        }
        let folder = self.out.parent().filter(|f| *f != Path::new("")).unwrap_or(Path::new("."));
        if !folder.is_dir() {
            return Err(Error::input(subject, "in a folder that does not exist", "a file in an existing folder"));
        }
        Ok(())
    }

    fn name(&self) -> String {
        let stem = || self.out.file_stem().map_or_else(|| "rig".into(), |s| s.to_string_lossy().into_owned());
        self.name.clone().unwrap_or_else(stem)
    }

    fn view(&self) -> stria_core::Result<FlatView> {
        match (self.fov_deg, self.fx_px) {
            (Some(fov), _) if fov > 1.0 && fov < 170.0 => Ok(FlatView::FovRad(fov.to_radians())),
            (Some(fov), _) => Err(Error::input("--fov-deg", format!("{fov}°"), "1° to 170°")),
            (None, Some(fx)) if fx.is_finite() && fx > 0.0 => Ok(FlatView::FocalPx(fx)),
            (None, Some(fx)) => Err(Error::input("--fx-px", format!("{fx} px"), "a focal length above 0 px")),
            (None, None) => Err(Error::input(
                "--flat",
                "no field of view",
                "--fov-deg (or --fx-px): flat walls cannot tell it, the camera's data sheet or a checkerboard can",
            )),
        }
    }

    fn write_rig(&self, rig: &Rig) -> stria_core::Result<()> {
        new_file::write(&self.out, rig.to_toml().as_bytes())
    }

    fn write_picture(&self, attempt: &Attempt) -> stria_core::Result<PathBuf> {
        let path = self.out.with_extension("coverage.png");
        attempt.write_picture(&path).map(|()| path)
    }
}

fn done(warnings: &[String]) -> Success {
    if warnings.is_empty() { Success::Done } else { Success::DoneWithWarnings }
}

fn go_on(stop: &AtomicBool) -> stria_core::Result<()> {
    if stop.load(Ordering::Relaxed) { Err(Error::Cancelled) } else { Ok(()) }
}

/// `wall.png=300` → source and distance; a `=` in the file's name does no harm.
fn parse_wall(text: &str) -> stria_core::Result<FlatWall> {
    let parsed = text.rsplit_once('=').and_then(|(source, mm)| Some((source, mm.trim().parse().ok()?)));
    match parsed {
        Some((source, distance_mm)) if !source.is_empty() => Ok(FlatWall { source: source.into(), distance_mm }),
        _ => Err(Error::input(
            format!("--flat {text}"),
            "no source and distance",
            "SOURCE=DISTANCE_MM, as in wall_300.png=300",
        )),
    }
}

fn progress_bar(what: &str) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template(&format!("{{bar:30}} {{pos}}/{{len}} {what}"))
        .unwrap_or_else(|e| unreachable!("the template is fixed: {e}"));
    ProgressBar::new(0).with_style(style)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn walls_are_read_or_refused() {
        let wall = parse_wall("a=b/wall.png=300.5").expect("a wall");
        assert_eq!((wall.source, wall.distance_mm), (PathBuf::from("a=b/wall.png"), 300.5));
        for text in ["wall.png", "=300", "wall.png=", "wall.png=near"] {
            let message = parse_wall(text).expect_err(text).to_string();
            assert!(message.contains(text) && message.contains("SOURCE=DISTANCE_MM"), "{message}");
        }
    }
}
