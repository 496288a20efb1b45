//! The recording of a job, in numbered segments while it runs.

use axum::extract::State;
use axum::http::{HeaderMap, Method};
use axum::response::{IntoResponse, Response};

use super::App;
use super::extract::Path;
use super::files::{self, FileAnswer, REVALIDATE};
use crate::error::Result;
use crate::wire::{Problem, Recording};

/// The segments so far; `complete` once no more will come.
#[utoipa::path(get, path = "/api/jobs/{job}/recording", tag = "jobs",
    params(("job" = String, Path, description = "The job")),
    responses((status = 200, body = Recording), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_recording(State(app): State<App>, Path(job): Path<String>) -> Result<Response> {
    Ok(axum::Json(app.runs.recording(&job).await?).into_response())
}

/// One segment: a complete small RRD.
#[utoipa::path(get, path = "/api/jobs/{job}/recording/{number}", tag = "jobs",
    params(("job" = String, Path, description = "The job"), ("number" = u32, Path, description = "From 0")),
    responses((status = 200, content_type = "application/octet-stream", body = Vec<u8>),
        (status = 206, description = "A range of it"), (status = 304, description = "Not changed"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_segment(
    State(app): State<App>,
    Path((job, number)): Path<(String, u32)>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let segment = app.runs.segment(&job, number).await?;
    let answer = FileAnswer {
        parts: vec![(segment.key, segment.facts.bytes)],
        facts: segment.facts,
        content_type: "application/octet-stream",
        // Another attempt may bring another segment of the same number.
        cache: REVALIDATE,
        save_as: None,
    };
    files::send(&app.store, &method, &headers, answer).await
}
