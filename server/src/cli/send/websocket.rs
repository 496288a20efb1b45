//! One connection of a live stream: hello, frames as far as the credit goes, what became durable, the end.

use std::time::Duration;

use bytes::Bytes;
use futures::stream::{SplitSink, SplitStream};
use futures::{SinkExt, StreamExt};
use serde::Deserialize;
use serde_json::{Value, json};
use stria_core::source::frame_file::FrameRecord;
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::task::block_in_place;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::http::header::AUTHORIZATION;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{Error as WsError, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async_with_config};

use super::contact::{ANSWER, Contact};
use super::session::{Place, Session};
use super::spool::Reader;
use super::trouble::{Trouble, of_status};

/// So often a connection without frames shows that it lives, and asks whether the other end does.
const PING_EVERY: Duration = Duration::from_secs(10);
/// The longest message of a server.
const MESSAGE_BYTES: usize = 4 << 20;
/// Bytes of a message before its image: number, time, checksum.
const FRAME_HEAD_BYTES: usize = 20;

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// What a server says.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
enum Said {
    Welcome {
        run: String,
        job: String,
        next_seq: u64,
        credit: u64,
    },
    Ack {
        durable_seq: u64,
        credit: u64,
    },
    Error {
        title: String,
        #[serde(default)]
        detail: String,
        #[serde(default)]
        retryable: bool,
    },
    Closed {
        frames: u64,
        missing: Vec<(u64, u64)>,
    },
    /// What a later version may say.
    #[serde(other)]
    Other,
}

/// A run that is complete.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Closed {
    pub(super) frames: u64,
    pub(super) missing: Vec<(u64, u64)>,
}

/// Why a connection ended before the stream did.
#[derive(Debug)]
pub(super) struct Broken {
    pub(super) trouble: Trouble,
    /// The server had taken the stream: what it refuses now is a frame or the moment, not the announcement.
    pub(super) welcomed: bool,
}

/// Opens a connection and sends what the session has, until the session's end or the connection's. `heard`: told of each
/// welcome and of each frame that became safe.
pub(super) async fn talk(
    contact: &Contact,
    stream: &str,
    session: &Session,
    heard: &(dyn Fn(&Place) + Sync),
    progress: &(dyn Fn() + Sync),
) -> Result<Closed, Broken> {
    let before = |trouble| Broken { trouble, welcomed: false };
    let mut socket = connect(contact, stream).await.map_err(before)?;
    let (place, at, credit) = greet(&mut socket, session).await.map_err(before)?;
    heard(&place);
    let after = |trouble| Broken { trouble, welcomed: true };
    let (sink, source) = socket.split();
    // The first frame that may not be sent yet.
    let (until, window) = watch::channel(place.wire(at).saturating_add(credit));
    let sending = send_all(sink, contact, session, &place, Reader::new(at), window);
    let listening = listen(source, contact.stall, session, until, progress);
    tokio::select! {
        biased;
        closed = listening => closed.map_err(after),
        trouble = sending => Err(after(trouble)),
    }
}

async fn connect(contact: &Contact, stream: &str) -> Result<Socket, Trouble> {
    let (url, token) = contact.websocket(&format!("/api/live/{stream}"));
    let mut request = url.as_str().into_client_request().map_err(|e| trouble(&e))?;
    request.headers_mut().extend(token.map(|token| (AUTHORIZATION, token)));
    let config = WebSocketConfig::default().max_message_size(Some(MESSAGE_BYTES)).max_frame_size(Some(MESSAGE_BYTES));
    let connected = timeout(ANSWER, connect_async_with_config(request, Some(config), true)).await;
    match connected {
        Ok(Ok((socket, _))) => Ok(socket),
        Ok(Err(WsError::Http(answer))) => {
            let problem: Value =
                answer.body().as_deref().and_then(|body| serde_json::from_slice(body).ok()).unwrap_or_default();
            Err(of_status(answer.status(), &problem, None))
        }
        Ok(Err(e)) => Err(trouble(&e)),
        Err(_) => Err(Trouble::passing("it does not answer")),
    }
}

async fn greet(socket: &mut Socket, session: &Session) -> Result<(Place, u64, u64), Trouble> {
    let record = session.record();
    let mut hello = record.hello;
    hello.insert("type".into(), "hello".into());
    // A mission that has no run yet must not go on with that of an earlier one.
    hello.insert("resume".into(), record.place.is_some().into());
    let text = Value::from(hello).to_string();
    let answered = timeout(ANSWER, async {
        socket.send(Message::text(text)).await.map_err(|e| trouble(&e))?;
        loop {
            match said(socket.next().await)? {
                Some(Said::Welcome { run, job, next_seq, credit }) => return Ok((run, job, next_seq, credit)),
                Some(Said::Error { title, detail, retryable }) => return Err(refusal(&title, &detail, retryable)),
                _ => {}
            }
        }
    });
    let (run, job, next_seq, credit) =
        answered.await.unwrap_or_else(|_| Err(Trouble::passing("it does not answer the hello")))?;
    let at = block_in_place(|| session.welcomed(&run, &job, next_seq)).map_err(|e| local(session, &e))?;
    let place = session.record().place;
    let place = place.ok_or_else(|| Trouble::Local("the place of the frames was not kept".into()))?;
    Ok((place, at, credit))
}

