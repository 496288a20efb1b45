//! Values to chunks: one row at a time, or whole columns.

use rerun::log::Chunk;
use rerun::{AsComponents, SerializedComponentColumn, TimeColumn, TimePoint, Timeline};

use crate::error::{Error, Result};

/// The timeline that counts frames.
pub(super) const FRAME: &str = "frame";
/// The timeline of capture times since the run's first frame.
pub(super) const TIME: &str = "time";

/// When something was: a frame and its capture time.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Moment {
    pub frame: u32,
    pub time_s: f64,
}

impl Moment {
    fn nanos(self) -> i64 {
        (self.time_s * 1e9).round() as i64
    }

    fn time_point(self) -> TimePoint {
        TimePoint::default()
            .with(Timeline::new_sequence(FRAME), i64::from(self.frame))
            .with(Timeline::new_duration(TIME), self.nanos())
    }
}

/// What holds at every time.
pub(super) fn fixed(entity: &str, what: &dyn AsComponents) -> Result<Chunk> {
    Chunk::builder(entity).with_archetype_auto_row(TimePoint::default(), what).build().map_err(failed)
}

/// What holds from one moment on.
pub(super) fn row(entity: &str, at: Moment, what: &dyn AsComponents) -> Result<Chunk> {
    Chunk::builder(entity).with_archetype_auto_row(at.time_point(), what).build().map_err(failed)
}

/// One row for each moment.
pub(super) fn rows(
    entity: &str,
    at: &[Moment],
    columns: impl IntoIterator<Item = SerializedComponentColumn>,
) -> Result<Chunk> {
    let times = [
        TimeColumn::new_sequence(FRAME, at.iter().map(|m| i64::from(m.frame))),
        TimeColumn::new_duration_nanos(TIME, at.iter().map(|m| m.nanos())),
    ];
    let columns = columns.into_iter().map(|c| (c.descriptor, c.list_array));
    Chunk::from_columns(entity, times, columns).map_err(failed)
}

/// The library's refusal of our data.
pub(super) fn failed(error: impl std::fmt::Display) -> Error {
    Error::internal("recording", error)
}
