//! `stria serve`: records, store, workers and HTTP in one process, until it is asked to stop.

use std::io::Write;
use std::net::{IpAddr, SocketAddr};
use std::num::NonZeroU32;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use super::engine::{Engine, JobArgs, PlaceArgs, StopSignals, block_on, positive, slots};
use super::logging::LogArgs;
use super::{Failed, Outcome, Success};
use crate::auth::{Auth, Scopes};
use crate::batches::Batches;
use crate::config::{Config, Doors, GB, LiveLimits, RequestLimits, UploadLimits};
use crate::defects::Defects;
use crate::error::Error;
use crate::http::{self, App, Changes, Rates};
use crate::live::Live;
use crate::retention::{MOST_DAYS, MOST_GB, Policy};
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
    /// A client may take so long for the head of a request, and stay connected without one, seconds
    #[arg(long, value_name = "S", default_value_t = 30.0, env = "STRIA_HEAD_TIMEOUT_S")]
    head_timeout_s: f64,
    /// An upload that nobody goes on with is kept for so long, hours
    #[arg(long, value_name = "H", default_value_t = 168.0, env = "STRIA_UPLOAD_KEPT_H")]
    upload_kept_h: f64,
    #[command(flatten)]
    jobs: JobArgs,
    /// Delete runs that came in more than so many days ago, unless they are pinned; GET /api/retention says which. Holds,
    /// as --quota-gb does, until somebody stores other rules in the browser's settings or by PUT /api/retention
    #[arg(long, value_name = "D", env = "STRIA_KEEP_DAYS")]
    keep_days: Option<f64>,
    /// Delete the oldest runs while sources and products take more than this, unless they are pinned
    #[arg(long, value_name = "GB", env = "STRIA_QUOTA_GB")]
    quota_gb: Option<f64>,
    #[command(flatten)]
    doors: DoorArgs,
    #[command(flatten)]
    log: LogArgs,
}

/// Who is let in, and how they come.
#[derive(Args)]
struct DoorArgs {
    /// Ask nobody for a token: whoever reaches the port can do everything; with a loopback --listen only
    #[arg(long, env = "STRIA_WITHOUT_AUTHENTICATION")]
    without_authentication: bool,
    /// Speak TLS with this certificate chain (PEM)
    #[arg(long, value_name = "FILE", env = "STRIA_TLS_CERT", requires = "tls_key")]
    tls_cert: Option<PathBuf>,
    /// The certificate's private key (PEM)
    #[arg(long, value_name = "FILE", env = "STRIA_TLS_KEY", requires = "tls_cert")]
    tls_key: Option<PathBuf>,
    /// Believe X-Forwarded-For and X-Forwarded-Proto of a proxy at this address; may be given several times
    #[arg(long, value_name = "IP", env = "STRIA_TRUSTED_PROXY", value_delimiter = ',')]
    trusted_proxy: Vec<IpAddr>,
    /// Requests a second that each token may make on average; ten times as many at once
    #[arg(long, value_name = "N", default_value_t = RequestLimits::default().per_s, env = "STRIA_REQUESTS_PER_S",
        value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    requests_per_s: u32,
}

impl Serve {
    pub(super) fn run(self) -> Outcome {
        let config = self.config()?;
        block_on(async {
            self.log.start()?;
            serve(config).await
        })
        .map(|()| Success::Done)
    }

