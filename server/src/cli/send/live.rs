//! `--live`: frames from stdin, on disk first, then to the server as fast as it takes them. What cannot be sent now, or
//! was left by an earlier process, is sent later, in order.

use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use reqwest::Method;
use serde_json::Value;
use tokio::sync::oneshot;

use super::super::{Failed, Outcome, Success};
use super::backoff::{GiveUp, Patience};
use super::report::Frames;
use super::session::{Place, Session};
use super::spool::{Appended, SYNC_EVERY};
use super::trouble::Trouble;
use super::websocket::{Broken, Closed, talk};
use super::{Desk, WhenFull, follow};
use crate::mjpeg::JpegSplitter;

/// Largest frame, bytes; a server takes no larger ones.
const FRAME_BYTES_MAX: usize = 32 << 20;
/// Bytes read from stdin at once.
const READ_BYTES: usize = 256 << 10;
/// Longest name of a stream.
const NAME_CHARS_MAX: usize = 100;
/// How often progress is told.
const TELL_EVERY: Duration = Duration::from_millis(500);
/// After a signal, what is on disk may still be sent for so long.
const GRACE: Duration = Duration::from_secs(10);
/// A stream that was taken and then refused is tried so often in a row without any frame getting through.
const REFUSALS: u32 = 3;

/// What a live stream is told.
pub(super) struct Options {
    /// Most bytes that wait on disk.
    pub(super) spool_bytes: u64,
    pub(super) when_full: WhenFull,
    pub(super) give_up: GiveUp,
    /// Follow the job to its end.
    pub(super) wait: bool,
}

/// Sends stdin's frames, and before them what earlier processes left.
pub(super) async fn run(desk: &Desk, stream: &str, options: &Options) -> Outcome {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    if stream.is_empty() || stream.len() > NAME_CHARS_MAX || !stream.chars().all(plain) {
        let expected = format!("1 to {NAME_CHARS_MAX} letters, digits, '.', '_' or '-'");
        return Err(Failed::Input(format!("--stream is {stream:?}; expected {expected}")));
    }
    let root = desk.states.stream(stream)?;
    let _lock = lock(&root, stream)?;
    let (older, own, damages) = Session::open_all(&root, &desk.fields.hello(), options.spool_bytes)?;
    damages.iter().for_each(|damage| desk.report.warning(damage));
    let (own, count) = (Arc::new(own), Arc::new(Count::default()));
    let input = read_stdin(own.clone(), count.clone(), options.when_full)?;
    keep_durable(own.clone())?;
    let delivery = Delivery { desk, stream, options, count: &count };
    let delivered = tokio::select! {
        delivered = delivery.all(&older, &own) => delivered,
        ended = delivery.stop_softly(&own) => Err(ended),
    };
    let last = delivered?;
    // After a signal stdin may still be open, and its reader blocked for ever.
    tokio::select! {
        biased;
        read = input => read.unwrap_or(Ok(()))?,
        () = desk.stop.cancelled() => {}
    }
    let Some((place, has_gaps)) = last else {
        return Err(Failed::Input("stdin: held no frame; expected MJPEG, as `ffmpeg -f mpjpeg -` writes it".into()));
    };
    let dropped = own.spool.figures().1;
    if dropped > 0 {
        desk.report.warning(format!("{dropped} frames were left out because --spool-gb was reached"));
    }
    let has_warnings = has_gaps || dropped > 0 || count.damaged.load(Ordering::Relaxed) > 0;
    let ended =
        if options.wait { follow::follow(desk, &place.run, &place.job, options.give_up).await? } else { Success::Done };
    Ok(if has_warnings { Success::DoneWithWarnings } else { ended })
}

/// What happened at stdin.
#[derive(Default)]
struct Count {
    frames: AtomicU64,
    /// Times that something in the stream was no JPEG.
    damaged: AtomicU64,
}

fn lock(root: &Path, stream: &str) -> Result<File, Failed> {
    let path = root.join(".lock");
    let unusable = |e: std::io::Error| Failed::Other(format!("{}: {e}", path.display()));
    let file = File::create(&path).map_err(unusable)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(std::fs::TryLockError::WouldBlock) => {
            Err(Failed::Other(format!("another stria sends the stream {stream} from this machine")))
        }
        Err(std::fs::TryLockError::Error(e)) => Err(unusable(e)),
    }
}

