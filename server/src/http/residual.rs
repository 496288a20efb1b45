//! The residual map as tiles, cut from `residual.tif` when they are asked for.

use axum::extract::State;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, ETAG};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use stria_core::export::residual_tif::NAME;
use stria_core::export::residual_tiles::ResidualTiles;

use super::App;
use super::extract::Path;
use super::files::{IMMUTABLE, none_matches};
use super::stored::StoredFileReader;
use crate::error::{Error, Result};
use crate::wire::Problem;

/// What is asked for.
#[derive(Clone, Copy)]
enum Part {
    Index,
    Tile { level: usize, column: usize, row: usize },
}

impl Part {
    /// Reads `tiles.json` and `depth/{level}/{column}_{row}.png`.
    fn read(name: &str) -> Option<Part> {
        if name == "tiles.json" {
            return Some(Part::Index);
        }
        let (level, place) = name.strip_prefix("depth/")?.strip_suffix(".png")?.split_once('/')?;
        let (column, row) = place.split_once('_')?;
        Some(Part::Tile { level: level.parse().ok()?, column: column.parse().ok()?, row: row.parse().ok()? })
    }
}

/// How far the surface lies from its undamaged shape, as a pyramid like that of `tiles/`: `tiles.json`,
/// `depth/{level}/{column}_{row}.png`.
#[utoipa::path(get, path = "/api/jobs/{job}/residual/{*name}", tag = "defects",
    params(("job" = String, Path, description = "The job"), ("name" = String, Path, description = "tiles.json, or a tile")),
    responses((status = 200, content_type = "application/octet-stream", body = Vec<u8>),
        (status = 304, description = "Not changed"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_residual(
    State(app): State<App>,
    Path((job, name)): Path<(String, String)>,
    headers: HeaderMap,
) -> Result<Response> {
    let file = app.runs.product(&job, NAME).await?;
    let missing = || Error::NotFound { what: "tile", id: name.clone() };
    let part = Part::read(&name).ok_or_else(missing)?;
    // The file never changes, and neither does what is cut from it.
    let etag = format!("\"{}-{}\"", file.facts.sha256, name.replace(['/', '"'], "-"));
    let kept = [(CACHE_CONTROL, IMMUTABLE.to_string()), (ETAG, etag.clone())];
    if none_matches(&headers, &etag) {
        return Ok((StatusCode::NOT_MODIFIED, kept).into_response());
    }
    let reader = StoredFileReader::new(app.store.clone(), file.key, file.facts.bytes);
    let cut = tokio::task::spawn_blocking(move || -> stria_core::Result<Option<(&'static str, Vec<u8>)>> {
        let mut tiles = ResidualTiles::open(reader)?;
        match part {
            Part::Index => {
                let text = serde_json::to_vec(&tiles.index()?);
                let text = text.map_err(|e| stria_core::Error::internal("tiles.json", e))?;
                Ok(Some(("application/json", text)))
            }
            Part::Tile { level, column, row } => Ok(tiles.tile(level, column, row)?.map(|png| ("image/png", png))),
        }
    });
    let cut = cut.await.map_err(|e| Error::Internal(format!("cutting a tile stopped: {e}")))?;
    let (kind, bytes) = cut.map_err(|e| Error::Internal(format!("{NAME} of job {job}: {e}")))?.ok_or_else(missing)?;
    Ok((kept, [(CONTENT_TYPE, kind)], bytes).into_response())
}

#[cfg(test)]
mod tests {
    use super::Part;

    #[test]
    fn only_tiles_names_are_tiles() {
        assert!(matches!(Part::read("tiles.json"), Some(Part::Index)));
        assert!(matches!(Part::read("depth/1/2_3.png"), Some(Part::Tile { level: 1, column: 2, row: 3 })));
        for name in
            ["", "depth/1/2.png", "depth/1/-2_3.png", "texture/1/2_3.jpg", "depth/../1/2_3.png", "depth/1/2_3.jpg"]
        {
            assert!(Part::read(name).is_none(), "{name}");
        }
    }
}
