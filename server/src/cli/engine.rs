//! What `serve` and `work` have in common: places, limits of jobs, the lock on a folder, the worker of a process.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio_util::sync::CancellationToken;

use super::Failed;
use crate::config::{GB, JobLimits, Places};
use crate::confinement::Confinement;
use crate::db::{DatabasePlace, Db};
use crate::disk::DiskGuard;
use crate::error::{Error, Result};
use crate::queue::Queue;
use crate::store::{Store, StorePlace};
use crate::worker::Worker;

/// Most jobs of one process at the same time.
const MOST_SLOTS: usize = 1024;

/// Where the records and the files are.
#[derive(Args)]
pub(super) struct PlaceArgs {
    /// The records: postgres://USER:PASSWORD@HOST/NAME, or sqlite:PATH [default: stria.db in --data]
    #[arg(long, value_name = "URL", env = "STRIA_DATABASE", hide_env_values = true, global = true)]
    database: Option<String>,
    /// The files: a folder, or s3://BUCKET/PREFIX with AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION,
    /// AWS_ENDPOINT, AWS_ALLOW_HTTP [default: store in --data]
    #[arg(long, value_name = "URL", env = "STRIA_STORE", global = true)]
    store: Option<String>,
}

impl PlaceArgs {
    /// The places of a process with this folder.
    pub(super) fn places(&self, folder: &Path) -> std::result::Result<Places, Failed> {
        let mut places = Places::in_folder(folder);
        if let Some(text) = &self.database {
            places.database = DatabasePlace::parse(text).map_err(wrong)?;
        }
        if let Some(text) = &self.store {
            places.store = StorePlace::parse(text).map_err(wrong)?;
        }
        Ok(places)
    }
}

/// Limits of jobs.
#[derive(Args)]
pub(super) struct JobArgs {
    /// Longest time of one attempt at a job, hours
    #[arg(long, value_name = "H", default_value_t = 12.0, env = "STRIA_JOB_TIME_LIMIT_H")]
    job_time_limit_h: f64,
    /// Most memory of one job, GB
    #[arg(long, value_name = "GB", default_value_t = 8.0, env = "STRIA_JOB_MEMORY_LIMIT_GB")]
    job_memory_limit_gb: f64,
    /// A worker without a sign of life for so long has lost its job to another, seconds
    #[arg(long, value_name = "S", default_value_t = 60.0, env = "STRIA_LEASE_S")]
    lease_s: f64,
    /// Attempts that may end with their worker or their process killed before a job counts as failed
    #[arg(long, value_name = "N", default_value_t = 10, env = "STRIA_MAX_LOSSES",
        value_parser = clap::value_parser!(i32).range(1..=1000))]
    max_losses: i32,
    /// Room that stays free on the disk of --data, GB: below it nothing is taken in and no job begins
    #[arg(long, value_name = "GB", default_value_t = 2.0, env = "STRIA_DISK_RESERVE_GB")]
    disk_reserve_gb: f64,
}

impl JobArgs {
    /// The reserve on the disk, bytes.
    pub(super) fn disk_reserve_bytes(&self) -> std::result::Result<u64, Failed> {
        match self.disk_reserve_gb {
            0.0 => Ok(0),
            gb => Ok((positive("--disk-reserve-gb", gb, 1e6, "GB")? * GB as f64) as u64),
        }
    }

    /// Checked.
    pub(super) fn limits(&self) -> std::result::Result<JobLimits, Failed> {
        let time_limit = positive("--job-time-limit-h", self.job_time_limit_h, 1e5, "h")? * 3600.0;
        let memory_bytes = (positive("--job-memory-limit-gb", self.job_memory_limit_gb, 1e6, "GB")? * GB as f64) as u64;
        let lease = Duration::from_secs_f64(positive("--lease-s", self.lease_s, 86_400.0, "s")?);
        let usual = JobLimits::default();
        Ok(JobLimits {
            time_limit: Duration::from_secs_f64(time_limit),
            memory_bytes,
            lease,
            max_losses: self.max_losses,
            // Several signs of life in each lease: one may be late.
            heartbeat: usual.heartbeat.min(lease / 6),
            ..usual
        })
    }
}

