//! One file, by tus 1.0.0: created once, sent from wherever the server is, asked for until its run is known.

use std::fs::File;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use futures::stream;
use reqwest::header::{CONTENT_LENGTH, CONTENT_TYPE, LOCATION};
use reqwest::{Body, Method, RequestBuilder, Response, Url};
use sha2::{Digest, Sha256};
use tokio::time::Instant;

use super::super::Failed;
use super::Desk;
use super::backoff::{GiveUp, Patience};
use super::state::Resume;
use super::trouble::{Trouble, trouble_of};
use crate::queue::Queue;
use crate::store::hex;

const VERSION: &str = "1.0.0";
const PIECE: &str = "application/offset+octet-stream";

/// An upload that the server lost, or that arrived damaged, is begun again so often.
const BEGINNINGS: u32 = 5;
/// So often in a row a server may fail at one file before others have their turn.
const FAULTS: u32 = 10;
/// Bytes read at once for the hash.
const READ_BYTES: usize = 1 << 20;

/// A file to be sent, as it was when it was opened.
pub(super) struct Source {
    pub(super) path: PathBuf,
    pub(super) name: String,
    pub(super) bytes: u64,
    pub(super) modified_ns: i128,
    inode: u64,
    file: Arc<File>,
}

impl Source {
    /// Opens it.
    pub(super) fn open(path: &Path) -> Result<Source, Failed> {
        let unreadable = |e: std::io::Error| Failed::Input(format!("{}: {e}; expected a file", path.display()));
        let file = File::open(path).map_err(unreadable)?;
        let facts = file.metadata().map_err(unreadable)?;
        if !facts.is_file() {
            return Err(Failed::Input(format!("{}: is no file; expected a video file", path.display())));
        }
        Ok(Source {
            path: path.canonicalize().map_err(unreadable)?,
            name: path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
            bytes: facts.len(),
            modified_ns: modified_ns(&facts),
            inode: facts.ino(),
            file: Arc::new(file),
        })
    }

    /// Keeps it to this process: two that send the same file would each stop the other's connection.
    pub(super) fn lock(&self) -> Result<(), Failed> {
        match self.file.try_lock() {
            Err(std::fs::TryLockError::WouldBlock) => {
                Err(Failed::Other(format!("{}: another stria is sending it", self.path.display())))
            }
            // Where a file system has no locks, nobody else has one either.
            Ok(()) | Err(std::fs::TryLockError::Error(_)) => Ok(()),
        }
    }

    /// Nobody wrote to it, moved it or put another in its place.
    pub(super) fn is_unchanged(&self) -> bool {
        std::fs::symlink_metadata(&self.path).is_ok_and(|facts| {
            facts.is_file()
                && (facts.len(), modified_ns(&facts), facts.ino()) == (self.bytes, self.modified_ns, self.inode)
        })
    }

    /// Its own time.
    pub(super) fn recorded_at(&self) -> Option<jiff::Timestamp> {
        jiff::Timestamp::from_nanosecond(self.modified_ns).ok()
    }
}

/// When a file was written last, ns since 1970.
pub(super) fn modified_ns(facts: &std::fs::Metadata) -> i128 {
    i128::from(facts.mtime()) * 1_000_000_000 + i128::from(facts.mtime_nsec())
}

/// What a file became.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Sent {
    pub(super) run: String,
    pub(super) job: String,
    pub(super) sha256: String,
}

/// What the server says about an upload.
struct Progress {
    offset_bytes: u64,
    became: Option<(String, String)>,
}

/// How it goes forward.
struct Pace {
    patience: Patience,
    /// Bytes that the server has confirmed.
    furthest: u64,
    /// Times in a row that the server itself failed.
    faults: u32,
}

impl Pace {
    /// The server has so many bytes. Each cut may bring some: that is progress, too.
    fn reached(&mut self, offset_bytes: u64) {
        if offset_bytes > self.furthest {
            (self.furthest, self.faults) = (offset_bytes, 0);
            self.patience.progress();
        }
    }
}

/// Sends files.
pub(super) struct Sender<'a> {
    pub(super) desk: &'a Desk,
    pub(super) give_up: GiveUp,
}

