//! `stria serve`: records, store, workers and HTTP in one process, until it is asked to stop.

use std::fs::{File, TryLockError};
use std::io::Write;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use super::{Failed, Outcome, Success};
use crate::config::{Config, GB, JobLimits, RequestLimits};
use crate::db::Db;
use crate::error::{Error, Result};
use crate::http::{self, App};
use crate::queue::Queue;
use crate::runs::Runs;
use crate::store::Store;
use crate::worker::Worker;
use crate::{incoming, retention};

/// Run the service: runs come in over HTTP, jobs process them, staff look at the results in a browser
#[derive(Args)]
#[command(after_help = "Everything is kept in --data: records, files, scratch space. Stop with Ctrl-C or SIGTERM: \
                        running jobs go back to the queue and go on at the next start.")]
pub(super) struct Serve {
    /// Where to listen; port 0 takes a free one
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8420", env = "STRIA_LISTEN")]
    listen: SocketAddr,
    /// The folder that keeps everything
    #[arg(long, value_name = "DIR", default_value = "stria-data", env = "STRIA_DATA")]
    data: PathBuf,
    /// Jobs at the same time; 0 takes runs in and lets them wait [default: one per two processors]
    #[arg(long, value_name = "N", env = "STRIA_WORKERS")]
    workers: Option<usize>,
    /// Largest upload, GB
    #[arg(long, value_name = "GB", default_value_t = 64.0, env = "STRIA_MAX_UPLOAD_GB")]
    max_upload_gb: f64,
    /// Longest time of one attempt at a job, hours
    #[arg(long, value_name = "H", default_value_t = 12.0, env = "STRIA_JOB_TIME_LIMIT_H")]
    job_time_limit_h: f64,
    /// Most memory of one job, GB
    #[arg(long, value_name = "GB", default_value_t = 8.0, env = "STRIA_JOB_MEMORY_LIMIT_GB")]
    job_memory_limit_gb: f64,
    /// Listen on a network although there is no authentication: whoever reaches the port can do everything
    #[arg(long, env = "STRIA_WITHOUT_AUTHENTICATION")]
    without_authentication: bool,
}

impl Serve {
    pub(super) fn run(self) -> Outcome {
        log_to_stderr();
        let config = self.config()?;
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
        let runtime = runtime.map_err(|e| Failed::Other(format!("the async runtime did not start: {e}")))?;
        let served = runtime.block_on(serve(config));
        // Reads of stdin and the like may never end; they must not keep a stopped server alive.
        runtime.shutdown_timeout(Duration::from_secs(1));
        served.map(|()| Success::Done)
    }

    fn config(&self) -> std::result::Result<Config, Failed> {
        if !self.listen.ip().is_loopback() && !self.without_authentication {
            return Err(Failed::Input(format!(
                "--listen {}: this version of Stria has no authentication, so whoever reaches the port can read, change \
                 and delete every run; expected an address of this machine (127.0.0.1:8420), or \
                 --without-authentication where the network lets in only those who may do all that",
                self.listen
            )));
        }
        let positive = |name: &str, value: f64, most: f64, unit: &str| {
            if value > 0.0 && value <= most {
                return Ok(value);
            }
            Err(Failed::Input(format!("{name} is {value} {unit}; expected more than 0, at most {most} {unit}")))
        };
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let workers = self.workers.unwrap_or((processors / 2).max(1));
        if workers > 1024 {
            return Err(Failed::Input(format!("--workers is {workers}; expected at most 1024")));
        }
        let upload_bytes = (positive("--max-upload-gb", self.max_upload_gb, 1e6, "GB")? * GB as f64) as u64;
        let time_limit = positive("--job-time-limit-h", self.job_time_limit_h, 1e5, "h")? * 3600.0;
        let memory_bytes = (positive("--job-memory-limit-gb", self.job_memory_limit_gb, 1e6, "GB")? * GB as f64) as u64;
        Ok(Config {
            listen: self.listen,
            data_dir: self.data.clone(),
            workers,
            requests: RequestLimits { upload_bytes, ..RequestLimits::default() },
            jobs: JobLimits { time_limit: Duration::from_secs_f64(time_limit), memory_bytes, ..JobLimits::default() },
        })
    }
}

/// Ctrl-C and SIGTERM.
pub(super) struct StopSignals {
    interrupt: Signal,
    terminate: Signal,
}

impl StopSignals {
    /// Hears them from now on.
    pub(super) fn listen() -> std::io::Result<StopSignals> {
        Ok(StopSignals { interrupt: signal(SignalKind::interrupt())?, terminate: signal(SignalKind::terminate())? })
    }

