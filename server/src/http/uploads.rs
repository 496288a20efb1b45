//! `/api/uploads`: the tus 1.0.0 protocol (creation, creation-with-upload, creation-defer-length, checksum, expiration,
//! termination). What an upload is, is `uploads.rs`'s; here are the headers and the status codes.

mod checksum;

use std::time::Duration;

use axum::extract::{Request, State};
use axum::http::header::{CACHE_CONTROL, CONTENT_LENGTH, LOCATION};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::checksum::{CHECKSUMS, Checksum};
use super::App;
use super::extract::Path;
use super::form::{self, Body, Fields};
use super::ingest::{content_type_of, idempotency_key};
use super::problem::Refusal;
use crate::error::{Error, Result};
use crate::uploads::{Held, NewUpload, Receiving, TAKEN_OVER, Upload};
use crate::wire::Problem;

pub(super) const VERSION: &str = "1.0.0";
const EXTENSIONS: &str = "creation,creation-with-upload,creation-defer-length,checksum,expiration,termination";
const PIECE: &str = "application/offset+octet-stream";

/// A request that shall end takes in what lies in its connection's buffers: until nothing comes for so long …
const LAST_CHUNK: Duration = Duration::from_millis(20);
/// … and no longer than this.
const LAST_CHUNKS: Duration = Duration::from_millis(300);

/// Longest metadata, bytes: a rig file travels in it.
const METADATA_BYTES: usize = 64 * 1024;

/// What an upload of a page's own library says beside our fields; it tells nothing new.
const KNOWN_AND_IGNORED: [&str; 4] = ["filetype", "type", "relativePath", "contentType"];

/// Every answer says which protocol it is; a request in another version is refused.
pub(super) async fn speak_tus(request: Request, next: Next) -> Response {
    let asked = request.headers().get("tus-resumable").and_then(|v| v.to_str().ok()).map(String::from);
    let needs_no_version = request.method() == axum::http::Method::OPTIONS;
    let mut response = match asked.as_deref() {
        Some(VERSION) => next.run(request).await,
        _ if needs_no_version => next.run(request).await,
        other => {
            let found = format!("Tus-Resumable is {:?}", other.unwrap_or("not there"));
            let mut refusal = Refusal::Version { found, expected: VERSION }.into_response();
            refusal.headers_mut().insert("tus-version", HeaderValue::from_static(VERSION));
            refusal
        }
    };
    response.headers_mut().insert("tus-resumable", HeaderValue::from_static(VERSION));
    response
}

/// What this server speaks.
#[utoipa::path(options, path = "/api/uploads", tag = "uploads",
    responses((status = 204, description = "Tus-Version, Tus-Extension, Tus-Max-Size, Tus-Checksum-Algorithm")))]
pub(super) async fn describe_uploads(State(app): State<App>) -> Response {
    abilities(&app)
}

/// What this server speaks, asked at an upload.
#[utoipa::path(options, path = "/api/uploads/{upload}", tag = "uploads",
    params(("upload" = String, Path, description = "The upload")),
    responses((status = 204, description = "Tus-Version, Tus-Extension, Tus-Max-Size, Tus-Checksum-Algorithm")))]
pub(super) async fn describe_upload(State(app): State<App>, Path(_upload): Path<String>) -> Response {
    abilities(&app)
}

fn abilities(app: &App) -> Response {
    let headers = [
        ("tus-version", VERSION.to_string()),
        ("tus-extension", EXTENSIONS.into()),
        ("tus-checksum-algorithm", CHECKSUMS.into()),
        ("tus-max-size", app.uploads.limits().upload_bytes.to_string()),
    ];
    (StatusCode::NO_CONTENT, headers_of(headers)).into_response()
}

