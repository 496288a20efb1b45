//! HTTP: all routes in one list, one file per resource; `http/problem.rs` is the only place of status codes of errors.
//!
//! Handlers meet the workers only in the records, the queue and the store.

mod archive;
mod batches;
mod change;
pub mod connection;
mod defects;
mod docs;
mod document;
mod doors;
mod events;
mod extract;
mod files;
mod form;
mod growing;
mod guard;
mod health;
mod ingest;
mod jobs;
mod lists;
mod live;
mod measure;
mod metrics;
mod page;
mod problem;
mod recording;
mod residual;
mod retention;
mod rigs;
mod runs;
mod session;
mod squeeze;
mod stored;
mod tokens;
mod uploads;
mod worker;

use std::sync::Arc;

pub use change::Changes;
pub use doors::Rates;
pub use worker::{WorkerApp, worker_router};

use axum::http::Uri;
use axum::response::Json;
use axum::routing::get;
use axum::{Router, middleware};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tower_http::catch_panic::CatchPanicLayer;
use utoipa::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::auth::Auth;
use crate::batches::Batches;
use crate::config::Config;
use crate::defects::Defects;
use crate::disk::DiskGuard;
use crate::error::Error;
use crate::live::Live;
use crate::queue::Queue;
use crate::runs::Runs;
use crate::store::Store;
use crate::uploads::Uploads;

/// What every handler may use.
#[derive(Clone)]
pub struct App {
    /// Who may come in.
    pub auth: Auth,
    /// How often.
    pub rates: Arc<Rates>,
    /// The records.
    pub runs: Runs,
    /// The jobs.
    pub queue: Queue,
    /// Reprocessing in bulk.
    pub batches: Batches,
    /// Defects over all runs.
    pub defects: Defects,
    /// What changed between jobs.
    pub changes: Changes,
    /// The files.
    pub store: Store,
    /// Limits and folders.
    pub config: Arc<Config>,
    /// Uploads in pieces.
    pub uploads: Uploads,
    /// Live streams.
    pub live: Live,
    /// One permit per live stream that may be open at the same time.
    pub streams: Arc<Semaphore>,
    /// Room on the disk.
    pub disk: DiskGuard,
    /// One permit per upload that may come in at the same time.
    pub arrivals: Arc<Semaphore>,
    /// What this machine does not allow, in words for people.
    pub warnings: Arc<Vec<String>>,
    /// The server shall stop: streams end.
    pub stop: CancellationToken,
}

/// The part of the OpenAPI document that is not a route.
#[derive(OpenApi)]
#[openapi(info(
    title = "Stria",
    description = "Runs of robots come in, jobs process them, products go out. Lengths are mm, times RFC 3339 in UTC, \
                   errors RFC 9457 problem documents. Lists page by `cursor` and `limit`. A creating request with an \
                   `Idempotency-Key` can be repeated: the same key with the same content is the same result.",
    license(name = "Apache-2.0")
))]
struct Document;

