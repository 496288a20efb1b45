//! Tokens and the audit log.

use std::time::Duration;

use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::CACHE_CONTROL;
use axum::response::{IntoResponse, Response};

use super::App;
use super::extract::{Json, PageQuery, Path, Query};
use crate::auth::{NewToken, Scopes};
use crate::error::Result;
use crate::runs::read_time;
use crate::wire::{AuditPage, Problem, Rotation, Token, TokenPage, TokenWish, TokenWithSecret};

/// How long an old secret still opens after a rotation, where nothing is said.
const OVERLAP: Duration = Duration::from_secs(24 * 3600);

/// Tokens, the newest first.
#[utoipa::path(get, path = "/api/tokens", tag = "doors", params(PageQuery),
    responses((status = 200, body = TokenPage), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_tokens(State(app): State<App>, Query(query): Query<PageQuery>) -> Result<Response> {
    Ok(axum::Json(app.auth.tokens(&query.page()?).await?).into_response())
}

/// Makes a token. Its secret is in this answer and nowhere else.
#[utoipa::path(post, path = "/api/tokens", tag = "doors", request_body = TokenWish,
    responses((status = 201, body = TokenWithSecret), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn create_token(State(app): State<App>, Json(wish): Json<TokenWish>) -> Result<Response> {
    let expires_ms = wish.expires_at.as_deref().map(|text| read_time("expires_at", text)).transpose()?;
    Ok(shown_once(app.auth.create_token(&wish.name, &Scopes::new(wish.scopes)?, expires_ms).await?))
}

/// Gives a token a new secret; the old one goes on for the overlap.
#[utoipa::path(post, path = "/api/tokens/{token}/rotate", tag = "doors", request_body = Rotation,
    params(("token" = String, Path, description = "The token")),
    responses((status = 201, body = TokenWithSecret), (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json", description = "It is no longer valid")))]
pub(super) async fn rotate_token(
    State(app): State<App>,
    Path(token): Path<String>,
    Json(asked): Json<Rotation>,
) -> Result<Response> {
    let overlap = asked.overlap_s.map_or(OVERLAP, |s| Duration::from_secs(s.into()));
    Ok(shown_once(app.auth.rotate_token(&token, overlap).await?))
}

/// Shuts a token out, and every session that it opened.
#[utoipa::path(delete, path = "/api/tokens/{token}", tag = "doors",
    params(("token" = String, Path, description = "The token")),
    responses((status = 200, body = Token), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn revoke_token(State(app): State<App>, Path(token): Path<String>) -> Result<Response> {
    Ok(axum::Json(app.auth.revoke_token(&token).await?).into_response())
}

/// Every request that wrote, or wanted to and was let in; the newest first.
#[utoipa::path(get, path = "/api/audit", tag = "doors", params(PageQuery),
    responses((status = 200, body = AuditPage), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_audit(State(app): State<App>, Query(query): Query<PageQuery>) -> Result<Response> {
    Ok(axum::Json(app.auth.audit(&query.page()?).await?).into_response())
}

fn shown_once(new: NewToken) -> Response {
    let body = TokenWithSecret { token: new.token, secret: new.secret };
    (StatusCode::CREATED, [(CACHE_CONTROL, "no-store")], axum::Json(body)).into_response()
}