    fn config(&self) -> std::result::Result<Config, Failed> {
        let doors = &self.doors;
        if !self.listen.ip().is_loopback() && doors.without_authentication {
            return Err(Failed::Input(format!(
                "--without-authentication with --listen {}: whoever reaches the port could read, change and delete every \
                 run; expected an address of this machine (127.0.0.1:8420), or no --without-authentication",
                self.listen
            )));
        }
        let keep_days = self.keep_days.map(|d| positive("--keep-days", d, MOST_DAYS, "days")).transpose()?;
        let quota_gb = self.quota_gb.map(|gb| positive("--quota-gb", gb, MOST_GB, "GB")).transpose()?;
        let upload_bytes = (positive("--max-upload-gb", self.max_upload_gb, 1e6, "GB")? * GB as f64) as u64;
        let come_back = Duration::from_secs_f64(positive("--live-come-back-s", self.live_come_back_s, 1e6, "s")?);
        let sender_silence = positive("--sender-silence-s", self.sender_silence_s, 86_400.0, "s")?;
        let head_timeout = positive("--head-timeout-s", self.head_timeout_s, 86_400.0, "s")?;
        let kept_for = positive("--upload-kept-h", self.upload_kept_h, 1e5, "h")? * 3600.0;
        Ok(Config {
            listen: self.listen,
            places: self.places.places(&self.data)?,
            workers: slots("--workers", self.workers)?,
            retention: Policy { keep_days, quota_gb },
            doors: Doors {
                locked: !doors.without_authentication,
                tls: doors.tls_cert.clone().zip(doors.tls_key.clone()),
                trusted_proxies: doors.trusted_proxy.clone(),
            },
            requests: RequestLimits {
                upload_bytes,
                head_timeout: Duration::from_secs_f64(head_timeout),
                sender_silence: Duration::from_secs_f64(sender_silence),
                disk_reserve_bytes: self.jobs.disk_reserve_bytes()?,
                per_s: doors.requests_per_s,
                at_once: doors.requests_per_s.saturating_mul(10),
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
    let tls = match &config.doors.tls {
        Some((certificates, key)) => Some(
            http::connection::tls(certificates, key)
                .map_err(|e| Failed::Input(format!("--tls-cert, --tls-key: {e}")))?,
        ),
        None => None,
    };
    let stop = CancellationToken::new();
    let mut signals = StopSignals::listen().map_err(|e| Failed::Other(format!("signals cannot be heard: {e}")))?;
    let listener = http::connection::listen(config.listen).await.map_err(|e| {
        Failed::Input(format!("--listen {}: {e}; expected a free address of this machine", config.listen))
    })?;
    let address = listener.local_addr().map_err(|e| Failed::Other(e.to_string()))?;
    let engine =
        Engine::start(&config.places, &config.jobs, config.requests.disk_reserve_bytes).await.map_err(failed)?;
    incoming::remove_leftovers(&config.places.incoming()).map_err(failed)?;
    Changes::prepare(&config.places.changes()).map_err(failed)?;
    let worker = engine.worker(&stop).await.map_err(failed)?;
    let (db, queue, store) = (engine.db.clone(), engine.queue.clone(), engine.store.clone());
    let runs = Runs::new(db.clone(), queue.clone(), store.clone());
    let uploads = Uploads::new(db.clone(), store.clone(), runs.clone(), config.uploads.clone());
    let live = Live::new(db.clone(), store.clone(), runs.clone(), queue.bell().clone(), config.live.clone());
    let batches = Batches::new(db.clone(), queue.clone());
    let auth = Auth::new(db.clone());
    let app = App {
        auth: auth.clone(),
        rates: Arc::new(Rates::new(at_least_one(config.requests.per_s), at_least_one(config.requests.at_once))),
        disk: engine.disk.clone(),
        runs: runs.clone(),
        uploads: uploads.clone(),
        live: live.clone(),
        streams: Arc::new(Semaphore::new(config.live.streams_at_once)),
        queue: queue.clone(),
        batches: batches.clone(),
        defects: Defects::new(db.clone()),
        changes: Changes::default(),
        store: store.clone(),
        arrivals: Arc::new(Semaphore::new(config.requests.uploads_at_once)),
        config: Arc::new(config.clone()),
        warnings: Arc::new(if config.workers > 0 { worker.confined.lacks() } else { Vec::new() }),
        stop: stop.clone(),
    };

    let relay = engine.relay(&stop);
    let work = tokio::spawn(worker.run(config.workers));
    let sweep = tokio::spawn(retention::run(
        db.clone(),
        store,
        uploads.clone(),
        runs,
        config.retention,
        queue.bell().clone(),
        stop.clone(),
    ));
    let watch = tokio::spawn(live::watch(live, stop.clone()));
    let step = tokio::spawn(batches.run(stop.clone()));
    let requests = config.requests.clone();
    let answer = tokio::spawn(http::connection::serve(listener, http::router(app), requests, tls, stop.clone()));
    let url = format!("{}://{address}/", if config.doors.tls.is_some() { "https" } else { "http" });
    println!("Stria is ready at {url}");
    if config.doors.locked && auth.is_new().await.map_err(failed)? {
        let code = auth.create_login("first start", &Scopes::all()).await.map_err(failed)?;
        println!("Nobody can log in yet. This address does, once, within an hour: {url}login?code={code}");
    }
    if config.doors.locked && config.doors.tls.is_none() && !address.ip().is_loopback() {
        tracing::warn!("tokens travel unencrypted; expected --tls-cert and --tls-key, or a proxy that speaks TLS");
    }
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
        let _ = relay.await;
        let _ = sweep.await;
        let _ = watch.await;
        let _ = step.await;
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

fn at_least_one(number: u32) -> NonZeroU32 {
    NonZeroU32::new(number).unwrap_or(NonZeroU32::MIN)
}
