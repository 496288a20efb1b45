//! A session: the frames of one mission, with what they were announced as and where the server has them.
//!
//! A mission that a crash or a reboot interrupts goes on in its session, and so in its run; another mission, or one whose
//! input had ended, is a session of its own. Sessions are sent one after the other, the oldest first.
//!
//! Frames have a number in the spool and one at the server (`wire`): wire = spool + shift. The shift changes where the
//! server begins a new run with numbers of its own.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::super::Failed;
use super::spool::Spool;
use super::state::write_whole;

const RECORD: &str = "session.json";

/// What must survive of a session, beside its frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    /// What the server is told first.
    pub(super) hello: Map<String, Value>,
    /// Where the frames go; `None` before the first welcome.
    pub(super) place: Option<Place>,
    /// Frames before it are safe on the server, whatever is still on disk.
    done: u64,
    /// The input has ended: no frame will be added.
    ended: bool,
    /// The server was told so.
    pub(super) end_said: bool,
}

/// A run that takes a session's frames.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Place {
    pub(super) run: String,
    pub(super) job: String,
    /// From spool numbers to wire numbers.
    pub(super) shift: i64,
    /// The run's first wire number.
    pub(super) first_wire: u64,
}

impl Place {
    pub(super) fn wire(&self, seq: u64) -> u64 {
        seq.saturating_add_signed(self.shift)
    }

    fn seq(&self, wire: u64) -> i128 {
        i128::from(wire) - i128::from(self.shift)
    }
}

/// A session.
pub(super) struct Session {
    folder: PathBuf,
    record: Mutex<Record>,
    pub(super) spool: Spool,
    /// One past the last frame that may have been sent.
    sent: Mutex<u64>,
}

impl Session {
    /// The sessions that were not delivered, the oldest first, and the one that this mission's frames go to. What is
    /// damaged is said.
    pub(super) fn open_all(
        root: &Path,
        hello: &Map<String, Value>,
        cap_bytes: u64,
    ) -> Result<(Vec<Session>, Session, Vec<String>), Failed> {
        let unusable = |e: std::io::Error| Failed::Other(format!("{}: {e}", root.display()));
        let mut numbers: Vec<u64> = std::fs::read_dir(root)
            .map_err(unusable)?
            .flatten()
            .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
            .collect();
        numbers.sort_unstable();
        let (mut sessions, mut damages) = (Vec::new(), Vec::new());
        for number in &numbers {
            let folder = root.join(number.to_string());
            match Session::read(&folder, cap_bytes).map_err(unusable)? {
                Some((session, damage)) => {
                    damages.extend(damage);
                    sessions.push(session);
                }
                None if is_empty(&folder) => std::fs::remove_dir_all(&folder).map_err(unusable)?,
                None => damages.push(format!("{}: its {RECORD} cannot be read; it is left alone", folder.display())),
            }
        }
        let goes_on = |session: &Session| !session.record().ended && session.record().hello == *hello;
        let own = match sessions.pop_if(|last| goes_on(last)) {
            Some(own) => own,
            None => {
                let number = numbers.last().map_or(0, |last| last + 1);
                Session::begin(&root.join(number.to_string()), hello, cap_bytes).map_err(unusable)?
            }
        };
        // The earlier ones get no more frames.
        sessions.iter().for_each(|session| session.spool.end());
        Ok((sessions, own, damages))
    }

    fn begin(folder: &Path, hello: &Map<String, Value>, cap_bytes: u64) -> std::io::Result<Session> {
        std::fs::create_dir_all(folder)?;
        let record = Record { hello: hello.clone(), place: None, done: 0, ended: false, end_said: false };
        let (spool, _) = Spool::open(folder, cap_bytes, 0)?;
        let session = Session { folder: folder.into(), record: Mutex::new(record), spool, sent: Mutex::new(0) };
        session.change(|_| {})?;
        Ok(session)
    }

