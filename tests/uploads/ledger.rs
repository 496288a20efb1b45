//! What a tunnel saw of each upload: how far the server said it was, how far the sender came, what was sent again.

use std::collections::BTreeMap;

/// What was seen.
#[derive(Default)]
pub(super) struct Ledger {
    uploads: BTreeMap<String, Account>,
}

/// What was seen of one upload, bytes.
#[derive(Clone, Debug, Default)]
pub(super) struct Account {
    /// The farthest that an answer confirmed to the sender.
    pub(super) confirmed: u64,
    /// The farthest byte that went to the server.
    pub(super) reached: u64,
    /// Bytes that went to the server more than once …
    pub(super) sent_again: u64,
    /// … and the most of them after one cut.
    pub(super) worst: u64,
    /// Pieces that began.
    pub(super) pieces: u32,
    /// What must not be, in words.
    pub(super) faults: Vec<String>,
    at: u64,
}

impl Ledger {
    /// A piece begins.
    pub(super) fn piece(&mut self, path: &str, offset: u64) {
        let account = self.uploads.entry(path.into()).or_default();
        account.pieces += 1;
        if offset < account.confirmed {
            let confirmed = account.confirmed;
            account.faults.push(format!("a piece begins at {offset}, but {confirmed} was confirmed"));
        }
        if offset > account.reached {
            let reached = account.reached;
            account.faults.push(format!("a piece begins at {offset}, but only {reached} bytes were ever sent"));
        }
        let again = account.reached.saturating_sub(offset);
        account.sent_again += again;
        account.worst = account.worst.max(again);
        account.at = offset;
    }

    /// Bytes of the piece go to the server.
    pub(super) fn sent(&mut self, path: &str, bytes: u64) {
        if let Some(account) = self.uploads.get_mut(path) {
            account.at += bytes;
            account.reached = account.reached.max(account.at);
        }
    }

    /// An answer reached the sender.
    pub(super) fn confirmed(&mut self, path: &str, offset: u64) {
        if let Some(account) = self.uploads.get_mut(path) {
            account.confirmed = account.confirmed.max(offset);
        }
    }

    /// What cannot be accounted for.
    pub(super) fn fault(&mut self, path: &str, words: &str) {
        self.uploads.entry(path.into()).or_default().faults.push(words.into());
    }

    /// What was seen of an upload.
    pub(super) fn of(&self, path: &str) -> Account {
        self.uploads.get(path).cloned().unwrap_or_default()
    }

    /// The farthest that any upload came.
    pub(super) fn reached(&self) -> u64 {
        self.uploads.values().map(|account| account.reached).max().unwrap_or(0)
    }
}

/// The requests of one connection, as far as they came.
#[derive(Default)]
pub(super) struct Requests {
    head: Vec<u8>,
    body_left: u64,
    path: String,
}

impl Requests {
    /// The path of the latest request.
    pub(super) fn path(&self) -> &str {
        &self.path
    }

    /// Reads on: these bytes went to the server.
    pub(super) fn read(&mut self, mut bytes: &[u8], ledger: &mut Ledger) {
        while !bytes.is_empty() {
            if self.body_left > 0 {
                let now = self.body_left.min(bytes.len() as u64);
                ledger.sent(&self.path, now);
                self.body_left -= now;
                bytes = &bytes[now as usize..];
                continue;
            }
            self.head.push(bytes[0]);
            bytes = &bytes[1..];
            if self.head.ends_with(b"\r\n\r\n") {
                let head = String::from_utf8_lossy(&std::mem::take(&mut self.head)).into_owned();
                self.begin(&head, ledger);
            }
        }
    }

    fn begin(&mut self, head: &str, ledger: &mut Ledger) {
        let mut words = head.split_whitespace();
        let (method, path) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
        self.path = path.into();
        self.body_left = field(head, "content-length").unwrap_or(0);
        if head.to_ascii_lowercase().contains("\r\ntransfer-encoding:") {
            ledger.fault(path, "a chunked body, whose bytes this ledger cannot count");
        }
        if method == "PATCH" {
            match field(head, "upload-offset") {
                Some(offset) => ledger.piece(path, offset),
                None => ledger.fault(path, "a piece without an offset"),
            }
        }
    }
}

/// A header that is a number, in the head of a message.
pub(super) fn field(head: &str, name: &str) -> Option<u64> {
    let lines = head.lines().filter_map(|line| line.split_once(':'));
    let mut values = lines.filter(|(found, _)| found.trim().eq_ignore_ascii_case(name)).map(|(_, value)| value);
    values.next_back()?.trim().parse().ok()
}

#[test]
fn a_ledger_counts_what_is_sent_again_and_what_must_not_be() {
    let mut ledger = Ledger::default();
    let mut requests = Requests::default();
    let request = |offset: u64| format!("PATCH /u HTTP/1.1\r\nUpload-Offset: {offset}\r\nContent-Length: 10\r\n\r\n");
    let all = [request(0).as_bytes(), b"0123456789", b"HEAD /u HTTP/1.1\r\n\r\n"].concat();
    for byte in all {
        requests.read(&[byte], &mut ledger);
    }
    ledger.confirmed("/u", 6);
    requests.read(request(6).as_bytes(), &mut ledger);
    requests.read(b"678", &mut ledger);
    let account = ledger.of("/u");
    assert_eq!((account.reached, account.sent_again, account.worst, account.pieces), (10, 4, 4, 2));
    assert!(account.faults.is_empty());
    for (offset, words) in [(5, "6 was confirmed"), (11, "only 10 bytes")] {
        Requests::default().read(request(offset).as_bytes(), &mut ledger);
        assert!(ledger.of("/u").faults.last().is_some_and(|fault| fault.contains(words)));
    }
}
