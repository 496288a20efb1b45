//! Live streams: frames become segments of a run's source as they come, durable before they are promised.
//!
//! A stream has a name (a robot's) and at most one open run. One connection at a time writes to it: a newer one takes over
//! from an older one, whose network is often dead. When the robot vanishes, the run stays open for a while; if it comes
//! back, the run goes on, else the run is closed and processed as it is.

mod watch;

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sea_orm::sea_query::Expr;
use sea_orm::{
    ActiveValue::Set, ColumnTrait, Condition, ConnectionTrait, EntityTrait, ExprTrait, QueryFilter, QueryOrder,
};
use sha2_resumable::Sha256;
use sha2_resumable::digest::Digest;
use stria_core::source::frame_file::append_record;
use stria_core::source::segments::SegmentKind;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

pub use watch::watch;

use crate::config::LiveLimits;
use crate::db::tables::{run, source_segment, stream};
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::error::{Error, Result};
use crate::queue::{Bell, Queue};
use crate::resumed_hash;
use crate::runs::{NewRun, Runs, SourceRecord};
use crate::store::{Key, Store};
use crate::turns::{Turn, Turns};
use crate::wire::Priority;
use crate::wire::time::now_ms;

/// Longest name of a stream, characters.
const MAX_NAME_CHARS: usize = 100;

/// Most ranges of missing frames that are kept; past them the last range grows.
const MAX_GAPS: usize = 10_000;

/// The live streams.
#[derive(Clone)]
pub struct Live {
    db: Db,
    store: Store,
    runs: Runs,
    bell: Bell,
    limits: LiveLimits,
    turns: Arc<Turns>,
}

/// What a connection says at first.
pub struct Hello {
    /// The stream's name.
    pub stream: String,
    /// What it brings.
    pub kind: SegmentKind,
    /// What the run will be, where one is begun.
    pub run: NewRun,
    /// Go on with the stream's open run, or at least with its numbers.
    pub resume: bool,
}

/// A stream as it stands.
#[derive(Clone, Debug)]
pub struct StreamState {
    /// Its name.
    pub name: String,
    /// Its latest run.
    pub run: String,
    /// That run's first job.
    pub job: String,
    /// What it brings: `frames` or `ts`.
    pub kind: String,
    /// The run is open.
    pub open: bool,
    /// Frames received.
    pub frames: u64,
    /// Bytes received.
    pub bytes: u64,
    /// Frames that were never sent: first and last of each range.
    pub missing: Vec<[u64; 2]>,
    /// When the run was opened, ms since 1970.
    pub opened_ms: i64,
}

impl Live {
    /// On the records and the store.
    pub fn new(db: Db, store: Store, runs: Runs, bell: Bell, limits: LiveLimits) -> Live {
        Live { db, store, runs, bell, limits, turns: Arc::default() }
    }

    /// The limits.
    pub fn limits(&self) -> &LiveLimits {
        &self.limits
    }

    /// Opens a stream for a connection, which takes it over from any other.
    pub async fn open(&self, hello: Hello) -> Result<Connection> {
        check_stream_name(&hello.stream)?;
        hello.run.check()?;
        let patience = self.limits.silence.min(Duration::from_secs(3));
        let turn = self.turns.take(&hello.stream, patience).await?;
        let row = retried(ANSWER_PATIENCE, || self.begin(&hello)).await?;
        self.bell.ring();
        let hash = resumed_hash::read(&row.hash_state)?;
        let missing = serde_json::from_str(&row.missing).unwrap_or_default();
        Ok(Connection {
            live: self.clone(),
            kind: hello.kind,
            next_seq: to_u64(row.next_seq),
            row,
            hash,
            missing,
            waiting: Vec::new(),
            waiting_frames: 0,
            waiting_since: None,
            first_time_ns: None,
            begins_part: true,
            turn,
        })
    }

