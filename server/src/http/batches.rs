//! Reprocessing in bulk.

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};

use super::extract::{Json, PageQuery, Path, Query};
use super::{App, ingest};
use crate::batches::{NewBatch, Wanted};
use crate::error::{Error, Result};
use crate::runs::{RecipeText, RunFilter};
use crate::wire::{Batch, BatchFilter, BatchPage, BatchPreview, BatchResultPage, BatchWish, Problem};

/// Batches, the newest first.
#[utoipa::path(get, path = "/api/batches", tag = "batches", params(PageQuery),
    responses((status = 200, body = BatchPage), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_batches(State(app): State<App>, Query(query): Query<PageQuery>) -> Result<Response> {
    Ok(axum::Json(app.batches.list(&query.page()?).await?).into_response())
}

/// Processes many runs again: those that a filter finds, or a list. With `dry_run` it only counts them.
#[utoipa::path(post, path = "/api/batches", tag = "batches", request_body = BatchWish,
    params(("Idempotency-Key" = Option<String>, Header, description = "Makes the request safe to repeat")),
    responses((status = 201, body = Batch), (status = 200, body = BatchPreview, description = "The count of a dry run"),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json", description = "The key was used before with other content")))]
pub(super) async fn create_batch(
    State(app): State<App>,
    headers: HeaderMap,
    Json(wish): Json<BatchWish>,
) -> Result<Response> {
    let key = ingest::idempotency_key(&headers)?;
    if wish.filter.is_none() && wish.runs.is_none() {
        return Err(Error::field(
            "filter",
            "neither a filter nor a list says which runs",
            "a filter ({} takes all), or runs",
        ));
    }
    let rig = match &wish.rig {
        Some(text) => Some(app.runs.rig(text).await?),
        None => None,
    };
    let recipe = wish.recipe.as_deref().map(|text| RecipeText::read(Some(text))).transpose()?;
    let BatchFilter { asset, state, q, from, to, rig: with_rig, recipe: with_recipe } = wish.filter.unwrap_or_default();
    let state = state.map(|s| s.as_str().to_string());
    let filter = RunFilter { asset, state, q, from, to, rig: with_rig, recipe: with_recipe, ..RunFilter::default() };
    let new = NewBatch { filter, runs: wish.runs, rig, recipe, note: wish.note };
    if wish.dry_run {
        return Ok(axum::Json(BatchPreview { runs: app.batches.count(&new).await? }).into_response());
    }
    let created = app.batches.create(new, key.as_deref()).await?;
    let location = format!("/api/batches/{}", created.made.id);
    Ok(ingest::created(&location, created.repeated, vec![], &created.made))
}

/// A batch: where it stands, and its jobs by state.
#[utoipa::path(get, path = "/api/batches/{batch}", tag = "batches",
    params(("batch" = String, Path, description = "The batch")),
    responses((status = 200, body = Batch), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_batch(State(app): State<App>, Path(batch): Path<String>) -> Result<Response> {
    Ok(axum::Json(app.batches.get(&batch).await?).into_response())
}

/// What a batch made of each run, with the difference in quality figures to the job before.
#[utoipa::path(get, path = "/api/batches/{batch}/results", tag = "batches",
    params(("batch" = String, Path, description = "The batch"), PageQuery),
    responses((status = 200, body = BatchResultPage), (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_results(
    State(app): State<App>,
    Path(batch): Path<String>,
    Query(query): Query<PageQuery>,
) -> Result<Response> {
    Ok(axum::Json(app.batches.results(&batch, &query.page()?).await?).into_response())
}

/// Holds back the batch's waiting jobs; those at work go on.
#[utoipa::path(post, path = "/api/batches/{batch}/pause", tag = "batches",
    params(("batch" = String, Path, description = "The batch")),
    responses((status = 202, body = Batch), (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json", description = "It was cancelled")))]
pub(super) async fn pause_batch(State(app): State<App>, Path(batch): Path<String>) -> Result<Response> {
    want(&app, &batch, Wanted::Pause).await
}

/// Lets a paused batch go on.
#[utoipa::path(post, path = "/api/batches/{batch}/resume", tag = "batches",
    params(("batch" = String, Path, description = "The batch")),
    responses((status = 202, body = Batch), (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json", description = "It was cancelled")))]
pub(super) async fn resume_batch(State(app): State<App>, Path(batch): Path<String>) -> Result<Response> {
    want(&app, &batch, Wanted::Run).await
}

/// Stops the batch's jobs, those at work within a second; what is done stays.
#[utoipa::path(post, path = "/api/batches/{batch}/cancel", tag = "batches",
    params(("batch" = String, Path, description = "The batch")),
    responses((status = 202, body = Batch), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn cancel_batch(State(app): State<App>, Path(batch): Path<String>) -> Result<Response> {
    want(&app, &batch, Wanted::Cancel).await
}

async fn want(app: &App, batch: &str, wanted: Wanted) -> Result<Response> {
    Ok((StatusCode::ACCEPTED, axum::Json(app.batches.want(batch, wanted).await?)).into_response())
}
