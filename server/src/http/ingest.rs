//! `POST /api/runs`: a whole run in one request, as a form or as a raw body, streamed to disk.

use axum::extract::{FromRequest, Multipart, Request, State};
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE, EXPECT, LOCATION};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::App;
use super::form::{self, Body, Fields};
use crate::error::{Error, Result};
use crate::incoming::{Incoming, Receiver};
use crate::wire::{Problem, Run};

/// What a form weighs beside its file, bytes.
const FORM_BYTES: u64 = 16 * 1024 * 1024;

/// Longest idempotency key, characters.
pub(super) const MAX_KEY_CHARS: usize = 255;

/// A whole run in one request.
///
/// Either a form (`multipart/form-data`) with the part `file` and the fields below, or the file itself as the body,
/// with the fields as query parameters and the file's name as `filename`. `rig` is the name of a stored rig, or a rig
/// file in TOML or JSON (in a form also as a file). Fields that stand before the file are checked before it is read.
#[utoipa::path(post, path = "/api/runs", tag = "runs",
    params(
        ("Idempotency-Key" = Option<String>, Header, description = "Makes the request safe to repeat"),
        ("asset" = Option<String>, Query, description = "The pipe or wall (with a raw body; in a form a field)"),
        ("rig" = Option<String>, Query, description = "A stored rig's name, or a rig file"),
        ("recipe" = Option<String>, Query, description = "A built-in recipe's name, or TOML; the default when absent"),
        ("chainage_mm" = Option<f64>, Query, description = "Chainage of the first frame, mm; 0 when absent"),
        ("direction" = Option<String>, Query, description = "forward (default) or backward"),
        ("recorded_at" = Option<String>, Query, description = "RFC 3339; when absent, the time of arrival"),
        ("fps" = Option<f64>, Query, description = "Frames a second, where the source does not say"),
        ("sha256" = Option<String>, Query, description = "SHA-256 of the file in hex, to be checked"),
        ("filename" = Option<String>, Query, description = "The file's own name"),
        ("note" = Option<String>, Query, description = "Words for people")),
    request_body(content((String = "multipart/form-data"), (Vec<u8> = "application/octet-stream"))),
    responses((status = 201, body = Run, description = "Headers `Stria-Run` and `Stria-Job` name what was made"),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 408, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 422, body = Problem, content_type = "application/problem+json", description = "The key was used before with other content"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
        (status = 507, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn create_run(State(app): State<App>, request: Request) -> Response {
    let (parts, body) = request.into_parts();
    let body = Body::new(body);
    let waits_for_word = parts.headers.contains_key(EXPECT);
    match receive(&app, &parts, body.clone()).await {
        Ok(response) => response,
        Err(error) => {
            // Whoever is still sending would take a closed connection for a broken one and never read the answer;
            // who asked first (Expect: 100-continue) has not begun to send.
            if !waits_for_word {
                tokio::spawn(body.drain(form::DRAIN_TIME));
            }
            error.into_response()
        }
    }
}

async fn receive(app: &App, parts: &axum::http::request::Parts, body: Body) -> Result<Response> {
    let limit_bytes = app.config.requests.upload_bytes;
    let key = idempotency_key(&parts.headers)?;
    let announced = parts.headers.get(CONTENT_LENGTH).and_then(|v| v.to_str().ok()?.parse::<u64>().ok());
    let is_form = content_type_of(&parts.headers).starts_with("multipart/form-data");
    let most = if is_form { limit_bytes.saturating_add(FORM_BYTES) } else { limit_bytes };
    if announced.is_some_and(|bytes| bytes > most) {
        return Err(Error::TooLarge { limit_bytes });
    }
    app.disk.check(announced.unwrap_or(0))?;
    let Ok(_permit) = app.arrivals.clone().try_acquire_owned() else {
        let most = app.config.requests.uploads_at_once;
        return Err(Error::Busy(format!("{most} uploads are coming in already; come back in a moment")));
    };
    let (fields, incoming) =
        if is_form { receive_form(app, parts, body).await? } else { receive_raw(app, parts, body).await? };
    let new = fields.into_new_run(&incoming)?;
    let created = app.runs.create(new, incoming, key.as_deref()).await?;
    let (run, job) = (&created.made.id, &created.made.job.id);
    let names = vec![("stria-run", run.clone()), ("stria-job", job.clone())];
    Ok(self::created(&format!("/api/runs/{run}"), created.repeated, names, &created.made))
}

async fn receive_raw(app: &App, parts: &axum::http::request::Parts, mut body: Body) -> Result<(Fields, Incoming)> {
    let pairs = axum::extract::Query::<Vec<(String, String)>>::try_from_uri(&parts.uri)
        .map_err(|e| Error::field("query", e.body_text(), "fields as name=value"))?;
    let mut fields = Fields::default();
    for (name, value) in pairs.0 {
        fields.take(app, &name, &value).await?;
    }
    fields.check_complete()?;
    let mut receiver = Receiver::start(&app.config.places.incoming(), app.config.requests.upload_bytes);
    while let Some(chunk) = body.chunk(app.config.requests.sender_silence).await? {
        receiver.push(chunk).await?;
    }
    Ok((fields, receiver.finish().await?))
}

async fn receive_form(app: &App, parts: &axum::http::request::Parts, body: Body) -> Result<(Fields, Incoming)> {
    let limits = &app.config.requests;
    let mut form = Multipart::from_request(form_request(parts, &body), &())
        .await
        .map_err(|e| Error::field("Content-Type", e.body_text(), "multipart/form-data with a boundary"))?;
    let (mut fields, mut incoming) = (Fields::default(), None);
    for _ in 0..=limits.form_fields {
        body.expect_head();
        let next = tokio::time::timeout(limits.sender_silence, form.next_field()).await;
        let Some(mut part) = next.map_err(|_| Error::SenderSilent)?.map_err(broken_form)? else {
            let incoming =
                incoming.ok_or_else(|| Error::field("file", "the form has no file", "one part named 'file'"))?;
            fields.check_complete()?;
            return Ok((fields, incoming));
        };
        body.expect_data();
        let name = part.name().unwrap_or_default().to_string();
        if name != "file" {
            let mut text = Vec::new();
            while let Some(chunk) = next_chunk(&mut part, limits.sender_silence).await? {
                if text.len() + chunk.len() > limits.small_body_bytes {
                    let found = format!("the field '{name}' is longer than {} bytes", limits.small_body_bytes);
                    return Err(Error::field(&name, found, "a short text"));
                }
                text.extend_from_slice(&chunk);
            }
            let text = String::from_utf8(text).map_err(|_| Error::field(&name, "it is not UTF-8 text", "text"))?;
            fields.take(app, &name, &text).await?;
            continue;
        }
        if incoming.is_some() {
            return Err(Error::field("file", "the form has more than one file", "one part named 'file'"));
        }
        fields.file_name(form::given_name(part.headers()).as_deref());
        let mut receiver = Receiver::start(&app.config.places.incoming(), limits.upload_bytes);
        while let Some(chunk) = next_chunk(&mut part, limits.sender_silence).await? {
            receiver.push(chunk).await?;
        }
        incoming = Some(receiver.finish().await?);
    }
    Err(Error::field("form", "the form has too many fields", format!("at most {}", limits.form_fields)))
}

/// The request as axum's form reader takes it; its body is read through ours.
fn form_request(parts: &axum::http::request::Parts, body: &Body) -> Request {
    let mut request = Request::new(axum::body::Body::from_stream(body.clone()));
    *request.headers_mut() = parts.headers.clone();
    // The limit of small bodies is not for uploads, whose size is counted as they come.
    axum::extract::DefaultBodyLimit::disable().apply(&mut request);
    request
}

async fn next_chunk(
    part: &mut axum::extract::multipart::Field<'_>,
    silence: std::time::Duration,
) -> Result<Option<bytes::Bytes>> {
    let next = tokio::time::timeout(silence, part.chunk()).await;
    next.map_err(|_| Error::SenderSilent)?.map_err(broken_form)
}

fn broken_form(error: axum::extract::multipart::MultipartError) -> Error {
    // What our own body said comes back wrapped; a sender who left is not a sender of nonsense.
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(&error);
    while let Some(here) = cause {
        if here.downcast_ref::<super::form::BodyBroken>().is_some() {
            return Error::SenderSilent;
        }
        cause = here.source();
    }
    Error::field("form", format!("the form cannot be read: {}", error.body_text()), "multipart/form-data (RFC 7578)")
}

/// The request's idempotency key.
pub(super) fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>> {
    let Some(value) = headers.get("idempotency-key") else { return Ok(None) };
    let text = value.to_str().unwrap_or_default().trim();
    if text.is_empty() || text.chars().count() > MAX_KEY_CHARS {
        let expected = format!("1 to {MAX_KEY_CHARS} visible ASCII characters");
        return Err(Error::field("Idempotency-Key", "the key cannot be used", expected));
    }
    Ok(Some(text.into()))
}

/// The type of a body, without its parameters' case.
pub(super) fn content_type_of(headers: &HeaderMap) -> &str {
    headers.get(CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default()
}

/// The answer to a creating request.
pub(super) fn created(
    location: &str,
    repeated: bool,
    names: Vec<(&'static str, String)>,
    body: &impl Serialize,
) -> Response {
    let mut response = (StatusCode::CREATED, axum::Json(body)).into_response();
    let repeated = repeated.then(|| ("idempotency-replayed", "true".to_string()));
    let pairs = names.into_iter().chain(repeated).chain([(LOCATION.as_str(), location.to_string())]);
    for (name, value) in pairs {
        if let (Ok(name), Ok(value)) = (name.parse::<axum::http::HeaderName>(), value.parse()) {
            response.headers_mut().insert(name, value);
        }
    }
    response
}