    /// The stream's row for a new connection: of its open run, or of a new one.
    async fn begin(&self, hello: &Hello) -> Result<stream::Model> {
        let t = self.db.write().await?;
        let before = stream::Entity::find_by_id(&hello.stream).one(&*t).await?;
        if let Some(row) = &before
            && row.is_open != 0
        {
            let same = row.kind == hello.kind.extension() && self.same_asset(&*t, row, hello).await?;
            if hello.resume && same {
                let change =
                    stream::ActiveModel { fence: Set(row.fence + 1), beat: Set(row.beat + 1), ..Default::default() };
                stream::Entity::update_many().set(change).filter(stream::Column::Name.eq(&row.name)).exec(&*t).await?;
                t.commit().await?;
                return Ok(stream::Model { fence: row.fence + 1, beat: row.beat + 1, ..row.clone() });
            }
            close_run(&*t, row).await?;
        }
        let (fence, next_seq) =
            before.as_ref().map_or((1, 0), |row| (row.fence + 1, if hello.resume { row.next_seq } else { 0 }));
        let run = Queue::new_id();
        let extension = hello.kind.extension();
        let source = SourceRecord { kind: extension, extension, bytes: 0, sha256: "", open: true };
        let job = self.runs.insert(&*t, &run, hello.run.clone(), &source, Priority::Live).await?;
        let row = stream::Model {
            name: hello.stream.clone(),
            run_id: run,
            job_id: job,
            kind: extension.into(),
            is_open: 1,
            fence,
            beat: 0,
            next_seq,
            frames: 0,
            segments: 0,
            bytes: 0,
            missing: "[]".into(),
            hash_state: String::new(),
            opened_ms: now_ms(),
        };
        stream::Entity::delete_by_id(&row.name).exec(&*t).await?;
        stream::Entity::insert(stream::ActiveModel::from(row.clone())).exec_without_returning(&*t).await?;
        t.commit().await?;
        Ok(row)
    }

    async fn same_asset(&self, records: &impl ConnectionTrait, row: &stream::Model, hello: &Hello) -> Result<bool> {
        let run = run::Entity::find_by_id(&row.run_id).one(records).await?;
        Ok(run.is_some_and(|run| run.asset == hello.run.asset && run.source_open != 0))
    }

    /// The streams, the latest first.
    pub async fn list(&self) -> Result<Vec<StreamState>> {
        let rows = stream::Entity::find().order_by_desc(stream::Column::OpenedMs).all(self.db.read()).await?;
        Ok(rows.into_iter().map(said).collect())
    }
}

fn said(row: stream::Model) -> StreamState {
    StreamState {
        missing: serde_json::from_str(&row.missing).unwrap_or_default(),
        open: row.is_open != 0,
        frames: to_u64(row.frames),
        bytes: to_u64(row.bytes),
        name: row.name,
        run: row.run_id,
        job: row.job_id,
        kind: row.kind,
        opened_ms: row.opened_ms,
    }
}

/// A connection's right to write to a stream.
pub struct Connection {
    live: Live,
    kind: SegmentKind,
    row: stream::Model,
    /// The number that comes next; what is before it and not missing is durable or in `waiting`.
    next_seq: u64,
    hash: Sha256,
    missing: Vec<[u64; 2]>,
    /// The segment that grows.
    waiting: Vec<u8>,
    waiting_frames: u64,
    waiting_since: Option<Instant>,
    /// Capture time of the run's first frame, where it came through this connection.
    first_time_ns: Option<i64>,
    /// The next segment of a transport stream begins a stream of its own.
    begins_part: bool,
    turn: Turn,
}

impl Connection {
    /// The run.
    pub fn run(&self) -> &str {
        &self.row.run_id
    }

    /// Its first job.
    pub fn job(&self) -> &str {
        &self.row.job_id
    }

    /// The number of the first frame that is not durable.
    pub fn durable_next_seq(&self) -> u64 {
        to_u64(self.row.next_seq)
    }

    /// The number that comes next.
    pub fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// Frames received so far.
    pub fn frames(&self) -> u64 {
        to_u64(self.row.frames) + self.waiting_frames
    }

    /// The frames that were never sent.
    pub fn missing(&self) -> &[[u64; 2]] {
        &self.missing
    }

