//! `GET /api/jobs/{job}/events`: what happens to a job, as server-sent events.
//!
//! A reader gets the present state first, whenever it comes; then what changes; after a final state the stream ends.
//! The records are the truth: the stream compares them with what it has sent, and the bell only says when to look.

use std::convert::Infallible;
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use super::App;
use super::extract::Path;
use super::growing::MOST_BYTES;
use crate::error::{Error, Result};
use crate::wire::{Job, JobEvent, JobState, Problem, RecordingSegment};

/// Least time between two looks at the records.
const AT_MOST_EVERY: Duration = Duration::from_millis(200);
/// Longest time between them: with SQLite, or without its NOTIFY, other processes ring no bell here.
const AT_LEAST_EVERY: Duration = Duration::from_secs(1);
/// So often a line goes out even when nothing happens, which tells a dead connection from a quiet one.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
/// Events that may wait for a slow reader.
const QUEUED_EVENTS: usize = 16;
/// How long a browser waits before it comes back, ms.
const COME_BACK: Duration = Duration::from_secs(2);
/// Least time between two looks at the tiles of a job that runs.
const TILES_EVERY: Duration = Duration::from_secs(1);
/// Log lines and segments of one look.
const AT_ONCE: u64 = 500;

/// Events of a job: `state` (the job), `progress` (the job), `log` (a line), `segment` (a recording segment),
/// `tile` (the `revision` of a pyramid that grows: its `tiles.json` names what changed).
///
/// The present state, the log and all segments so far come first. When a segment's `generation` grows, the recording
/// has started anew. The stream ends after a final state.
#[utoipa::path(get, path = "/api/jobs/{job}/events", tag = "jobs",
    params(("job" = String, Path, description = "The job")),
    responses((status = 200, content_type = "text/event-stream", body = JobEvent),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn stream_events(State(app): State<App>, Path(job): Path<String>) -> Result<Response> {
    app.runs.job(&job).await?;
    let (events, stream) = mpsc::channel::<std::result::Result<Event, Infallible>>(QUEUED_EVENTS);
    tokio::spawn(async move {
        let mut teller = Teller { app: app.clone(), job, events, told: Told::default() };
        tokio::select! {
            ended = teller.tell() => {
                if let Err(error) = ended && !matches!(error, Error::NotFound { .. }) {
                    tracing::warn!(%error, "an event stream ended");
                }
            }
            () = app.stop.cancelled() => {}
        }
    });
    let keep_alive = KeepAlive::new().interval(KEEP_ALIVE);
    Ok(Sse::new(ReceiverStream::new(stream)).keep_alive(keep_alive).into_response())
}

/// What a reader knows already.
#[derive(Default)]
struct Told {
    state: Option<(JobState, u32, bool)>,
    job: Option<Job>,
    log_lines: i64,
    /// Generation and number of the newest segment.
    segment: Option<(u64, u32)>,
    /// When the tiles were looked at, and their revision.
    tiles: Option<(Instant, u64)>,
}

/// The part of `tiles.json` that says whether it has changed.
#[derive(Deserialize, Serialize)]
struct TilesState {
    revision: u64,
}

struct Teller {
    app: App,
    job: String,
    events: mpsc::Sender<std::result::Result<Event, Infallible>>,
    told: Told,
}

impl Teller {
    async fn tell(&mut self) -> Result<()> {
        let mut changes = self.app.queue.bell().listen();
        loop {
            changes.borrow_and_update();
            // The state is read before the rest and told after it: when it is final, everything was told.
            let job = self.app.runs.job(&self.job).await?;
            if self.told.job.is_none() {
                self.tell_job(&job).await?;
            }
            self.tell_log().await?;
            self.tell_segments().await?;
            self.tell_tiles().await?;
            self.tell_job(&job).await?;
            if job.state.is_final() || self.events.is_closed() {
                return Ok(());
            }
            tokio::time::sleep(AT_MOST_EVERY).await;
            let _ = tokio::time::timeout(AT_LEAST_EVERY, changes.changed()).await;
        }
    }

    async fn tell_job(&mut self, job: &Job) -> Result<()> {
        let state = (job.state, job.attempt, job.cancelling);
        if self.told.state != Some(state) {
            self.send("state", job).await?;
        }
        if self.told.job.as_ref() != Some(job) {
            self.send("progress", job).await?;
        }
        self.told.state = Some(state);
        self.told.job = Some(job.clone());
        Ok(())
    }

    async fn tell_log(&mut self) -> Result<()> {
        loop {
            let lines = self.app.runs.log_lines(&self.job, self.told.log_lines, AT_ONCE).await?;
            let Some(last) = lines.last() else { return Ok(()) };
            self.told.log_lines = i64::try_from(last.number).unwrap_or(i64::MAX - 1) + 1;
            for line in &lines {
                self.send("log", line).await?;
            }
        }
    }

    async fn tell_segments(&mut self) -> Result<()> {
        let newest = self.told.segment;
        // Numbers have no gaps, so the last one told is where to look on; a new generation begins at 0 again.
        let from = newest.map_or(0, |(_, number)| number + 1);
        let first = self.app.runs.segments(&self.job, 0, Some(1)).await?;
        let anew = first.first().is_some_and(|s| newest.is_some_and(|(generation, _)| s.generation != generation));
        let mut next = if anew { 0 } else { from };
        loop {
            let segments: Vec<RecordingSegment> = self.app.runs.segments(&self.job, next, Some(AT_ONCE)).await?;
            let Some(last) = segments.last() else { return Ok(()) };
            next = last.number.saturating_add(1);
            for segment in &segments {
                self.send("segment", segment).await?;
            }
            self.told.segment = Some((last.generation, last.number));
        }
    }

    async fn tell_tiles(&mut self) -> Result<()> {
        let known = match self.told.tiles {
            Some((looked, _)) if looked.elapsed() < TILES_EVERY => return Ok(()),
            Some((_, revision)) => revision,
            None => 0,
        };
        let (key, published) = self.app.runs.growing_file(&self.job, "tiles/tiles.json").await?;
        if published.is_some() {
            return Ok(()); // the final state tells it
        }
        let Some(bytes) = self.app.store.find_bytes(&key, MOST_BYTES).await? else { return Ok(()) };
        let Ok(state) = serde_json::from_slice::<TilesState>(&bytes) else { return Ok(()) };
        if state.revision != known {
            self.send("tile", &state).await?;
        }
        self.told.tiles = Some((Instant::now(), state.revision));
        Ok(())
    }

    /// Waits for a slow reader; ends when there is none any more.
    async fn send(&self, name: &str, data: &impl Serialize) -> Result<()> {
        let event = Event::default().event(name).retry(COME_BACK).json_data(data);
        let event = event.map_err(|e| Error::Internal(format!("an event is not JSON: {e}")))?;
        let gone = |_| Error::NotFound { what: "reader", id: self.job.clone() };
        self.events.send(Ok(event)).await.map_err(gone)
    }
}
