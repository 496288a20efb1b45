//! A job's MCAP archive: as it is, or a part of it that is made while it is sent.

use std::io::Write;

use axum::body::Body;
use axum::extract::State;
use axum::http::header::{CACHE_CONTROL, CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::http::{HeaderMap, Method};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde::Deserialize;
use stria_core::export::archive_mcap::{ArchiveCut, ArchiveSource, cut};
use stria_core::mcap_file::Records;
use tokio::sync::{Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use utoipa::IntoParams;

use super::App;
use super::extract::{Path, Query};
use super::files::REVALIDATE;
use super::jobs::send_product;
use super::stored::StoredFileReader;
use crate::error::{Error, Result};
use crate::runs::StoredFile;
use crate::store::Store;
use crate::wire::{Direction, Problem};

const NAME: &str = "archive.mcap";
/// Parts that are made at the same time, at most: each keeps a core busy.
const PARTS_AT_ONCE: usize = 2;
static PARTS: Semaphore = Semaphore::const_new(PARTS_AT_ONCE);
/// Frames from one that is kept to the next, at most.
const MOST_EVERY: u32 = 1_000_000;
/// Bytes that are sent at once, about.
const PIECE_BYTES: usize = 256 * 1024;
/// Pieces that wait for a slow reader, at most.
const PIECES_WAIT: usize = 4;

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct ArchiveQuery {
    /// `false`: without the camera's frames.
    frames: Option<bool>,
    #[param(minimum = 1, maximum = 1_000_000)]
    /// Only every n-th frame with what was measured in it, and every n-th point of the surface.
    every: Option<u32>,
    /// Only the wall from this chainage on, mm.
    from_mm: Option<f64>,
    /// Only the wall up to this chainage, mm.
    to_mm: Option<f64>,
}

/// The job's MCAP archive. Without parameters it is the product `archive.mcap`, with ranges and an ETag; with any, the
/// part that they name is made while it is sent.
#[utoipa::path(get, path = "/api/jobs/{job}/archive.mcap", tag = "jobs",
    params(("job" = String, Path, description = "The job"), ArchiveQuery),
    responses((status = 200, content_type = "application/octet-stream", body = Vec<u8>),
        (status = 206, description = "A range of it"), (status = 304, description = "Not changed"),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 416, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_archive(
    State(app): State<App>,
    Path(job): Path<String>,
    Query(query): Query<ArchiveQuery>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    if query.frames.is_none() && query.every.is_none() && query.from_mm.is_none() && query.to_mm.is_none() {
        return send_product(&app, &job, NAME, &method, &headers).await;
    }
    let run = app.runs.get(&app.runs.job(&job).await?.run).await?;
    let how = query.cut(run.chainage_mm, run.direction)?;
    let file = app.runs.product(&job, NAME).await?;
    let head = [
        (CONTENT_TYPE, "application/octet-stream"),
        (CACHE_CONTROL, REVALIDATE),
        (CONTENT_DISPOSITION, "attachment; filename=\"archive.mcap\""),
    ];
    if method == Method::HEAD {
        return Ok((head, Body::empty()).into_response());
    }
    Ok((head, Body::from_stream(part(app.store.clone(), file, how)?)).into_response())
}

impl ArchiveQuery {
    fn cut(&self, start_mm: f64, direction: Direction) -> Result<ArchiveCut> {
        let every = self.every.unwrap_or(1);
        if !(1..=MOST_EVERY).contains(&every) {
            return Err(Error::field("every", format!("every is {every}"), format!("1 to {MOST_EVERY}")));
        }
        let (from_mm, to_mm) = (self.from_mm.unwrap_or(f64::NEG_INFINITY), self.to_mm.unwrap_or(f64::INFINITY));
        if from_mm.is_nan() || to_mm.is_nan() || from_mm > to_mm {
            return Err(Error::field("to_mm", format!("{to_mm}, from_mm {from_mm}"), "a chainage not before from_mm"));
        }
        let some = self.from_mm.is_some() || self.to_mm.is_some();
        let range = match direction {
            Direction::Forward => from_mm - start_mm..=to_mm - start_mm,
            Direction::Backward => start_mm - to_mm..=start_mm - from_mm,
        };
        let x_mm = some.then_some(range);
        Ok(ArchiveCut { frames: self.frames.unwrap_or(true), every, x_mm })
    }
}

/// Makes a part in a thread of its own; it stops where the reader has gone.
fn part(store: Store, file: StoredFile, how: ArchiveCut) -> Result<ReceiverStream<std::io::Result<Bytes>>> {
    let Ok(permit) = PARTS.try_acquire() else {
        return Err(Error::Busy(format!("{PARTS_AT_ONCE} parts of archives are being made")));
    };
    let (pieces, stream) = mpsc::channel(PIECES_WAIT);
    tokio::task::spawn_blocking(move || {
        let _permit = permit;
        let source = StoredArchive { store, file };
        let out = Pieces { gathered: Vec::with_capacity(PIECE_BYTES), pieces: pieces.clone() };
        if let Err(error) = cut(source, &how, out, NAME) {
            // The answer ends without its end, so that nobody takes it for whole.
            tracing::warn!(%error, "a part of an archive could not be sent");
            let _ = pieces.blocking_send(Err(std::io::Error::other(error.to_string())));
        }
    });
    Ok(ReceiverStream::new(stream))
}

/// An archive in the store.
struct StoredArchive {
    store: Store,
    file: StoredFile,
}

impl ArchiveSource for StoredArchive {
    fn name(&self) -> String {
        NAME.into()
    }

    fn open(&mut self) -> stria_core::Result<Records> {
        let StoredFile { key, facts } = &self.file;
        let reader = StoredFileReader::new(self.store.clone(), key.clone(), facts.bytes);
        Ok(Records::of(Box::new(reader), NAME))
    }
}

/// Bytes that go, from code that waits until they have gone.
struct Pieces {
    gathered: Vec<u8>,
    pieces: mpsc::Sender<std::io::Result<Bytes>>,
}

impl Write for Pieces {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.gathered.extend_from_slice(bytes);
        if self.gathered.len() >= PIECE_BYTES {
            self.flush()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        if self.gathered.is_empty() {
            return Ok(());
        }
        let piece = std::mem::replace(&mut self.gathered, Vec::with_capacity(PIECE_BYTES));
        let gone = |_| std::io::Error::new(std::io::ErrorKind::BrokenPipe, "the reader has gone");
        self.pieces.blocking_send(Ok(piece.into())).map_err(gone)
    }
}
