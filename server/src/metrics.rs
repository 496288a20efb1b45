//! What is counted in this process, in Prometheus' words. Each process tells its own counts; what the records know
//! (the queue) every server tells alike.

use std::sync::LazyLock;

use prometheus_client::encoding::{EncodeLabelSet, text};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;

use crate::disk::Room;
use crate::error::{Error, Result};
use crate::queue::QueueDepth;
use crate::wire::JobState;

/// A method and a class of answers.
#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
pub struct Answer {
    /// The request's method.
    pub method: String,
    /// The answer's status.
    pub status: u16,
}

/// How an attempt ended.
#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
pub struct AttemptEnd {
    /// `done`, `cancelled`, `released`, `lost`, or the kind of failure.
    pub end: String,
}

/// A stage of the processing.
#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
pub struct Stage {
    /// As the manifest calls it.
    pub stage: String,
}

/// A priority and a state of jobs.
#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Waiting {
    priority: &'static str,
    state: &'static str,
}

/// What a child is kept from.
#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
pub struct Fence {
    /// `network` or `files`.
    pub what: String,
}

/// Seconds between which things are counted: from a tenth to a day.
const SECONDS: [f64; 10] = [0.1, 0.5, 1.0, 5.0, 15.0, 60.0, 300.0, 1800.0, 7200.0, 86_400.0];

/// Everything that is counted.
pub struct Metrics {
    registry: Registry,
    /// Answered requests.
    pub answers: Family<Answer, Counter>,
    /// Bytes of sources that came in.
    pub bytes_in: Counter,
    /// Bytes of products, recordings and sources that went out.
    pub bytes_out: Counter,
    /// Ended attempts.
    pub attempts: Family<AttemptEnd, Counter>,
    /// Frames of finished jobs.
    pub frames: Counter,
    /// Frames a second of the attempt that was last heard of.
    pub frames_per_s: Gauge<f64, std::sync::atomic::AtomicU64>,
    /// Time of finished jobs by stage.
    pub stage_s: Family<Stage, Histogram>,
    /// Time between enqueue and claim.
    pub wait_s: Histogram,
    /// Leases that this process took from a silent worker.
    pub leases_lost: Counter,
    /// Changes that other processes told of.
    pub rings_heard: Counter,
    /// 1 where the processes that decode videos are kept from it, 0 where this system does not allow that.
    pub fences: Family<Fence, Gauge>,
    queue_jobs: Family<Waiting, Gauge>,
    queue_oldest_s: Family<Waiting, Gauge<f64, std::sync::atomic::AtomicU64>>,
    disk_free_bytes: Gauge,
    disk_total_bytes: Gauge,
}

/// This process's counts.
pub fn metrics() -> &'static Metrics {
    static METRICS: LazyLock<Metrics> = LazyLock::new(Metrics::new);
    &METRICS
}

impl Metrics {
    fn new() -> Metrics {
        let mut m = Metrics {
            registry: Registry::with_prefix("stria"),
            answers: Family::default(),
            bytes_in: Counter::default(),
            bytes_out: Counter::default(),
            attempts: Family::default(),
            frames: Counter::default(),
            frames_per_s: Gauge::default(),
            stage_s: Family::new_with_constructor(|| Histogram::new(SECONDS)),
            wait_s: Histogram::new(SECONDS),
            leases_lost: Counter::default(),
            rings_heard: Counter::default(),
            fences: Family::default(),
            queue_jobs: Family::default(),
            queue_oldest_s: Family::default(),
            disk_free_bytes: Gauge::default(),
            disk_total_bytes: Gauge::default(),
        };
        let r = &mut m.registry;
        r.register("http_answers", "Answered requests", m.answers.clone());
        r.register("bytes_in", "Bytes of sources that came in", m.bytes_in.clone());
        r.register("bytes_out", "Bytes of files that went out", m.bytes_out.clone());
        r.register("attempts", "Ended attempts by their end", m.attempts.clone());
        r.register("frames", "Frames of finished jobs", m.frames.clone());
        r.register("frames_per_second", "Frames a second of the attempt last heard of", m.frames_per_s.clone());
        r.register("stage_seconds", "Time of finished jobs by stage", m.stage_s.clone());
        r.register("wait_seconds", "Time between enqueue and claim", m.wait_s.clone());
        r.register("leases_lost", "Leases taken from silent workers", m.leases_lost.clone());
        r.register("rings_heard", "Changes that other processes on the same PostgreSQL told of", m.rings_heard.clone());
        r.register("fences", "1 where children are kept from it, 0 where the system cannot", m.fences.clone());
        r.register("queue_jobs", "Jobs that wait or run", m.queue_jobs.clone());
        r.register("queue_oldest_seconds", "Age of the oldest job that waits or runs", m.queue_oldest_s.clone());
        r.register("disk_free_bytes", "Room on the disk of this process's folder", m.disk_free_bytes.clone());
        r.register("disk_total_bytes", "Size of the disk of this process's folder", m.disk_total_bytes.clone());
        m
    }

    /// An attempt ended so.
    pub fn attempt_ended(&self, end: &str) {
        self.attempts.get_or_create(&AttemptEnd { end: end.into() }).inc();
    }

    /// Everything, as Prometheus reads it.
    pub fn text(&self, depths: &[QueueDepth], room: Option<Room>, now_ms: i64) -> Result<String> {
        // Priorities that have nothing any more say 0.
        for priority in crate::wire::Priority::ALL {
            for state in [JobState::Queued, JobState::Running] {
                let labels = Waiting { priority: priority.as_str(), state: state.as_str() };
                let depth = depths.iter().find(|d| d.priority == priority && d.state == state);
                self.queue_jobs.get_or_create(&labels).set(depth.map_or(0, |d| d.jobs));
                let age_s = depth.map_or(0.0, |d| (now_ms - d.oldest_ms).max(0) as f64 / 1000.0);
                self.queue_oldest_s.get_or_create(&labels).set(age_s);
            }
        }
        if let Some(room) = room {
            self.disk_free_bytes.set(i64::try_from(room.free).unwrap_or(i64::MAX));
            self.disk_total_bytes.set(i64::try_from(room.total).unwrap_or(i64::MAX));
        }
        let mut out = String::new();
        text::encode(&mut out, &self.registry).map_err(|e| Error::Internal(format!("metrics: {e}")))?;
        Ok(out)
    }
}
