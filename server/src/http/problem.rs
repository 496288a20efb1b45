//! Errors → HTTP: the only place where an error gets a status code.

use std::any::Any;

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, RETRY_AFTER, WWW_AUTHENTICATE};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};

use crate::auth::Scope;
use crate::error::Error;
use crate::wire::Problem;

/// Refusals that only HTTP knows.
#[derive(Debug)]
pub(super) enum Refusal {
    /// The path exists, but not with this method.
    Method { method: String, path: String },
    /// The body is not of the kind that the route reads.
    MediaType { found: String, expected: &'static str },
    /// The asked range lies outside the file.
    Range { asked: String, bytes: u64 },
    /// The protocol's version is another.
    Version { found: String, expected: &'static str },
    /// The answer did not begin in time.
    TooSlow,
    /// Nobody that we know asks; `said` where a token or a session came along.
    Unknown { said: bool },
    /// Whoever asks may not do this.
    Scope { needed: Scope },
    /// Whoever asks came too often.
    TooMany { retry_after_s: u64 },
    /// The connection went silent, or broke, in the middle of a piece of an upload; what arrived is kept.
    CutOff,
}

/// What tus 1.0.0 answers to a wrong checksum.
fn checksum_mismatch() -> StatusCode {
    StatusCode::from_u16(460).unwrap_or(StatusCode::BAD_REQUEST)
}

impl IntoResponse for Error {
    fn into_response(self) -> Response {
        let problem = problem_of(self);
        let status = problem.status.and_then(|code| StatusCode::from_u16(code).ok());
        let status = status.unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = send(status, &problem);
        if status == StatusCode::SERVICE_UNAVAILABLE {
            response.headers_mut().insert(RETRY_AFTER, HeaderValue::from_static("5"));
        }
        response
    }
}

/// What a client is told of an error, over HTTP or a WebSocket.
pub(super) fn problem_of(error: Error) -> Problem {
    let detail = error.to_string();
    if error.is_storage_full() {
        tracing::error!(%detail, "the disk is full");
        return problem(StatusCode::INSUFFICIENT_STORAGE, "storage-full", "The server's disk is full", detail, true);
    }
    if error.is_passing() {
        tracing::warn!(%detail, "the records or the store do not answer");
        return problem_of(Error::Busy("the server's records or files do not answer; come back in a moment".into()));
    }
    match error {
        Error::NotFound { .. } => {
            problem(StatusCode::NOT_FOUND, "not-found", "Nothing of that name exists", detail, false)
        }
        Error::Input { field, expected, .. } => Problem {
            field,
            expected,
            ..problem(StatusCode::BAD_REQUEST, "bad-input", "The request cannot be used", detail, false)
        },
        Error::Conflict(_) => {
            problem(StatusCode::CONFLICT, "conflict", "Its present state does not allow it", detail, false)
        }
        Error::Changed(_) => {
            problem(StatusCode::PRECONDITION_FAILED, "changed", "Somebody else has changed it", detail, false)
        }
        Error::Locked(_) => problem(StatusCode::LOCKED, "locked", "Another request is writing to it", detail, true),
        Error::Gone(_) => problem(StatusCode::GONE, "gone", "It is no more", detail, false),
        Error::Checksum(_) => problem(checksum_mismatch(), "checksum-mismatch", "Not what was announced", detail, true),
        Error::KeyReused(_) => {
            let title = "The idempotency key belongs to another request";
            problem(StatusCode::UNPROCESSABLE_ENTITY, "key-reused", title, detail, false)
        }
        Error::TooLarge { .. } => {
            problem(StatusCode::PAYLOAD_TOO_LARGE, "too-large", "The request is too large", detail, false)
        }
        Error::SenderSilent => {
            problem(StatusCode::REQUEST_TIMEOUT, "incomplete", "The request did not arrive whole", detail, true)
        }
        Error::Busy(_) => problem(StatusCode::SERVICE_UNAVAILABLE, "busy", "The server is busy", detail, true),
        Error::Foreign(_) => {
            problem(StatusCode::FORBIDDEN, "foreign-origin", "The request comes from elsewhere", detail, false)
        }
        Error::NoRoom(_)
        | Error::LeaseLost
        | Error::Records(_)
        | Error::Store(_)
        | Error::Io { .. }
        | Error::Internal(_) => {
            // The cause is for the log; what leaves the server names no folder of it.
            tracing::error!(%detail, "a request failed");
            let detail = "the server failed; its log says why".into();
            problem(StatusCode::INTERNAL_SERVER_ERROR, "internal", "The server failed", detail, true)
        }
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        match self {
            Refusal::Method { method, path } => {
                let detail = format!("{path} cannot be asked with {method}");
                answer(StatusCode::METHOD_NOT_ALLOWED, "wrong-method", "The method does not fit", detail, false)
            }
            Refusal::MediaType { found, expected } => {
                let status = StatusCode::UNSUPPORTED_MEDIA_TYPE;
                let detail = format!("the body's type is {found:?}");
                let mut problem = problem(status, "wrong-media-type", "The body's type does not fit", detail, false);
                problem.field = Some("Content-Type".into());
                problem.expected = Some(expected.into());
                send(status, &problem)
            }
            Refusal::Range { asked, bytes } => {
                let detail = format!("the range {asked:?} lies outside the file's {bytes} bytes");
                let mut response = answer(
                    StatusCode::RANGE_NOT_SATISFIABLE,
                    "no-such-range",
                    "There are no such bytes",
                    detail,
                    false,
                );
                if let Ok(value) = HeaderValue::from_str(&format!("bytes */{bytes}")) {
                    response.headers_mut().insert(axum::http::header::CONTENT_RANGE, value);
                }
                response
            }
            Refusal::Version { found, expected } => {
                let status = StatusCode::PRECONDITION_FAILED;
                let mut problem = problem(status, "wrong-version", "The protocol's version does not fit", found, false);
                problem.expected = Some(expected.into());
                send(status, &problem)
            }
            Refusal::Unknown { said } => {
                let detail = match said {
                    true => "the token or session is wrong, revoked or over",
                    false => "the request brings no token",
                };
                let status = StatusCode::UNAUTHORIZED;
                let mut problem = problem(status, "unknown", "Nobody that this server knows", detail.into(), false);
                problem.field = Some("Authorization".into());
                problem.expected =
                    Some("Bearer and a token (`stria token create`), or a browser that logged in".into());
                let mut response = send(status, &problem);
                response.headers_mut().insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer realm=\"stria\""));
                response
            }
            Refusal::Scope { needed } => {
                let detail = format!("this needs the scope '{}'", needed.as_str());
                answer(StatusCode::FORBIDDEN, "scope", "The token may not do this", detail, false)
            }
            Refusal::TooMany { retry_after_s } => {
                let status = StatusCode::TOO_MANY_REQUESTS;
                let detail = format!("more requests than this server takes from one; come back in {retry_after_s} s");
                let mut response = answer(status, "too-many", "Too many requests", detail, true);
                response.headers_mut().insert(RETRY_AFTER, HeaderValue::from(retry_after_s));
                response
            }
            Refusal::CutOff => {
                // Not 408: clients of tus take every 4xx but 409 and 423 for the end.
                let detail = "the sender went silent; ask how far the upload is, and go on there".into();
                answer(StatusCode::SERVICE_UNAVAILABLE, "cut-off", "The piece did not arrive whole", detail, true)
            }
            Refusal::TooSlow => {
                let detail = "the server did not answer in time".into();
                answer(StatusCode::SERVICE_UNAVAILABLE, "too-slow", "The server is busy", detail, true)
            }
        }
    }
}

/// After a panic in a handler: that request fails, the server goes on.
pub(super) fn after_panic(panic: Box<dyn Any + Send>) -> Response {
    let words = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
    tracing::error!(panic = words.unwrap_or("(no words)"), "a handler panicked");
    internal()
}

fn internal() -> Response {
    let detail = "the server failed; its log says why".into();
    answer(StatusCode::INTERNAL_SERVER_ERROR, "internal", "The server failed", detail, true)
}

fn answer(status: StatusCode, kind: &str, title: &str, detail: String, retryable: bool) -> Response {
    send(status, &problem(status, kind, title, detail, retryable))
}

fn problem(status: StatusCode, kind: &str, title: &str, detail: String, retryable: bool) -> Problem {
    Problem {
        kind: format!("urn:stria:{kind}"),
        title: title.into(),
        status: Some(status.as_u16()),
        detail,
        field: None,
        expected: None,
        retryable,
    }
}

fn send(status: StatusCode, problem: &Problem) -> Response {
    let body = serde_json::to_string(problem).unwrap_or_else(|_| "{}".into());
    let headers = [(CONTENT_TYPE, "application/problem+json"), (CACHE_CONTROL, "no-store")];
    (status, headers, body).into_response()
}
