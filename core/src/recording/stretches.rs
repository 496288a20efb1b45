//! A long run's recordings: one of the whole, which becomes sparse to keep within its budget, and dense ones of stretches
//! of the wall, each within a budget of its own, so that no file is more than a browser takes.

use std::path::{Path, PathBuf};

use nalgebra::Point3;

use super::{FrameSteps, RecordedRun, Recorder, Segment};
use crate::error::Result;
use crate::export::manifest::Stretch;
use crate::recipe::RecordingOptions;
use crate::rig::Rig;

/// Writes all recordings of a job.
pub struct Recordings {
    whole: Recorder,
    options: RecordingOptions,
    rig: Rig,
    run_name: String,
    recorded_at: jiff::Timestamp,
    folder: PathBuf,
    open: Option<(Recorder, Stretch)>,
    done: Vec<Stretch>,
}

impl Recordings {
    /// Starts the recording of the whole at `rrd`, as [`Recorder::create`]; those of stretches follow beside it, from
    /// where the whole's becomes sparse.
    ///
    /// # Errors
    /// Where the files cannot be written; so for all that follow.
    pub fn create(
        options: &RecordingOptions,
        rig: &Rig,
        run: &RecordedRun<'_>,
        rrd: &Path,
        segments_dir: Option<&Path>,
    ) -> Result<Recordings> {
        Ok(Recordings {
            whole: Recorder::create(options, rig, run, rrd, segments_dir)?,
            options: options.clone(),
            rig: rig.clone(),
            run_name: run.name.to_string(),
            recorded_at: run.recorded_at,
            folder: rrd.parent().unwrap_or(Path::new("")).to_path_buf(),
            open: None,
            done: Vec::new(),
        })
    }

    /// As [`Recorder::wants_image`], for any of them.
    pub fn wants_image(&self, time_s: f64) -> bool {
        let open = self.open.as_ref().is_some_and(|(recorder, _)| recorder.wants_image(time_s));
        open || self.whole.wants_image(time_s)
    }

    /// Records a frame; gives the live segments that it completed.
    ///
    /// # Errors
    /// As [`Recordings::create`].
    pub fn log_frame(&mut self, steps: &FrameSteps<'_>) -> Result<Vec<Segment>> {
        let segments = self.whole.log_frame(steps)?;
        self.log_in_stretch(steps)?;
        Ok(segments)
    }

    fn log_in_stretch(&mut self, steps: &FrameSteps<'_>) -> Result<()> {
        let length_mm = self.options.stretch_m * 1000.0;
        if length_mm <= 0.0 || (self.open.is_none() && !self.whole.is_sparse()) {
            return Ok(());
        }
        let x_mm = steps.world_from_camera.map(|pose| pose.translation.x);
        if let (Some((_, stretch)), Some(x_mm)) = (&self.open, x_mm)
            && x_mm.max(stretch.to_x_mm) - x_mm.min(stretch.from_x_mm) > length_mm
        {
            self.close()?;
        }
        let (recorder, stretch) = match self.open.take() {
            Some(open) => self.open.insert(open),
            None => {
                let open = self.begin(steps, x_mm.unwrap_or_else(|| self.done.last().map_or(0.0, |s| s.to_x_mm)))?;
                self.open.insert(open)
            }
        };
        recorder.log_frame(steps)?;
        stretch.last_frame = steps.frame_index;
        if let Some(x_mm) = x_mm {
            (stretch.from_x_mm, stretch.to_x_mm) = (stretch.from_x_mm.min(x_mm), stretch.to_x_mm.max(x_mm));
        }
        Ok(())
    }

    fn begin(&self, steps: &FrameSteps<'_>, x_mm: f64) -> Result<(Recorder, Stretch)> {
        let name = format!("recording-{:04}.rrd", self.done.len() + 1);
        let title = format!("{}, from {:.1} m", self.run_name, x_mm / 1000.0);
        let run = RecordedRun {
            name: &title,
            recorded_at: self.recorded_at,
            frames_expected: None,
            duration_expected_s: None,
            watched: false,
        };
        let recorder = Recorder::create(&self.options, &self.rig, &run, &self.folder.join(&name), None)?;
        let frame = steps.frame_index;
        Ok((recorder, Stretch { name, from_x_mm: x_mm, to_x_mm: x_mm, first_frame: frame, last_frame: frame }))
    }

    fn close(&mut self) -> Result<()> {
        if let Some((recorder, stretch)) = self.open.take() {
            recorder.finish()?;
            self.done.push(stretch);
        }
        Ok(())
    }

    /// As [`Recorder::log_newest`], for the whole.
    ///
    /// # Errors
    /// As [`Recordings::create`].
    pub fn log_newest(&mut self, frame_index: u32, time_s: f64, in_world: &[Point3<f64>]) -> Result<Vec<Segment>> {
        self.whole.log_newest(frame_index, time_s, in_world)
    }

    /// As [`Recorder::log_map`], for the whole.
    ///
    /// # Errors
    /// As [`Recordings::create`].
    pub fn log_map(&mut self, width_px: u32, height_px: u32, rgb: &[u8]) -> Result<()> {
        self.whole.log_map(width_px, height_px, rgb)
    }

    /// As [`Recorder::log_warning`], for the whole.
    ///
    /// # Errors
    /// As [`Recordings::create`].
    pub fn log_warning(&mut self, text: &str) -> Result<()> {
        self.whole.log_warning(text)
    }

    /// Completes every file; gives the last live segments, and the stretches.
    ///
    /// # Errors
    /// As [`Recordings::create`].
    pub fn finish(mut self) -> Result<(Vec<Segment>, Vec<Stretch>)> {
        self.close()?;
        Ok((self.whole.finish()?, self.done))
    }
}
