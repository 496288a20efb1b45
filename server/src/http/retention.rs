//! What would be deleted, and what never is.

use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;

use super::App;
use super::extract::{Path, Query};
use crate::error::{Error, Result};
use crate::retention::Policy;
use crate::wire::{Pin, Problem, RetentionPreview};

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct PolicyQuery {
    #[param(minimum = 0, maximum = 1_000_000_000)]
    /// As if runs older than this went, days; the server's own value when nothing is said.
    keep_days: Option<f64>,
    #[param(minimum = 0, maximum = 1_000_000_000)]
    /// As if the oldest runs went while more than this is stored, GB; the server's own value when nothing is said.
    quota_gb: Option<f64>,
}

/// What the server's policy, or another, would delete now. Nothing is deleted by asking.
#[utoipa::path(get, path = "/api/retention", tag = "retention", params(PolicyQuery),
    responses((status = 200, body = RetentionPreview), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn preview_retention(State(app): State<App>, Query(query): Query<PolicyQuery>) -> Result<Response> {
    for (name, value) in [("keep_days", query.keep_days), ("quota_gb", query.quota_gb)] {
        if let Some(value) = value.filter(|v| !(0.0..=1e9).contains(v)) {
            return Err(Error::field(name, format!("{name} is {value}"), "0 to 1,000,000,000"));
        }
    }
    let own = app.config.retention;
    let policy = Policy { keep_days: query.keep_days.or(own.keep_days), quota_gb: query.quota_gb.or(own.quota_gb) };
    Ok(axum::Json(app.runs.preview(&policy).await?).into_response())
}

/// Keeps a run whatever the policy says.
#[utoipa::path(put, path = "/api/runs/{run}/pin", tag = "retention", params(("run" = String, Path, description = "The run")),
    responses((status = 200, body = Pin), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn pin_run(State(app): State<App>, Path(run): Path<String>) -> Result<Response> {
    app.runs.pin(&run, true).await?;
    Ok(axum::Json(Pin { pinned: true }).into_response())
}

/// Lets the policy decide about a run again.
#[utoipa::path(delete, path = "/api/runs/{run}/pin", tag = "retention", params(("run" = String, Path, description = "The run")),
    responses((status = 200, body = Pin), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn unpin_run(State(app): State<App>, Path(run): Path<String>) -> Result<Response> {
    app.runs.pin(&run, false).await?;
    Ok(axum::Json(Pin { pinned: false }).into_response())
}

/// Whether a run is pinned.
#[utoipa::path(get, path = "/api/runs/{run}/pin", tag = "retention", params(("run" = String, Path, description = "The run")),
    responses((status = 200, body = Pin), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_pin(State(app): State<App>, Path(run): Path<String>) -> Result<Response> {
    Ok(axum::Json(Pin { pinned: app.runs.is_pinned(&run).await? }).into_response())
}