/// Begin an upload in pieces (tus 1.0.0).
///
/// `Upload-Metadata` carries the run's fields, base64 each: `filename`, `asset`, `rig` (a stored rig's name, or a rig
/// file), `recipe`, `chainage_mm`, `direction`, `recorded_at`, `fps`, `note`, `sha256` of the whole file. They are
/// checked now, before any byte is sent. The body may be the first piece.
#[utoipa::path(post, path = "/api/uploads", tag = "uploads",
    params(("Tus-Resumable" = String, Header, description = "1.0.0"),
        ("Upload-Length" = Option<u64>, Header, description = "Size of the file, bytes"),
        ("Upload-Defer-Length" = Option<u8>, Header, description = "1: the size follows later"),
        ("Upload-Metadata" = String, Header, description = "The run's fields"),
        ("Upload-Checksum" = Option<String>, Header, description = "Of the piece in the body: sha1 or sha256, base64"),
        ("Idempotency-Key" = Option<String>, Header, description = "Makes the request safe to repeat")),
    request_body(content((Vec<u8> = "application/offset+octet-stream"))),
    responses((status = 201, description = "Location, Upload-Offset, Upload-Expires; Stria-Run, Stria-Job once whole"),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 412, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 460, body = Problem, content_type = "application/problem+json"),
        (status = 507, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn create_upload(State(app): State<App>, request: Request) -> Response {
    let task = app.uploads.tasks().clone();
    apart(&task, request, |parts, body| create(app, parts, body)).await
}

/// How far an upload is. A request that is still writing to it is stopped first, so that the offset is final.
#[utoipa::path(head, path = "/api/uploads/{upload}", tag = "uploads",
    params(("upload" = String, Path, description = "The upload"),
        ("Tus-Resumable" = String, Header, description = "1.0.0")),
    responses((status = 200, description = "Upload-Offset, Upload-Length or Upload-Defer-Length, Upload-Metadata, \
            Upload-Expires; Stria-Run and Stria-Job once whole"),
        (status = 404), (status = 410), (status = 423), (status = 460)))]
pub(super) async fn get_upload(State(app): State<App>, Path(id): Path<String>) -> Response {
    let task = app.uploads.tasks().clone();
    in_task(&task, async move { tell(&app, &id).await }).await.unwrap_or_else(Error::into_response)
}

async fn tell(app: &App, id: &str) -> Result<Response> {
    let mut held = app.uploads.take(id).await?;
    held.finish_if_whole().await?;
    let upload = held.upload();
    let mut headers = progress_headers(&upload);
    match upload.length_bytes {
        Some(bytes) => headers.push(("upload-length", bytes.to_string())),
        None => headers.push(("upload-defer-length", "1".into())),
    }
    headers.push(("upload-metadata", upload.metadata));
    Ok((StatusCode::OK, [(CACHE_CONTROL, "no-store")], headers_of(headers)).into_response())
}

