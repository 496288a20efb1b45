//! A network between a sender and a server: one address that stays, while the server behind it comes and goes.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// What is kept of each connection's beginning, bytes.
const KEPT_BYTES: usize = 4096;

/// A relay; ends with the process.
#[derive(Clone)]
pub(super) struct Relay(Arc<Inner>);

struct Inner {
    address: SocketAddr,
    target: Mutex<Option<SocketAddr>>,
    open: Mutex<Vec<TcpStream>>,
    /// Bytes from senders to the server.
    up: AtomicU64,
    connections: AtomicU64,
    /// A connection is cut after so many bytes up; 0: never.
    cut_after: AtomicU64,
    /// Answers are swallowed, and their connections cut.
    deaf: AtomicBool,
    heard: Mutex<Vec<u8>>,
}

impl Relay {
    /// Listens; nothing is behind it yet.
    pub(super) fn start() -> Relay {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let relay = Relay(Arc::new(Inner {
            address: listener.local_addr().expect("an address"),
            target: Mutex::new(None),
            open: Mutex::default(),
            up: AtomicU64::new(0),
            connections: AtomicU64::new(0),
            cut_after: AtomicU64::new(0),
            deaf: AtomicBool::new(false),
            heard: Mutex::default(),
        }));
        let accepting = relay.clone();
        std::thread::spawn(move || {
            for sender in listener.incoming().flatten() {
                let relay = accepting.clone();
                std::thread::spawn(move || relay.carry(sender));
            }
        });
        relay
    }

    /// Its address, as a sender's `--server`.
    pub(super) fn url(&self) -> String {
        format!("http://{}", self.0.address)
    }

    /// Leads to another place, or nowhere; what is open is cut.
    pub(super) fn lead_to(&self, url: Option<&str>) {
        let parse = |url: &str| url.trim_start_matches("http://").parse().expect("an address");
        *self.0.target.lock().expect("lock") = url.map(parse);
        self.cut();
    }

    /// Cuts what is open.
    pub(super) fn cut(&self) {
        for stream in self.0.open.lock().expect("lock").drain(..) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    /// Cuts each connection after so many bytes up.
    pub(super) fn cut_after(&self, bytes: u64) {
        self.0.cut_after.store(bytes, Ordering::SeqCst);
    }

    /// Swallows answers, or lets them through again.
    pub(super) fn be_deaf(&self, deaf: bool) {
        self.0.deaf.store(deaf, Ordering::SeqCst);
    }

    /// Bytes from senders so far.
    pub(super) fn up(&self) -> u64 {
        self.0.up.load(Ordering::SeqCst)
    }

    /// Connections so far.
    pub(super) fn connections(&self) -> u64 {
        self.0.connections.load(Ordering::SeqCst)
    }

    /// What senders said first, as text.
    pub(super) fn heard(&self) -> String {
        String::from_utf8_lossy(&self.0.heard.lock().expect("lock")).into_owned()
    }

    /// Waits until so many bytes went up.
    ///
    /// # Panics
    /// Where that takes too long.
    pub(super) fn wait_for_up(&self, bytes: u64) {
        stria_tests::support::eventually("bytes on their way", || self.up() >= bytes);
    }

    fn carry(&self, mut sender: TcpStream) {
        self.0.connections.fetch_add(1, Ordering::SeqCst);
        let target = *self.0.target.lock().expect("lock");
        let server = target.and_then(|target| TcpStream::connect_timeout(&target, Duration::from_secs(5)).ok());
        let Some(mut server) = server else { return };
        let clones = (sender.try_clone().expect("clones"), server.try_clone().expect("clones"));
        let (mut to_sender, mut from_server) = clones;
        let ends = [sender.try_clone().expect("clones"), server.try_clone().expect("clones")];
        self.0.open.lock().expect("lock").extend(ends);
        let relay = self.clone();
        std::thread::spawn(move || {
            let mut buffer = vec![0; 64 << 10];
            while let Ok(read @ 1..) = from_server.read(&mut buffer) {
                if relay.0.deaf.load(Ordering::SeqCst) || to_sender.write_all(&buffer[..read]).is_err() {
                    break;
                }
            }
            let _ = to_sender.shutdown(Shutdown::Both);
            let _ = from_server.shutdown(Shutdown::Both);
        });
        let (mut buffer, mut carried) = (vec![0; 64 << 10], 0);
        while let Ok(read @ 1..) = sender.read(&mut buffer) {
            if carried == 0 {
                self.0.heard.lock().expect("lock").extend_from_slice(&buffer[..read.min(KEPT_BYTES)]);
            }
            if server.write_all(&buffer[..read]).is_err() {
                break;
            }
            self.0.up.fetch_add(read as u64, Ordering::SeqCst);
            carried += read as u64;
            let most = self.0.cut_after.load(Ordering::SeqCst);
            if most > 0 && carried >= most {
                break;
            }
        }
        let _ = sender.shutdown(Shutdown::Both);
        let _ = server.shutdown(Shutdown::Both);
    }
}
