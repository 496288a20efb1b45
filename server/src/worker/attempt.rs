//! One attempt at a job, from its lease to its one end.

use std::time::Duration;

use stria_core::pipeline::Event;
use tokio::sync::watch;
use tokio::time::Instant;
use tracing::Instrument;

use super::child::{Child, Said};
use super::follow::Source;
use super::scratch::Scratch;
use super::showcase::Showcase;
use super::{Worker, publish};
use crate::error::{Error, Result};
use crate::metrics::metrics;
use crate::queue::{Lease, Outcome, Progress, Signal};
use crate::wire::child::Failure;

/// The stage after the last product is written: the products go into the store.
const STORING: &str = "storing";

/// How an attempt ended.
enum Ended {
    Done(Outcome),
    Failed(Failure),
    Cancelled,
    /// The records or the store were away for too long; that is not the job's fault.
    Postponed(Failure),
    /// Another owns the job, or it is gone: nothing may be written any more.
    Lost,
    /// The worker stops; the job goes back.
    Released,
}

/// Works on a job until its end, whatever that is, and writes it down.
pub(super) async fn run(worker: &Worker, lease: &Lease) {
    let span = tracing::info_span!("attempt", job = %lease.job, run = %lease.run, attempt = lease.attempt);
    attempt(worker, lease).instrument(span).await;
}

async fn attempt(worker: &Worker, lease: &Lease) {
    tracing::info!(job = %lease.job, attempt = lease.attempt, "begins");
    let (signals, heart) = beat(worker, lease);
    let ended = match work(worker, lease, signals).await {
        Ok(ended) => ended,
        Err(Error::LeaseLost) => Ended::Lost,
        Err(error) if error.is_passing() => Ended::Postponed(Failure::new("away", error.to_string(), true)),
        Err(error @ Error::Internal(_)) => Ended::Failed(Failure::new("internal", error.to_string(), true)),
        Err(error) => Ended::Failed(Failure::new("io", error.to_string(), true)),
    };
    heart.abort();
    metrics().attempt_ended(match &ended {
        Ended::Done(_) => "done",
        Ended::Failed(failure) => &failure.kind,
        Ended::Cancelled => "cancelled",
        Ended::Postponed(_) => "postponed",
        Ended::Released => "released",
        Ended::Lost => "lost",
    });
    let written = tokio::select! {
        written = write_down(worker, lease, ended) => written,
        () = stopped_for(worker, worker.limits.stop_patience) => {
            Err(Error::Internal("the worker stops and the records do not answer".into()))
        }
    };
    match written {
        Ok(()) => {}
        Err(Error::LeaseLost) => {
            tracing::warn!(job = %lease.job, "the lease was lost; the attempt counts for nothing");
            if let Err(error) = worker.queue.abandon(lease).await {
                tracing::warn!(job = %lease.job, %error, "files of a lost attempt may stay behind");
            }
        }
        // The lease runs out or is taken back at the next start; then the job is tried again.
        Err(error) => tracing::error!(job = %lease.job, %error, "the end of an attempt could not be written"),
    }
    // Only now: a file of this name is what tells a leftover from an attempt that still runs.
    Scratch::remove(&worker.scratch, lease).await;
}

/// The one end of an attempt into the records.
async fn write_down(worker: &Worker, lease: &Lease, ended: Ended) -> Result<()> {
    match ended {
        Ended::Done(outcome) => {
            let products = outcome.products.len();
            worker.queue.finish(lease, outcome).await?;
            tracing::info!(job = %lease.job, products, "done");
            Ok(())
        }
        Ended::Failed(failure) => {
            tracing::warn!(job = %lease.job, kind = failure.kind, message = failure.message, "failed");
            worker.queue.fail(lease, &failure).await
        }
        Ended::Postponed(failure) => {
            tracing::warn!(message = failure.message, "postponed");
            worker.queue.postpone(lease, &failure).await
        }
        Ended::Cancelled => worker.queue.cancelled(lease).await,
        Ended::Released => worker.queue.release(lease).await,
        Ended::Lost => Err(Error::LeaseLost),
    }
}

/// Returns when the worker was asked to stop so long ago.
async fn stopped_for(worker: &Worker, time: Duration) {
    worker.stop.cancelled().await;
    tokio::time::sleep(time).await;
}

/// Signs of life and the answer to them, apart from the work.
fn beat(worker: &Worker, lease: &Lease) -> (watch::Receiver<Signal>, tokio::task::JoinHandle<()>) {
    let (sender, receiver) = watch::channel(Signal::Continue);
    let (queue, limits, lease) = (worker.queue.clone(), worker.limits.clone(), lease.clone());
    let task = tokio::spawn(async move {
        let mut last_beat = Instant::now();
        loop {
            tokio::time::sleep(limits.cancel_poll).await;
            let signal = async {
                if last_beat.elapsed() >= limits.heartbeat {
                    queue.beat(&lease).await?;
                    last_beat = Instant::now();
                }
                queue.signal(&lease).await
            };
            // An answer that does not come must not keep the next sign of life from being given.
            let answer = tokio::time::timeout(limits.lease / 2, signal).await;
            match answer.unwrap_or_else(|_| Err(Error::Busy("the records do not answer".into()))) {
                Ok(signal) => drop(sender.send(signal)),
                Err(Error::LeaseLost) => drop(sender.send(Signal::Lost)),
                // The records may be back in a moment; if they are not, the lease runs out.
                Err(error) => tracing::warn!(%error, "no sign of life could be given"),
            }
        }
    });
    (receiver, task)
}

