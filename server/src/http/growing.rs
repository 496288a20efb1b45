//! What a job has to show, also while it runs: the tiles of its maps, the newest frame.

use axum::extract::State;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, ETAG};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use sha2::{Digest, Sha256};

use super::App;
use super::extract::Path;
use super::files::{self, FileAnswer, IMMUTABLE, REVALIDATE};
use crate::error::{Error, Result};
use crate::runs::content_type;
use crate::store::hex;
use crate::wire::Problem;

/// Largest file that a running job shows, bytes; the worker stores no larger ones.
pub(super) const MOST_BYTES: u64 = 8 << 20;

/// The maps' pyramid: `tiles.json`, `depth/{level}/{column}_{row}.png`, `texture/{level}/{column}_{row}.jpg`. While the job
/// runs, its state so far: `tiles.json` counts `revision` and names what changed; a `tile` event says when to look.
#[utoipa::path(get, path = "/api/jobs/{job}/tiles/{*name}", tag = "jobs",
    params(("job" = String, Path, description = "The job"), ("name" = String, Path, description = "Path below tiles/")),
    responses((status = 200, content_type = "application/octet-stream", body = Vec<u8>),
        (status = 206, description = "A range of it"), (status = 304, description = "Not changed"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_tile(
    State(app): State<App>,
    Path((job, name)): Path<(String, String)>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    send(&app, &job, &format!("tiles/{name}"), &method, &headers).await
}

/// The newest frame of a job that runs: `frame.jpg`, small, and `frame.json` with the stripe found in it.
#[utoipa::path(get, path = "/api/jobs/{job}/live/{name}", tag = "jobs",
    params(("job" = String, Path, description = "The job"),
        ("name" = String, Path, description = "frame.jpg or frame.json")),
    responses((status = 200, content_type = "application/octet-stream", body = Vec<u8>),
        (status = 304, description = "Not changed"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_live_frame(
    State(app): State<App>,
    Path((job, name)): Path<(String, String)>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    send(&app, &job, &format!("live/{name}"), &method, &headers).await
}

async fn send(app: &App, job: &str, name: &str, method: &Method, asked: &HeaderMap) -> Result<Response> {
    let (key, published) = app.runs.growing_file(job, name).await?;
    let content_type = content_type(name);
    if let Some(facts) = published {
        let parts = vec![(key, facts.bytes)];
        let answer = FileAnswer { parts, facts, content_type, cache: IMMUTABLE, save_as: None };
        return files::send(&app.store, method, asked, answer).await;
    }
    let missing = || Error::NotFound { what: "file", id: name.into() };
    let bytes = app.store.find_bytes(&key, MOST_BYTES).await?.ok_or_else(missing)?;
    let etag = format!("\"{}\"", hex(&Sha256::digest(&bytes)));
    let mut headers = HeaderMap::new();
    headers.insert(CACHE_CONTROL, HeaderValue::from_static(REVALIDATE));
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(content_type));
    if let Ok(value) = HeaderValue::from_str(&etag) {
        headers.insert(ETAG, value);
    }
    if files::none_matches(asked, &etag) {
        return Ok((StatusCode::NOT_MODIFIED, headers).into_response());
    }
    Ok((headers, bytes).into_response())
}
