//! Live streams: frames become segments of a run's source as they come, durable before they are promised.
//!
//! A stream has a name (a robot's) and at most one open run. One connection at a time writes to it: a newer one takes over
//! from an older one, whose network is often dead. When the robot vanishes, the run stays open for a while; if it comes
//! back, the run goes on, else the run is closed and processed as it is.

mod watch;

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use sea_orm::sea_query::Expr;
use sea_orm::{
    ActiveModelTrait, ActiveValue::Set, ColumnTrait, Condition, ConnectionTrait, EntityTrait, ExprTrait, QueryFilter,
    QueryOrder, QuerySelect,
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
use crate::runs::{NewRun, Page, Runs, SourceRecord};
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
        let turn = self.turns.take(&hello.stream, self.limits.takeover).await?;
        let row = retried(ANSWER_PATIENCE, || self.begin(&hello)).await?;
        self.bell.ring();
        let hash = resumed_hash::read(&row.hash_state)?;
        let missing = read_gaps(&row)?;
        Ok(Connection {
            live: self.clone(),
            kind: hello.kind,
            row,
            hash,
            missing,
            waiting_frames: BTreeMap::new(),
            waiting_bytes: Vec::new(),
            waiting_size_bytes: 0,
            waiting_since: None,
            begins_part: true,
            turn,
        })
    }

    /// The stream's row for a new connection: of its open run, or of a new one.
    async fn begin(&self, hello: &Hello) -> Result<stream::Model> {
        let t = self.db.write().await?;
        let before = stream::Entity::find_by_id(&hello.stream).lock_exclusive().one(&*t).await?;
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
        let record = stream::ActiveModel::from(row.clone());
        if before.is_some() {
            stream::Entity::update(record.reset_all()).exec(&*t).await?;
        } else {
            // A row that another server made since nobody had one is not ours to replace: this fails, and is tried again.
            stream::Entity::insert(record).exec_without_returning(&*t).await?;
        }
        t.commit().await?;
        Ok(row)
    }

    async fn same_asset(&self, records: &impl ConnectionTrait, row: &stream::Model, hello: &Hello) -> Result<bool> {
        let run = run::Entity::find_by_id(&row.run_id).one(records).await?;
        Ok(run.is_some_and(|run| run.asset == hello.run.asset && run.source_open != 0))
    }

    /// A page of the streams, those opened last first.
    pub async fn list(&self, page: &Page) -> Result<(Vec<StreamState>, Option<String>)> {
        // Names of runs grow with time.
        let mut query = stream::Entity::find().order_by_desc(stream::Column::RunId).limit(page.limit + 1);
        if let Some(cursor) = &page.cursor {
            query = query.filter(stream::Column::RunId.lt(cursor.as_str()));
        }
        let mut rows = query.all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |row| row.run_id.clone());
        Ok((rows.into_iter().map(said).collect::<Result<_>>()?, next_cursor))
    }
}

fn said(row: stream::Model) -> Result<StreamState> {
    Ok(StreamState {
        missing: read_gaps(&row)?,
        open: row.is_open != 0,
        frames: to_u64(row.frames),
        bytes: to_u64(row.bytes),
        name: row.name,
        run: row.run_id,
        job: row.job_id,
        kind: row.kind,
        opened_ms: row.opened_ms,
    })
}

/// A list that cannot be read is no empty list.
fn read_gaps(row: &stream::Model) -> Result<Vec<[u64; 2]>> {
    serde_json::from_str(&row.missing)
        .map_err(|e| Error::Internal(format!("the gaps of stream {} cannot be read: {e}", row.name)))
}

/// A frame that is not durable yet.
struct WaitingFrame {
    capture_time_ns: i64,
    image: Bytes,
    image_crc32c: u32,
}

/// A segment as it is written, and what it says of the stream.
struct Sealed {
    bytes: Vec<u8>,
    next_seq: u64,
    missing: Vec<[u64; 2]>,
    /// Capture time of its first frame.
    first_time_ns: Option<i64>,
}

