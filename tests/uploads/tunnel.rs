//! A network as a tunnel has it, between a client and a server: it cuts, stalls, delays and throttles as its dice say.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use stria_tests::support::dice::Dice;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::runtime::Runtime;

use super::ledger::{Ledger, Requests, field};

/// Bytes that are carried at once.
const CHUNK_BYTES: usize = 64 * 1024;
/// What may wait in the tunnel on its way to the server: what is lost with a reset, beside the server's own buffer.
const WAITING_BYTES: u32 = 256 * 1024;
/// One chunk of so many is followed by a stall …
const STALL_ONE_IN: usize = 64;
/// … of at most this, ms.
const STALL_MOST_MS: usize = 25;
/// Longest delay before a connection is made, ms.
const DELAY_MOST_MS: usize = 5;
/// Every second connection is throttled to so many MB/s, at random.
const THROTTLED_MB_S: std::ops::Range<usize> = 15..60;
/// One answer of so many is lost, and its connection with it.
const ANSWER_LOST_ONE_IN: usize = 12;

/// How connections end before their time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum End {
    /// Both sides are closed.
    Close,
    /// Both sides are reset: what lies in buffers is gone.
    Reset,
    /// The client loses its connection; the server never hears of it.
    Dead,
    /// The request arrived, its answer does not.
    AnswerLost,
}

/// What the tunnel does to those who use it.
#[derive(Clone, Copy)]
pub(super) struct Weather {
    /// Cuts before it becomes calm.
    pub(super) cuts: u32,
    /// Bytes between two cuts, on average.
    pub(super) bytes_between_cuts: usize,
    /// Most bytes a second of one connection, MB/s; else as the dice say.
    pub(super) throttle_mb_s: Option<usize>,
}

impl Weather {
    /// It carries, and does nothing else.
    pub(super) const CALM: Weather = Weather { cuts: 0, bytes_between_cuts: 1, throttle_mb_s: None };
}

/// A tunnel with its own port.
pub(super) struct Tunnel {
    address: SocketAddr,
    shared: Arc<Shared>,
    runtime: Option<Runtime>,
}

struct Shared {
    state: Mutex<State>,
    cut_now: tokio::sync::watch::Sender<Option<End>>,
}

struct State {
    servers: Vec<SocketAddr>,
    weather: Weather,
    dice: Dice,
    bytes_to_cut: usize,
    cuts: Vec<End>,
    ledger: Ledger,
    /// Connections whose client has gone.
    dead: Vec<TcpStream>,
}

impl Tunnel {
    /// To one of the servers, a random one for each connection.
    ///
    /// # Panics
    /// Where it cannot listen.
    pub(super) fn to(servers: &[&str], weather: Weather, seed: u64) -> Tunnel {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let runtime = runtime.expect("a runtime");
        let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).expect("a free port");
        let address = listener.local_addr().expect("an address");
        let mut dice = Dice::with_seed(seed);
        let bytes_to_cut = 1 + dice.throw(2 * weather.bytes_between_cuts);
        let state = State {
            servers: parsed(servers),
            weather,
            dice,
            bytes_to_cut,
            cuts: Vec::new(),
            ledger: Ledger::default(),
            dead: Vec::new(),
        };
        let shared = Arc::new(Shared { state: Mutex::new(state), cut_now: tokio::sync::watch::Sender::new(None) });
        runtime.spawn(accept(listener, shared.clone()));
        Tunnel { address, shared, runtime: Some(runtime) }
    }

    /// Leads elsewhere from now on.
    pub(super) fn lead_to(&self, servers: &[&str]) {
        self.shared.state().servers = parsed(servers);
    }

    /// Host and port of its near end.
    pub(super) fn authority(&self) -> String {
        self.address.to_string()
    }

    /// An address at its far end.
    pub(super) fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.address)
    }

    /// Ends all connections now.
    pub(super) fn cut(&self, end: End) {
        self.shared.cut_now.send_replace(Some(end));
    }

    /// The cuts so far.
    pub(super) fn cuts(&self) -> Vec<End> {
        self.shared.state().cuts.clone()
    }

    /// Looks at what it saw.
    pub(super) fn look<T>(&self, at: impl FnOnce(&Ledger) -> T) -> T {
        at(&self.shared.state().ledger)
    }
}

