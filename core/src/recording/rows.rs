//! What is recorded of every frame: the plots, and where the camera was.

use rerun::log::Chunk;
use rerun::{LineStrips3D, Scalars, SeriesLines, Transform3D};

use super::budget::Share;
use super::data::{Moment, failed, fixed, rows};
use super::{FrameSteps, entity, metres};
use crate::error::Result;
use crate::geometry::WorldFromCamera;

/// What one row of the plots and its pose take in the file, compressed.
const ROW_BYTES: usize = 150;

/// Values of one or more frames, with their mean.
#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    sum: f64,
    count: u32,
}

impl Mean {
    fn add(&mut self, value: Option<f64>) {
        if let Some(value) = value.filter(|v| v.is_finite()) {
            self.sum += value;
            self.count += 1;
        }
    }

    /// NaN where there was no value; to single precision, whose zeros compress.
    fn value(&self) -> f64 {
        f64::from((self.sum / f64::from(self.count)) as f32)
    }
}

/// The plotted values of one row: dx, dy, residual, scale, rows found.
type Values = [Mean; 5];

/// Collects a row a frame, or the mean of 2, 4, 8 … frames once its share of the budget fills.
pub(super) struct Rows {
    frames: u32,
    current: Values,
    moments: Vec<Moment>,
    values: Vec<[f64; 5]>,
    pose_moments: Vec<Moment>,
    poses: Vec<WorldFromCamera>,
    last_position: Option<[f32; 3]>,
}

impl Rows {
    pub(super) fn new(frames_expected: Option<u64>, share: &mut Share) -> Rows {
        if let Some(frames) = frames_expected {
            share.plan(frames as f64 * ROW_BYTES as f64);
        }
        Rows {
            frames: 0,
            current: Values::default(),
            moments: vec![],
            values: vec![],
            pose_moments: vec![],
            poses: vec![],
            last_position: None,
        }
    }

    /// How the lines are drawn and named.
    pub(super) fn opening() -> Result<Vec<Chunk>> {
        let line = |names: &[&str], colours: &[[u8; 3]]| {
            SeriesLines::new().with_names(names.iter().copied()).with_colors(colours.iter().copied())
        };
        Ok(vec![
            fixed(
                entity::SHIFT,
                &line(&["dx (px)", "dy (px)", "residual (px)"], &[[66, 135, 245], [245, 166, 35], [150, 150, 150]]),
            )?,
            fixed(entity::SCALE, &line(&["scale"], &[[189, 110, 240]]))?,
            fixed(entity::ROWS_FOUND, &line(&["rows found"], &[[80, 200, 120]]))?,
        ])
    }

    pub(super) fn push(&mut self, steps: &FrameSteps<'_>, share: &mut Share) {
        let shift = steps.shift;
        let found = steps.stripe.found() as f64;
        let frame = [shift.dx_px, shift.dy_px, shift.residual_px, shift.scale, Some(found)];
        self.current.iter_mut().zip(frame).for_each(|(mean, value)| mean.add(value));
        self.frames += 1;
        if self.frames < 1 << share.halvings() || !share.spend(ROW_BYTES) {
            return;
        }
        let moment = steps.moment();
        self.moments.push(moment);
        self.values.push(std::mem::take(&mut self.current).map(|mean| mean.value()));
        self.frames = 0;
        if let Some(pose) = steps.world_from_camera {
            self.pose_moments.push(moment);
            self.poses.push(pose);
        }
    }

    pub(super) fn len(&self) -> usize {
        self.moments.len()
    }

    /// The rows since the last call.
    pub(super) fn take(&mut self) -> Result<Vec<Chunk>> {
        let mut chunks = Vec::new();
        if !self.moments.is_empty() {
            for (entity, columns) in [(entity::SHIFT, 0..3), (entity::SCALE, 3..4), (entity::ROWS_FOUND, 4..5)] {
                let values = self.values.iter().flat_map(|v| v[columns.clone()].iter().copied());
                let lengths = std::iter::repeat_n(columns.len(), self.moments.len());
                let scalars = Scalars::new(values).columns(lengths).map_err(failed)?;
                chunks.push(rows(entity, &self.moments, scalars)?);
            }
        }
        if !self.poses.is_empty() {
            chunks.extend([self.camera()?, self.trajectory()?]);
        }
        self.moments.clear();
        self.values.clear();
        self.pose_moments.clear();
        self.poses.clear();
        Ok(chunks)
    }

    fn camera(&self) -> Result<Chunk> {
        let rotation = |pose: &WorldFromCamera| {
            let q = pose.rotation.coords;
            rerun::Quaternion::from_xyzw([q.x as f32, q.y as f32, q.z as f32, q.w as f32])
        };
        let transforms = Transform3D::update_fields()
            .with_many_translation(self.poses.iter().map(position))
            .with_many_quaternion(self.poses.iter().map(rotation));
        rows(entity::CAMERA, &self.pose_moments, transforms.columns_of_unit_batches().map_err(failed)?)
    }

    /// The path of the camera since the last piece, joined to it.
    fn trajectory(&mut self) -> Result<Chunk> {
        let strip: Vec<[f32; 3]> = self.last_position.into_iter().chain(self.poses.iter().map(position)).collect();
        self.last_position = strip.last().copied();
        let strips = LineStrips3D::update_fields().with_strips([strip]);
        rows(
            entity::TRAJECTORY,
            &self.pose_moments[self.pose_moments.len() - 1..],
            strips.columns_of_unit_batches().map_err(failed)?,
        )
    }
}

fn position(pose: &WorldFromCamera) -> [f32; 3] {
    metres(&pose.translation.vector.into())
}
