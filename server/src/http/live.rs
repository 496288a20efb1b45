//! `/api/live`: frames of a robot that walks now, by WebSocket or as the body of a POST. What a stream is, is `live.rs`'s.

use std::time::Duration;

use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code};
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::http::request::Parts;
use axum::response::{IntoResponse, Json, Response};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use stria_core::source::frame_file::still_format;
use stria_core::source::segments::SegmentKind;
use tokio::time::Instant;

use super::App;
use super::extract::{PageQuery, Path, Query};
use super::form::{Body, Fields};
use crate::error::{Error, Result};
use crate::live::{Connection, Hello, StreamState};
use crate::mjpeg::JpegSplitter;
use crate::wire::time::to_text;
use crate::wire::{LiveEnded, LiveStream, LiveStreamPage, Problem};

/// Bytes of a binary message before its image: number, time, checksum.
const FRAME_HEAD_BYTES: usize = 20;

/// So often a connection that brings nothing is asked whether it is still there.
const PING_EVERY: Duration = Duration::from_secs(10);

/// How long a sender that was told an error is given to hear it.
const LAST_WORDS: Duration = Duration::from_secs(2);

/// A transport stream is packets of so many bytes, each with this first byte.
const TS_PACKET_BYTES: usize = 188;
const TS_SYNC: u8 = 0x47;
/// So many packets in a row tell a transport stream.
const TS_PACKETS: usize = 3;

