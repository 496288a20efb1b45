//! Frames on their way: on disk before anything else happens to them, until the server has them as safe.
//!
//! Segment files of the core's record format, named by their first frame. One thread appends; the sender reads behind it.
//! A process that dies leaves whole records and perhaps half of one, which the next process cuts off.

use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use stria_core::source::frame_file::{EXTENSION, FrameFile, FrameRecord, HEAD_BYTES, append_record, read_head};
use tokio::sync::watch;

use super::WhenFull;
use super::state::sync_folder_of;

/// How often what was written is made durable.
pub(super) const SYNC_EVERY: Duration = Duration::from_millis(250);
/// A segment is closed at this size, or at an eighth of the share, where that is less.
const SEGMENT_BYTES: u64 = 8 << 20;
/// How often a disk that is full is tried again.
const FULL_PAUSE: Duration = Duration::from_secs(1);

/// What became of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Appended {
    Kept,
    /// The share is full, and it was left out.
    Dropped,
    /// Nothing more is taken.
    Ended,
}

/// How far the writing is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Written {
    /// One past the last frame.
    pub(super) next_seq: u64,
    /// No more will come.
    pub(super) ended: bool,
}

/// The frames of one session.
pub(super) struct Spool {
    folder: PathBuf,
    cap_bytes: u64,
    segment_bytes: u64,
    inner: Mutex<Inner>,
    room: Condvar,
    written: watch::Sender<Written>,
}

struct Inner {
    segments: VecDeque<Segment>,
    /// The last segment, while it grows.
    growing: Option<File>,
    /// Written, perhaps not durable.
    unsynced: Vec<Arc<File>>,
    /// Frames before this one are safe on the server.
    done: u64,
    bytes: u64,
    dropped: u64,
    scratch: Vec<u8>,
}

struct Segment {
    path: PathBuf,
    first: u64,
    /// One past its last frame.
    next: u64,
    bytes: u64,
}