async fn work(worker: &Worker, lease: &Lease, mut signals: watch::Receiver<Signal>) -> Result<Ended> {
    let begins = format!("attempt {} begins on worker '{}'", lease.attempt, worker.name);
    may_pass(worker.queue.log(lease, &begins).await)?;
    let scratch = Scratch::make(&worker.scratch, lease).await?;
    let source = tokio::select! {
        source = Source::open(worker, lease, scratch.folder()) => source?,
        ended = interrupted(worker, &mut signals) => return Ok(ended),
    };
    let lease = &Lease { recorded_ms: source.recorded_ms, ..lease.clone() };
    let mut child = Child::start(worker, lease, &scratch, &source.path)?;
    let deadline = Instant::now() + worker.limits.time_limit;
    let mut teller = Teller {
        worker,
        lease,
        scratch: &scratch,
        showcase: Showcase::open(&worker.store, lease, &scratch),
        told: None,
        progress: Progress::default(),
        stderr_lines: 0,
    };
    let listened = async {
        while let Some(said) = child.next().await {
            teller.tell(said).await?;
        }
        Ok::<_, Error>(child.end().await)
    };
    let result = tokio::select! {
        result = listened => Ok(result?),
        failed = source.follow(worker, lease) => return Err(failed),
        ended = interrupted(worker, &mut signals) => Err(ended),
        () = tokio::time::sleep_until(deadline) => Err(Ended::Failed(too_long(worker.limits.time_limit))),
    };
    let manifest = match result {
        Ok(Ok(manifest)) => manifest,
        Ok(Err(failure)) => return Ok(Ended::Failed(failure)),
        Err(ended) => {
            child.kill().await;
            return Ok(ended);
        }
    };
    teller.showcase.close().await;
    let storing = Progress { stage: STORING.into(), fraction: 1.0, time_left_s: None, ..teller.progress };
    may_pass(worker.queue.progress(lease, &storing).await)?;
    tokio::select! {
        outcome = publish::store(worker, lease, &scratch, *manifest) => Ok(Ended::Done(outcome?)),
        ended = interrupted(worker, &mut signals) => Ok(ended),
    }
}

/// What is only for watching may be missed while the records are away.
fn may_pass(written: Result<()>) -> Result<()> {
    match written {
        Err(error) if error.is_passing() => {
            tracing::warn!(%error, "progress could not be told");
            Ok(())
        }
        other => other,
    }
}

/// Returns when the attempt shall not go on.
async fn interrupted(worker: &Worker, signals: &mut watch::Receiver<Signal>) -> Ended {
    let signal = tokio::select! {
        signal = signals.wait_for(|s| *s != Signal::Continue) => signal.map(|s| *s),
        () = worker.stop.cancelled() => return Ended::Released,
    };
    match signal {
        Ok(Signal::Cancel) => Ended::Cancelled,
        // Without a heart the lease runs out unseen.
        Ok(_) | Err(_) => Ended::Lost,
    }
}

fn too_long(limit: Duration) -> Failure {
    let hours = limit.as_secs_f64() / 3600.0;
    Failure::new("time_limit", format!("the attempt took longer than {hours:.3} h, the limit of this server"), false)
}

/// Brings what the child says to the records.
struct Teller<'a> {
    worker: &'a Worker,
    lease: &'a Lease,
    scratch: &'a Scratch,
    /// What people see while the child goes on.
    showcase: Showcase,
    /// When progress was last written.
    told: Option<Instant>,
    progress: Progress,
    stderr_lines: usize,
}

impl Teller<'_> {
    async fn tell(&mut self, said: Said) -> Result<()> {
        let (queue, limits) = (&self.worker.queue, &self.worker.limits);
        match said {
            Said::Event(Event::Progress { stage, fraction, frames, frames_total, frames_per_s, time_left_s }) => {
                metrics().frames_per_s.set(frames_per_s);
                let progress = Progress { stage, fraction, frames, frames_total, frames_per_s, time_left_s };
                let before = std::mem::replace(&mut self.progress, progress);
                let same_stage = before.stage == self.progress.stage;
                if same_stage && self.told.is_some_and(|at| at.elapsed() < limits.progress_every) {
                    return Ok(());
                }
                self.told = Some(Instant::now());
                may_pass(queue.progress(self.lease, &self.progress).await)
            }
            Said::Event(Event::Warning { message }) => {
                may_pass(queue.log(self.lease, &format!("warning: {message}")).await)
            }
            Said::Event(Event::Segment { number, path, .. }) => {
                publish::segment(self.worker, self.lease, self.scratch, number, &path).await
            }
            Said::Event(Event::Files { names }) => {
                self.showcase.show(names);
                Ok(())
            }
            Said::Stderr(line) => {
                self.stderr_lines += 1;
                if self.stderr_lines > limits.stderr_lines {
                    return Ok(());
                }
                may_pass(queue.log(self.lease, &line).await)
            }
        }
    }
}