/// Reads stdin in a thread of its own: it may block for ever, and must then be left behind.
fn read_stdin(
    session: Arc<Session>,
    count: Arc<Count>,
    when_full: WhenFull,
) -> Result<oneshot::Receiver<Result<(), Failed>>, Failed> {
    let (tell, told) = oneshot::channel();
    let work = move || {
        let result = read_frames(&session, &count, when_full);
        let ended = session.end_input().map_err(|e| Failed::Other(format!("{}: {e}", session.folder().display())));
        // Whoever does not listen has stopped.
        let _ = tell.send(result.and(ended));
    };
    std::thread::Builder::new()
        .name("stdin".into())
        .spawn(work)
        .map_err(|e| Failed::Other(format!("a thread did not start: {e}")))?;
    Ok(told)
}

fn read_frames(session: &Session, count: &Count, when_full: WhenFull) -> Result<(), Failed> {
    let mut stdin = std::io::stdin().lock();
    let mut splitter = JpegSplitter::new(FRAME_BYTES_MAX);
    let mut buffer = vec![0; READ_BYTES];
    loop {
        let read = match stdin.read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(read) => read,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(e) => return Err(Failed::Other(format!("stdin: {e}"))),
        };
        splitter.push(&buffer[..read]);
        loop {
            match splitter.next_frame() {
                Ok(Some(frame)) => {
                    count.frames.fetch_add(1, Ordering::Relaxed);
                    let time_ns = frame.capture_time_ns.unwrap_or_else(now_ns);
                    let crc = crc32c::crc32c(&frame.image);
                    let kept = session.spool.append(time_ns, &frame.image, crc, when_full);
                    match kept.map_err(|e| Failed::Other(e.to_string()))? {
                        Appended::Ended => return Ok(()),
                        Appended::Kept | Appended::Dropped => {}
                    }
                }
                Ok(None) => break,
                Err(e) if count.frames.load(Ordering::Relaxed) == 0 => {
                    return Err(Failed::Input(format!(
                        "stdin: {e}; expected MJPEG, as `ffmpeg -f mpjpeg -` writes it, or bare JPEGs"
                    )));
                }
                Err(_) => {
                    // A camera that stutters is no reason to stop: it goes on at the next image.
                    count.damaged.fetch_add(1, Ordering::Relaxed);
                    splitter = JpegSplitter::new(FRAME_BYTES_MAX);
                    break;
                }
            }
        }
    }
}

fn now_ns() -> i64 {
    i64::try_from(jiff::Timestamp::now().as_nanosecond()).unwrap_or(i64::MAX)
}

/// Makes frames durable soon after they came, also when no further one comes.
fn keep_durable(session: Arc<Session>) -> Result<(), Failed> {
    let work = move || {
        let mut written = session.spool.written();
        while !written.borrow_and_update().ended {
            std::thread::sleep(SYNC_EVERY);
            // The writer meets the same fault, and says so.
            let _ = session.spool.sync();
        }
    };
    let started = std::thread::Builder::new().name("sync".into()).spawn(work);
    started.map(drop).map_err(|e| Failed::Other(format!("a thread did not start: {e}")))
}

struct Delivery<'a> {
    desk: &'a Desk,
    stream: &'a str,
    options: &'a Options,
    count: &'a Count,
}

