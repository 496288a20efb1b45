//! Jobs: list, read, cancel, try again; their log and products.

use axum::extract::State;
use axum::http::{HeaderMap, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;

use super::App;
use super::extract::{PageQuery, Path, Query};
use super::files::{self, FileAnswer, IMMUTABLE};
use crate::error::Result;
use crate::runs::{Page, content_type};
use crate::wire::{Job, JobPage, LogPage, Problem, ProductPage};

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct JobQuery {
    /// Jobs of this run only.
    run: Option<String>,
    /// Jobs that are `queued`, `running`, `done`, `failed` or `cancelled`.
    state: Option<String>,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most items, 1 to 1000; 50 when nothing is said.
    limit: Option<u64>,
}

/// Jobs, the newest first.
#[utoipa::path(get, path = "/api/jobs", tag = "jobs", params(JobQuery),
    responses((status = 200, body = JobPage), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_jobs(State(app): State<App>, Query(query): Query<JobQuery>) -> Result<Response> {
    let page = Page::new(query.cursor, query.limit)?;
    Ok(axum::Json(app.runs.jobs(query.run.as_deref(), query.state.as_deref(), &page).await?).into_response())
}

/// A job: state, stage, progress, attempt, warnings, error, quality.
#[utoipa::path(get, path = "/api/jobs/{job}", tag = "jobs", params(("job" = String, Path, description = "The job")),
    responses((status = 200, body = Job), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_job(State(app): State<App>, Path(job): Path<String>) -> Result<Response> {
    Ok(axum::Json(app.runs.job(&job).await?).into_response())
}

/// Asks a job to stop. A waiting job is cancelled at once, a running one within a second.
#[utoipa::path(post, path = "/api/jobs/{job}/cancel", tag = "jobs",
    params(("job" = String, Path, description = "The job")),
    responses((status = 202, body = Job), (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn cancel_job(State(app): State<App>, Path(job): Path<String>) -> Result<Response> {
    app.queue.cancel(&job).await?;
    Ok((StatusCode::ACCEPTED, axum::Json(app.runs.job(&job).await?)).into_response())
}

/// Puts a failed or cancelled job back to the queue.
#[utoipa::path(post, path = "/api/jobs/{job}/retry", tag = "jobs",
    params(("job" = String, Path, description = "The job")),
    responses((status = 202, body = Job), (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn retry_job(State(app): State<App>, Path(job): Path<String>) -> Result<Response> {
    app.queue.retry(&job).await?;
    Ok((StatusCode::ACCEPTED, axum::Json(app.runs.job(&job).await?)).into_response())
}

/// A job's log, the oldest line first.
#[utoipa::path(get, path = "/api/jobs/{job}/log", tag = "jobs",
    params(("job" = String, Path, description = "The job"), PageQuery),
    responses((status = 200, body = LogPage), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_log(
    State(app): State<App>,
    Path(job): Path<String>,
    Query(query): Query<PageQuery>,
) -> Result<Response> {
    Ok(axum::Json(app.runs.log(&job, &query.page()?).await?).into_response())
}

/// The files that a job made; none until it is done.
#[utoipa::path(get, path = "/api/jobs/{job}/products", tag = "jobs",
    params(("job" = String, Path, description = "The job"), PageQuery),
    responses((status = 200, body = ProductPage),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_products(
    State(app): State<App>,
    Path(job): Path<String>,
    Query(query): Query<PageQuery>,
) -> Result<Response> {
    Ok(axum::Json(app.runs.products(&job, &query.page()?).await?).into_response())
}

/// One product; takes range requests. It never changes, and its ETag is its SHA-256.
#[utoipa::path(get, path = "/api/jobs/{job}/products/{*name}", tag = "jobs",
    params(("job" = String, Path, description = "The job"),
        ("name" = String, Path, description = "Path inside the product folder")),
    responses((status = 200, content_type = "application/octet-stream", body = Vec<u8>),
        (status = 206, description = "A range of it"), (status = 304, description = "Not changed"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 416, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_product(
    State(app): State<App>,
    Path((job, name)): Path<(String, String)>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    send_product(&app, &job, &name, &method, &headers).await
}

pub(super) async fn send_product(
    app: &App,
    job: &str,
    name: &str,
    method: &Method,
    headers: &HeaderMap,
) -> Result<Response> {
    let product = app.runs.product(job, name).await?;
    // Only pictures and texts are for looking at in the browser; the rest is for keeping.
    let content_type = content_type(name);
    let save = content_type == "application/octet-stream";
    let answer = FileAnswer {
        parts: vec![(product.key, product.facts.bytes)],
        facts: product.facts,
        content_type,
        cache: IMMUTABLE,
        save_as: save.then(|| name.to_string()),
    };
    files::send(&app.store, method, headers, answer).await
}
