//! `stria work`: workers on another machine, on the records and the store that the servers use.

use std::io::Write;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use tokio_util::sync::CancellationToken;

use super::engine::{Engine, JobArgs, PlaceArgs, StopSignals, block_on, slots};
use super::logging::LogArgs;
use super::{Failed, Outcome, Success};
use crate::auth::Auth;
use crate::config::{JobLimits, Places, RequestLimits};
use crate::db::DatabasePlace;
use crate::error::Error;
use crate::http::{self, WorkerApp};
use crate::store::StorePlace;

/// Connections at the same time of those who ask how a worker is.
const WATCHERS: usize = 64;

/// Work on the jobs of servers on other machines
#[derive(Args)]
#[command(after_help = "Example: stria work --database postgres://stria@db/stria --store s3://walls\n\
                        Stop with Ctrl-C or SIGTERM: running jobs go back to the queue.")]
pub(super) struct Work {
    #[command(flatten)]
    places: PlaceArgs,
    /// Jobs at the same time [default: one per two processors]
    #[arg(long, value_name = "N", env = "STRIA_SLOTS")]
    slots: Option<usize>,
    /// This worker's own folder: scratch space, and the name by which it finds its jobs again after a crash
    #[arg(long, value_name = "DIR", default_value = "stria-work", env = "STRIA_DATA")]
    data: PathBuf,
    /// Answer /livez, /readyz and /metrics here, such as 127.0.0.1:9420; asked from another machine, /metrics needs a
    /// token that may read [default: nowhere]
    #[arg(long, value_name = "ADDR", env = "STRIA_METRICS_LISTEN")]
    metrics_listen: Option<SocketAddr>,
    #[command(flatten)]
    jobs: JobArgs,
    #[command(flatten)]
    log: LogArgs,
}

impl Work {
    pub(super) fn run(self) -> Outcome {
        let places = self.places.places(&self.data)?;
        let own = Places::in_folder(&self.data);
        // What lies in the worker's own folder no server can see.
        if matches!(places.database, DatabasePlace::Sqlite(_)) {
            return Err(Failed::Input(format!(
                "--database {}: SQLite serves one machine; expected the servers' postgres://USER:PASSWORD@HOST/NAME \
                 (on one machine, `stria serve` works itself)",
                places.database
            )));
        }
        if places.store == own.store {
            return Err(Failed::Input("--store is missing; expected the servers' s3://BUCKET/PREFIX or folder".into()));
        }
        if let StorePlace::Folder(folder) = &places.store
            && !folder.is_dir()
        {
            return Err(Failed::Input(format!("--store {}: there is no such folder", folder.display())));
        }
        let slots = slots("--slots", self.slots)?;
        if slots == 0 {
            return Err(Failed::Input("--slots is 0; expected at least 1".into()));
        }
        let (limits, reserve_bytes) = (self.jobs.limits()?, self.jobs.disk_reserve_bytes()?);
        block_on(async {
            self.log.start()?;
            work(places, limits, reserve_bytes, slots, self.metrics_listen).await
        })
        .map(|()| Success::Done)
    }
}

async fn work(
    places: Places,
    limits: JobLimits,
    reserve_bytes: u64,
    slots: usize,
    metrics_listen: Option<SocketAddr>,
) -> Result<(), Failed> {
    let failed = |e: Error| Failed::Other(e.to_string());
    let stop = CancellationToken::new();
    let mut signals = StopSignals::listen().map_err(|e| Failed::Other(format!("signals cannot be heard: {e}")))?;
    let engine = Engine::start(&places, &limits, reserve_bytes).await.map_err(failed)?;
    engine.store.ping().await.map_err(|e| Failed::Other(format!("--store {}: {e}", places.store)))?;
    let worker = engine.worker(&stop).await.map_err(failed)?;
    println!("Worker {} takes {slots} jobs at a time from {}", worker.name, places.database);
    let answer = match metrics_listen {
        Some(address) => Some(answer(address, &engine, &worker.confined.lacks(), &stop).await?),
        None => None,
    };
    let _ = std::io::stdout().flush();
    let relay = engine.relay(&stop);
    let mut work = tokio::spawn(worker.run(slots));
    let ended = tokio::select! {
        ended = &mut work => ended,
        () = signals.next() => {
            tracing::info!("stopping: running jobs go back to the queue");
            stop.cancel();
            tokio::select! {
                ended = &mut work => ended,
                () = signals.next() => std::process::exit(130),
            }
        }
    };
    match ended {
        Ok(result) => result.map_err(failed)?,
        Err(e) => return Err(Failed::Other(format!("the workers stopped: {e}"))),
    }
    if let Some(answer) = answer {
        let _ = answer.await;
    }
    stop.cancel();
    let _ = relay.await;
    engine.db.close().await.map_err(failed)
}

/// Says on its own address how this worker is.
async fn answer(
    address: SocketAddr,
    engine: &Engine,
    warnings: &[String],
    stop: &CancellationToken,
) -> Result<tokio::task::JoinHandle<()>, Failed> {
    let listener = http::connection::listen(address).await.map_err(|e| {
        Failed::Input(format!("--metrics-listen {address}: {e}; expected a free address of this machine"))
    })?;
    let address = listener.local_addr().map_err(|e| Failed::Other(e.to_string()))?;
    println!("Its counts are at http://{address}/metrics");
    let app = WorkerApp {
        listen: address,
        auth: Auth::new(engine.db.clone()),
        db: engine.db.clone(),
        queue: engine.queue.clone(),
        store: engine.store.clone(),
        disk: engine.disk.clone(),
        warnings: Arc::new(warnings.to_vec()),
        stop: stop.clone(),
    };
    let limits = RequestLimits { connections: WATCHERS, ..RequestLimits::default() };
    Ok(tokio::spawn(http::connection::serve(listener, http::worker_router(app), limits, None, stop.clone())))
}