impl Spool {
    /// Opens what an earlier process left, or begins; with what was damaged, in words. `done`: frames before it are safe.
    pub(super) fn open(folder: &Path, cap_bytes: u64, done: u64) -> io::Result<(Spool, Vec<String>)> {
        let mut paths: Vec<PathBuf> = std::fs::read_dir(folder)?.flatten().map(|entry| entry.path()).collect();
        paths.retain(|path| path.extension().is_some_and(|e| e == EXTENSION));
        paths.sort();
        let (mut segments, mut damages) = (VecDeque::new(), Vec::new());
        for path in paths {
            let (segment, damage) = recover(&path)?;
            damages.extend(damage);
            match segment {
                Some(segment) => segments.push_back(segment),
                None => std::fs::remove_file(&path)?,
            }
        }
        let next_seq = segments.back().map_or(0, |last: &Segment| last.next).max(done);
        let inner = Inner {
            bytes: segments.iter().map(|segment| segment.bytes).sum(),
            segments,
            growing: None,
            unsynced: Vec::new(),
            done,
            dropped: 0,
            scratch: Vec::new(),
        };
        let spool = Spool {
            folder: folder.into(),
            cap_bytes,
            segment_bytes: SEGMENT_BYTES.min(cap_bytes / 8),
            inner: Mutex::new(inner),
            room: Condvar::new(),
            written: watch::Sender::new(Written { next_seq, ended: false }),
        };
        Ok((spool, damages))
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        // Each change is made after the disk has taken it, so that a panic leaves what is true.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How far the writing is, and hears of more.
    pub(super) fn written(&self) -> watch::Receiver<Written> {
        self.written.subscribe()
    }

    /// No more will come.
    pub(super) fn end(&self) {
        self.written.send_modify(|written| written.ended = true);
        self.room.notify_all();
    }

    /// The first frame that is not safe on the server.
    pub(super) fn first_undone(&self) -> u64 {
        let inner = self.inner();
        inner.segments.front().map_or(inner.done, |first| first.first.max(inner.done))
    }

    /// One past the last frame that was kept; what was left out after it is nobody's loss.
    pub(super) fn end_of_frames(&self) -> u64 {
        let inner = self.inner();
        inner.segments.back().map_or(inner.done, |last| last.next)
    }

    /// Frames that wait, frames that were left out, bytes on disk.
    pub(super) fn figures(&self) -> (u64, u64, u64) {
        let first = self.first_undone();
        let inner = self.inner();
        (self.written.borrow().next_seq.saturating_sub(first), inner.dropped, inner.bytes)
    }

    /// Keeps a frame. Blocks while the share is full and `when_full` says so.
    pub(super) fn append(
        &self,
        time_ns: i64,
        image: &[u8],
        image_crc32c: u32,
        when_full: WhenFull,
    ) -> io::Result<Appended> {
        let need = (HEAD_BYTES + image.len()) as u64;
        let mut inner = self.inner();
        loop {
            let Written { next_seq, ended } = *self.written.borrow();
            if ended {
                return Ok(Appended::Ended);
            }
            let room = inner.bytes + need <= self.cap_bytes;
            let written = if room { self.write(&mut inner, next_seq, time_ns, image, image_crc32c)? } else { false };
            if written {
                self.written.send_modify(|written| written.next_seq += 1);
                return Ok(Appended::Kept);
            }
            if when_full == WhenFull::Drop {
                inner.dropped += 1;
                // Its number stays free, so that the server knows that it is missing.
                self.written.send_modify(|written| written.next_seq += 1);
                return Ok(Appended::Dropped);
            }
            inner = self.room.wait_timeout(inner, FULL_PAUSE).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// False where the disk itself is full.
    fn write(&self, inner: &mut Inner, seq: u64, time_ns: i64, image: &[u8], crc: u32) -> io::Result<bool> {
        match self.try_write(inner, seq, time_ns, image, crc) {
            Ok(()) => Ok(true),
            Err(e) if matches!(e.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded) => Ok(false),
            Err(e) => Err(io::Error::new(e.kind(), format!("{}: {e}", self.folder.display()))),
        }
    }

    fn try_write(&self, inner: &mut Inner, seq: u64, time_ns: i64, image: &[u8], crc: u32) -> io::Result<()> {
        if inner.growing.is_none() || inner.segments.back().is_none_or(|last| last.bytes >= self.segment_bytes) {
            let path = self.folder.join(format!("{seq:020}.{EXTENSION}"));
            let file = OpenOptions::new().append(true).create(true).open(&path)?;
            sync_folder_of(&path)?;
            inner.growing = Some(file);
            inner.segments.push_back(Segment { path, first: seq, next: seq, bytes: 0 });
        }
        let mut scratch = std::mem::take(&mut inner.scratch);
        scratch.clear();
        append_record(&mut scratch, seq, time_ns, image, crc);
        let (Some(file), Some(segment)) = (&mut inner.growing, inner.segments.back_mut()) else {
            return Err(io::Error::other("a segment was opened but is not there"));
        };
        if let Err(error) = file.write_all(&scratch) {
            // Half a record must not stay between whole ones.
            file.set_len(segment.bytes)?;
            return Err(error);
        }
        let bytes = scratch.len() as u64;
        (segment.next, segment.bytes) = (seq + 1, segment.bytes + bytes);
        if inner.unsynced.is_empty() || segment.bytes == bytes {
            inner.unsynced.push(Arc::new(file.try_clone()?));
        }
        inner.bytes += bytes;
        inner.scratch = scratch;
        Ok(())
    }

    /// Makes durable what was written.
    pub(super) fn sync(&self) -> io::Result<()> {
        let files = std::mem::take(&mut self.inner().unsynced);
        files.iter().try_for_each(|file| file.sync_data())
    }

    /// Frames before `done` are safe on the server. The files that are not needed any more; they are not counted any
    /// more, and the caller's to delete.
    pub(super) fn forget(&self, done: u64) -> Vec<PathBuf> {
        let mut inner = self.inner();
        inner.done = inner.done.max(done);
        let mut over = Vec::new();
        while let Some(first) = inner.segments.front() {
            let grows = inner.growing.is_some() && inner.segments.len() == 1;
            if first.next > inner.done || grows {
                break;
            }
            inner.bytes -= first.bytes;
            over.extend(inner.segments.pop_front().map(|segment| segment.path));
        }
        drop(inner);
        self.room.notify_all();
        over
    }

    /// The segment that holds the frame, or the next one after it: path, first frame, bytes.
    fn find(&self, seq: u64) -> Option<(PathBuf, u64, u64)> {
        let inner = self.inner();
        let found = inner.segments.partition_point(|segment| segment.next <= seq);
        inner.segments.get(found).map(|segment| (segment.path.clone(), segment.first, segment.bytes))
    }
}

/// Reads behind the writer.
pub(super) struct Reader {
    /// The frame that is wanted next.
    pub(super) at: u64,
    open: Option<Open>,
    /// Frames that the disk did not give back as they were written.
    pub(super) damaged: u64,
}

struct Open {
    file: File,
    first: u64,
    offset: u64,
}

impl Reader {
    pub(super) fn new(at: u64) -> Reader {
        Reader { at, open: None, damaged: 0 }
    }

    /// The next frame and its CRC-32C; `None` where none is written yet.
    pub(super) fn next(&mut self, spool: &Spool) -> io::Result<Option<(FrameRecord, u32)>> {
        while let Some((path, first, bytes)) = spool.find(self.at) {
            let mut open = match self.open.take() {
                Some(open) if open.first == first => open,
                _ => Open { file: File::open(&path)?, first, offset: 0 },
            };
            let mut head = [0; HEAD_BYTES];
            while open.offset < bytes {
                open.file.read_exact_at(&mut head, open.offset)?;
                let head = read_head(&head).map_err(|e| io::Error::other(format!("{}: {e}", path.display())))?;
                let image_at = open.offset + HEAD_BYTES as u64;
                open.offset = image_at + head.image_bytes as u64;
                if head.seq < self.at {
                    continue;
                }
                let mut image = vec![0; head.image_bytes];
                open.file.read_exact_at(&mut image, image_at)?;
                self.at = head.seq + 1;
                if crc32c::crc32c(&image) != head.image_crc32c {
                    self.damaged += 1;
                    continue;
                }
                self.open = Some(open);
                let record = FrameRecord { seq: head.seq, capture_time_ns: head.capture_time_ns, image };
                return Ok(Some((record, head.image_crc32c)));
            }
            self.open = Some(open);
        }
        Ok(None)
    }
}

/// A segment of an earlier process, cut to its whole records; `None` where it has none.
fn recover(path: &Path) -> io::Result<(Option<Segment>, Option<String>)> {
    let mut file = FrameFile::open(path, &path.display().to_string()).map_err(io::Error::other)?;
    let mut segment: Option<Segment> = None;
    while let Some(record) = file.next_record() {
        let bytes = (HEAD_BYTES + record.image.len()) as u64;
        let found = segment.get_or_insert_with(|| Segment { path: path.into(), first: record.seq, next: 0, bytes: 0 });
        (found.next, found.bytes) = (record.seq + 1, found.bytes + bytes);
    }
    if file.damage.is_some() {
        let file = OpenOptions::new().write(true).open(path)?;
        file.set_len(segment.as_ref().map_or(0, |segment| segment.bytes))?;
        file.sync_all()?;
    }
    Ok((segment, file.damage))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(tag: u64, bytes: usize) -> Vec<u8> {
        let mut image = vec![tag as u8; bytes];
        image[..3].copy_from_slice(&[0xff, 0xd8, 0xff]);
        image
    }

    fn append(spool: &Spool, tag: u64, bytes: usize, when_full: WhenFull) -> Appended {
        let image = image(tag, bytes);
        spool.append(tag as i64, &image, crc32c::crc32c(&image), when_full).expect("appended")
    }

    fn drain(spool: &Spool, reader: &mut Reader) -> Vec<(u64, i64)> {
        let mut found = Vec::new();
        while let Some((record, _)) = reader.next(spool).expect("read") {
            assert_eq!(record.image, image(record.capture_time_ns as u64, record.image.len()));
            found.push((record.seq, record.capture_time_ns));
        }
        found
    }

    #[test]
    fn frames_come_back_in_order_while_more_are_written() {
        let folder = tempfile::tempdir().expect("folder");
        let (spool, _) = Spool::open(folder.path(), 80_000, 0).expect("opens");
        let mut reader = Reader::new(0);
        assert_eq!(drain(&spool, &mut reader), []);
        let mut found = Vec::new();
        for tag in 0..30 {
            assert_eq!(append(&spool, tag, 1500, WhenFull::Wait), Appended::Kept);
            if tag % 7 == 0 {
                found.extend(drain(&spool, &mut reader));
            }
        }
        found.extend(drain(&spool, &mut reader));
        assert_eq!(found, (0..30).map(|n| (n, n as i64)).collect::<Vec<_>>());
        assert_eq!(drain(&spool, &mut Reader::new(17)).first(), Some(&(17, 17)), "from the middle");
    }

    #[test]
    fn an_earlier_process_s_frames_are_there_again_and_a_cut_one_is_not() {
        let folder = tempfile::tempdir().expect("folder");
        let (spool, _) = Spool::open(folder.path(), 80_000, 0).expect("opens");
        for tag in 0..12 {
            append(&spool, tag, 3000, WhenFull::Wait);
        }
        spool.sync().expect("synced");
        let last = spool.inner().segments.back().expect("segments").path.clone();
        drop(spool);
        let file = OpenOptions::new().write(true).open(&last).expect("opens");
        file.set_len(file.metadata().expect("facts").len() - 10).expect("cut");
        let (spool, damages) = Spool::open(folder.path(), 80_000, 2).expect("opens");
        assert_eq!(damages.len(), 1);
        assert_eq!((spool.first_undone(), spool.written().borrow().next_seq), (2, 11));
        append(&spool, 50, 3000, WhenFull::Wait);
        let found = drain(&spool, &mut Reader::new(spool.first_undone()));
        let expected: Vec<_> = (2..11).map(|n| (n, n as i64)).chain([(11, 50)]).collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn a_full_share_drops_or_waits_and_goes_on_when_frames_are_safe() {
        let folder = tempfile::tempdir().expect("folder");
        let (spool, _) = Spool::open(folder.path(), 80_000, 0).expect("opens");
        let mut kept = 0;
        while append(&spool, kept, 5000, WhenFull::Drop) == Appended::Kept {
            kept += 1;
        }
        assert!((14..=16).contains(&kept), "{kept} frames of 5 kB in 80 kB");
        let (waiting, dropped, bytes) = spool.figures();
        assert_eq!((waiting, dropped), (kept + 1, 1));
        assert!(bytes <= 80_000);
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| append(&spool, 99, 5000, WhenFull::Wait));
            std::thread::sleep(Duration::from_millis(100));
            assert!(!waiting.is_finished(), "there is no room yet");
            let over = spool.forget(kept);
            assert!(!over.is_empty() && over.iter().all(|path| path.exists()), "the caller deletes");
            assert_eq!(waiting.join().expect("no panic"), Appended::Kept);
        });
        // The dropped frame's number is nobody's.
        assert_eq!(drain(&spool, &mut Reader::new(kept)), [(kept + 1, 99)]);
        spool.end();
        assert_eq!(append(&spool, 1, 5000, WhenFull::Wait), Appended::Ended);
    }

    #[test]
    fn whatever_is_safe_there_is_room_again() {
        let folder = tempfile::tempdir().expect("folder");
        let (spool, _) = Spool::open(folder.path(), 80_000, 0).expect("opens");
        for seq in 0..200 {
            assert_eq!(append(&spool, seq, 20_000, WhenFull::Drop), Appended::Kept, "frame {seq}");
            for path in spool.forget(seq + 1) {
                std::fs::remove_file(path).expect("deleted");
            }
        }
        assert!(std::fs::read_dir(folder.path()).expect("folder").count() <= 2);
    }
}
