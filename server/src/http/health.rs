//! Whether the server lives, and whether it can do its work.

use std::time::Duration;

use axum::extract::State;
use axum::response::{IntoResponse, Response};
use tokio_util::sync::CancellationToken;

use super::App;
use crate::disk::DiskGuard;
use crate::error::{Error, Result};
use crate::wire::{Health, Problem};

/// How long the records and the files may take to answer.
const PATIENCE: Duration = Duration::from_secs(2);

/// The process answers.
#[utoipa::path(get, path = "/livez", tag = "health", responses((status = 200, body = Health)))]
pub(super) async fn get_livez() -> Response {
    axum::Json(ok(&[])).into_response()
}

/// Records and files can be reached, the disk has room, and the server is not about to stop. `warnings` says what this
/// machine lacks to keep the processing of strangers' videos in its place.
#[utoipa::path(get, path = "/readyz", tag = "health",
    responses((status = 200, body = Health), (status = 503, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_readyz(State(app): State<App>) -> Result<Response> {
    ready(&app.stop, app.runs.ping(), app.store.ping(), &app.disk, &app.warnings).await
}

/// The answer of a process that needs these.
pub(super) async fn ready(
    stop: &CancellationToken,
    records: impl Future<Output = Result<()>>,
    files: impl Future<Output = Result<()>>,
    disk: &DiskGuard,
    warnings: &[String],
) -> Result<Response> {
    if stop.is_cancelled() {
        return Err(Error::Busy("the process is stopping".into()));
    }
    in_time("the records", records).await?;
    in_time("the files", files).await?;
    if let Some(lack) = disk.lack() {
        return Err(Error::Busy(lack));
    }
    Ok(axum::Json(ok(warnings)).into_response())
}

/// Whoever asks does not wait as long as the work may.
async fn in_time(what: &str, asked: impl Future<Output = Result<()>>) -> Result<()> {
    match tokio::time::timeout(PATIENCE, asked).await {
        Ok(Ok(())) => Ok(()),
        Ok(Err(e)) => Err(Error::Busy(format!("{what} do not answer: {e}"))),
        Err(_) => Err(Error::Busy(format!("{what} do not answer within {} s", PATIENCE.as_secs()))),
    }
}

fn ok(warnings: &[String]) -> Health {
    Health { status: "ok".into(), version: env!("CARGO_PKG_VERSION").into(), warnings: warnings.to_vec() }
}