impl Drop for Tunnel {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

fn parsed(servers: &[&str]) -> Vec<SocketAddr> {
    servers.iter().map(|server| server.parse().expect("host and port")).collect()
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn chance(&mut self, one_in: usize) -> bool {
        self.cuts_left() && self.dice.throw(one_in) == 0
    }

    fn cuts_left(&self) -> bool {
        self.cuts.len() < self.weather.cuts as usize
    }

    /// Of so many bytes that came from the client: how many go on, and whether the connection ends there.
    fn spend(&mut self, bytes: usize) -> (usize, Option<End>) {
        if !self.cuts_left() || bytes < self.bytes_to_cut {
            self.bytes_to_cut = self.bytes_to_cut.saturating_sub(bytes).max(1);
            return (bytes, None);
        }
        let go_on = self.bytes_to_cut;
        self.bytes_to_cut = 1 + self.dice.throw(2 * self.weather.bytes_between_cuts);
        let end = [End::Close, End::Reset, End::Dead][self.dice.throw(3)];
        self.cuts.push(end);
        (go_on, Some(end))
    }

    fn pause_after(&mut self, bytes: usize, rate_mb_s: Option<usize>) -> Duration {
        let throttled = rate_mb_s.map_or(0, |mb_s| bytes / mb_s);
        let stalls = self.chance(STALL_ONE_IN);
        let stalled = if stalls { 1000 * self.dice.throw(STALL_MOST_MS) } else { 0 };
        Duration::from_micros((throttled + stalled) as u64)
    }
}

async fn accept(listener: TcpListener, shared: Arc<Shared>) {
    while let Ok((client, _)) = listener.accept().await {
        let shared = shared.clone();
        tokio::spawn(async move {
            let (server, delay, rate) = {
                let mut state = shared.state();
                let servers = state.servers.len();
                let which = state.dice.throw(servers);
                let delay = if state.cuts_left() { state.dice.throw(DELAY_MOST_MS) } else { 0 };
                let throttled = state.chance(2);
                let own = THROTTLED_MB_S.start + state.dice.throw(THROTTLED_MB_S.len());
                let rate = state.weather.throttle_mb_s.or(throttled.then_some(own));
                (state.servers[which], Duration::from_millis(delay as u64), rate)
            };
            tokio::time::sleep(delay).await;
            let socket = TcpSocket::new_v4().and_then(|s| s.set_send_buffer_size(WAITING_BYTES).map(|()| s));
            let Ok(socket) = socket else { return };
            // A server that is not there: the client finds its connection closed.
            let Ok(server) = socket.connect(server).await else { return };
            let _ = (server.set_nodelay(true), client.set_nodelay(true));
            carry(client, server, rate, &shared).await;
        });
    }
}

async fn carry(mut client: TcpStream, mut server: TcpStream, rate: Option<usize>, shared: &Shared) {
    let mut cut_now = shared.cut_now.subscribe();
    let (mut up, mut down) = (vec![0; CHUNK_BYTES], vec![0; CHUNK_BYTES]);
    let (mut requests, mut answers) = (Requests::default(), Vec::new());
    let end = loop {
        tokio::select! {
            biased;
            _ = cut_now.changed() => {
                if let Some(end) = *cut_now.borrow() {
                    break end;
                }
            }
            read = server.read(&mut down) => {
                let Ok(bytes @ 1..) = read else { break End::Close };
                let lost = {
                    let mut state = shared.state();
                    let lost = state.chance(ANSWER_LOST_ONE_IN);
                    if lost {
                        state.cuts.push(End::AnswerLost);
                    }
                    lost
                };
                if lost || client.write_all(&down[..bytes]).await.is_err() {
                    break End::AnswerLost;
                }
                answers.extend_from_slice(&down[..bytes]);
                if let Some(end) = answers.windows(4).rposition(|four| four == b"\r\n\r\n") {
                    let heads: Vec<u8> = answers.drain(..end + 4).collect();
                    if let Some(offset) = field(&String::from_utf8_lossy(&heads), "upload-offset") {
                        shared.state().ledger.confirmed(requests.path(), offset);
                    }
                }
            }
            read = client.read(&mut up) => {
                let Ok(bytes @ 1..) = read else { break End::Close };
                let (go_on, end) = shared.state().spend(bytes);
                if server.write_all(&up[..go_on]).await.is_err() {
                    break End::Close;
                }
                let pause = {
                    let mut state = shared.state();
                    requests.read(&up[..go_on], &mut state.ledger);
                    state.pause_after(go_on, rate)
                };
                if let Some(end) = end {
                    break end;
                }
                if !pause.is_zero() {
                    tokio::time::sleep(pause).await;
                }
            }
        }
    };
    match end {
        End::Close | End::AnswerLost => {}
        End::Reset => drop((client.set_zero_linger(), server.set_zero_linger())),
        End::Dead => shared.state().dead.push(server),
    }
}