    /// Another connection wants the stream.
    pub fn wanted_by_another(&self) -> &CancellationToken {
        self.turn.wanted()
    }

    /// Takes a frame; one that came before is dropped. The image's CRC-32C is the caller's to check.
    pub fn push_frame(&mut self, seq: u64, capture_time_ns: i64, image: &[u8], image_crc32c: u32) {
        if seq < self.next_seq {
            return;
        }
        if seq > self.next_seq {
            self.note_missing(self.next_seq, seq - 1);
        }
        if self.row.frames == 0 && self.waiting_frames == 0 {
            self.first_time_ns = Some(capture_time_ns);
        }
        append_record(&mut self.waiting, seq, capture_time_ns, image, image_crc32c);
        self.next_seq = seq + 1;
        self.waiting_frames += 1;
        self.waiting_since.get_or_insert_with(Instant::now);
    }

    fn note_missing(&mut self, first: u64, last: u64) {
        let full = self.missing.len() >= MAX_GAPS;
        match self.missing.last_mut() {
            Some(range) if full || range[1] + 1 == first => range[1] = last,
            _ => self.missing.push([first, last]),
        }
    }

    /// Takes bytes of a transport stream.
    pub fn push_bytes(&mut self, bytes: &[u8]) {
        self.waiting.extend_from_slice(bytes);
        self.waiting_since.get_or_insert_with(Instant::now);
    }

    /// When the growing segment shall be closed; `None` where nothing waits.
    pub fn due_at(&self) -> Option<Instant> {
        let limits = &self.live.limits;
        let since = self.waiting_since?;
        let full = self.waiting.len() >= limits.segment_bytes || self.waiting_frames >= limits.credit;
        Some(if full { since } else { since + limits.segment_time })
    }

    /// Whether the growing segment shall be closed now.
    pub fn is_due(&self) -> bool {
        self.due_at().is_some_and(|due| due <= Instant::now())
    }

