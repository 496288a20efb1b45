//! What `stria work` says of itself, where it was told to listen: whether it lives, whether it can work, its counts.

use std::net::SocketAddr;
use std::sync::Arc;

use axum::Router;
use axum::extract::{Request, State};
use axum::http::HeaderMap;
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use tokio_util::sync::CancellationToken;

use super::problem::Refusal;
use super::{doors, guard, health, metrics, unknown};
use crate::auth::{Auth, Scope};
use crate::db::Db;
use crate::disk::DiskGuard;
use crate::error::Result;
use crate::queue::Queue;
use crate::store::Store;

/// What a worker can tell of.
#[derive(Clone)]
pub struct WorkerApp {
    /// Where it listens; who asks from another machine brings a token.
    pub listen: SocketAddr,
    /// Who may come in.
    pub auth: Auth,
    /// The records.
    pub db: Db,
    /// The jobs.
    pub queue: Queue,
    /// The files.
    pub store: Store,
    /// Room on the disk.
    pub disk: DiskGuard,
    /// What this machine does not allow.
    pub warnings: Arc<Vec<String>>,
    /// The worker shall stop.
    pub stop: CancellationToken,
}

/// `/livez`, `/readyz` and `/metrics` of a worker.
pub fn worker_router(app: WorkerApp) -> Router {
    Router::new()
        .route("/livez", get(health::get_livez))
        .route("/readyz", get(get_readyz))
        .route("/metrics", get(get_metrics))
        .fallback(unknown)
        .layer(middleware::from_fn_with_state(app.clone(), guard_metrics))
        .layer(middleware::map_response(guard::safe_headers))
        .layer(middleware::from_fn(guard::named))
        .with_state(app)
}

async fn get_readyz(State(app): State<WorkerApp>) -> Result<Response> {
    let (db, store) = (app.db.ping(), app.store.ping());
    health::ready(&app.stop, db, store, &app.disk, &app.warnings).await
}

async fn get_metrics(State(app): State<WorkerApp>) -> Result<Response> {
    metrics::tell(&app.queue, &app.disk).await
}

/// The counts are for whoever is on this machine; from another one they need a token that may read, as at a server.
async fn guard_metrics(State(app): State<WorkerApp>, request: Request, next: Next) -> Response {
    let open = matches!(request.uri().path(), "/livez" | "/readyz");
    match admit(&app, open, request.headers().clone()).await {
        Ok(None) => next.run(request).await,
        Ok(Some(refusal)) => refusal.into_response(),
        Err(error) => error.into_response(),
    }
}

async fn admit(app: &WorkerApp, open: bool, headers: HeaderMap) -> Result<Option<Refusal>> {
    guard::check_host(&headers, None, app.listen.ip().is_loopback())?;
    if open || app.listen.ip().is_loopback() {
        return Ok(None);
    }
    let token = doors::bearer_of(&headers);
    let visitor = match &token {
        Some(token) => app.auth.by_token(token).await?,
        None => None,
    };
    Ok(match visitor {
        None => Some(Refusal::Unknown { said: token.is_some() }),
        Some(visitor) if !visitor.scopes.allow(Scope::Read) => Some(Refusal::Scope { needed: Scope::Read }),
        Some(_) => None,
    })
}