    fn read(folder: &Path, cap_bytes: u64) -> std::io::Result<Option<(Session, Vec<String>)>> {
        let record = std::fs::read(folder.join(RECORD)).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok());
        let Some(record): Option<Record> = record else { return Ok(None) };
        let (spool, damages) = Spool::open(folder, cap_bytes, record.done)?;
        let sent = spool.written().borrow().next_seq;
        let session = Session { folder: folder.into(), record: Mutex::new(record), spool, sent: Mutex::new(sent) };
        Ok(Some((session, damages)))
    }

    fn lock(&self) -> MutexGuard<'_, Record> {
        // It is replaced as a whole, after the disk has it.
        self.record.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What is known of it.
    pub(super) fn record(&self) -> Record {
        self.lock().clone()
    }

    /// Where it lies.
    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Changes what is known, durably; blocks.
    pub(super) fn change(&self, change: impl FnOnce(&mut Record)) -> std::io::Result<()> {
        let mut record = self.lock();
        let mut changed = record.clone();
        change(&mut changed);
        write_whole(&self.folder.join(RECORD), &serde_json::to_vec_pretty(&changed)?)?;
        *record = changed;
        Ok(())
    }

    /// No frame will be added.
    pub(super) fn end_input(&self) -> std::io::Result<()> {
        if self.lock().ended {
            return Ok(());
        }
        self.spool.sync()?;
        self.change(|record| record.ended = true)?;
        self.spool.end();
        Ok(())
    }

    /// The server has told where it takes frames: settles the numbers, durably, and gives the first frame to send.
    pub(super) fn welcomed(&self, run: &str, job: &str, next_wire: u64) -> std::io::Result<u64> {
        let first_undone = self.spool.first_undone();
        let sent = (*self.sent.lock().unwrap_or_else(PoisonError::into_inner)).max(first_undone);
        let before = self.record().place;
        let same_run = before.as_ref().is_some_and(|place| place.run == run);
        // Where the server's numbers go on, it has all frames before its next one, also those of an earlier run.
        let next = before.as_ref().map(|place| place.seq(next_wire));
        let (at, shift_from) = match next {
            Some(next) if next >= i128::from(first_undone) && next <= i128::from(sent) => (next as u64, None),
            // Frames that the server has, and this machine lost with its power before they were safe on its own disk:
            // their numbers are taken.
            Some(next) if same_run && next > i128::from(sent) => (sent, Some(sent)),
            Some(_) if same_run => (first_undone, None),
            _ => (first_undone, Some(first_undone)),
        };
        let shift = match (shift_from, &before) {
            (Some(seq), _) => shift(seq, next_wire)?,
            (None, Some(place)) => place.shift,
            (None, None) => 0,
        };
        let first_wire = before.as_ref().filter(|_| same_run).map_or(next_wire, |place| place.first_wire);
        let place = Place { run: run.into(), job: job.into(), shift, first_wire };
        if before.as_ref() != Some(&place) {
            self.change(|record| record.place = Some(place))?;
        }
        self.safe_before(at)?;
        Ok(at)
    }

    /// The frame is about to be sent.
    pub(super) fn sending(&self, seq: u64) {
        let mut sent = self.sent.lock().unwrap_or_else(PoisonError::into_inner);
        *sent = (*sent).max(seq + 1);
    }

    /// The server's word that all up to a wire number is safe; the first spool number that is not.
    pub(super) fn durable(&self, wire: u64) -> std::io::Result<u64> {
        let next = self.lock().place.as_ref().map_or(0, |place| place.seq(wire) + 1);
        let sent = *self.sent.lock().unwrap_or_else(PoisonError::into_inner);
        // A server cannot have what was never sent.
        let next = u64::try_from(next.max(0)).unwrap_or(u64::MAX).min(sent);
        self.safe_before(next)?;
        Ok(next)
    }

    /// Frames before it are safe: what is known of that is durable before any of them is deleted.
    fn safe_before(&self, next: u64) -> std::io::Result<()> {
        let over = self.spool.forget(next);
        if over.is_empty() {
            return Ok(());
        }
        self.change(|record| record.done = record.done.max(next))?;
        over.iter().try_for_each(std::fs::remove_file)
    }

    /// Everything was delivered.
    pub(super) fn remove(&self) -> std::io::Result<()> {
        std::fs::remove_dir_all(&self.folder)
    }

    /// The server will not have it: it is kept out of the way of others; where.
    pub(super) fn set_aside(&self, why: &str) -> std::io::Result<PathBuf> {
        let shelf = self.folder.parent().unwrap_or(Path::new(".")).join("refused");
        std::fs::create_dir_all(&shelf)?;
        std::fs::write(self.folder.join("why.txt"), format!("{why}\n"))?;
        let place = shelf.join(crate::queue::Queue::new_id());
        std::fs::rename(&self.folder, &place)?;
        Ok(place)
    }
}

