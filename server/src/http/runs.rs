//! Runs: list, read, change, delete, get the source back, process again.

use axum::extract::State;
use axum::http::{HeaderMap, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;

use super::extract::{IfMatch, Json, Path, Query};
use super::files::{self, FileAnswer, IMMUTABLE};
use super::{App, ingest};
use crate::error::Result;
use crate::runs::{Page, RecipeText, RunFilter, RunSort, content_type};
use crate::wire::{Job, Priority, Problem, Reprocess, Run, RunChange, RunPage};

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct RunQuery {
    /// Runs of this asset only.
    asset: Option<String>,
    /// Runs whose latest job is `queued`, `running`, `done`, `failed` or `cancelled`.
    state: Option<String>,
    /// Runs with this text in the asset's, the file's or the rig's name, or in the note.
    q: Option<String>,
    /// Recorded at this time or later (RFC 3339).
    from: Option<String>,
    /// Recorded before this time (RFC 3339).
    to: Option<String>,
    /// `created`, `recorded` or `asset`, with a minus before it for the other way round; `-created` when nothing is said.
    sort: Option<String>,
    /// Recorded with the rig of this name.
    rig: Option<String>,
    /// Whose latest job has the recipe of this name.
    recipe: Option<String>,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most items, 1 to 1000; 50 when nothing is said.
    limit: Option<u64>,
}

/// Runs, the newest first or in another order.
#[utoipa::path(get, path = "/api/runs", tag = "runs", params(RunQuery),
    responses((status = 200, body = RunPage), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_runs(State(app): State<App>, Query(query): Query<RunQuery>) -> Result<Response> {
    let page = Page::new(query.cursor, query.limit)?;
    let sort = RunSort::parse(query.sort.as_deref())?;
    let RunQuery { asset, state, q, from, to, rig, recipe, .. } = query;
    let filter = RunFilter { asset, state, q, from, to, rig, recipe, sort };
    Ok(axum::Json(app.runs.list(&filter, &page).await?).into_response())
}

/// A run with its latest job.
#[utoipa::path(get, path = "/api/runs/{run}", tag = "runs", params(("run" = String, Path, description = "The run")),
    responses((status = 200, body = Run), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_run(State(app): State<App>, Path(run): Path<String>) -> Result<Response> {
    Ok(axum::Json(app.runs.get(&run).await?).into_response())
}

/// Changes what is said about a run.
#[utoipa::path(patch, path = "/api/runs/{run}", tag = "runs",
    params(("run" = String, Path, description = "The run"),
        ("If-Match" = Option<String>, Header, description = "The run's `version`, quoted: changes nothing where it has another by now")),
    request_body = RunChange,
    responses((status = 200, body = Run), (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 412, body = Problem, content_type = "application/problem+json", description = "Somebody else has changed it")))]
pub(super) async fn change_run(
    State(app): State<App>,
    Path(run): Path<String>,
    IfMatch(versions): IfMatch,
    Json(change): Json<RunChange>,
) -> Result<Response> {
    Ok(axum::Json(app.runs.change(&run, change, versions.as_deref()).await?).into_response())
}

/// Deletes a run with its jobs and all their files; a job that runs is stopped.
#[utoipa::path(delete, path = "/api/runs/{run}", tag = "runs", params(("run" = String, Path, description = "The run")),
    responses((status = 204), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn delete_run(State(app): State<App>, Path(run): Path<String>) -> Result<Response> {
    app.runs.delete(&run).await?;
    Ok(StatusCode::NO_CONTENT.into_response())
}

/// The run's images as they came in, byte for byte; takes range requests.
#[utoipa::path(get, path = "/api/runs/{run}/source", tag = "runs",
    params(("run" = String, Path, description = "The run")),
    responses((status = 200, content_type = "application/octet-stream", body = Vec<u8>),
        (status = 206, description = "A range of it"), (status = 304, description = "Not changed"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 416, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_source(
    State(app): State<App>,
    Path(run): Path<String>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response> {
    let source = app.runs.source(&run).await?;
    let answer = FileAnswer {
        content_type: content_type(&source.filename.to_ascii_lowercase()),
        parts: source.parts,
        facts: source.facts,
        cache: IMMUTABLE,
        save_as: Some(source.filename),
    };
    files::send(&app.store, &method, &headers, answer).await
}

/// Processes a run again: what is not said stays as in its latest job.
#[utoipa::path(post, path = "/api/runs/{run}/jobs", tag = "jobs",
    params(("run" = String, Path, description = "The run"),
        ("Idempotency-Key" = Option<String>, Header, description = "Makes the request safe to repeat")),
    request_body = Reprocess,
    responses((status = 201, body = Job), (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn create_job(
    State(app): State<App>,
    Path(run): Path<String>,
    headers: HeaderMap,
    Json(asked): Json<Reprocess>,
) -> Result<Response> {
    let key = ingest::idempotency_key(&headers)?;
    let rig = match &asked.rig {
        Some(text) => Some(app.runs.rig(text).await?),
        None => None,
    };
    let recipe = asked.recipe.as_deref().map(|text| RecipeText::read(Some(text))).transpose()?;
    let priority = asked.priority.unwrap_or(Priority::Upload);
    let created = app.runs.reprocess(&run, rig, recipe, priority, key.as_deref()).await?;
    let location = format!("/api/jobs/{}", created.made.id);
    Ok(ingest::created(&location, created.repeated, vec![], &created.made))
}
