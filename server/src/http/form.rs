//! The body of an upload as it comes in, and the fields that come with it.

use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::body::BodyDataStream;
use axum::http::HeaderMap;
use axum::http::header::CONTENT_DISPOSITION;
use bytes::Bytes;
use futures::{Stream, StreamExt};

use super::App;
use crate::error::{Error, Result};
use crate::incoming::Incoming;
use crate::runs::{MAX_NAME_CHARS, NewRun, RecipeText, RigText, read_time};
use crate::wire::Direction;

/// Most bytes between two parts of a form: heads, and what the form's reader reads ahead.
const HEAD_BYTES: u64 = 4 * 1024 * 1024;

/// How much, and for how long, is read from a sender of a file whose request was refused already.
const DRAIN_BYTES: u64 = 1_000_000_000;
pub(super) const DRAIN_TIME: Duration = Duration::from_secs(30);

/// The sender left, or sent what no body may hold.
#[derive(Debug, thiserror::Error)]
#[error("the body ended early")]
pub(super) struct BodyBroken;

/// A request's body, which stays readable after whoever read it has given up.
///
/// As a stream it pauses after each chunk and counts what a form's head may weigh: the form's reader takes all that is
/// there before it looks at any of it.
#[derive(Clone)]
pub(super) struct Body(Arc<Mutex<State>>);

struct State {
    stream: BodyDataStream,
    left: u64,
    pause: bool,
}

impl Body {
    pub(super) fn new(body: axum::body::Body) -> Body {
        Body(Arc::new(Mutex::new(State { stream: body.into_data_stream(), left: u64::MAX, pause: false })))
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        // A panic while it was held leaves the stream as it was.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A part's head comes next.
    pub(super) fn expect_head(&self) {
        self.state().left = HEAD_BYTES;
    }

    /// A part's data comes next; whoever reads it counts it.
    pub(super) fn expect_data(&self) {
        self.state().left = u64::MAX;
    }

    /// The next chunk, within a time.
    pub(super) async fn chunk(&mut self, silence: Duration) -> Result<Option<Bytes>> {
        match tokio::time::timeout(silence, self.next()).await {
            Ok(None) => Ok(None),
            Ok(Some(Ok(chunk))) => Ok(Some(chunk)),
            Ok(Some(Err(_))) | Err(_) => Err(Error::SenderSilent),
        }
    }

    /// Reads on and throws away, within limits.
    pub(super) async fn drain(mut self, longest: Duration) {
        self.state().left = DRAIN_BYTES;
        let _ = tokio::time::timeout(longest, async { while let Some(Ok(_)) = self.next().await {} }).await;
    }
}

impl Stream for Body {
    type Item = std::result::Result<Bytes, BodyBroken>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let mut state = self.state();
        if std::mem::take(&mut state.pause) {
            cx.waker().wake_by_ref();
            return Poll::Pending;
        }
        match state.stream.poll_next_unpin(cx) {
            Poll::Pending => Poll::Pending,
            Poll::Ready(None) => Poll::Ready(None),
            Poll::Ready(Some(Err(_))) => Poll::Ready(Some(Err(BodyBroken))),
            Poll::Ready(Some(Ok(chunk))) => {
                state.pause = true;
                if state.left != u64::MAX {
                    state.left = state.left.saturating_sub(chunk.len() as u64);
                    if state.left == 0 {
                        return Poll::Ready(Some(Err(BodyBroken)));
                    }
                }
                Poll::Ready(Some(Ok(chunk)))
            }
        }
    }
}

/// The fields of an upload; each is checked as it comes.
#[derive(Default)]
pub(super) struct Fields {
    asset: Option<String>,
    rig: Option<RigText>,
    recipe: Option<RecipeText>,
    chainage_mm: Option<f64>,
    direction: Option<Direction>,
    recorded_ms: Option<i64>,
    fps: Option<f64>,
    sha256: Option<String>,
    filename: Option<String>,
    note: Option<String>,
}

impl Fields {
    /// Takes a field. Empty ones count as absent, since a page's form sends all it has.
    pub(super) async fn take(&mut self, app: &App, name: &str, value: &str) -> Result<()> {
        if value.trim().is_empty() {
            return if NAMES.contains(&name) { Ok(()) } else { Err(unknown(name)) };
        }
        match name {
            "asset" => once(&mut self.asset, name, value.trim().to_string()),
            "rig" => once(&mut self.rig, name, app.runs.rig(value).await?),
            "recipe" => once(&mut self.recipe, name, RecipeText::read(Some(value))?),
            "chainage_mm" => once(&mut self.chainage_mm, name, number(name, value)?),
            "direction" => once(&mut self.direction, name, direction(value)?),
            "recorded_at" => once(&mut self.recorded_ms, name, read_time(name, value)?),
            "fps" => once(&mut self.fps, name, number(name, value)?),
            "sha256" => once(&mut self.sha256, name, sha256(value)?),
            "filename" => once(&mut self.filename, name, value.to_string()),
            "note" => once(&mut self.note, name, value.to_string()),
            _ => Err(unknown(name)),
        }
    }

    /// The name that the form gives its file; the field `filename` goes before it.
    pub(super) fn file_name(&mut self, name: Option<&str>) {
        self.filename = self.filename.take().or_else(|| name.map(Into::into));
    }