    /// The next of them.
    pub(super) async fn next(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
    }
}

async fn serve(config: Config) -> std::result::Result<(), Failed> {
    let failed = |e: Error| Failed::Other(e.to_string());
    let stop = CancellationToken::new();
    let mut signals = StopSignals::listen().map_err(|e| Failed::Other(format!("signals cannot be heard: {e}")))?;
    let _lock = prepare(&config).map_err(failed)?;
    let listener = http::connection::listen(config.listen).await.map_err(|e| {
        Failed::Input(format!("--listen {}: {e}; expected a free address of this machine", config.listen))
    })?;
    let address = listener.local_addr().map_err(|e| Failed::Other(e.to_string()))?;
    let db = Db::open_sqlite(&config.database()).await.map_err(failed)?;
    let queue = Queue::new(db.clone(), config.jobs.clone());
    let store = Store::open(&config.store()).map_err(failed)?;
    let worker = worker(&config, &db, &queue, &store, &stop).map_err(failed)?;
    let app = App {
        runs: Runs::new(db.clone(), queue.clone(), store.clone()),
        queue: queue.clone(),
        store: store.clone(),
        uploads: Arc::new(Semaphore::new(config.requests.uploads_at_once)),
        config: Arc::new(config.clone()),
        stop: stop.clone(),
    };

    let work = tokio::spawn(worker.run(config.workers));
    let sweep = tokio::spawn(retention::run(db.clone(), store, queue.bell().clone(), stop.clone()));
    let requests = config.requests.clone();
    let answer = tokio::spawn(http::connection::serve(listener, http::router(app), requests, stop.clone()));
    println!("Stria is ready at http://{address}/");
    // Whoever started us may have closed stdout; the server is ready all the same.
    let _ = std::io::stdout().flush();

    signals.next().await;
    tracing::info!("stopping: running jobs go back to the queue");
    stop.cancel();
    let told_again = async {
        signals.next().await;
        std::process::exit(130);
    };
    let end = async {
        let _ = answer.await;
        let _ = sweep.await;
        match work.await {
            Ok(result) => result,
            Err(e) => Err(Error::Internal(format!("the workers stopped: {e}"))),
        }
    };
    tokio::select! {
        ended = end => ended.map_err(failed)?,
        () = told_again => {}
    }
    db.close().await.map_err(failed)
}

fn worker(config: &Config, db: &Db, queue: &Queue, store: &Store, stop: &CancellationToken) -> Result<Worker> {
    let program = std::env::current_exe().map_err(|e| Error::io("the path of this program", e))?;
    let node = node_name(&config.node())?;
    Ok(Worker {
        queue: queue.clone(),
        db: db.clone(),
        store: store.clone(),
        limits: config.jobs.clone(),
        program,
        scratch: std::path::absolute(config.scratch()).map_err(|e| Error::io(config.scratch(), e))?,
        name: format!("{node}-{}", std::process::id()),
        node,
        stop: stop.clone(),
    })
}

/// Makes the folders and takes the one lock: two servers on one folder would each think the other's jobs dead.
fn prepare(config: &Config) -> Result<File> {
    for folder in [&config.data_dir, &config.incoming(), &config.scratch()] {
        std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    }
    let path = config.lock();
    let lock = File::create(&path).map_err(|e| Error::io(&path, e))?;
    match lock.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let folder = config.data_dir.display();
            return Err(Error::Internal(format!(
                "{folder} is in use by another stria serve; give each its own --data"
            )));
        }
        Err(TryLockError::Error(e)) => return Err(Error::io(&path, e)),
    }
    incoming::remove_leftovers(&config.incoming())?;
    Ok(lock)
}

/// The name of this folder's workers, made once.
fn node_name(path: &Path) -> Result<String> {
    match std::fs::read_to_string(path) {
        Ok(name) if !name.trim().is_empty() => return Ok(name.trim().into()),
        Ok(_) => {}
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
        Err(e) => return Err(Error::io(path, e)),
    }
    let name = Queue::new_id();
    let half = path.with_extension("new");
    let written = std::fs::write(&half, &name).and_then(|()| std::fs::rename(&half, path));
    written.map_err(|e| Error::io(path, e))?;
    Ok(name)
}

fn log_to_stderr() {
    use std::io::IsTerminal;
    use tracing_subscriber::EnvFilter;
    let filter = EnvFilter::try_from_env("STRIA_LOG").unwrap_or_else(|_| EnvFilter::new("info"));
    // A second subscriber in one process is a test's; the first stays.
    let terminal = std::io::stderr().is_terminal();
    let _ =
        tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(terminal).try_init();
}
