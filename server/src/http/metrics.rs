//! `GET /metrics`, as Prometheus reads it.

use axum::extract::State;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};

use super::App;
use crate::disk::DiskGuard;
use crate::error::Result;
use crate::metrics::metrics;
use crate::queue::Queue;
use crate::wire::time::now_ms;

/// The kind of text that Prometheus asks for.
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Queue depth and age by priority, job times by stage, attempts, leases lost, bytes, answers, disk.
#[utoipa::path(get, path = "/metrics", tag = "health",
    responses((status = 200, content_type = "application/openmetrics-text", body = String)))]
pub(super) async fn get_metrics(State(app): State<App>) -> Result<Response> {
    tell(&app.queue, &app.disk).await
}

/// What this process counted, and what the records know of the queue.
pub(super) async fn tell(queue: &Queue, disk: &DiskGuard) -> Result<Response> {
    let text = metrics().text(&queue.depths().await?, disk.room(), now_ms())?;
    Ok(([(CONTENT_TYPE, OPEN_METRICS)], text).into_response())
}
