//! JSON in gzip for those who take it: a list of runs shrinks to a tenth, which a thin link feels.

use axum::body::{Body, HttpBody, to_bytes};
use axum::extract::Request;
use axum::http::header::{CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE, ETAG, VARY};
use axum::http::{HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::page::{compressed, takes};
use crate::error::Error;

/// Smaller answers gain nothing.
const LEAST_BYTES: u64 = 1024;
/// Larger ones are no lists: they go as they are.
const MOST_BYTES: u64 = 16 << 20;

/// Squeezes what handlers answer from memory. Stored files have ETags and ranges of their own and stay as they are.
pub(super) async fn squeeze_json(request: Request, next: Next) -> Response {
    let wanted = takes("gzip", request.headers());
    let response = next.run(request).await;
    if !wanted || !worth_it(&response) {
        return response;
    }
    let (mut head, body) = response.into_parts();
    let Ok(bytes) = to_bytes(body, MOST_BYTES as usize).await else {
        return Error::Internal("an answer ended early".into()).into_response();
    };
    let gzip = tokio::task::spawn_blocking({
        let bytes = bytes.clone();
        move || compressed(&bytes)
    });
    let Ok(Ok(squeezed)) = gzip.await else { return Response::from_parts(head, Body::from(bytes)) };
    head.headers.remove(CONTENT_LENGTH);
    head.headers.insert(CONTENT_ENCODING, HeaderValue::from_static("gzip"));
    head.headers.append(VARY, HeaderValue::from_static("accept-encoding"));
    Response::from_parts(head, Body::from(squeezed))
}

fn worth_it(response: &Response) -> bool {
    let headers = response.headers();
    let json = headers.get(CONTENT_TYPE).is_some_and(|kind| kind.as_bytes().starts_with(b"application/json"));
    let as_it_is = headers.contains_key(ETAG) || headers.contains_key(CONTENT_ENCODING);
    let bytes = response.body().size_hint().exact().unwrap_or(0);
    response.status() == StatusCode::OK && json && !as_it_is && (LEAST_BYTES..=MOST_BYTES).contains(&bytes)
}