/// A connection's right to write to a stream.
pub struct Connection {
    live: Live,
    kind: SegmentKind,
    row: stream::Model,
    hash: Sha256,
    missing: Vec<[u64; 2]>,
    /// The segment that grows: frames by their numbers, so that what is only a little late still finds its place, or
    /// bytes of a transport stream.
    waiting_frames: BTreeMap<u64, WaitingFrame>,
    waiting_bytes: Vec<u8>,
    waiting_size_bytes: usize,
    waiting_since: Option<Instant>,
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
        self.waiting_frames.last_key_value().map_or(self.durable_next_seq(), |(seq, _)| seq + 1)
    }

    /// Frames received so far.
    pub fn frames(&self) -> u64 {
        to_u64(self.row.frames) + self.waiting_frames.len() as u64
    }

    /// The frames before the first that is not durable that were never sent, or came too late.
    pub fn missing(&self) -> &[[u64; 2]] {
        &self.missing
    }

    /// Another connection wants the stream.
    pub fn wanted_by_another(&self) -> &CancellationToken {
        self.turn.wanted()
    }

    /// Takes a frame. One that is there already is dropped, and so is one whose place is behind what is durable: the
    /// job has passed it; false says so. The image's CRC-32C is the caller's to check.
    pub fn push_frame(&mut self, seq: u64, capture_time_ns: i64, image: Bytes, image_crc32c: u32) -> bool {
        if seq < self.durable_next_seq() || self.waiting_frames.contains_key(&seq) {
            return false;
        }
        self.waiting_size_bytes += image.len();
        self.waiting_frames.insert(seq, WaitingFrame { capture_time_ns, image, image_crc32c });
        self.waiting_since.get_or_insert_with(Instant::now);
        true
    }

    /// Takes bytes of a transport stream.
    pub fn push_bytes(&mut self, bytes: &[u8]) {
        self.waiting_size_bytes += bytes.len();
        self.waiting_bytes.extend_from_slice(bytes);
        self.waiting_since.get_or_insert_with(Instant::now);
    }

    /// What waits, as it will be written.
    fn seal(&self) -> Sealed {
        let (mut bytes, mut missing) = (self.waiting_bytes.clone(), self.missing.clone());
        let mut next_seq = self.durable_next_seq();
        for (seq, frame) in &self.waiting_frames {
            if *seq > next_seq {
                note_missing(&mut missing, next_seq, seq - 1);
            }
            append_record(&mut bytes, *seq, frame.capture_time_ns, &frame.image, frame.image_crc32c);
            next_seq = seq + 1;
        }
        let first_time_ns = self.waiting_frames.first_key_value().map(|(_, frame)| frame.capture_time_ns);
        Sealed { bytes, next_seq, missing, first_time_ns }
    }

    /// When the growing segment shall be closed; `None` where nothing waits.
    pub fn due_at(&self) -> Option<Instant> {
        let limits = &self.live.limits;
        let since = self.waiting_since?;
        let full = self.waiting_size_bytes >= limits.segment_bytes || self.waiting_frames.len() as u64 >= limits.credit;
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
        if self.waiting_since.is_none() {
            return Ok(());
        }
        let number = u32::try_from(self.row.segments).map_err(|_| Error::Internal("too many segments".into()))?;
        let key = Key::source_segment(&self.row.run_id, number, self.row.fence, self.kind.extension());
        // A failed write leaves what waits to be written again.
        let sealed = self.seal();
        let bytes = Bytes::from(sealed.bytes);
        let (store, hash) = (&self.live.store, self.hash.clone().chain_update(&bytes));
        let facts = retried(ANSWER_PATIENCE, || store.put_durable(&key, bytes.clone())).await?;
        let part = self.begins_part && self.kind == SegmentKind::TransportStream;
        let segment = source_segment::Model {
            run_id: self.row.run_id.clone(),
            number: self.row.segments,
            fence: self.row.fence,
            bytes: to_i64(facts.bytes),
            sha256: facts.sha256,
            frames: self.waiting_frames.len() as i64,
            part_arrival_ns: part.then(|| now_ms().saturating_mul(1_000_000)),
        };
        let row = stream::Model {
            beat: self.row.beat + 1,
            next_seq: to_i64(sealed.next_seq),
            frames: self.row.frames + segment.frames,
            segments: self.row.segments + 1,
            bytes: self.row.bytes + segment.bytes,
            missing: serde_json::to_string(&sealed.missing)
                .map_err(|e| Error::Internal(format!("a list of gaps is not JSON: {e}")))?,
            hash_state: resumed_hash::write(&hash),
            ..self.row.clone()
        };
        retried(ANSWER_PATIENCE, || self.record(&segment, &row, sealed.first_time_ns)).await?;
        self.live.bell.ring();
        (self.row, self.hash, self.missing) = (row, hash, sealed.missing);
        self.waiting_frames.clear();
        self.waiting_bytes.clear();
        (self.waiting_size_bytes, self.waiting_since, self.begins_part) = (0, None, false);
        Ok(())
    }

    async fn record(
        &self,
        segment: &source_segment::Model,
        row: &stream::Model,
        first_time_ns: Option<i64>,
    ) -> Result<()> {
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
        if let Some(time_ns) = first_time_ns.filter(|_| segment.number == 0) {
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
            .add(stream::Column::RunId.eq(&self.row.run_id))
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

fn note_missing(missing: &mut Vec<[u64; 2]>, first: u64, last: u64) {
    let full = missing.len() >= MAX_GAPS;
    match missing.last_mut() {
        Some(range) if full || range[1] + 1 == first => range[1] = last,
        _ => missing.push([first, last]),
    }
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
