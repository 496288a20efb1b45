//! Chunks of data to RRD bytes: the recording's file, and the live segments beside it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rerun::external::re_build_info::CrateVersion;
use rerun::external::re_log_encoding::{EncodeError, Encoder, EncodingOptions};
use rerun::log::{Chunk, LogMsg};
use rerun::{EntityPath, SizeBytes, StoreId};

use super::budget::Share;
use crate::error::{Error, Result};
use crate::export::new_file::NewFile;

/// Data of one entity waits for this much of it before it is written as one chunk: few large chunks load fast.
const CHUNK_BYTES: u64 = 384 << 10;
const CHUNK_ROWS: usize = 4096;
/// Chunks of one row are joined as soon as there are so many: each takes some kilobytes for a few bytes of data.
const LOOSE_CHUNKS: usize = 32;
/// A live segment is written before it grows past this, whatever its age.
const SEGMENT_BYTES: u64 = 8 << 20;
/// What one chunk costs on top of its data: schema, names, types.
const CHUNK_OVERHEAD_BYTES: usize = 1_500;

/// A finished piece of a running recording: a complete RRD file of its own.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Segment {
    /// From 0, without gaps; the viewer gets them in this order.
    pub number: u32,
    /// Where it lies.
    pub path: PathBuf,
    /// Its size.
    pub bytes: u64,
}

/// Writes one recording.
pub(super) struct RrdStore {
    id: StoreId,
    path: PathBuf,
    file: Encoder<NewFile>,
    waiting: BTreeMap<EntityPath, Waiting>,
    live: Option<LiveSegments>,
}

/// Chunks of one entity that become one.
#[derive(Default)]
struct Waiting {
    chunks: Vec<Chunk>,
    /// The last of the chunks, that were never joined.
    loose: usize,
    rows: usize,
}

impl Waiting {
    fn push(&mut self, chunk: Chunk) {
        self.rows += chunk.num_rows();
        self.chunks.push(chunk);
        self.loose += 1;
        if self.loose >= LOOSE_CHUNKS {
            let loose = self.chunks.split_off(self.chunks.len() - self.loose);
            self.chunks.extend(joined(loose));
            self.loose = 0;
        }
    }

    fn is_full(&self) -> bool {
        self.rows >= CHUNK_ROWS || self.chunks.iter().map(SizeBytes::total_size_bytes).sum::<u64>() >= CHUNK_BYTES
    }
}

/// One chunk of them, or as few as their columns allow. Neighbours in pairs, then pairs of pairs: every byte is copied
/// only a few times.
fn joined(mut chunks: Vec<Chunk>) -> Vec<Chunk> {
    loop {
        let before = chunks.len();
        let mut joined = Vec::with_capacity(before.div_ceil(2));
        let mut rest = chunks.into_iter();
        while let Some(left) = rest.next() {
            match rest.next() {
                None => joined.push(left),
                Some(right) => match Chunk::concat_and_sort(&left, &right) {
                    Ok(both) => joined.push(both),
                    Err(_) => joined.extend([left, right]),
                },
            }
        }
        chunks = joined;
        if chunks.len() <= 1 || chunks.len() == before {
            return chunks;
        }
    }
}

impl RrdStore {
    /// Starts a recording that `opening` opens: its store's info, its blueprint. Nothing is at `path` before
    /// [`RrdStore::finish`].
    pub(super) fn create(
        id: StoreId,
        opening: Vec<LogMsg>,
        path: &Path,
        live: Option<LiveSegments>,
    ) -> Result<RrdStore> {
        let mut file = encoder(path)?;
        for message in &opening {
            file.append(message).map_err(|e| failed(path, e))?;
        }
        let live = live.map(|mut live| {
            live.start(opening);
            live
        });
        Ok(RrdStore { id, path: path.to_path_buf(), file, waiting: BTreeMap::new(), live })
    }

    /// Adds a chunk to the file and to the current live segment.
    pub(super) fn push(&mut self, chunk: Chunk) -> Result<()> {
        if let Some(live) = &mut self.live {
            live.push(message(&self.id, &chunk)?, chunk.total_size_bytes());
        }
        if chunk.is_static() {
            return self.write(&chunk);
        }
        let waiting = self.waiting.entry(chunk.entity_path().clone()).or_default();
        waiting.push(chunk);
        if waiting.is_full() {
            let full = std::mem::take(waiting);
            self.write_joined(full)?;
        }
        Ok(())
    }

    /// Adds a chunk to the current live segment alone: what is of the moment and not of the record.
    pub(super) fn push_live(&mut self, chunk: &Chunk) -> Result<()> {
        match &mut self.live {
            Some(live) => {
                live.push(message(&self.id, chunk)?, chunk.total_size_bytes());
                Ok(())
            }
            None => Ok(()),
        }
    }

    fn write_joined(&mut self, waiting: Waiting) -> Result<()> {
        joined(waiting.chunks).iter().try_for_each(|chunk| self.write(chunk))
    }