/// Send the next piece of an upload.
///
/// What arrives is kept, also when the connection is cut (but for a piece with a checksum, which counts as a whole). The
/// piece that completes the file makes the run and its job: `Stria-Run` and `Stria-Job` name them.
#[utoipa::path(patch, path = "/api/uploads/{upload}", tag = "uploads",
    params(("upload" = String, Path, description = "The upload"),
        ("Tus-Resumable" = String, Header, description = "1.0.0"),
        ("Upload-Offset" = u64, Header, description = "Where the piece begins: the upload's offset"),
        ("Upload-Length" = Option<u64>, Header, description = "Size of the file, where it was deferred"),
        ("Upload-Checksum" = Option<String>, Header, description = "Of the piece: sha1 or sha256, base64")),
    request_body(content((Vec<u8> = "application/offset+octet-stream"))),
    responses((status = 204, description = "Upload-Offset, Upload-Expires; Stria-Run, Stria-Job once whole"),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 409, body = Problem, content_type = "application/problem+json"),
        (status = 410, body = Problem, content_type = "application/problem+json"),
        (status = 413, body = Problem, content_type = "application/problem+json"),
        (status = 415, body = Problem, content_type = "application/problem+json"),
        (status = 423, body = Problem, content_type = "application/problem+json"),
        (status = 460, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
        (status = 507, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn send_piece(State(app): State<App>, Path(id): Path<String>, request: Request) -> Response {
    let task = app.uploads.tasks().clone();
    apart(&task, request, |parts, body| async move { patch(&app, &id, &parts, body).await }).await
}

/// A request of a client that can only POST: `X-HTTP-Method-Override` names the method that it means.
#[utoipa::path(post, path = "/api/uploads/{upload}", tag = "uploads",
    params(("upload" = String, Path, description = "The upload"),
        ("X-HTTP-Method-Override" = String, Header, description = "PATCH, HEAD or DELETE")),
    responses((status = 204), (status = 405, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn send_piece_by_post(
    State(app): State<App>,
    Path(id): Path<String>,
    request: Request,
) -> Result<Response> {
    match text(request.headers(), "x-http-method-override") {
        Some("PATCH") => Ok(send_piece(State(app), Path(id), request).await),
        Some("HEAD") => Ok(get_upload(State(app), Path(id)).await),
        Some("DELETE") => delete_upload(State(app), Path(id)).await,
        _ => Ok(Refusal::Method { method: "POST".into(), path: request.uri().path().into() }.into_response()),
    }
}

/// Give an upload up. A run that it became stays.
#[utoipa::path(delete, path = "/api/uploads/{upload}", tag = "uploads",
    params(("upload" = String, Path, description = "The upload"),
        ("Tus-Resumable" = String, Header, description = "1.0.0")),
    responses((status = 204),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 410, body = Problem, content_type = "application/problem+json"),
        (status = 423, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn delete_upload(State(app): State<App>, Path(id): Path<String>) -> Result<Response> {
    let task = app.uploads.tasks().clone();
    in_task(&task, async move { app.uploads.take(&id).await?.give_up().await }).await?;
    Ok(StatusCode::NO_CONTENT.into_response())
}

/// Works in a task of its own: when the connection dies, what was begun is brought to its end.
async fn in_task<T: Send + 'static>(
    tasks: &TaskTracker,
    work: impl Future<Output = Result<T>> + Send + 'static,
) -> Result<T> {
    let done = tasks.spawn(work).await;
    done.unwrap_or_else(|e| Err(Error::Internal(format!("an upload's task stopped: {e}"))))
}

/// As [`in_task`], with a body: what arrived of it is still made durable.
async fn apart<F>(tasks: &TaskTracker, request: Request, work: impl FnOnce(Parts, Body) -> F) -> Response
where
    F: Future<Output = Result<Response>> + Send + 'static,
{
    let waits_for_word = request.headers().contains_key(axum::http::header::EXPECT);
    let (parts, body) = request.into_parts();
    let body = Body::new(body);
    let response = match in_task(tasks, work(parts, body.clone())).await {
        Ok(response) => response,
        Err(Error::SenderSilent) => Refusal::CutOff.into_response(),
        Err(error) => error.into_response(),
    };
    // Whoever is still sending would take a closed connection for a broken one and never read the answer.
    if !waits_for_word {
        tokio::spawn(body.drain(form::DRAIN_TIME));
    }
    response
}

async fn create(app: App, parts: Parts, body: Body) -> Result<Response> {
    let headers = &parts.headers;
    let length_bytes = match (text(headers, "upload-length"), text(headers, "upload-defer-length")) {
        (Some(length), None) => Some(number("Upload-Length", length)?),
        (None, Some("1")) => None,
        (length, deferred) => {
            let found = format!("Upload-Length is {length:?}, Upload-Defer-Length is {deferred:?}");
            return Err(Error::field("Upload-Length", found, "a size in bytes, or Upload-Defer-Length: 1"));
        }
    };
    let metadata = match headers.get("upload-metadata").map(HeaderValue::to_str) {
        None => "",
        Some(Ok(metadata)) => metadata,
        Some(Err(_)) => {
            let expected = "ASCII: each value is in base64";
            return Err(Error::field("Upload-Metadata", "Upload-Metadata cannot be read", expected));
        }
    };
    let (run, sha256) = read_metadata(&app, metadata).await?.into_announced_run()?;
    let has_piece = content_type_of(headers) == PIECE;
    let checksum = Checksum::announced(text(headers, "upload-checksum"))?;
    let new = NewUpload { length_bytes, metadata: metadata.into(), run, sha256 };
    if let (Some(length), Some(piece)) = (length_bytes, content_length(headers))
        && piece > length
        && has_piece
    {
        return Err(Error::TooLarge { limit_bytes: length });
    }
    // What is too large for ever is said before what is too large for now.
    app.uploads.check_length(length_bytes)?;
    app.disk.check(length_bytes.unwrap_or(0))?;
    let made = app.uploads.create(new, idempotency_key(headers)?.as_deref()).await?;
    let location = [(LOCATION, format!("/api/uploads/{}", made.id))];
    match if has_piece { first_piece(&app, &made.id, body, checksum).await } else { Ok(made) } {
        Ok(upload) => Ok((StatusCode::CREATED, location, headers_of(progress_headers(&upload))).into_response()),
        // The upload is there all the same, and can be gone on with.
        Err(Error::SenderSilent) => Ok((location, Refusal::CutOff).into_response()),
        Err(error) => Ok((location, error).into_response()),
    }
}

async fn first_piece(app: &App, id: &str, body: Body, checksum: Option<Checksum>) -> Result<Upload> {
    let mut held = app.uploads.take(id).await?;
    // A creation that is repeated brings its first piece again.
    if held.upload().offset_bytes == 0 {
        receive(app, &mut held, body, checksum).await?;
    }
    held.finish_if_whole().await?;
    Ok(held.upload())
}

async fn patch(app: &App, id: &str, parts: &Parts, body: Body) -> Result<Response> {
    let headers = &parts.headers;
    let found = content_type_of(headers);
    if found != PIECE {
        return Ok(Refusal::MediaType { found: found.into(), expected: PIECE }.into_response());
    }
    let offset = text(headers, "upload-offset")
        .ok_or_else(|| Error::field("Upload-Offset", "Upload-Offset is missing", "the offset, bytes"))?;
    let offset = number("Upload-Offset", offset)?;
    let checksum = Checksum::announced(text(headers, "upload-checksum"))?;
    let length = text(headers, "upload-length").map(|length| number("Upload-Length", length)).transpose()?;
    let mut held = app.uploads.take(id).await?;
    let upload = held.upload();
    if offset != upload.offset_bytes {
        let mut answer = Error::Conflict(format!(
            "Upload-Offset is {offset}; expected {}, which is how far the upload is",
            upload.offset_bytes
        ))
        .into_response();
        answer.headers_mut().extend(headers_of([("upload-offset", upload.offset_bytes.to_string())]));
        return Ok(answer);
    }
    if let Some(length) = length {
        held.declare_length(length).await?;
    }
    if let (Some(length), Some(piece)) = (held.upload().length_bytes, content_length(headers))
        && offset.saturating_add(piece) > length
    {
        return Err(Error::TooLarge { limit_bytes: length });
    }
    match held.upload().became {
        None => receive(app, &mut held, body, checksum).await?,
        // Its last answer was lost, and it is asked again with nothing more to send.
        Some(_) => nothing_more(app, body, offset).await?,
    }
    held.finish_if_whole().await?;
    Ok((StatusCode::NO_CONTENT, headers_of(progress_headers(&held.upload()))).into_response())
}

async fn nothing_more(app: &App, mut body: Body, length_bytes: u64) -> Result<()> {
    match body.chunk(app.config.requests.sender_silence).await? {
        Some(chunk) if !chunk.is_empty() => Err(Error::TooLarge { limit_bytes: length_bytes }),
        _ => Ok(()),
    }
}

/// Takes a piece in, as far as it comes.
async fn receive(app: &App, held: &mut Held, body: Body, mut checksum: Option<Checksum>) -> Result<()> {
    app.disk.check(0)?;
    let Ok(_permit) = app.arrivals.clone().try_acquire_owned() else {
        let most = app.config.requests.uploads_at_once;
        return Err(Error::Busy(format!("{most} uploads are coming in already; come back in a moment")));
    };
    let wanted = held.wanted_by_another().clone();
    let mut receiving = held.receive(checksum.is_some()).await?;
    let arrived = take_in(app, &wanted, body, &mut receiving, &mut checksum).await;
    let (kept, ended) = match (arrived, checksum) {
        // After a failed write nothing is sure but what was promised before.
        (Err(error), _) => (Err(error), Ok(())),
        // A piece with a checksum counts as a whole.
        (Ok(Err(ended)), Some(_)) => (Err(ended), Ok(())),
        (Ok(ended), None) => (receiving.commit().await, ended),
        (Ok(Ok(())), Some(checksum)) => match checksum.check() {
            Ok(()) => (receiving.commit().await, Ok(())),
            Err(wrong) => (Err(wrong), Ok(())),
        },
    };
    if let Err(error) = kept {
        receiving.drop_the_rest().await;
        return Err(error);
    }
    ended
}

/// Takes in what comes; says how that ended. The outer error is one of ours.
async fn take_in(
    app: &App,
    wanted: &CancellationToken,
    mut body: Body,
    receiving: &mut Receiving<'_>,
    checksum: &mut Option<Checksum>,
) -> Result<Result<()>> {
    let mut asked_to_end = None;
    loop {
        let patience = match &asked_to_end {
            None => app.config.requests.sender_silence,
            Some((reason, deadline)) if Instant::now() >= *deadline => return Ok(Err(Error::from(reason))),
            Some(_) => LAST_CHUNK,
        };
        let chunk = tokio::select! {
            biased;
            () = wanted.cancelled(), if asked_to_end.is_none() => {
                asked_to_end = Some((Asked::TakenOver, Instant::now() + LAST_CHUNKS));
                continue;
            }
            () = app.stop.cancelled(), if asked_to_end.is_none() => {
                asked_to_end = Some((Asked::Stop, Instant::now() + LAST_CHUNKS));
                continue;
            }
            chunk = body.chunk(patience) => chunk,
        };
        match (chunk, &asked_to_end) {
            (Ok(Some(chunk)), _) => {
                if let Some(checksum) = checksum {
                    checksum.update(&chunk);
                }
                receiving.push(chunk).await?;
            }
            (Ok(None), _) => return Ok(Ok(())),
            (Err(_), Some((reason, _))) => return Ok(Err(Error::from(reason))),
            (Err(error), None) => return Ok(Err(error)),
        }
    }
}

/// Why a request that still receives shall end.
enum Asked {
    TakenOver,
    Stop,
}

impl From<&Asked> for Error {
    fn from(asked: &Asked) -> Error {
        match asked {
            Asked::TakenOver => Error::Locked(TAKEN_OVER.into()),
            Asked::Stop => Error::Busy("the server stops; come back in a moment".into()),
        }
    }
}

/// The run's fields from `Upload-Metadata`.
async fn read_metadata(app: &App, metadata: &str) -> Result<Fields> {
    if metadata.len() > METADATA_BYTES {
        let found = format!("Upload-Metadata has {} bytes", metadata.len());
        return Err(Error::field("Upload-Metadata", found, format!("at most {METADATA_BYTES} bytes")));
    }
    let mut fields = Fields::default();
    let mut fallback_name = None;
    for pair in metadata.split(',').map(str::trim).filter(|pair| !pair.is_empty()) {
        let (name, encoded) = pair.split_once(' ').unwrap_or((pair, ""));
        let decoded = BASE64_STANDARD.decode(encoded.trim()).ok().and_then(|bytes| String::from_utf8(bytes).ok());
        let value = decoded.ok_or_else(|| {
            Error::field(name, format!("Upload-Metadata: the value of '{name}' cannot be read"), "UTF-8 in base64")
        })?;
        match name {
            "name" => fallback_name = Some(value),
            ignored if KNOWN_AND_IGNORED.contains(&ignored) => {}
            _ => fields.take(app, name, &value).await?,
        }
    }
    fields.file_name(fallback_name.as_deref());
    Ok(fields)
}

/// What every answer about an upload says.
fn progress_headers(upload: &Upload) -> Vec<(&'static str, String)> {
    let mut headers = vec![("upload-offset", upload.offset_bytes.to_string())];
    match &upload.became {
        Some((run, job)) => headers.extend([("stria-run", run.clone()), ("stria-job", job.clone())]),
        None => headers.extend(http_date(upload.expires_ms).map(|date| ("upload-expires", date))),
    }
    headers
}

fn http_date(ms: i64) -> Option<String> {
    let time = jiff::Timestamp::from_millisecond(ms).ok()?;
    jiff::fmt::rfc2822::DateTimePrinter::new().timestamp_to_rfc9110_string(&time).ok()
}

fn headers_of(pairs: impl IntoIterator<Item = (&'static str, String)>) -> HeaderMap {
    // What was taken from a header may stand in one.
    let pair = |(name, value): (&'static str, String)| {
        Some((axum::http::HeaderName::from_static(name), HeaderValue::from_str(&value).ok()?))
    };
    pairs.into_iter().filter_map(pair).collect()
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name).and_then(|v| v.to_str().ok())
}

fn content_length(headers: &HeaderMap) -> Option<u64> {
    text(headers, CONTENT_LENGTH.as_str())?.parse().ok()
}

fn number(name: &str, value: &str) -> Result<u64> {
    let digits = value.bytes().all(|b| b.is_ascii_digit()).then(|| value.parse().ok()).flatten();
    digits.ok_or_else(|| Error::field(name, format!("{name} is {value:?}"), "a whole number of bytes"))
}
