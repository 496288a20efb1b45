//! The queue against a model of it, on a real database: whatever workers, people and deaths do in whatever order, no
//! job is lost, none has two results, none starves, and who lost a lease writes nothing.

use std::collections::BTreeMap;

use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

use super::tests::{Records, outcome, records};
use super::*;
use crate::db::tables::product;
use crate::wire::child::Failure;

const WORKERS: usize = 3;
const CASES: u32 = 48;
const STEPS: usize = 60;

/// One thing that happens. Numbers choose among what is there.
#[derive(Clone, Debug)]
enum Step {
    Add(Priority),
    Claim(usize),
    Beat(usize),
    Progress(usize),
    Finish(usize),
    Fail(usize, bool),
    Release(usize),
    Postpone(usize),
    AnswerCancel(usize),
    /// A worker dies, and its node starts again.
    Die(usize),
    /// It goes on with a lease that it had before; it must hear that it is lost.
    WakeLate(usize),
    Cancel(usize),
    Retry(usize),
}

fn step() -> impl Strategy<Value = Step> {
    let worker = 0..WORKERS;
    let job = 0..8usize;
    prop_oneof![
        4 => prop::sample::select(Priority::ALL.to_vec()).prop_map(Step::Add),
        6 => worker.clone().prop_map(Step::Claim),
        1 => worker.clone().prop_map(Step::Beat),
        1 => worker.clone().prop_map(Step::Progress),
        3 => worker.clone().prop_map(Step::Finish),
        3 => (worker.clone(), any::<bool>()).prop_map(|(w, again)| Step::Fail(w, again)),
        1 => worker.clone().prop_map(Step::Release),
        1 => worker.clone().prop_map(Step::Postpone),
        2 => worker.clone().prop_map(Step::AnswerCancel),
        2 => worker.clone().prop_map(Step::Die),
        2 => worker.prop_map(Step::WakeLate),
        2 => job.clone().prop_map(Step::Cancel),
        2 => job.prop_map(Step::Retry),
    ]
}

/// What a job should be.
#[derive(Clone, Debug, PartialEq)]
struct Expected {
    rank: (i64, String),
    state: JobState,
    attempt: i32,
    failures: i32,
    losses: i32,
    results: usize,
    cancelling: bool,
}

struct Model {
    r: Records,
    limits: JobLimits,
    jobs: BTreeMap<String, Expected>,
    /// What each worker is at.
    leases: Vec<Option<Lease>>,
    /// What each worker was at when it lost it.
    late: Vec<Option<Lease>>,
}

impl Model {
    fn job(&mut self, lease: &Lease) -> &mut Expected {
        self.jobs.get_mut(&lease.job).expect("a job that was added")
    }

    fn pick(&self, n: usize) -> Option<String> {
        self.jobs.keys().nth(n % self.jobs.len().max(1)).cloned()
    }

    async fn step(&mut self, step: &Step) -> Result<()> {
        match step {
            Step::Add(priority) => {
                let id = self.r.add(*priority).await;
                let row = self.r.job(&id).await;
                let expected = Expected {
                    rank: (row.rank_ms, id.clone()),
                    state: JobState::Queued,
                    attempt: 0,
                    failures: 0,
                    losses: 0,
                    results: 0,
                    cancelling: false,
                };
                self.jobs.insert(id, expected);
            }
            Step::Claim(w) => self.claim(*w).await?,
            Step::Beat(w) => {
                if let Some(lease) = &self.leases[*w] {
                    self.r.queue.beat(lease).await?;
                }
            }
            Step::Progress(w) => {
                if let Some(lease) = &self.leases[*w] {
                    self.r.queue.progress(lease, &Progress::default()).await?;
                }
            }
            Step::WakeLate(w) => {
                if let Some(lease) = self.late[*w].take() {
                    self.nothing_can_be_written(&lease).await;
                }
            }
            Step::Cancel(n) => self.cancel(*n).await,
            Step::Retry(n) => self.retry(*n).await,
            Step::Die(w) => {
                self.r.queue.recover(&node(*w)).await?;
                if let Some(lease) = self.leases[*w].take() {
                    let most = self.limits.max_losses;
                    let job = self.job(&lease);
                    job.losses += 1;
                    job.state = match (job.cancelling, job.losses >= most) {
                        (true, _) => JobState::Cancelled,
                        (false, true) => JobState::Failed,
                        (false, false) => JobState::Queued,
                    };
                    job.cancelling = false;
                    self.late[*w] = Some(lease);
                }
            }
            Step::Finish(w) | Step::Fail(w, _) | Step::Release(w) | Step::Postpone(w) | Step::AnswerCancel(w) => {
                if let Some(lease) = self.leases[*w].take() {
                    self.end(step, &lease).await?;
                    // Its end is written once: a second one is refused.
                    self.late[*w] = Some(lease);
                }
            }
        }
        Ok(())
    }

    /// The most urgent, oldest job is taken, and one is taken wherever one waits: nothing starves.
    async fn claim(&mut self, w: usize) -> Result<()> {
        if self.leases[w].is_some() {
            return Ok(());
        }
        let waiting = self.jobs.values().filter(|j| j.state == JobState::Queued);
        let next = waiting.min_by(|a, b| a.rank.cmp(&b.rank)).map(|j| j.rank.1.clone());
        let lease = self.r.queue.claim(Wanted::Any, &node(w), &node(w)).await?;
        assert_eq!(lease.as_ref().map(|l| l.job.clone()), next);
        if let Some(lease) = lease {
            let job = self.job(&lease);
            job.state = JobState::Running;
            job.attempt += 1;
            assert_eq!(lease.attempt, job.attempt);
            self.leases[w] = Some(lease);
        }
        Ok(())
    }