fn shift(seq: u64, wire: u64) -> std::io::Result<i64> {
    let shift = i128::from(wire) - i128::from(seq);
    i64::try_from(shift).map_err(|_| std::io::Error::other(format!("the server's next frame is {wire}")))
}

fn is_empty(folder: &Path) -> bool {
    std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_none())
}

#[cfg(test)]
mod tests {
    use super::super::WhenFull;
    use super::*;

    const CAP_BYTES: u64 = 1_000_000;

    fn hello(asset: &str) -> Map<String, Value> {
        [("asset".to_string(), Value::from(asset))].into_iter().collect()
    }

    fn open(root: &Path, asset: &str) -> (Vec<Session>, Session) {
        let (older, own, damages) = Session::open_all(root, &hello(asset), CAP_BYTES).ok().expect("opens");
        assert!(damages.is_empty(), "{damages:?}");
        (older, own)
    }

    fn push(session: &Session, frames: u64) {
        for _ in 0..frames {
            let image = [0xff, 0xd8, 0xff, 1];
            session.spool.append(1, &image, crc32c::crc32c(&image), WhenFull::Wait).expect("appended");
        }
    }

    fn send(session: &Session, seqs: std::ops::Range<u64>) {
        seqs.for_each(|seq| session.sending(seq));
    }

    #[test]
    fn an_interrupted_mission_goes_on_and_another_is_a_session_of_its_own() {
        let root = tempfile::tempdir().expect("folder");
        push(&open(root.path(), "a").1, 3);
        let (older, own) = open(root.path(), "a");
        assert_eq!((older.len(), own.spool.written().borrow().next_seq), (0, 3));
        drop(own);
        let (older, own) = open(root.path(), "b");
        assert_eq!((older.len(), own.spool.written().borrow().next_seq), (1, 0));
        assert!(older[0].spool.written().borrow().ended);
        push(&own, 1);
        own.end_input().expect("ended");
        drop((older, own));
        let (older, own) = open(root.path(), "b");
        assert_eq!((older.len(), own.record().hello), (2, hello("b")), "its input had ended");
        let assets: Vec<_> = older.iter().map(|session| session.record().hello["asset"].clone()).collect();
        assert_eq!(assets, ["a", "b"]);
    }

    #[test]
    fn numbers_fit_whatever_the_server_says() {
        let root = tempfile::tempdir().expect("folder");
        let (_, session) = open(root.path(), "a");
        push(&session, 10);
        // A stream whose numbers go on from another robot's run.
        assert_eq!(session.welcomed("r1", "j1", 100).expect("place"), 0);
        assert_eq!(session.record().place.expect("place").wire(4), 104);
        send(&session, 0..8);
        assert_eq!(session.durable(104).expect("durable"), 5);
        // The connection breaks; two more had become durable.
        assert_eq!(session.welcomed("r1", "j1", 107).expect("place"), 7);
        send(&session, 7..10);
        assert_eq!(session.durable(109).expect("durable"), 10);
        // The server closed the run meanwhile; the stream's numbers go on, and nothing is sent twice.
        push(&session, 2);
        assert_eq!(session.welcomed("r2", "j2", 110).expect("place"), 10);
        assert_eq!(session.record().place.expect("place").first_wire, 110);
        send(&session, 10..11);
        // Another server, which knows nothing: it gets what is not safe, from number 0.
        assert_eq!(session.welcomed("r3", "j3", 0).expect("place"), 10);
        assert_eq!(session.record().place.expect("place").wire(10), 0);
    }

    #[test]
    fn frames_that_only_the_server_kept_do_not_hide_new_ones() {
        let root = tempfile::tempdir().expect("folder");
        let (_, session) = open(root.path(), "a");
        push(&session, 5);
        session.welcomed("r1", "j1", 0).expect("place");
        drop(session);
        // The server had got frames 5 to 7, too; the power went before they were safe here.
        let (_, session) = open(root.path(), "a");
        push(&session, 2);
        assert_eq!(session.welcomed("r1", "j1", 8).expect("place"), 5);
        let place = session.record().place.expect("place");
        assert_eq!((place.wire(5), place.wire(6)), (8, 9));
        assert_eq!(session.durable(8).expect("durable"), 5, "not sent yet, so not safe");
        send(&session, 5..6);
        assert_eq!(session.durable(8).expect("durable"), 6);
    }
}