impl Delivery<'_> {
    /// All sessions, in order; the last run, where there is one, and whether any has gaps.
    async fn all(&self, older: &[Session], own: &Session) -> Result<Option<(Place, bool)>, Failed> {
        let told = async {
            loop {
                self.tell(own);
                tokio::time::sleep(TELL_EVERY).await;
            }
        };
        let sent = async {
            let (mut has_gaps, mut last) = (false, None);
            for session in older {
                match self.one(session).await {
                    Ok(Some((place, gaps))) => {
                        has_gaps |= gaps;
                        last = Some(place);
                    }
                    Ok(None) => {}
                    // It must not stand in the way of today's frames for ever.
                    Err(Failed::Input(why)) => {
                        let place = session.set_aside(&why).map_err(|e| self.local(session, &e))?;
                        let place = place.display();
                        self.desk
                            .report
                            .warning(format!("frames of an earlier run were refused: {why}; kept in {place}"));
                        has_gaps = true;
                    }
                    Err(other) => return Err(other),
                }
            }
            if let Some((place, gaps)) = self.one(own).await? {
                has_gaps |= gaps;
                last = Some(place);
            }
            Ok(last.map(|place| (place, has_gaps)))
        };
        tokio::select! {
            never = told => never,
            sent = sent => sent,
        }
    }

    fn local(&self, session: &Session, error: &std::io::Error) -> Failed {
        Failed::Other(format!("{}: {error}", session.folder().display()))
    }

    fn tell(&self, own: &Session) {
        let (waiting, dropped, spool_bytes) = own.spool.figures();
        let read = self.count.frames.load(Ordering::Relaxed);
        self.desk.report.frames(&Frames { read, waiting, dropped, spool_bytes });
    }

    /// After a signal the input counts as ended, and what is there may still go out.
    async fn stop_softly(&self, own: &Session) -> Failed {
        self.desk.stop.cancelled().await;
        if let Err(e) = tokio::task::block_in_place(|| own.end_input()) {
            return self.local(own, &e);
        }
        tokio::time::sleep(GRACE).await;
        let (waiting, _, _) = own.spool.figures();
        self.desk.report.warning(format!("{waiting} frames stay on this machine; the same command sends them"));
        Failed::Cancelled
    }

    /// One session to its end. `None` where it has no frame.
    async fn one(&self, session: &Session) -> Result<Option<(Place, bool)>, Failed> {
        let mut written = session.spool.written();
        // Without a frame there is no run to begin.
        let undone = session.spool.first_undone();
        let first = written.wait_for(|written| written.ended || written.next_seq > undone).await;
        let nothing_new = first.is_ok_and(|written| written.next_seq <= undone);
        if nothing_new && session.record().place.is_none() {
            session.remove().map_err(|e| self.local(session, &e))?;
            return Ok(None);
        }
        let closed = self.until_closed(session).await?;
        let Some(place) = session.record().place else { return Ok(None) };
        let page = self.desk.contact.page(&place.run);
        self.desk.report.closed(&place.run, &place.job, page.as_str(), closed.frames, &closed.missing);
        session.remove().map_err(|e| self.local(session, &e))?;
        Ok(Some((place, !closed.missing.is_empty())))
    }

    async fn until_closed(&self, session: &Session) -> Result<Closed, Failed> {
        let (patience, refusals) = (std::sync::Mutex::new(Patience::new(self.options.give_up)), AtomicU64::new(0));
        let locked = || patience.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let said_run = std::sync::Mutex::new(None);
        let heard = |place: &Place| {
            let before = said_run.lock().unwrap_or_else(std::sync::PoisonError::into_inner).replace(place.run.clone());
            if before.as_ref() != Some(&place.run) {
                let page = self.desk.contact.page(&place.run);
                self.desk.report.stream(&place.run, &place.job, page.as_str());
            }
        };
        let progress = || {
            locked().progress();
            refusals.store(0, Ordering::Relaxed);
        };
        loop {
            let attempt = match self.closed_already(session).await {
                Ok(Some(closed)) => return Ok(closed),
                Ok(None) => talk(&self.desk.contact, self.stream, session, &heard, &progress).await,
                Err(trouble) => Err(Broken { trouble, welcomed: false }),
            };
            let (why, wait) = match attempt {
                Ok(closed) => return Ok(closed),
                Err(Broken { trouble: Trouble::Passing { why, wait, .. }, .. }) => (why, wait),
                Err(Broken { trouble: Trouble::Gone(why), .. }) => {
                    return Err(Failed::Input(format!("the server takes no live streams ({why})")));
                }
                Err(Broken { trouble: Trouble::Refused { words, .. }, welcomed: true })
                    if refusals.fetch_add(1, Ordering::Relaxed) + 1 < u64::from(REFUSALS) =>
                {
                    (words, None)
                }
                Err(Broken { trouble, .. }) => return Err(trouble.into()),
            };
            let server = self.desk.contact.server();
            let Some(pause) = locked().next_wait(wait) else {
                return Err(Failed::Other(format!(
                    "{server}: {why}; tried without progress for the whole of --give-up-h. The same command sends what \
                     waits"
                )));
            };
            self.desk.report.retry(&format!("{server}: {why}"), pause);
            tokio::time::sleep(pause).await;
        }
    }

    /// Where the end was said and its answer lost: asks whether the run is complete, since another hello would begin a
    /// new one.
    async fn closed_already(&self, session: &Session) -> Result<Option<Closed>, Trouble> {
        let record = session.record();
        let (true, Some(place)) = (record.end_said, record.place) else { return Ok(None) };
        let request = self.desk.contact.request(Method::GET, self.desk.contact.url("/api/live"));
        let list: Value = self.desk.contact.ask(request).await?.json().await?;
        let items = list.get("items").and_then(Value::as_array).cloned().unwrap_or_default();
        let ours = |item: &&Value| item["stream"] == self.stream && item["run"] == place.run && item["open"] == false;
        let Some(item) = items.iter().find(ours) else { return Ok(None) };
        let frames = item["frames"].as_u64().unwrap_or(0);
        let missing: Vec<(u64, u64)> = serde_json::from_value(item["missing"].clone()).unwrap_or_default();
        let absent: u64 = missing.iter().map(|(first, last)| last - first + 1).sum();
        // A run that was closed because nobody came back may lack the last frames.
        let next_wire = place.first_wire + frames + absent;
        let has_all = next_wire >= place.wire(session.spool.end_of_frames());
        Ok(has_all.then_some(Closed { frames, missing }))
    }
}
