//! Addresses, folders and limits: what the server may use and how long it waits. Flags set some; all have names here.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::db::DatabasePlace;
use crate::retention::Policy;
use crate::store::StorePlace;

/// Bytes in a GB as the flags count them.
pub const GB: u64 = 1_000_000_000;

/// What `stria serve` was told.
#[derive(Clone, Debug)]
pub struct Config {
    /// Where to listen.
    pub listen: SocketAddr,
    /// Where everything is.
    pub places: Places,
    /// Jobs that run at the same time.
    pub workers: usize,
    /// Who is let in.
    pub doors: Doors,
    /// How long runs are kept, where nobody stored other rules.
    pub retention: Policy,
    /// Limits of requests.
    pub requests: RequestLimits,
    /// Limits of uploads in pieces.
    pub uploads: UploadLimits,
    /// Limits of live streams.
    pub live: LiveLimits,
    /// Limits of jobs.
    pub jobs: JobLimits,
}

/// Who is let in, and how they come.
#[derive(Clone, Debug)]
pub struct Doors {
    /// False where whoever reaches the loopback may do everything.
    pub locked: bool,
    /// Certificate chain and key, PEM files.
    pub tls: Option<(PathBuf, PathBuf)>,
    /// Proxies whose `X-Forwarded-…` are believed.
    pub trusted_proxies: Vec<IpAddr>,
}

/// Where a process keeps what.
#[derive(Clone, Debug)]
pub struct Places {
    /// The process's own folder; where nothing else is said, the records and the files are in it as well.
    pub folder: PathBuf,
    /// The records.
    pub database: DatabasePlace,
    /// The files.
    pub store: StorePlace,
}

impl Places {
    /// Everything in one folder.
    pub fn in_folder(folder: &Path) -> Places {
        Places {
            folder: folder.to_path_buf(),
            database: DatabasePlace::Sqlite(folder.join("stria.db")),
            store: StorePlace::Folder(folder.join("store")),
        }
    }

    /// Uploads that are still coming in.
    pub fn incoming(&self) -> PathBuf {
        self.folder.join("incoming")
    }

    /// Maps of the differences between runs, while a server keeps them.
    pub fn changes(&self) -> PathBuf {
        self.folder.join("changes")
    }

    /// What attempts write before it is published.
    pub fn scratch(&self) -> PathBuf {
        self.folder.join("scratch")
    }

    /// Held by the one process that uses the folder.
    pub fn lock(&self) -> PathBuf {
        self.folder.join("lock")
    }

    /// The name of this folder's workers, the same after a restart.
    pub fn node(&self) -> PathBuf {
        self.folder.join("node")
    }
}

/// Limits of requests.
#[derive(Clone, Debug)]
pub struct RequestLimits {
    /// Largest upload, bytes.
    pub upload_bytes: u64,
    /// Largest body of any other request, and largest field of a form beside its file, bytes.
    pub small_body_bytes: usize,
    /// Most fields of a form.
    pub form_fields: usize,
    /// Uploads at the same time; further ones are asked to come back.
    pub uploads_at_once: usize,
    /// Room that must stay free on the disk of the process's folder, bytes: below it nothing more is taken in, and no
    /// job begins.
    pub disk_reserve_bytes: u64,
    /// Requests a second of one token or session, on average; further ones are asked to come back.
    pub per_s: u32,
    /// As many it may make at once.
    pub at_once: u32,
    /// Connections at the same time; further ones wait to be accepted.
    pub connections: usize,
    /// How long a client may take to send the head of a request, and to stay connected without one.
    pub head_timeout: Duration,
    /// How long a sender may be silent in the middle of a body.
    pub sender_silence: Duration,
    /// How long a receiver may take nothing of what is there for it.
    pub receiver_silence: Duration,
    /// How long anything but an upload may take until its answer begins.
    pub answer_timeout: Duration,
    /// How long open requests may go on after the server was asked to stop.
    pub stop_grace: Duration,
}

impl RequestLimits {
    /// Largest body of what is no upload, bytes.
    pub const SMALL_BODY_BYTES: usize = 256 * 1024;
}

impl Default for RequestLimits {
    fn default() -> Self {
        RequestLimits {
            upload_bytes: 64 * GB,
            small_body_bytes: RequestLimits::SMALL_BODY_BYTES,
            form_fields: 32,
            uploads_at_once: 16,
            disk_reserve_bytes: 2 * GB,
            per_s: 200,
            at_once: 2000,
            connections: 1024,
            head_timeout: Duration::from_secs(30),
            sender_silence: Duration::from_secs(60),
            receiver_silence: Duration::from_secs(60),
            answer_timeout: Duration::from_secs(30),
            stop_grace: Duration::from_secs(5),
        }
    }
}

/// Limits of uploads that arrive in pieces (tus).
#[derive(Clone, Debug)]
pub struct UploadLimits {
    /// Largest upload, bytes.
    pub upload_bytes: u64,
    /// Most received bytes that are not made durable and promised yet, apart from what lies in buffers …
    pub unpromised_bytes: u64,
    /// … and how long they may be so while more comes.
    pub sync_every: Duration,
    /// How long a request waits for the one before it to let go of an upload.
    pub takeover: Duration,
    /// An upload that nobody goes on with is kept this long.
    pub kept_for: Duration,
    /// That it expired is remembered this long.
    pub remembered_for: Duration,
}