/// Sends frames as they come and as the credit allows, then the end; never ends by itself but in trouble.
async fn send_all(
    mut sink: SplitSink<Socket, Message>,
    contact: &Contact,
    session: &Session,
    place: &Place,
    mut reader: Reader,
    mut window: watch::Receiver<u64>,
) -> Trouble {
    let mut written = session.spool.written();
    let mut waiting: Option<(FrameRecord, u32)> = None;
    let mut end_said = false;
    loop {
        let now = *written.borrow_and_update();
        let until = *window.borrow_and_update();
        if waiting.is_none() {
            waiting = match block_in_place(|| reader.next(&session.spool)) {
                Ok(next) => next,
                Err(e) => return local(session, &e),
            };
        }
        if let Some((record, crc)) = waiting.take_if(|(record, _)| place.wire(record.seq) < until) {
            session.sending(record.seq);
            if let Err(trouble) = wait_for_turn(&mut sink, contact, FRAME_HEAD_BYTES + record.image.len()).await {
                return trouble;
            }
            let message = Message::Binary(frame(place.wire(record.seq), &record, crc));
            if let Err(trouble) = put(&mut sink, message, contact.stall).await {
                return trouble;
            }
            continue;
        }
        // Nothing is left behind: `now` was taken before the reader looked.
        if waiting.is_none() && now.ended && !end_said {
            if let Err(e) = block_in_place(|| session.change(|record| record.end_said = true)) {
                return local(session, &e);
            }
            if let Err(trouble) = put(&mut sink, Message::text(json!({"type": "end"}).to_string()), contact.stall).await
            {
                return trouble;
            }
            end_said = true;
        }
        let is_quiet = tokio::select! {
            _ = written.changed(), if !now.ended => false,
            // An error: nobody listens any more, and whoever did says why.
            changed = window.changed() => match changed {
                Ok(()) => false,
                Err(_) => std::future::pending().await,
            },
            () = tokio::time::sleep(PING_EVERY) => true,
        };
        if is_quiet && let Err(trouble) = put(&mut sink, Message::Ping(Bytes::new()), contact.stall).await {
            return trouble;
        }
    }
}

/// Waits until the cap lets a frame go out; a large one may wait longer than a connection may be silent.
async fn wait_for_turn(sink: &mut SplitSink<Socket, Message>, contact: &Contact, bytes: usize) -> Result<(), Trouble> {
    let mut turn = std::pin::pin!(contact.may_send(bytes));
    loop {
        tokio::select! {
            () = &mut turn => return Ok(()),
            () = tokio::time::sleep(PING_EVERY) => put(sink, Message::Ping(Bytes::new()), contact.stall).await?,
        }
    }
}

/// Hears what is safe, until the run is complete.
async fn listen(
    mut source: SplitStream<Socket>,
    stall: Duration,
    session: &Session,
    until: watch::Sender<u64>,
    progress: &(dyn Fn() + Sync),
) -> Result<Closed, Trouble> {
    loop {
        let message = timeout(stall, source.next()).await;
        let message = message.map_err(|_| Trouble::passing("nothing is heard from it any more"))?;
        match said(message)? {
            Some(Said::Ack { durable_seq, credit }) => {
                block_in_place(|| session.durable(durable_seq)).map_err(|e| local(session, &e))?;
                until.send_replace(durable_seq.saturating_add(1).saturating_add(credit));
                progress();
            }
            Some(Said::Closed { frames, missing }) => return Ok(Closed { frames, missing }),
            Some(Said::Error { title, detail, retryable }) => return Err(refusal(&title, &detail, retryable)),
            _ => {}
        }
    }
}

async fn put(sink: &mut SplitSink<Socket, Message>, message: Message, stall: Duration) -> Result<(), Trouble> {
    match timeout(stall, sink.send(message)).await {
        Ok(sent) => sent.map_err(|e| trouble(&e)),
        Err(_) => Err(Trouble::passing("nothing moves any more")),
    }
}

/// Number, time and checksum, little endian, and the image.
fn frame(wire: u64, record: &FrameRecord, crc: u32) -> Bytes {
    let mut message = Vec::with_capacity(FRAME_HEAD_BYTES + record.image.len());
    message.extend(wire.to_le_bytes());
    message.extend(record.capture_time_ns.to_le_bytes());
    message.extend(crc.to_le_bytes());
    message.extend(&record.image);
    message.into()
}

/// A message's meaning; `None` for what has none for us.
fn said(message: Option<Result<Message, WsError>>) -> Result<Option<Said>, Trouble> {
    match message {
        None => Err(Trouble::passing("the connection ended")),
        Some(Err(e)) => Err(trouble(&e)),
        Some(Ok(Message::Text(text))) => {
            let said = serde_json::from_str(&text);
            said.map(Some).map_err(|e| Trouble::passing(format!("it says what cannot be read ({e})")))
        }
        Some(Ok(Message::Close(Some(close)))) if !close.reason.is_empty() => {
            Err(Trouble::passing(format!("the connection was closed: {}", close.reason)))
        }
        Some(Ok(Message::Close(_))) => Err(Trouble::passing("the connection was closed")),
        Some(Ok(_)) => Ok(None),
    }
}

fn refusal(title: &str, detail: &str, retryable: bool) -> Trouble {
    let words = if detail.is_empty() { title.to_string() } else { format!("{title}: {detail}") };
    if retryable {
        return Trouble::passing(words);
    }
    Trouble::Refused { field: None, words: format!("the server refuses the stream: {words}") }
}

fn trouble(error: &WsError) -> Trouble {
    match error {
        WsError::Io(e) => Trouble::passing(e.to_string()),
        other => Trouble::passing(other.to_string()),
    }
}

fn local(session: &Session, error: &std::io::Error) -> Trouble {
    Trouble::Local(format!("{}: {error}", session.folder().display()))
}