    /// Makes what waits durable, and known to the workers.
    ///
    /// # Errors
    /// [`Error::Locked`] where another server took the stream over, [`Error::Gone`] where the run was deleted or closed.
    pub async fn flush(&mut self) -> Result<()> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        let number = u32::try_from(self.row.segments).map_err(|_| Error::Internal("too many segments".into()))?;
        let key = Key::source_segment(&self.row.run_id, number, self.row.fence, self.kind.extension());
        // A failed write leaves it to be written again.
        let bytes = Bytes::copy_from_slice(&self.waiting);
        let (store, hash) = (&self.live.store, self.hash.clone().chain_update(&self.waiting));
        let facts = retried(ANSWER_PATIENCE, || store.put_durable(&key, bytes.clone())).await?;
        let part = self.begins_part && self.kind == SegmentKind::TransportStream;
        let segment = source_segment::Model {
            run_id: self.row.run_id.clone(),
            number: self.row.segments,
            fence: self.row.fence,
            bytes: to_i64(facts.bytes),
            sha256: facts.sha256,
            frames: to_i64(self.waiting_frames),
            part_arrival_ns: part.then(|| now_ms().saturating_mul(1_000_000)),
        };
        let row = stream::Model {
            beat: self.row.beat + 1,
            next_seq: to_i64(self.next_seq),
            frames: self.row.frames + segment.frames,
            segments: self.row.segments + 1,
            bytes: self.row.bytes + segment.bytes,
            missing: serde_json::to_string(&self.missing).unwrap_or_default(),
            hash_state: resumed_hash::write(&hash),
            ..self.row.clone()
        };
        retried(ANSWER_PATIENCE, || self.record(&segment, &row)).await?;
        self.live.bell.ring();
        (self.row, self.hash) = (row, hash);
        self.waiting.clear();
        (self.waiting_frames, self.waiting_since, self.begins_part) = (0, None, false);
        Ok(())
    }

    async fn record(&self, segment: &source_segment::Model, row: &stream::Model) -> Result<()> {
        let t = self.live.db.write().await?;
        let change = stream::ActiveModel {
            beat: Set(row.beat),
            next_seq: Set(row.next_seq),
            frames: Set(row.frames),
            segments: Set(row.segments),
            bytes: Set(row.bytes),
            missing: Set(row.missing.clone()),
            hash_state: Set(row.hash_state.clone()),
            ..Default::default()
        };
        if stream::Entity::update_many().set(change).filter(self.mine()).exec(&*t).await?.rows_affected == 0 {
            return Err(self.not_mine(&*t).await?);
        }
        let mut change = run::ActiveModel { source_bytes: Set(row.bytes), ..Default::default() };
        if let Some(time_ns) = self.first_time_ns.filter(|_| segment.number == 0) {
            change.recorded_ms = Set(time_ns.div_euclid(1_000_000));
        }
        let still_there = run::Column::Id.eq(&row.run_id).and(run::Column::SourceOpen.eq(1));
        if run::Entity::update_many().set(change).filter(still_there).exec(&*t).await?.rows_affected == 0 {
            return Err(Error::Gone("the run was deleted or closed".into()));
        }
        // A commit whose answer was lost is made again.
        source_segment::Entity::delete_by_id((row.run_id.clone(), segment.number)).exec(&*t).await?;
        source_segment::Entity::insert(source_segment::ActiveModel::from(segment.clone()))
            .exec_without_returning(&*t)
            .await?;
        t.commit().await
    }

    fn mine(&self) -> Condition {
        Condition::all()
            .add(stream::Column::Name.eq(&self.row.name))
            .add(stream::Column::Fence.eq(self.row.fence))
            .add(stream::Column::IsOpen.eq(1))
    }

    async fn not_mine(&self, records: &impl ConnectionTrait) -> Result<Error> {
        let row = stream::Entity::find_by_id(&self.row.name).one(records).await?;
        Ok(match row {
            Some(row) if row.fence == self.row.fence => Error::Gone("the run was closed".into()),
            _ => Error::Locked("another connection has taken the stream over".into()),
        })
    }

    /// A sign of life of the sender, who has nothing to send at the moment.
    pub async fn beat(&mut self) -> Result<()> {
        let t = self.live.db.write().await?;
        let change =
            stream::Entity::update_many().col_expr(stream::Column::Beat, Expr::col(stream::Column::Beat).add(1));
        if change.filter(self.mine()).exec(&*t).await?.rows_affected == 0 {
            return Err(self.not_mine(&*t).await?);
        }
        t.commit().await?;
        self.row.beat += 1;
        Ok(())
    }

    /// The sender has said that this was all: what waits is kept, and the run is closed.
    pub async fn end(&mut self) -> Result<()> {
        self.flush().await?;
        retried(ANSWER_PATIENCE, || self.try_end()).await?;
        self.live.bell.ring();
        Ok(())
    }

    async fn try_end(&self) -> Result<()> {
        let t = self.live.db.write().await?;
        close_run(&*t, &self.row).await?;
        t.commit().await
    }
}

/// Closes a stream's run: no further segment will come.
async fn close_run(records: &impl ConnectionTrait, row: &stream::Model) -> Result<()> {
    let sha256 = resumed_hash::finish(&row.hash_state)?;
    let change = run::ActiveModel { source_open: Set(0), source_sha256: Set(sha256), ..Default::default() };
    run::Entity::update_many().set(change).filter(run::Column::Id.eq(&row.run_id)).exec(records).await?;
    let change = stream::ActiveModel { is_open: Set(0), ..Default::default() };
    let mine = stream::Column::Name.eq(&row.name).and(stream::Column::RunId.eq(&row.run_id));
    stream::Entity::update_many().set(change).filter(mine).exec(records).await?;
    Ok(())
}

fn check_stream_name(name: &str) -> Result<()> {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    if !name.is_empty() && name.len() <= MAX_NAME_CHARS && name.chars().all(plain) {
        return Ok(());
    }
    let expected = format!("1 to {MAX_NAME_CHARS} letters, digits, '.', '_' or '-'");
    Err(Error::field("stream", format!("the stream's name is {name:?}"), expected))
}

fn to_i64(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

fn to_u64(value: i64) -> u64 {
    u64::try_from(value).unwrap_or(0)
}
