//! Stored rigs.

use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};

use super::App;
use super::extract::{PageQuery, Path, Query};
use crate::error::{Error, Result};
use crate::runs::RigText;
use crate::wire::{Problem, Rig, RigPage};

/// Stored rigs by name.
#[utoipa::path(get, path = "/api/rigs", tag = "rigs", params(PageQuery),
    responses((status = 200, body = RigPage), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_rigs(State(app): State<App>, Query(query): Query<PageQuery>) -> Result<Response> {
    Ok(axum::Json(app.runs.rigs(&query.page()?).await?).into_response())
}

/// Stores a rig file (TOML, or the same fields as JSON). A stored rig never changes; storing the same again is no error.
#[utoipa::path(post, path = "/api/rigs", tag = "rigs",
    request_body(content((String = "application/toml"), (serde_json::Value = "application/json"))),
    responses((status = 201, body = Rig), (status = 200, body = Rig, description = "It was there already"),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json", description = "Another of that name is there")))]
pub(super) async fn create_rig(
    State(app): State<App>,
    body: std::result::Result<Bytes, BytesRejection>,
) -> Result<Response> {
    let limit_bytes = app.config.requests.small_body_bytes as u64;
    let body = body.map_err(|e| match e.status() {
        StatusCode::PAYLOAD_TOO_LARGE => Error::TooLarge { limit_bytes },
        _ => Error::SenderSilent,
    })?;
    let text = std::str::from_utf8(&body)
        .map_err(|_| Error::field("rig", "the body is not UTF-8 text", "a rig file in TOML or JSON"))?;
    let (rig, made) = app.runs.store_rig(&RigText::read(text)?).await?;
    let status = if made { StatusCode::CREATED } else { StatusCode::OK };
    Ok((status, axum::Json(rig)).into_response())
}

/// A stored rig.
#[utoipa::path(get, path = "/api/rigs/{rig}", tag = "rigs", params(("rig" = String, Path, description = "Its name")),
    responses((status = 200, body = Rig), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_rig(State(app): State<App>, Path(rig): Path<String>) -> Result<Response> {
    Ok(axum::Json(app.runs.stored_rig(&rig).await?).into_response())
}
