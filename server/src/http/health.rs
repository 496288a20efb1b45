//! Whether the server lives, and whether it can do its work.

use axum::extract::State;
use axum::response::{IntoResponse, Response};

use super::App;
use crate::error::{Error, Result};
use crate::wire::{Health, Problem};

/// The process answers.
#[utoipa::path(get, path = "/livez", tag = "health", responses((status = 200, body = Health)))]
pub(super) async fn get_livez() -> Response {
    axum::Json(ok()).into_response()
}

/// The records answer and the server is not about to stop.
#[utoipa::path(get, path = "/readyz", tag = "health",
    responses((status = 200, body = Health), (status = 503, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_readyz(State(app): State<App>) -> Result<Response> {
    if app.stop.is_cancelled() {
        return Err(Error::Busy("the server is stopping".into()));
    }
    app.runs.ping().await.map_err(|e| Error::Busy(format!("the records do not answer: {e}")))?;
    Ok(axum::Json(ok()).into_response())
}

fn ok() -> Health {
    Health { status: "ok".into(), version: env!("CARGO_PKG_VERSION").into() }
}