impl Sender<'_> {
    /// Sends a file, or goes on with it; ends when the server has confirmed its run. What is needed to go on stays
    /// until [`super::state::States::forget`].
    pub(super) async fn send(&self, source: &Source, recorded_at: Option<jiff::Timestamp>) -> Result<Sent, Trouble> {
        tokio::select! {
            biased;
            () = self.desk.stop.cancelled() => Err(Trouble::Stopped),
            sent = self.keep_sending(source, recorded_at) => sent,
        }
    }

    async fn keep_sending(&self, source: &Source, recorded_at: Option<jiff::Timestamp>) -> Result<Sent, Trouble> {
        let mut resume = self.resume(source, recorded_at).await?;
        let mut pace = Pace { patience: Patience::new(self.give_up), furthest: 0, faults: 0 };
        let mut beginnings = 1;
        loop {
            let (why, wait) = match self.step(source, &mut resume, recorded_at, &mut pace).await {
                Ok(Progress { became: Some((run, job)), .. }) => {
                    return Ok(Sent { run, job, sha256: resume.sha256 });
                }
                Ok(Progress { offset_bytes, .. }) if offset_bytes < source.bytes => continue,
                Ok(_) => ("the server has the whole file, but no run yet".to_string(), None),
                Err(Trouble::Gone(why)) if resume.upload.is_some() && beginnings < BEGINNINGS => {
                    beginnings += 1;
                    pace.furthest = 0;
                    (resume.key, resume.upload) = (Queue::new_id(), None);
                    self.save(source, &resume)?;
                    (format!("{why}; the upload begins anew"), None)
                }
                Err(Trouble::Gone(why)) => {
                    let server = self.desk.contact.server();
                    let words = format!("{server} takes no uploads at /api/uploads ({why}); expected a Stria server");
                    return Err(Trouble::Refused { field: Some("server".into()), words });
                }
                Err(Trouble::Passing { why, wait, fault }) => {
                    pace.faults += u32::from(fault);
                    if pace.faults >= FAULTS && matches!(self.give_up, GiveUp::Never) {
                        return Err(Trouble::GaveUp(format!("the server failed {FAULTS} times at it: {why}")));
                    }
                    (why, wait)
                }
                Err(other) => return Err(other),
            };
            let server = self.desk.contact.server();
            let Some(pause) = pace.patience.next_wait(wait) else {
                return Err(Trouble::GaveUp(format!(
                    "{server}: {why}; tried without progress for the whole of --give-up-h. The same command goes on \
                     where this one was"
                )));
            };
            self.desk.report.retry(&format!("{server}: {why}"), pause);
            tokio::time::sleep(pause).await;
        }
    }

    /// Where an earlier process left it, else a new beginning.
    async fn resume(&self, source: &Source, recorded_at: Option<jiff::Timestamp>) -> Result<Resume, Trouble> {
        let fields = format!("{} {recorded_at:?}", self.desk.fields.digest());
        match self.desk.states.load(source) {
            Some(resume) if resume.fields == fields => return Ok(resume),
            // It was begun with other fields, and a run cannot have both.
            Some(Resume { upload: Some(upload), .. }) => {
                let url = self.desk.contact.url(&upload);
                let _ = self.desk.contact.ask(self.tus(Method::DELETE, url)).await;
            }
            _ => {}
        }
        let resume = Resume {
            file: source.path.display().to_string(),
            fields,
            sha256: self.hash(source).await?,
            key: Queue::new_id(),
            upload: None,
        };
        self.save(source, &resume)?;
        Ok(resume)
    }

    fn save(&self, source: &Source, resume: &Resume) -> Result<(), Trouble> {
        let saved = self.desk.states.save(source, resume);
        saved.map_err(|e| Trouble::Local(format!("the state folder cannot be written to: {e}")))
    }

    async fn hash(&self, source: &Source) -> Result<String, Trouble> {
        let (file, bytes, report) = (source.file.clone(), source.bytes, self.desk.report.clone());
        report.begin("reading", &source.name, 0, bytes);
        let hashed = tokio::task::spawn_blocking(move || hash(&file, bytes, |at| report.at(at))).await;
        let hashed = hashed.unwrap_or_else(|e| Err(std::io::Error::other(e)));
        hashed.map_err(|e| Trouble::Local(format!("{}: {e}", source.path.display())))
    }

    /// One request forward: creates the upload, or asks how far it is and sends the rest.
    async fn step(
        &self,
        source: &Source,
        resume: &mut Resume,
        recorded_at: Option<jiff::Timestamp>,
        pace: &mut Pace,
    ) -> Result<Progress, Trouble> {
        self.check_unchanged(source)?;
        let contact = &self.desk.contact;
        let (upload, known) = match &resume.upload {
            Some(upload) => {
                let url = contact.url(upload);
                let known = progress_of(&contact.ask(self.tus(Method::HEAD, url.clone())).await?)?;
                (url, known)
            }
            None => {
                let (url, known) = self.create(source, resume, recorded_at).await?;
                resume.upload = Some(url.path().into());
                self.save(source, resume)?;
                (url, known)
            }
        };
        pace.reached(known.offset_bytes);
        if known.became.is_some() || known.offset_bytes >= source.bytes {
            return Ok(known);
        }
        self.desk.report.begin("sending", &source.name, known.offset_bytes, source.bytes);
        let known = self.send_from(source, upload, known.offset_bytes).await?;
        pace.reached(known.offset_bytes);
        Ok(known)
    }

    fn check_unchanged(&self, source: &Source) -> Result<(), Trouble> {
        if source.is_unchanged() {
            return Ok(());
        }
        let path = source.path.display();
        Err(Trouble::Changed(format!("{path}: it was changed or moved while it was sent; send it when it is whole")))
    }

    fn tus(&self, method: Method, url: Url) -> RequestBuilder {
        self.desk.contact.request(method, url).header("Tus-Resumable", VERSION)
    }

    async fn create(
        &self,
        source: &Source,
        resume: &Resume,
        recorded_at: Option<jiff::Timestamp>,
    ) -> Result<(Url, Progress), Trouble> {
        let contact = &self.desk.contact;
        let metadata = self.desk.fields.metadata(&source.name, recorded_at, &resume.sha256);
        let request = self
            .tus(Method::POST, contact.url("/api/uploads"))
            .header("Upload-Length", source.bytes)
            .header("Upload-Metadata", metadata)
            .header("Idempotency-Key", &resume.key)
            .header(CONTENT_LENGTH, 0);
        let answer = contact.ask(request).await?;
        let location = text(&answer, LOCATION.as_str()).ok_or_else(|| wrong_answer("no Location"))?;
        Ok((contact.own_url(&location)?, progress_of(&answer)?))
    }

    /// Sends all that is left in one request.
    async fn send_from(&self, source: &Source, upload: Url, offset_bytes: u64) -> Result<Progress, Trouble> {
        let pulse = Arc::new(Pulse::new());
        let request = self
            .tus(Method::PATCH, upload)
            .header(CONTENT_TYPE, PIECE)
            .header("Upload-Offset", offset_bytes)
            .header(CONTENT_LENGTH, source.bytes - offset_bytes);
        let outcome = {
            // A stream that lives in the request must own what it reads; what it waits for is fed from here.
            let (feed, body) = tokio::sync::mpsc::channel(1);
            let body = stream::unfold(body, |mut body| async { body.recv().await.map(|chunk| (chunk, body)) });
            let answer = request.body(Body::wrap_stream(body)).send();
            let fed = async {
                self.feed(source, offset_bytes, feed, &pulse).await?;
                // All is handed over; now the answer has its time.
                std::future::pending::<Result<Response, Trouble>>().await
            };
            tokio::select! {
                biased;
                answer = answer => answer.map_err(Trouble::from),
                broken = fed => broken,
                () = pulse.stopped_for(self.desk.contact.stall) => Err(Trouble::passing("nothing moves any more")),
            }
        };
        let answer = outcome?;
        if answer.status().is_success() { progress_of(&answer) } else { Err(trouble_of(answer).await) }
    }

    /// Reads the file and hands it over as fast as the network and the cap allow.
    async fn feed(
        &self,
        source: &Source,
        mut at: u64,
        feed: tokio::sync::mpsc::Sender<std::io::Result<Bytes>>,
        pulse: &Pulse,
    ) -> Result<(), Trouble> {
        let most = self.desk.contact.chunk_bytes() as u64;
        while at < source.bytes {
            let bytes = most.min(source.bytes - at) as usize;
            let file = source.file.clone();
            let read = tokio::task::spawn_blocking(move || read_at(&file, at, bytes)).await;
            let read = read.unwrap_or_else(|e| Err(std::io::Error::other(e)));
            let chunk = read.map_err(|e| Trouble::Local(format!("{}: {e}", source.path.display())))?;
            self.desk.contact.may_send(bytes).await;
            if feed.send(Ok(chunk)).await.is_err() {
                // The request is over; its answer says why.
                return Ok(());
            }
            pulse.beat();
            at += bytes as u64;
            self.desk.report.at(at);
        }
        Ok(())
    }
}