    async fn end(&mut self, step: &Step, lease: &Lease) -> Result<()> {
        let most = self.limits.max_failures;
        let queue = self.r.queue.clone();
        let job = self.job(lease);
        // Whoever asked it to stop is heard, however the attempt ends before its worker is.
        let back = if job.cancelling { JobState::Cancelled } else { JobState::Queued };
        job.cancelling = false;
        match step {
            Step::Finish(_) => {
                job.state = JobState::Done;
                job.results += 1;
                queue.finish(lease, outcome()).await
            }
            Step::Fail(_, again) => {
                job.failures += 1;
                job.state = if *again && job.failures < most { back } else { JobState::Failed };
                queue.fail(lease, &Failure::new("killed", "killed", *again)).await
            }
            Step::Release(_) => {
                (job.state, job.attempt) = (back, job.attempt - 1);
                queue.release(lease).await
            }
            Step::Postpone(_) => {
                (job.state, job.attempt) = (back, job.attempt - 1);
                queue.postpone(lease, &Failure::new("away", "away", true)).await
            }
            _ => {
                job.state = JobState::Cancelled;
                queue.cancelled(lease).await
            }
        }
    }

    async fn nothing_can_be_written(&self, lease: &Lease) {
        let queue = &self.r.queue;
        let failure = Failure::new("killed", "late", true);
        let lost = [
            queue.finish(lease, outcome()).await,
            queue.fail(lease, &failure).await,
            queue.cancelled(lease).await,
            queue.release(lease).await,
            queue.postpone(lease, &failure).await,
            queue.beat(lease).await,
            queue.progress(lease, &Progress::default()).await,
            queue.segment(lease, 0, &crate::store::Facts { bytes: 1, sha256: String::new() }).await,
            queue.log(lease, "late").await,
        ];
        for written in lost {
            assert!(matches!(written, Err(Error::LeaseLost)), "{written:?}");
        }
        assert_eq!(queue.signal(lease).await.expect("asks"), Signal::Lost);
    }

    async fn cancel(&mut self, n: usize) {
        let Some(id) = self.pick(n) else { return };
        let answer = self.r.queue.cancel(&id).await;
        let job = self.jobs.get_mut(&id).expect("picked");
        match job.state {
            JobState::Queued => job.state = JobState::Cancelled,
            JobState::Running => job.cancelling = true,
            JobState::Cancelled => {}
            _ => return assert!(matches!(answer, Err(Error::Conflict(_))), "{answer:?}"),
        }
        answer.expect("a job that has not ended can be cancelled");
    }

    async fn retry(&mut self, n: usize) {
        let Some(id) = self.pick(n) else { return };
        let answer = self.r.queue.retry(&id).await;
        let job = self.jobs.get_mut(&id).expect("picked");
        if !matches!(job.state, JobState::Failed | JobState::Cancelled) {
            return assert!(matches!(answer, Err(Error::Conflict(_))), "{answer:?}");
        }
        answer.expect("a dead letter can be tried again");
        (job.state, job.failures, job.losses) = (JobState::Queued, 0, 0);
    }

    /// The records are what the model says.
    async fn check(&self) {
        for (id, expected) in &self.jobs {
            let row = self.r.job(id).await;
            let found = Expected {
                rank: (row.rank_ms, row.id.clone()),
                state: state_of(&row).expect("a state"),
                attempt: row.attempt,
                failures: row.failures,
                losses: row.losses,
                results: usize::from(row.result_fence.is_some()),
                cancelling: row.cancel_requested != 0,
            };
            assert_eq!(&found, expected);
            let products = product::Entity::find().filter(product::Column::JobId.eq(id));
            assert_eq!(products.all(self.r.db.read()).await.expect("lists").len(), expected.results, "one result each");
            let run = run::Entity::find_by_id(&row.run_id).one(self.r.db.read()).await.expect("reads");
            assert_eq!(run.expect("exists").state, row.state, "the run says what its job says");
        }
    }

    /// In the end every job that waits is done: none was lost on the way.
    async fn drain(&mut self) -> Result<()> {
        for w in 0..WORKERS {
            self.step(&Step::Finish(w)).await?;
        }
        while self.jobs.values().any(|j| j.state == JobState::Queued) {
            self.step(&Step::Claim(0)).await?;
            self.step(&Step::Finish(0)).await?;
        }
        assert!(self.jobs.values().all(|j| j.state.is_final()));
        Ok(())
    }
}

fn node(w: usize) -> String {
    format!("node {w}")
}

#[test]
fn whatever_happens_no_job_is_lost_and_none_has_two_results() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    let config = Config { cases: CASES, failure_persistence: None, max_shrink_iters: 200, ..Config::default() };
    let steps = prop::collection::vec(step(), 1..STEPS);
    let run = TestRunner::new(config).run(&steps, |steps| {
        runtime.block_on(async {
            let limits = JobLimits {
                max_losses: 3,
                retry_base: std::time::Duration::ZERO,
                postpone: std::time::Duration::ZERO,
                ..JobLimits::default()
            };
            let none = || vec![None; WORKERS];
            let r = records(limits.clone()).await;
            let mut model = Model { r, limits, jobs: BTreeMap::new(), leases: none(), late: none() };
            for step in &steps {
                model.step(step).await.unwrap_or_else(|e| panic!("{step:?}: {e}"));
            }
            model.check().await;
            model.drain().await.expect("the rest is done");
            model.check().await;
        });
        Ok(())
    });
    if let Err(failed) = run {
        panic!("{failed}");
    }
}