/// The live streams, those opened last first.
#[utoipa::path(get, path = "/api/live", tag = "live", params(PageQuery),
    responses((status = 200, body = LiveStreamPage), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_streams(
    State(app): State<App>,
    Query(query): Query<PageQuery>,
) -> Result<Json<LiveStreamPage>> {
    let (items, next_cursor) = app.live.list(&query.page()?).await?;
    Ok(Json(LiveStreamPage { items: items.into_iter().map(shown).collect(), next_cursor }))
}

fn shown(state: StreamState) -> LiveStream {
    LiveStream {
        stream: state.name,
        run: state.run,
        job: state.job,
        kind: state.kind,
        open: state.open,
        frames: state.frames,
        bytes: state.bytes,
        missing: state.missing,
        opened_at: to_text(state.opened_ms),
    }
}

/// Frames of a robot that walks now, by WebSocket.
///
/// Text messages are JSON, binary ones frames: sequence number (u64), capture time in ns since 1970 (i64), CRC-32C of the
/// image (u32), the image (JPEG, PNG or WebP), little endian. The client begins with `hello` (`asset`, `rig`, `recipe`,
/// `fps`, `chainage_mm`, `direction`, `note`, `resume`), is told `welcome` (`run`, `job`, `next_seq`, `credit`), sends frames
/// from `next_seq` on, at most `credit` ahead of the last `ack` (`durable_seq`, `credit`), and ends with `end`, answered by
/// `closed` (`frames`, `missing`). An `error` (`title`, `detail`, `retryable`) comes before the connection is closed.
#[utoipa::path(get, path = "/api/live/{stream}", tag = "live",
    params(("stream" = String, Path, description = "The stream's name, such as the robot's")),
    responses((status = 101, description = "A WebSocket"),
        (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn open_stream(
    State(app): State<App>,
    Path(stream): Path<String>,
    upgrade: std::result::Result<WebSocketUpgrade, axum::extract::ws::rejection::WebSocketUpgradeRejection>,
) -> Result<Response> {
    let upgrade = upgrade.map_err(|e| Error::field("Upgrade", e.body_text(), "a WebSocket (RFC 6455)"))?;
    let most = app.config.live.frame_bytes + FRAME_HEAD_BYTES;
    let upgrade = upgrade.max_message_size(most).max_frame_size(most);
    Ok(upgrade.on_upgrade(move |socket| async move {
        let mut talk = Talk { app, socket };
        if let Err(error) = talk.run(&stream).await {
            tracing::info!(stream, %error, "a live connection ended");
            talk.say_error(error).await;
        }
    }))
}

/// What a client may say in JSON.
#[derive(Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
enum Said {
    Hello(Box<SaidHello>),
    End {},
}

#[derive(Deserialize)]
struct SaidHello {
    asset: String,
    rig: serde_json::Value,
    recipe: Option<String>,
    fps: Option<f64>,
    chainage_mm: Option<f64>,
    direction: Option<String>,
    note: Option<String>,
    #[serde(default)]
    resume: bool,
}

/// What the server says in JSON.
#[derive(Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
enum Say<'a> {
    Welcome { run: &'a str, job: &'a str, next_seq: u64, credit: u64 },
    Ack { durable_seq: u64, credit: u64 },
    Error { title: &'a str, detail: String, retryable: bool },
    Closed { frames: u64, missing: &'a [[u64; 2]] },
}

/// One WebSocket.
struct Talk {
    app: App,
    socket: WebSocket,
}

impl Talk {
    async fn run(&mut self, stream: &str) -> Result<()> {
        self.app.disk.check(0)?;
        let _place = self.app.streams.clone().try_acquire_owned().map_err(|_| too_many(&self.app))?;
        let hello = self.hello(stream).await?;
        let mut connection = self.app.live.open(hello).await?;
        let (run, job) = (connection.run().to_string(), connection.job().to_string());
        let credit = self.app.config.live.credit;
        self.say(&Say::Welcome { run: &run, job: &job, next_seq: connection.next_seq(), credit }).await?;
        let ended = self.frames(&mut connection).await;
        // What arrived is kept, whatever ended it.
        let kept = connection.flush().await;
        ended.and(kept)
    }

    async fn hello(&mut self, stream: &str) -> Result<Hello> {
        let first = tokio::time::timeout(self.app.config.requests.head_timeout, self.next_message()).await;
        let text = match first.map_err(|_| Error::SenderSilent)?? {
            Some(Message::Text(text)) => text,
            _ => return Err(Error::field("hello", "the first message is none", "{\"type\":\"hello\", …} as text")),
        };
        let said: Said = serde_json::from_str(&text).map_err(|e| unreadable(&e))?;
        let Said::Hello(hello) = said else {
            return Err(Error::field("hello", "the first message is another", "{\"type\":\"hello\", …}"));
        };
        let rig = match hello.rig {
            serde_json::Value::String(text) => text,
            object => object.to_string(),
        };
        let mut fields = Fields::default();
        let number = |value: Option<f64>| value.map(|v| v.to_string());
        let given = [
            ("asset", Some(hello.asset)),
            ("rig", Some(rig)),
            ("recipe", hello.recipe),
            ("fps", number(hello.fps)),
            ("chainage_mm", number(hello.chainage_mm)),
            ("direction", hello.direction),
            ("note", hello.note),
            ("filename", Some(format!("live-{stream}.frames"))),
        ];
        for (name, value) in given {
            if let Some(value) = value {
                fields.take(&self.app, name, &value).await?;
            }
        }
        let (run, _) = fields.into_announced_run()?;
        Ok(Hello { stream: stream.into(), kind: SegmentKind::Frames, run, resume: hello.resume })
    }

    async fn frames(&mut self, connection: &mut Connection) -> Result<()> {
        let limits = self.app.config.live.clone();
        let (wanted, stop) = (connection.wanted_by_another().clone(), self.app.stop.clone());
        let mut heard_at = Instant::now();
        let mut ping_at = heard_at + PING_EVERY;
        // Whoever sends what is durable already has not heard of it.
        let mut owed_at: Option<Instant> = None;
        loop {
            let due_at = [connection.due_at(), owed_at].into_iter().flatten().fold(ping_at, Instant::min);
            let message = tokio::select! {
                biased;
                () = wanted.cancelled() => return Err(Error::Locked("another connection has taken the stream over".into())),
                () = stop.cancelled() => return Err(Error::Busy("the server stops; come back in a moment".into())),
                () = tokio::time::sleep_until(due_at) => None,
                message = self.next_message() => Some(message?),
            };
            match message {
                Some(None) => return Err(Error::SenderSilent),
                Some(Some(Message::Binary(frame))) => {
                    heard_at = Instant::now();
                    if !take_frame(connection, frame)? {
                        owed_at.get_or_insert(heard_at + limits.ack_every);
                    }
                }
                Some(Some(Message::Text(text))) => match serde_json::from_str(&text).map_err(|e| unreadable(&e))? {
                    Said::End {} => {
                        connection.end().await?;
                        let closed = Say::Closed { frames: connection.frames(), missing: connection.missing() };
                        return self.say(&closed).await;
                    }
                    Said::Hello(_) => return Err(Error::field("hello", "a second hello", "frames, or end")),
                },
                Some(Some(_)) => heard_at = Instant::now(),
                None => {}
            }
            let owed = owed_at.is_some_and(|at| at <= Instant::now());
            if connection.is_due() || owed {
                connection.flush().await?;
                self.acknowledge(connection).await?;
                owed_at = None;
            }
            let now = Instant::now();
            if now >= ping_at {
                if now.duration_since(heard_at) > limits.silence {
                    return Err(Error::SenderSilent);
                }
                connection.beat().await?;
                self.acknowledge(connection).await?;
                self.send(Message::Ping(Bytes::new())).await?;
                ping_at = now + PING_EVERY;
            }
        }
    }

    async fn acknowledge(&mut self, connection: &Connection) -> Result<()> {
        let credit = self.app.config.live.credit;
        match connection.durable_next_seq().checked_sub(1) {
            Some(durable_seq) => self.say(&Say::Ack { durable_seq, credit }).await,
            None => Ok(()),
        }
    }

    async fn next_message(&mut self) -> Result<Option<Message>> {
        match self.socket.recv().await {
            None | Some(Ok(Message::Close(_))) => Ok(None),
            Some(Ok(message)) => Ok(Some(message)),
            Some(Err(e)) => {
                let words = e.to_string();
                // The one fault that the sender can mend.
                if words.contains("too long") || words.contains("too big") || words.contains("capacity") {
                    return Err(Error::TooLarge { limit_bytes: self.app.config.live.frame_bytes as u64 });
                }
                Ok(None)
            }
        }
    }

    async fn say(&mut self, what: &Say<'_>) -> Result<()> {
        let text = serde_json::to_string(what).map_err(|e| Error::Internal(format!("a message is not JSON: {e}")))?;
        self.send(Message::Text(text.into())).await
    }

    async fn send(&mut self, message: Message) -> Result<()> {
        let sent = tokio::time::timeout(self.app.config.requests.receiver_silence, self.socket.send(message)).await;
        match sent {
            Ok(Ok(())) => Ok(()),
            _ => Err(Error::SenderSilent),
        }
    }

    async fn say_error(&mut self, error: Error) {
        let problem = super::problem::problem_of(error);
        let said = Say::Error { title: &problem.title, detail: problem.detail, retryable: problem.retryable };
        // Whoever is gone hears nothing; that is no fault any more.
        if self.say(&said).await.is_ok() {
            let code = if problem.retryable { close_code::AGAIN } else { close_code::POLICY };
            let reason = problem.title.as_str().into();
            let _ = self.send(Message::Close(Some(CloseFrame { code, reason }))).await;
            // A connection that is closed on data that nobody read is reset, and what was said last is lost.
            let gone = async { while let Ok(Some(_)) = self.next_message().await {} };
            let _ = tokio::time::timeout(LAST_WORDS, gone).await;
            tokio::time::sleep(LAST_WORDS / 4).await;
        }
    }
}

fn unreadable(error: &serde_json::Error) -> Error {
    Error::field("message", format!("a message cannot be read: {error}"), "hello, frames, end, as the contract says")
}

fn too_many(app: &App) -> Error {
    Error::Busy(format!("{} streams are open already; come back in a moment", app.config.live.streams_at_once))
}

/// A binary message → a frame of the stream; false where it was there already.
fn take_frame(connection: &mut Connection, message: Bytes) -> Result<bool> {
    let short = || {
        let found = format!("a frame of {} bytes", message.len());
        Error::field("frame", found, format!("{FRAME_HEAD_BYTES} bytes of head and an image"))
    };
    let (seq, rest) = message.split_first_chunk::<8>().ok_or_else(short)?;
    let (time_ns, rest) = rest.split_first_chunk::<8>().ok_or_else(short)?;
    let (crc, image) = rest.split_first_chunk::<4>().ok_or_else(short)?;
    let (seq, crc) = (u64::from_le_bytes(*seq), u32::from_le_bytes(*crc));
    if crc32c::crc32c(image) != crc {
        return Err(Error::Checksum(format!("frame {seq} arrived with another CRC-32C than announced; send it again")));
    }
    check_number(seq)?;
    if still_format(image).is_none() {
        return Err(Error::field("frame", format!("frame {seq} begins as no image"), "a whole JPEG, PNG or WebP file"));
    }
    let time_ns = i64::from_le_bytes(*time_ns);
    Ok(connection.push_frame(seq, time_ns, message.slice(FRAME_HEAD_BYTES..), crc))
}

/// The records keep numbers as signed ones.
fn check_number(seq: u64) -> Result<()> {
    const MOST: u64 = i64::MAX as u64 - 1;
    if seq <= MOST { Ok(()) } else { Err(Error::field("seq", format!("seq is {seq}"), format!("0 to {MOST}"))) }
}

/// Frames of a robot that walks now, as the body of one request.
///
/// MJPEG (multipart with any boundary, or bare images one after the other) or MPEG-TS (H.264, H.265), told apart by their
/// bytes. The run's fields are query parameters. A part's `X-Timestamp` (s since 1970) and `X-Seq` are honoured; without
/// them a frame counts from its arrival. A body that ends closes the run; a connection that breaks leaves it open for a
/// while, and the next request of the stream goes on with it (unless `resume=false`).
#[utoipa::path(post, path = "/api/live/{stream}", tag = "live",
    params(("stream" = String, Path, description = "The stream's name, such as the robot's"),
        ("asset" = String, Query, description = "The pipe or wall"),
        ("rig" = String, Query, description = "A stored rig's name, or a rig file"),
        ("recipe" = Option<String>, Query, description = "A built-in recipe's name, or TOML"),
        ("chainage_mm" = Option<f64>, Query, description = "Chainage of the first frame, mm"),
        ("direction" = Option<String>, Query, description = "forward (default) or backward"),
        ("recorded_at" = Option<String>, Query, description = "RFC 3339; when absent, the first frame's time"),
        ("note" = Option<String>, Query, description = "Words for people"),
        ("resume" = Option<bool>, Query, description = "Go on with an open run; true when absent")),
    request_body(content((Vec<u8> = "multipart/x-mixed-replace"), (Vec<u8> = "video/mp2t"), (Vec<u8> = "image/jpeg"))),
    responses((status = 200, body = LiveEnded),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 408, body = Problem, content_type = "application/problem+json"),
        (status = 423, body = Problem, content_type = "application/problem+json"),
        (status = 503, body = Problem, content_type = "application/problem+json"),
        (status = 507, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn post_stream(State(app): State<App>, Path(stream): Path<String>, request: Request) -> Response {
    let (parts, body) = request.into_parts();
    let body = Body::new(body);
    // In a task of its own: when the connection dies, what arrived is still kept.
    let receiving = tokio::spawn({
        let body = body.clone();
        async move { receive(&app, stream, &parts, body).await }
    });
    let result = receiving.await.unwrap_or_else(|e| Err(Error::Internal(format!("a stream's task stopped: {e}"))));
    match result {
        Ok(ended) => (StatusCode::OK, Json(ended)).into_response(),
        Err(error) => {
            // A robot that hears no answer while it sends, such as ffmpeg, notices when the connection ends, and comes again.
            tokio::spawn(body.drain(LAST_WORDS));
            error.into_response()
        }
    }
}

async fn receive(app: &App, stream: String, parts: &Parts, body: Body) -> Result<LiveEnded> {
    app.disk.check(0)?;
    let _place = app.streams.clone().try_acquire_owned().map_err(|_| too_many(app))?;
    let pairs = axum::extract::Query::<Vec<(String, String)>>::try_from_uri(&parts.uri)
        .map_err(|e| Error::field("query", e.body_text(), "fields as name=value"))?;
    let (mut fields, mut resume) = (Fields::default(), true);
    for (name, value) in pairs.0 {
        match (name.as_str(), value.as_str()) {
            ("resume", "true" | "false") => resume = value == "true",
            ("resume", _) => return Err(Error::field("resume", format!("resume is {value:?}"), "true or false")),
            _ => fields.take(app, &name, &value).await?,
        }
    }
    fields.check_complete()?;
    let mut incoming = Incoming { body, silence: app.config.live.silence };
    let (kind, first) = incoming.tell_kind().await?;
    fields.file_name(Some(&format!("live-{stream}.{}", kind.extension())));
    let (run, _) = fields.into_announced_run()?;
    let mut connection = app.live.open(Hello { stream, kind, run, resume }).await?;
    let ended = take_all(app, &mut connection, &mut incoming, kind, first).await;
    // What arrived is kept, whatever ended it.
    let kept = connection.flush().await;
    ended.and(kept)?;
    connection.end().await?;
    Ok(LiveEnded {
        run: connection.run().into(),
        job: connection.job().into(),
        frames: connection.frames(),
        missing: connection.missing().to_vec(),
    })
}

/// The body as it comes.
struct Incoming {
    body: Body,
    silence: Duration,
}

impl Incoming {
    async fn next(&mut self) -> Result<Option<Bytes>> {
        self.body.chunk(self.silence).await
    }

    /// Reads as much as is needed to tell what it is.
    async fn tell_kind(&mut self) -> Result<(SegmentKind, Vec<u8>)> {
        let mut first = Vec::new();
        let enough = TS_PACKET_BYTES * (TS_PACKETS - 1) + 1;
        while first.len() < enough {
            match self.next().await? {
                Some(chunk) => first.extend_from_slice(&chunk),
                None => break,
            }
        }
        let is_ts = first.len() >= enough && (0..TS_PACKETS).all(|i| first[i * TS_PACKET_BYTES] == TS_SYNC);
        if is_ts {
            return Ok((SegmentKind::TransportStream, first));
        }
        let text_or_jpeg = first.starts_with(&[0xff, 0xd8]) || first.starts_with(b"--") || first.starts_with(b"\r\n--");
        if text_or_jpeg {
            return Ok((SegmentKind::Frames, first));
        }
        let found = match first.len() {
            0 => "an empty body".to_string(),
            _ => format!("a body that begins with the bytes {:02x?}", &first[..first.len().min(8)]),
        };
        Err(Error::field("body", found, "MJPEG (ffmpeg -f mpjpeg, bare JPEG images) or MPEG-TS (ffmpeg -f mpegts)"))
    }
}

async fn take_all(
    app: &App,
    connection: &mut Connection,
    incoming: &mut Incoming,
    kind: SegmentKind,
    first: Vec<u8>,
) -> Result<()> {
    let wanted = connection.wanted_by_another().clone();
    let mut splitter = JpegSplitter::new(app.config.live.frame_bytes);
    let mut chunk = Bytes::from(first);
    loop {
        match kind {
            SegmentKind::TransportStream => connection.push_bytes(&chunk),
            SegmentKind::Frames => {
                splitter.push(&chunk);
                while let Some(frame) = splitter.next_frame()? {
                    let now_ns = i64::try_from(jiff::Timestamp::now().as_nanosecond()).unwrap_or(i64::MAX);
                    let seq = frame.seq.unwrap_or(connection.next_seq());
                    check_number(seq)?;
                    let time_ns = frame.capture_time_ns.unwrap_or(now_ns);
                    let crc = crc32c::crc32c(&frame.image);
                    // One that comes again is dropped.
                    let _ = connection.push_frame(seq, time_ns, frame.image, crc);
                }
            }
        }
        if connection.is_due() {
            connection.flush().await?;
        }
        chunk = loop {
            let due_at = connection.due_at();
            tokio::select! {
                biased;
                () = wanted.cancelled() => return Err(Error::Locked("another connection has taken the stream over".into())),
                () = app.stop.cancelled() => return Err(Error::Busy("the server stops; come back in a moment".into())),
                next = incoming.next() => match next? {
                    Some(chunk) => break chunk,
                    None => return Ok(()),
                },
                // A sender that pauses does not keep its last frames waiting.
                () = sleep_until(due_at) => connection.flush().await?,
            }
        };
    }
}

async fn sleep_until(at: Option<Instant>) {
    match at {
        Some(at) => tokio::time::sleep_until(at).await,
        None => std::future::pending().await,
    }
}