impl UploadLimits {
    /// Bytes of a part on S3, so that the largest upload has no more parts than S3 takes.
    pub fn part_bytes(&self) -> u64 {
        const USUAL_BYTES: u64 = 8 << 20;
        USUAL_BYTES.max(self.upload_bytes.div_ceil(u64::from(crate::store::PARTS_MAX)).next_multiple_of(1 << 20))
    }
}

impl Default for UploadLimits {
    fn default() -> Self {
        UploadLimits {
            upload_bytes: 64 * GB,
            unpromised_bytes: 16 << 20,
            sync_every: Duration::from_secs(1),
            takeover: Duration::from_secs(3),
            kept_for: Duration::from_secs(7 * 86_400),
            remembered_for: Duration::from_secs(30 * 86_400),
        }
    }
}

/// Limits of live streams.
#[derive(Clone, Debug)]
pub struct LiveLimits {
    /// Largest frame, bytes.
    pub frame_bytes: usize,
    /// Frames that a sender may be ahead of what is durable.
    pub credit: u64,
    /// A segment is closed after this time …
    pub segment_time: Duration,
    /// … or so many bytes.
    pub segment_bytes: usize,
    /// So often a sender hears what is durable while it sends.
    pub ack_every: Duration,
    /// A connection that brings nothing for this long is closed.
    pub silence: Duration,
    /// How long a new connection waits for the one before it to let go of a stream.
    pub takeover: Duration,
    /// A robot that vanished has this long to come back before its run is closed.
    pub come_back: Duration,
    /// Live streams at the same time in one process.
    pub streams_at_once: usize,
}

impl Default for LiveLimits {
    fn default() -> Self {
        LiveLimits {
            frame_bytes: 32 << 20,
            credit: 120,
            segment_time: Duration::from_millis(200),
            segment_bytes: 8 << 20,
            ack_every: Duration::from_millis(250),
            silence: Duration::from_secs(30),
            takeover: Duration::from_secs(3),
            come_back: Duration::from_secs(60),
            streams_at_once: 16,
        }
    }
}

/// Limits of jobs.
#[derive(Clone, Debug)]
pub struct JobLimits {
    /// Attempts that may end in an error before the job fails.
    pub max_failures: i32,
    /// Attempts that may end with their worker (a crash, a kill, the loss of power) before the job fails.
    pub max_losses: i32,
    /// Wait before the second attempt; each further one waits [`JobLimits::RETRY_FACTOR`] times longer.
    pub retry_base: Duration,
    /// Longest wait between two attempts.
    pub retry_max: Duration,
    /// Wait of a job whose attempt ended because the records or the store were away.
    pub postpone: Duration,
    /// How often a worker gives a sign of life.
    pub heartbeat: Duration,
    /// A worker without a sign of life for this long has lost its lease. Measured on the clock of whoever watches,
    /// which no one sets, so that a jump of the wall clock ends no lease.
    pub lease: Duration,
    /// How long a worker tries to write what it has done while the records do not answer. Longer than a lease: whoever
    /// has lost its lease hears so when they answer again.
    pub record_patience: Duration,
    /// How long of this a worker takes that was asked to stop.
    pub stop_patience: Duration,
    /// How often a worker looks whether its job was cancelled.
    pub cancel_poll: Duration,
    /// Least time between two writes of progress.
    pub progress_every: Duration,
    /// Longest time of one attempt.
    pub time_limit: Duration,
    /// Most memory (data segment) of a child process, bytes.
    pub memory_bytes: u64,
    /// Longest line that a child may print, bytes; its last one holds the whole manifest.
    pub line_bytes: usize,
    /// How much of a child's last words is kept, bytes.
    pub last_words_bytes: usize,
    /// Most lines of a job's log.
    pub log_lines: i64,
    /// Most lines of one attempt's stderr that go into the log.
    pub stderr_lines: usize,
    /// Longest line of a job's log, characters.
    pub log_line_chars: usize,
    /// Largest recording segment, bytes.
    pub segment_bytes: u64,
    /// Most warnings kept with a job; the manifest has them all.
    pub warnings: usize,
}

impl JobLimits {
    /// How much longer each further wait between attempts is.
    pub const RETRY_FACTOR: u32 = 4;
}

impl Default for JobLimits {
    fn default() -> Self {
        JobLimits {
            max_failures: 3,
            max_losses: 10,
            retry_base: Duration::from_secs(1),
            retry_max: Duration::from_secs(300),
            postpone: Duration::from_secs(20),
            heartbeat: Duration::from_secs(5),
            lease: Duration::from_secs(60),
            record_patience: Duration::from_secs(3600),
            stop_patience: Duration::from_secs(10),
            cancel_poll: Duration::from_millis(300),
            progress_every: Duration::from_millis(500),
            time_limit: Duration::from_secs(12 * 3600),
            memory_bytes: 8 * GB,
            line_bytes: 64 * 1024 * 1024,
            last_words_bytes: 4096,
            log_lines: 2000,
            stderr_lines: 200,
            log_line_chars: 2000,
            segment_bytes: 256 * 1024 * 1024,
            warnings: 100,
        }
    }
}