/// Every route of the API. What is not here does not exist.
fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::with_openapi(Document::openapi())
        .routes(routes!(runs::list_runs, ingest::create_run))
        .merge(tus_routes())
        .routes(routes!(live::list_streams))
        .routes(routes!(live::open_stream, live::post_stream))
        .routes(routes!(runs::get_run, runs::change_run, runs::delete_run))
        .routes(routes!(runs::get_source))
        .routes(routes!(runs::create_job))
        .routes(routes!(jobs::list_jobs))
        .routes(routes!(jobs::get_job))
        .routes(routes!(jobs::cancel_job))
        .routes(routes!(jobs::retry_job))
        .routes(routes!(events::stream_events))
        .routes(routes!(jobs::get_log))
        .routes(routes!(jobs::list_products))
        .routes(routes!(jobs::get_product))
        .routes(routes!(recording::get_recording))
        .routes(routes!(recording::get_segment))
        .routes(routes!(measure::get_profile))
        .routes(routes!(measure::get_trajectory))
        .routes(routes!(growing::get_tile))
        .routes(routes!(growing::get_live_frame))
        .routes(routes!(archive::get_archive))
        .routes(routes!(rigs::list_rigs, rigs::create_rig))
        .routes(routes!(rigs::get_rig))
        .routes(routes!(lists::list_assets))
        .routes(routes!(lists::list_recipes))
        .routes(routes!(lists::list_options))
        .routes(routes!(lists::list_workers))
        .routes(routes!(defects::list_defects))
        .routes(routes!(defects::get_csv))
        .routes(routes!(defects::get_geojson))
        .routes(routes!(defects::get_defect, defects::change_defect))
        .routes(routes!(defects::get_history))
        .routes(routes!(change::get_change))
        .routes(routes!(change::get_difference))
        .routes(routes!(residual::get_residual))
        .routes(routes!(retention::preview_retention, retention::store_retention, retention::forget_retention))
        .routes(routes!(retention::get_pin, retention::pin_run, retention::unpin_run))
        .routes(routes!(batches::list_batches, batches::create_batch))
        .routes(routes!(batches::get_batch))
        .routes(routes!(batches::list_results))
        .routes(routes!(batches::pause_batch))
        .routes(routes!(batches::resume_batch))
        .routes(routes!(batches::cancel_batch))
        .routes(routes!(session::get_session, session::create_session, session::delete_session))
        .routes(routes!(tokens::list_tokens, tokens::create_token))
        .routes(routes!(tokens::revoke_token))
        .routes(routes!(tokens::rotate_token))
        .routes(routes!(tokens::list_audit))
        .routes(routes!(health::get_livez))
        .routes(routes!(health::get_readyz))
        .routes(routes!(metrics::get_metrics))
}

/// Uploads in pieces speak tus, in every answer.
fn tus_routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(uploads::create_upload, uploads::describe_uploads))
        .routes(routes!(
            uploads::get_upload,
            uploads::send_piece,
            uploads::send_piece_by_post,
            uploads::delete_upload,
            uploads::describe_upload
        ))
        .layer(middleware::from_fn(uploads::speak_tus))
}

/// The OpenAPI document, from the same list.
pub fn openapi() -> utoipa::openapi::OpenApi {
    let mut document = routes().to_openapi();
    // The router's way to say "the rest of the path" is not OpenAPI's.
    let paths = std::mem::take(&mut document.paths.paths);
    document.paths.paths = paths.into_iter().map(|(path, item)| (path.replace("{*", "{"), item)).collect();
    document::add_doors(&mut document);
    document
}

/// The whole server: API, page, viewer, and what guards them.
pub fn router(app: App) -> Router {
    let document = Arc::new(openapi());
    let (api, _) = routes().split_for_parts();
    let limits = app.config.requests.clone();
    api.route("/api/openapi.json", get(move || async move { Json(document.as_ref().clone()) }))
        .route("/api/docs", get(docs::get_docs))
        .route("/api", axum::routing::any(unknown))
        .route("/api/", axum::routing::any(unknown))
        .route("/api/{*rest}", axum::routing::any(unknown))
        .route("/login", get(session::get_login).post(session::post_login))
        .merge(page::routes())
        .method_not_allowed_fallback(wrong_method)
        .layer(middleware::from_fn(squeeze::squeeze_json))
        .layer(middleware::from_fn_with_state(app.clone(), guard::answer_in_time))
        .layer(middleware::from_fn_with_state(app.clone(), doors::guard))
        .layer(middleware::from_fn_with_state(app.clone(), guard::own_origin_only))
        .layer(middleware::map_response(guard::safe_headers))
        .layer(middleware::from_fn(guard::named))
        .layer(CatchPanicLayer::custom(problem::after_panic))
        .layer(axum::extract::DefaultBodyLimit::max(limits.small_body_bytes))
        .with_state(app)
}

async fn unknown(uri: Uri) -> Error {
    Error::NotFound { what: "address", id: uri.path().into() }
}

async fn wrong_method(method: axum::http::Method, uri: Uri) -> problem::Refusal {
    problem::Refusal::Method { method: method.to_string(), path: uri.path().into() }
}