    fn write(&mut self, chunk: &Chunk) -> Result<()> {
        let message = message(&self.id, chunk)?;
        self.file.append(&message).map_err(|e| failed(&self.path, e))?;
        Ok(())
    }

    /// Whether a live segment is due.
    pub(super) fn segment_due(&self, costs: &Share) -> bool {
        self.live.as_ref().is_some_and(|live| live.due(costs))
    }

    /// Whether live segments are written at all.
    pub(super) fn is_live(&self) -> bool {
        self.live.is_some()
    }

    /// Writes the live segment, if there is anything in it.
    pub(super) fn cut_segment(&mut self, costs: &mut Share) -> Result<Option<Segment>> {
        match &mut self.live {
            Some(live) => live.cut(costs),
            None => Ok(None),
        }
    }

    /// Writes what waits, syncs the file and gives it its name.
    pub(super) fn finish(mut self) -> Result<()> {
        for (_, waiting) in std::mem::take(&mut self.waiting) {
            self.write_joined(waiting)?;
        }
        persist(self.file, &self.path, true)?;
        Ok(())
    }
}

/// The numbered segments of a recording that still runs.
pub(super) struct LiveSegments {
    dir: PathBuf,
    period: Duration,
    /// However much has been shown, people wait no longer than this.
    longest: Duration,
    head: Vec<LogMsg>,
    messages: Vec<LogMsg>,
    bytes: u64,
    last: Instant,
    next_number: u32,
}

impl LiveSegments {
    /// Segments in `dir`, one at most every `period`, which grows with what was shown up to `longest`.
    pub(super) fn new(dir: &Path, period: Duration, longest: Duration) -> Result<LiveSegments> {
        std::fs::create_dir_all(dir).map_err(|e| Error::io(dir, e))?;
        let dir = dir.to_path_buf();
        Ok(LiveSegments {
            dir,
            period,
            longest,
            head: vec![],
            messages: vec![],
            bytes: 0,
            last: Instant::now(),
            next_number: 0,
        })
    }

    /// Every segment begins with the store's info, so that each can be read alone; the first has the blueprint too.
    fn start(&mut self, opening: Vec<LogMsg>) {
        self.head = opening.iter().filter(|m| is_recording_info(m)).take(1).cloned().collect();
        self.messages = opening;
    }

    fn push(&mut self, message: LogMsg, bytes: u64) {
        if self.messages.is_empty() {
            self.messages.clone_from(&self.head);
        }
        self.messages.push(message);
        self.bytes += bytes;
    }

    fn due(&self, costs: &Share) -> bool {
        let first = self.next_number == 0;
        first
            || self.bytes >= SEGMENT_BYTES
            || self.last.elapsed() >= (self.period * (1 << costs.halvings().min(8))).min(self.longest)
    }

    fn cut(&mut self, costs: &mut Share) -> Result<Option<Segment>> {
        if self.messages.is_empty() {
            return Ok(None);
        }
        let number = self.next_number;
        let path = self.dir.join(format!("{number:06}.rrd"));
        let mut file = encoder(&path)?;
        for message in &self.messages {
            file.append(message).map_err(|e| failed(&path, e))?;
        }
        let bytes = persist(file, &path, false)?;
        costs.spend(self.messages.len() * CHUNK_OVERHEAD_BYTES);
        self.messages.clear();
        self.bytes = 0;
        self.last = Instant::now();
        self.next_number += 1;
        Ok(Some(Segment { number, path, bytes }))
    }
}

fn is_recording_info(message: &LogMsg) -> bool {
    matches!(message, LogMsg::SetStoreInfo(info) if info.info.store_id.is_recording())
}

fn message(id: &StoreId, chunk: &Chunk) -> Result<LogMsg> {
    let arrow = chunk.to_arrow_msg().map_err(|e| Error::internal("recording", e))?;
    Ok(LogMsg::ArrowMsg(id.clone(), arrow))
}

fn failed(path: &Path, error: EncodeError) -> Error {
    match error {
        EncodeError::Write(e) => Error::io(path, e),
        other => Error::internal("recording", other),
    }
}

/// An encoder into a temporary file beside `path`.
fn encoder(path: &Path) -> Result<Encoder<NewFile>> {
    let file = NewFile::create(path)?;
    Encoder::new_eager(CrateVersion::LOCAL, EncodingOptions::PROTOBUF_COMPRESSED, file).map_err(|e| failed(path, e))
}

/// Ends the file with its index and moves it to `path`; gives its size.
fn persist(mut encoder: Encoder<NewFile>, path: &Path, sync: bool) -> Result<u64> {
    encoder.finish().map_err(|e| failed(path, e))?;
    let file = encoder.into_inner().map_err(|e| failed(path, e))?;
    if sync {
        file.commit()?
    } else {
        file.commit_without_sync()?
    }
    Ok(std::fs::metadata(path).map_err(|e| Error::io(path, e))?.len())
}