/// When something moved last.
struct Pulse(Mutex<Instant>);

impl Pulse {
    fn new() -> Pulse {
        Pulse(Mutex::new(Instant::now()))
    }

    fn last(&self) -> Instant {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn beat(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
    }

    /// Ends when nothing has moved for so long.
    async fn stopped_for(&self, limit: Duration) {
        while self.last().elapsed() < limit {
            tokio::time::sleep_until(self.last() + limit).await;
        }
    }
}

fn read_at(file: &File, at: u64, bytes: usize) -> std::io::Result<Bytes> {
    let mut chunk = vec![0; bytes];
    file.read_exact_at(&mut chunk, at)?;
    Ok(chunk.into())
}

fn hash(file: &File, bytes: u64, progress: impl Fn(u64)) -> std::io::Result<String> {
    let (mut hash, mut buffer, mut at) = (Sha256::new(), vec![0; READ_BYTES], 0);
    while at < bytes {
        let read = file.read_at(&mut buffer, at)?;
        if read == 0 {
            return Err(std::io::Error::other("it became shorter while it was read"));
        }
        hash.update(&buffer[..read]);
        at += read as u64;
        progress(at);
    }
    Ok(hex(&hash.finalize()))
}

fn progress_of(answer: &Response) -> Result<Progress, Trouble> {
    let offset = text(answer, "upload-offset").and_then(|text| text.parse().ok());
    let offset_bytes = offset.ok_or_else(|| wrong_answer("no Upload-Offset"))?;
    Ok(Progress { offset_bytes, became: text(answer, "stria-run").zip(text(answer, "stria-job")) })
}

fn wrong_answer(what: &str) -> Trouble {
    // A page that some network shows before it lets one in looks like this.
    Trouble::passing(format!("the answer is not that of a Stria server ({what})"))
}

fn text(answer: &Response, name: &str) -> Option<String> {
    answer.headers().get(name).and_then(|v| v.to_str().ok()).map(String::from)
}