/// A number of a flag, within its range.
pub(super) fn positive(name: &str, value: f64, most: f64, unit: &str) -> std::result::Result<f64, Failed> {
    if value > 0.0 && value <= most {
        return Ok(value);
    }
    Err(Failed::Input(format!("{name} is {value} {unit}; expected more than 0, at most {most} {unit}")))
}

/// Jobs at the same time: as told, else one per two processors.
pub(super) fn slots(name: &str, told: Option<usize>) -> std::result::Result<usize, Failed> {
    let processors = std::thread::available_parallelism().map_or(1, usize::from);
    match told.unwrap_or((processors / 2).max(1)) {
        slots if slots <= MOST_SLOTS => Ok(slots),
        slots => Err(Failed::Input(format!("{name} is {slots}; expected at most {MOST_SLOTS}"))),
    }
}

/// An error of a flag's value is wrong usage.
pub(super) fn wrong(error: Error) -> Failed {
    match error {
        Error::Input { detail, expected: Some(expected), .. } => {
            Failed::Input(format!("{detail}; expected {expected}"))
        }
        Error::Input { detail, .. } => Failed::Input(detail),
        other => Failed::Other(other.to_string()),
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

/// Records, queue and store of a process, and the lock on its folder.
pub(super) struct Engine {
    pub(super) db: Db,
    pub(super) queue: Queue,
    pub(super) store: Store,
    pub(super) disk: DiskGuard,
    limits: JobLimits,
    places: Places,
    _lock: File,
}

impl Engine {
    /// Makes the folders, takes the lock, opens records and store.
    pub(super) async fn start(places: &Places, limits: &JobLimits, reserve_bytes: u64) -> Result<Engine> {
        let lock = lock_folder(places)?;
        let db = Db::open(&places.database).await?;
        let queue = Queue::new(db.clone(), limits.clone());
        let store = Store::open(&places.store)?;
        let disk = DiskGuard::new(&places.folder, reserve_bytes);
        Ok(Engine { db, queue, store, disk, limits: limits.clone(), places: places.clone(), _lock: lock })
    }

    /// Hears of other processes' changes, and tells them of ours, until asked to stop.
    pub(super) fn relay(&self, stop: &CancellationToken) -> tokio::task::JoinHandle<()> {
        tokio::spawn(self.queue.bell().clone().relay(self.db.clone(), stop.clone()))
    }

    /// The worker of this process.
    pub(super) async fn worker(&self, stop: &CancellationToken) -> Result<Worker> {
        let program = std::env::current_exe().map_err(|e| Error::io("the path of this program", e))?;
        let scratch = self.places.scratch();
        let node = node_name(&self.places.node())?;
        Ok(Worker {
            queue: self.queue.clone(),
            db: self.db.clone(),
            store: self.store.clone(),
            limits: self.limits.clone(),
            program,
            confined: Confinement::find().await,
            scratch: std::path::absolute(&scratch).map_err(|e| Error::io(scratch, e))?,
            name: format!("{}-{}-{}", machine_name(), node.get(..8).unwrap_or(&node), std::process::id()),
            node,
            disk: self.disk.clone(),
            stop: stop.clone(),
        })
    }
}

/// Makes the folders and takes the one lock: two processes on one folder would each think the other's jobs dead.
fn lock_folder(places: &Places) -> Result<File> {
    for folder in [&places.folder, &places.incoming(), &places.scratch()] {
        std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    }
    let path = places.lock();
    let lock = File::create(&path).map_err(|e| Error::io(&path, e))?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => {
            let folder = places.folder.display();
            Err(Error::Internal(format!("{folder} is in use by another stria; give each its own --data")))
        }
        Err(TryLockError::Error(e)) => Err(Error::io(&path, e)),
    }
}

/// The name of this folder's workers, made once.
fn node_name(path: &PathBuf) -> Result<String> {
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

/// What people call this machine.
fn machine_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let name = name.trim();
    if name.is_empty() { "machine".into() } else { name.into() }
}

/// Runs a command's async part on all processors, and ends it however much hangs behind it.
pub(super) fn block_on<T>(
    work: impl Future<Output = std::result::Result<T, Failed>>,
) -> std::result::Result<T, Failed> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
    let runtime = runtime.map_err(|e| Failed::Other(format!("the async runtime did not start: {e}")))?;
    let done = runtime.block_on(work);
    // Reads of stdin and the like may never end; they must not keep a stopped process alive.
    runtime.shutdown_timeout(Duration::from_secs(1));
    done
}
