//! `stria serve`: records, store, workers and HTTP in one process, until it is asked to stop.

use std::io::Write;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use super::engine::{Engine, JobArgs, PlaceArgs, StopSignals, block_on, log_to_stderr, positive, slots};
use super::{Failed, Outcome, Success};
use crate::config::{Config, GB, LiveLimits, RequestLimits, UploadLimits};
use crate::error::Error;
use crate::http::{self, App};
use crate::live::Live;
use crate::runs::Runs;
use crate::uploads::Uploads;
use crate::{incoming, live, retention};

/// Run the service: runs come in over HTTP, jobs process them, staff look at the results in a browser
#[derive(Args)]
#[command(
    after_help = "Everything is kept in --data: records, files, scratch space, unless --database and --store say \
                        otherwise; then any number of machines may share them. Stop with Ctrl-C or SIGTERM: running \
                        jobs go back to the queue and go on at the next start."
)]
pub(super) struct Serve {
    /// Where to listen; port 0 takes a free one
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8420", env = "STRIA_LISTEN")]
    listen: SocketAddr,
    /// The folder that keeps everything; each stria has its own
    #[arg(long, value_name = "DIR", default_value = "stria-data", env = "STRIA_DATA")]
    data: PathBuf,
    #[command(flatten)]
    places: PlaceArgs,
    /// Jobs at the same time; 0 takes runs in and leaves them to others [default: one per two processors]
    #[arg(long, value_name = "N", env = "STRIA_WORKERS")]
    workers: Option<usize>,
    /// Largest upload, GB
    #[arg(long, value_name = "GB", default_value_t = 64.0, env = "STRIA_MAX_UPLOAD_GB")]
    max_upload_gb: f64,
    /// How long a robot whose connection broke may stay away before its live run is closed, s
    #[arg(long, value_name = "S", default_value_t = 60.0, env = "STRIA_LIVE_COME_BACK_S")]
    live_come_back_s: f64,
    /// A sender may be silent in the middle of a request for so long, seconds; an upload then keeps what came
    #[arg(long, value_name = "S", default_value_t = 60.0, env = "STRIA_SENDER_SILENCE_S")]
    sender_silence_s: f64,
    /// An upload that nobody goes on with is kept for so long, hours
    #[arg(long, value_name = "H", default_value_t = 168.0, env = "STRIA_UPLOAD_KEPT_H")]
    upload_kept_h: f64,
    #[command(flatten)]
    jobs: JobArgs,
    /// Listen on a network although there is no authentication: whoever reaches the port can do everything
    #[arg(long, env = "STRIA_WITHOUT_AUTHENTICATION")]
    without_authentication: bool,
}

impl Serve {
    pub(super) fn run(self) -> Outcome {
        log_to_stderr();
        let config = self.config()?;
        block_on(serve(config)).map(|()| Success::Done)
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
        let upload_bytes = (positive("--max-upload-gb", self.max_upload_gb, 1e6, "GB")? * GB as f64) as u64;
        let come_back = Duration::from_secs_f64(positive("--live-come-back-s", self.live_come_back_s, 1e6, "s")?);
        let sender_silence = positive("--sender-silence-s", self.sender_silence_s, 86_400.0, "s")?;
        let kept_for = positive("--upload-kept-h", self.upload_kept_h, 1e5, "h")? * 3600.0;
        Ok(Config {
            listen: self.listen,
            places: self.places.places(&self.data)?,
            workers: slots("--workers", self.workers)?,
            requests: RequestLimits {
                upload_bytes,
                sender_silence: Duration::from_secs_f64(sender_silence),
                ..RequestLimits::default()
            },
            uploads: UploadLimits {
                upload_bytes,
                kept_for: Duration::from_secs_f64(kept_for),
                ..UploadLimits::default()
            },
            live: LiveLimits { come_back, ..LiveLimits::default() },
            jobs: self.jobs.limits()?,
        })
    }
}

async fn serve(config: Config) -> std::result::Result<(), Failed> {
    let failed = |e: Error| Failed::Other(e.to_string());
    let stop = CancellationToken::new();
    let mut signals = StopSignals::listen().map_err(|e| Failed::Other(format!("signals cannot be heard: {e}")))?;
    let listener = http::connection::listen(config.listen).await.map_err(|e| {
        Failed::Input(format!("--listen {}: {e}; expected a free address of this machine", config.listen))
    })?;
    let address = listener.local_addr().map_err(|e| Failed::Other(e.to_string()))?;
    let engine = Engine::start(&config.places, &config.jobs).await.map_err(failed)?;
    incoming::remove_leftovers(&config.places.incoming()).map_err(failed)?;
    let worker = engine.worker(&stop).map_err(failed)?;
    let (db, queue, store) = (engine.db.clone(), engine.queue.clone(), engine.store.clone());
    let runs = Runs::new(db.clone(), queue.clone(), store.clone());
    let uploads = Uploads::new(db.clone(), store.clone(), runs.clone(), config.uploads.clone());
    let live = Live::new(db.clone(), store.clone(), runs.clone(), queue.bell().clone(), config.live.clone());
    let app = App {
        runs,
        uploads: uploads.clone(),
        live: live.clone(),
        streams: Arc::new(Semaphore::new(config.live.streams_at_once)),
        queue: queue.clone(),
        store: store.clone(),
        arrivals: Arc::new(Semaphore::new(config.requests.uploads_at_once)),
        config: Arc::new(config.clone()),
        stop: stop.clone(),
    };

    let work = tokio::spawn(worker.run(config.workers));
    let sweep = tokio::spawn(retention::run(db.clone(), store, uploads.clone(), queue.bell().clone(), stop.clone()));
    let watch = tokio::spawn(live::watch(live, stop.clone()));
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
        // What arrived of an upload whose connection died is still being kept.
        uploads.tasks().close();
        let _ = tokio::time::timeout(config.requests.stop_grace, uploads.tasks().wait()).await;
        let _ = sweep.await;
        let _ = watch.await;
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
