//! Assets, recipes, their options, workers.

use axum::extract::State;
use axum::response::{IntoResponse, Response};

use super::App;
use super::extract::{PageQuery, Query};
use crate::error::Result;
use crate::runs;
use crate::wire::{AssetPage, Problem, Recipe, RecipeOption, Worker};

/// Assets by name.
#[utoipa::path(get, path = "/api/assets", tag = "assets", params(PageQuery),
    responses((status = 200, body = AssetPage), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_assets(State(app): State<App>, Query(query): Query<PageQuery>) -> Result<Response> {
    Ok(axum::Json(app.runs.assets(&query.page()?).await?).into_response())
}

/// The built-in recipes.
#[utoipa::path(get, path = "/api/recipes", tag = "recipes", responses((status = 200, body = Vec<Recipe>)))]
pub(super) async fn list_recipes() -> Response {
    axum::Json(runs::built_in_recipes()).into_response()
}

/// Every key of a recipe with its unit, default and range.
#[utoipa::path(get, path = "/api/options", tag = "recipes", responses((status = 200, body = Vec<RecipeOption>)))]
pub(super) async fn list_options() -> Response {
    axum::Json(runs::options()).into_response()
}

/// The worker processes and what they are at.
#[utoipa::path(get, path = "/api/workers", tag = "workers", responses((status = 200, body = Vec<Worker>)))]
pub(super) async fn list_workers(State(app): State<App>) -> Result<Response> {
    Ok(axum::Json(app.runs.workers().await?).into_response())
}
