//! `GET /metrics`, as Prometheus reads it.

use axum::extract::State;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};

use super::App;
use crate::error::Result;
use crate::metrics::metrics;
use crate::wire::time::now_ms;

/// The kind of text that Prometheus asks for.
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Queue depth and age by priority, job times by stage, attempts, leases lost, bytes, answers, disk.
#[utoipa::path(get, path = "/metrics", tag = "health",
    responses((status = 200, content_type = "application/openmetrics-text", body = String)))]
pub(super) async fn get_metrics(State(app): State<App>) -> Result<Response> {
    let text = metrics().text(&app.queue.depths().await?, app.disk.room(), now_ms())?;
    Ok(([(CONTENT_TYPE, OPEN_METRICS)], text).into_response())
}
