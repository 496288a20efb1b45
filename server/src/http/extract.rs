//! Axum's extractors with problem documents for what they refuse.

use axum::extract::{FromRequest, FromRequestParts, Request};
use axum::http::StatusCode;
use axum::http::header::IF_MATCH;
use axum::http::request::Parts;
use axum::response::{IntoResponse, Response};
use serde::de::DeserializeOwned;

use super::problem::Refusal;
use crate::config::RequestLimits;
use crate::error::Error;
use crate::runs::Page;

/// Parts of the path.
pub(super) struct Path<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Send> FromRequestParts<S> for Path<T> {
    type Rejection = Error;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Error> {
        match axum::extract::Path::from_request_parts(parts, state).await {
            Ok(axum::extract::Path(value)) => Ok(Path(value)),
            // A part that does not parse (a letter where a number stands) names nothing.
            Err(_) => Err(Error::NotFound { what: "address", id: parts.uri.path().into() }),
        }
    }
}

/// The query.
pub(super) struct Query<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequestParts<S> for Query<T> {
    type Rejection = Error;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Error> {
        match axum::extract::Query::from_request_parts(parts, state).await {
            Ok(axum::extract::Query(value)) => Ok(Query(value)),
            Err(e) => Err(Error::field("query", e.body_text(), "the parameters that /api/openapi.json lists")),
        }
    }
}

/// The versions that `If-Match` names; `None` where any will do.
pub(super) struct IfMatch(pub Option<Vec<String>>);

impl<S: Send + Sync> FromRequestParts<S> for IfMatch {
    type Rejection = Error;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Error> {
        let said: Vec<&str> = parts.headers.get_all(IF_MATCH).iter().filter_map(|v| v.to_str().ok()).collect();
        let each = || said.iter().flat_map(|line| line.split(',')).map(str::trim);
        if !parts.headers.contains_key(IF_MATCH) || each().any(|v| v == "*") {
            return Ok(IfMatch(None));
        }
        Ok(IfMatch(Some(each().map(|v| v.trim_matches('"').to_string()).collect())))
    }
}

/// A JSON body.
pub(super) struct Json<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequest<S> for Json<T> {
    type Rejection = Response;

    async fn from_request(request: Request, state: &S) -> Result<Self, Response> {
        use axum::extract::rejection::JsonRejection as No;
        let found = super::ingest::content_type_of(request.headers()).to_string();
        match axum::Json::from_request(request, state).await {
            Ok(axum::Json(value)) => Ok(Json(value)),
            Err(No::MissingJsonContentType(_)) => {
                Err(Refusal::MediaType { found, expected: "application/json" }.into_response())
            }
            Err(No::BytesRejection(e)) if e.status() == StatusCode::PAYLOAD_TOO_LARGE => {
                Err(Error::TooLarge { limit_bytes: RequestLimits::SMALL_BODY_BYTES as u64 }.into_response())
            }
            Err(e) => {
                let expected = "a body as /api/openapi.json describes it";
                Err(Error::field("body", e.body_text(), expected).into_response())
            }
        }
    }
}

/// Which part of a list.
#[derive(serde::Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct PageQuery {
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most items, 1 to 1000; 50 when nothing is said.
    limit: Option<u64>,
}

impl PageQuery {
    pub(super) fn page(self) -> Result<Page, Error> {
        Page::new(self.cursor, self.limit)
    }
}