    /// What nobody can guess was given.
    pub(super) fn check_complete(&self) -> Result<()> {
        if self.asset.is_none() {
            return Err(Error::field("asset", "the field 'asset' is missing", "the name of the pipe or wall"));
        }
        if self.rig.is_none() {
            let expected = "the name of a stored rig, or a rig file in TOML or JSON";
            return Err(Error::field("rig", "the field 'rig' is missing", expected));
        }
        Ok(())
    }

    /// All of it, checked against the file that came.
    pub(super) fn into_new_run(self, incoming: &Incoming) -> Result<NewRun> {
        let (new, sha256) = self.into_announced_run()?;
        if incoming.facts.bytes == 0 {
            return Err(Error::field("file", "the file is empty (0 bytes)", "a video file"));
        }
        match sha256 {
            Some(expected) if expected != incoming.facts.sha256 => {
                let found = format!("the file arrived with the SHA-256 {}", incoming.facts.sha256);
                Err(Error::field("sha256", found, format!("{expected}, as announced; send it again")))
            }
            _ => Ok(new),
        }
    }

    /// All of it before its file is here, and the SHA-256 that the file shall have.
    pub(super) fn into_announced_run(self) -> Result<(NewRun, Option<String>)> {
        self.check_complete()?;
        let (Some(asset), Some(rig)) = (self.asset, self.rig) else {
            return Err(Error::Internal("fields were checked but are missing".into()));
        };
        let new = NewRun {
            asset,
            rig,
            recipe: self.recipe.map_or_else(|| RecipeText::read(None), Ok)?,
            chainage_mm: self.chainage_mm.unwrap_or(0.0),
            direction: self.direction.unwrap_or_default(),
            recorded_ms: self.recorded_ms,
            note: self.note.unwrap_or_default(),
            filename: printable(self.filename.as_deref().unwrap_or_default()),
            fps: self.fps,
        };
        new.check()?;
        Ok((new, self.sha256))
    }
}

const NAMES: [&str; 10] =
    ["asset", "rig", "recipe", "chainage_mm", "direction", "recorded_at", "fps", "sha256", "filename", "note"];

fn unknown(name: &str) -> Error {
    let name = printable(name);
    Error::field(&name, format!("there is no field '{name}'"), format!("file, {}", NAMES.join(", ")))
}

fn once<T>(place: &mut Option<T>, name: &str, value: T) -> Result<()> {
    match place.replace(value) {
        None => Ok(()),
        Some(_) => Err(Error::field(name, format!("the field '{name}' comes twice"), "it once")),
    }
}

fn number(name: &str, value: &str) -> Result<f64> {
    match value.trim().parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        _ => Err(Error::field(name, format!("{name} is '{}'", printable(value)), "a number")),
    }
}

fn direction(value: &str) -> Result<Direction> {
    Direction::parse(value.trim())
        .ok_or_else(|| Error::field("direction", format!("direction is '{}'", printable(value)), "forward or backward"))
}

fn sha256(value: &str) -> Result<String> {
    let text = value.trim().to_ascii_lowercase();
    if text.len() == 64 && text.bytes().all(|b| b.is_ascii_hexdigit()) {
        return Ok(text);
    }
    Err(Error::field("sha256", format!("sha256 is '{}'", printable(value)), "64 hexadecimal digits"))
}

/// A name for people: bounded, without control characters. It is never a path.
fn printable(name: &str) -> String {
    let name: String = name.chars().filter(|c| !c.is_control()).take(MAX_NAME_CHARS).collect();
    if name.trim().is_empty() { "upload".into() } else { name }
}

/// The file's name as a part of a form gives it. Browsers write a quote in it as `%22`, other programs as `\"`.
pub(super) fn given_name(headers: &HeaderMap) -> Option<String> {
    let disposition = String::from_utf8_lossy(headers.get(CONTENT_DISPOSITION)?.as_bytes()).into_owned();
    let quoted = disposition.split_once("filename=\"")?.1;
    let mut name = String::new();
    let mut characters = quoted.chars();
    loop {
        match characters.next()? {
            '"' => break,
            '\\' => match characters.next()? {
                escaped @ ('"' | '\\') => name.push(escaped),
                other => name.extend(['\\', other]),
            },
            other => name.push(other),
        }
    }
    Some(name.replace("%22", "\"").replace("%0D", " ").replace("%0A", " "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_files_name_may_hold_quotes_and_backslashes() {
        for (sent, name) in [
            (r#"form-data; name="file"; filename="a.mp4""#, Some("a.mp4")),
            (r#"form-data; name="file"; filename="a%22b.mp4""#, Some("a\"b.mp4")),
            (r#"form-data; name="file"; filename="a\"b.mp4""#, Some("a\"b.mp4")),
            (r#"form-data; name="file"; filename="C:\x\y.mp4""#, Some(r"C:\x\y.mp4")),
            (r#"form-data; name="file"; filename="cut"#, None),
            (r#"form-data; name="file""#, None),
        ] {
            let headers = [(CONTENT_DISPOSITION, sent.parse().expect("a value"))].into_iter().collect();
            assert_eq!(given_name(&headers).as_deref(), name, "{sent}");
        }
    }
}
