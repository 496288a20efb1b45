//! The rules of keeping: which hold, what they would delete; and what is never deleted.

use axum::Extension;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;

use super::App;
use super::extract::{IfMatch, Json, Path, Query};
use crate::auth::Visitor;
use crate::error::{Error, Result};
use crate::retention::Policy;
use crate::wire::{Pin, Problem, RetentionPreview, RetentionWish};

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct PolicyQuery {
    #[param(minimum = 0, maximum = 1_000_000_000)]
    /// As if runs older than this went, days; as the rules that hold say where nothing is said.
    keep_days: Option<f64>,
    #[param(minimum = 0, maximum = 1_000_000_000)]
    /// As if the oldest runs went while more than this is stored, GB; as the rules that hold say where nothing is said.
    quota_gb: Option<f64>,
    /// As if there were no other rules than those that the query names.
    exactly: Option<bool>,
}

/// The rules of keeping that hold, and what they, or others, would delete now. Nothing is deleted by asking.
#[utoipa::path(get, path = "/api/retention", tag = "retention", params(PolicyQuery),
    responses((status = 200, body = RetentionPreview), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn preview_retention(State(app): State<App>, Query(query): Query<PolicyQuery>) -> Result<Response> {
    for (name, value) in [("keep_days", query.keep_days), ("quota_gb", query.quota_gb)] {
        if let Some(value) = value.filter(|v| !(0.0..=1e9).contains(v)) {
            return Err(Error::field(name, format!("{name} is {value}"), "0 to 1,000,000,000"));
        }
    }
    let own = app.config.retention;
    let other = match query.exactly {
        Some(true) => Policy::default(),
        _ => app.runs.rules_of_keeping(own).await?.policy,
    };
    let policy = Policy { keep_days: query.keep_days.or(other.keep_days), quota_gb: query.quota_gb.or(other.quota_gb) };
    Ok(axum::Json(app.runs.preview(&policy, own).await?).into_response())
}

/// Stores rules of keeping: from now on they hold on every server, whatever its flags say. What they do not keep goes at
/// once: GET with `exactly` and the same rules says beforehand what that is. The answer is what still has to go.
#[utoipa::path(put, path = "/api/retention", tag = "retention",
    params(("If-Match" = Option<String>, Header, description = "The rules' `version`, quoted: stores nothing where they have another by now")),
    request_body = RetentionWish,
    responses((status = 200, body = RetentionPreview),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 412, body = Problem, content_type = "application/problem+json", description = "Somebody else has changed them")))]
pub(super) async fn store_retention(
    State(app): State<App>,
    Extension(visitor): Extension<Visitor>,
    IfMatch(versions): IfMatch,
    Json(wish): Json<RetentionWish>,
) -> Result<Response> {
    let policy = Policy { keep_days: wish.keep_days, quota_gb: wish.quota_gb };
    app.runs.keep_by(Some(policy), versions.as_deref(), &visitor.name).await?;
    Ok(axum::Json(app.runs.preview(&policy, app.config.retention).await?).into_response())
}

/// Lets each server's own flags hold again.
#[utoipa::path(delete, path = "/api/retention", tag = "retention",
    params(("If-Match" = Option<String>, Header, description = "The rules' `version`, quoted: changes nothing where they have another by now")),
    responses((status = 200, body = RetentionPreview),
        (status = 412, body = Problem, content_type = "application/problem+json", description = "Somebody else has changed them")))]
pub(super) async fn forget_retention(
    State(app): State<App>,
    Extension(visitor): Extension<Visitor>,
    IfMatch(versions): IfMatch,
) -> Result<Response> {
    let own = app.config.retention;
    app.runs.keep_by(None, versions.as_deref(), &visitor.name).await?;
    Ok(axum::Json(app.runs.preview(&own, own).await?).into_response())
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
