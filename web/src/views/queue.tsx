// The queue: what is at work, what waits and why, batches, who works, what ended badly and can be tried again.

import { useState } from "preact/hooks";
import { cancelJob, getRun, listJobsIn, listWorkers, retryJob, type Job, type Run, type Worker } from "../api.ts";
import { count, duration, secondsBetween } from "../format.ts";
import { useLoaded, useTitle } from "../hooks.ts";
import { ActionButton } from "../parts/action_button.tsx";
import { Batches } from "../parts/batches.tsx";
import { farInWords, JobBar } from "../parts/job_bar.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { State } from "../parts/state.tsx";
import { Time } from "../parts/time.tsx";
import { Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { runTexts } from "../texts/run.ts";
import { workTexts } from "../texts/work.ts";

const words = workTexts.queue;
const FRESH_MS = 3000;
const MOST = 100;
/** Failed jobs that are shown at first, and how many more at a time. */
const FAILED = 20;
const CANCELLED = 10;

const runs = new Map<string, Promise<Run | null>>();

/** A run's name does not change while it waits: asked once. */
function runOf(job: Job): Promise<Run | null> {
  const known = runs.get(job.run) ?? getRun(job.run).catch(() => null);
  runs.set(job.run, known);
  return known;
}

interface Entry {
  job: Job;
  run: Run | null;
}

async function loadQueue(mostFailed: number) {
  const [running, queued, failed, cancelled, workers] = await Promise.all([listJobsIn("running", MOST), listJobsIn("queued", MOST), listJobsIn("failed", mostFailed), listJobsIn("cancelled", CANCELLED), listWorkers()]);
  const named = (jobs: Job[]): Promise<Entry[]> => Promise.all(jobs.map(async (job) => ({ job, run: await runOf(job) })));
  // The queue's own order is its ranks'; the oldest of the most urgent comes next.
  const urgency = { live: 0, upload: 1, batch: 2 };
  const waiting = queued.items.sort((a, b) => urgency[a.priority] - urgency[b.priority] || a.created_at.localeCompare(b.created_at));
  // A server without workers of its own is listed with no places: it takes no job.
  const taking = workers.filter(({ slots }) => slots > 0);
  return {
    running: await named(running.items),
    waiting: await named(waiting),
    more: queued.next_cursor != null,
    failed: await named(failed.items),
    moreFailed: failed.next_cursor != null,
    cancelled: await named(cancelled.items),
    workers: taking,
  };
}

export function QueueView() {
  const [mostFailed, setMostFailed] = useState(FAILED);
  const queue = useLoaded("queue", () => loadQueue(mostFailed), () => FRESH_MS);
  useTitle(words.heading);
  const value = queue.value;
  return (
    <>
      <h1>{words.heading}</h1>
      {queue.problem && <ProblemBox problem={queue.problem} onRetry={queue.reload} />}
      {value === null && !queue.problem && <p role="status">{texts.waiting.list}</p>}
      {value && (
        <>
          <Group heading={words.running} none={words.none.running} entries={value.running} onChanged={queue.reload} tell={(job) => <AtWork job={job} />} />
          <Group heading={words.waiting} none={words.none.queued} entries={value.waiting} onChanged={queue.reload} tell={(job) => <Waits job={job} workers={value.workers} />}>
            {value.more && <p class="faint">{words.more}</p>}
          </Group>
          <Batches />
          <Workers workers={value.workers} running={value.running} />
          <Group heading={words.failed} none={words.none.failed} entries={value.failed} onChanged={queue.reload} tell={(job) => <WentWrong job={job} />}>
            {value.moreFailed && (
              <p class="actions">
                <button type="button" onClick={() => (setMostFailed(mostFailed + MOST), queue.reload())}>
                  {words.moreFailed}
                </button>
              </p>
            )}
          </Group>
          <Group heading={words.cancelled} none={words.none.cancelled} entries={value.cancelled} onChanged={queue.reload} tell={(job) => <Ended job={job} />} />
        </>
      )}
    </>
  );
}

type GroupProps = { heading: string; none: string; entries: Entry[]; tell: (job: Job) => preact.ComponentChild; onChanged: () => void; children?: preact.ComponentChildren };

function Group({ heading, none, entries, tell, onChanged, children }: GroupProps) {
  return (
    <section class="card" aria-label={heading}>
      <h2>
        {heading} {entries.length > 0 && <span class="faint">{count(entries.length)}</span>}
      </h2>
      {entries.length === 0 ? (
        <p class="faint">{none}</p>
      ) : (
        <ul class="queue">
          {entries.map(({ job, run }) => (
            <li key={job.id}>
              <span class="queue-name words">
                <Link to={runPath(job.run, run !== null && run.job.id !== job.id ? job.id : null)}>
                  <span class="run-asset">{run?.asset ?? ""}</span> {run?.source.filename ?? words.run}
                </Link>
                <span class="faint">
                  {words.priorities[job.priority]} · {runTexts.jobs.job(job.recipe, job.rig)}
                  {job.attempt > 1 && ` · ${words.attempt(job.attempt)}`}
                </span>
              </span>
              <span class="queue-tell">{tell(job)}</span>
              <State state={job.state} />
              <span class="actions">
                {job.state === "queued" || job.state === "running" ? (
                  <ActionButton class="small" disabled={job.cancelling} action={() => cancelJob(job.id).then(onChanged)}>
                    {words.cancel}
                  </ActionButton>
                ) : (
                  <ActionButton class="small" action={() => retryJob(job.id).then(onChanged)}>
                    {words.retry}
                  </ActionButton>
                )}
              </span>
            </li>
          ))}
        </ul>
      )}
      {children}
    </section>
  );
}

function AtWork({ job }: { job: Job }) {
  const facts = [
    farInWords(job),
    ...(job.frames_per_s > 0 ? [words.rate(job.frames_per_s)] : []),
    ...(job.time_left_s ? [words.left(job.time_left_s)] : []),
  ];
  return (
    <>
      <JobBar job={job} />
      <span class="faint">{job.cancelling ? runTexts.progress.cancelling : facts.join(" · ")}</span>
    </>
  );
}

function Waits({ job, workers }: { job: Job; workers: Worker[] }) {
  const untilS = job.next_attempt_at ? -secondsBetween(job.next_attempt_at, null) : 0;
  const why = workers.length === 0 ? words.why.workers : untilS > 0 ? words.why.backoff(untilS) : job.priority === "live" ? words.why.turn : `${words.why.turn} ${words.why.live}`;
  return (
    <span class="faint">
      {why} {words.since(duration(secondsBetween(job.created_at, null)))}
    </span>
  );
}

function Ended({ job }: { job: Job }) {
  return <span class="faint">{job.finished_at && <Time at={job.finished_at} />}</span>;
}

/** Why a job was given up, and after how many attempts. */
function WentWrong({ job }: { job: Job }) {
  return (
    <>
      <span class="clamp">{job.error?.detail ?? ""}</span>
      <span class="faint">
        {words.gaveUp(job.attempt)} <Ended job={job} />
      </span>
    </>
  );
}

function Workers({ workers, running }: { workers: Worker[]; running: Entry[] }) {
  return (
    <section class="card" aria-label={words.workers}>
      <h2>{words.workers}</h2>
      {workers.length === 0 ? (
        <p class="faint">{words.none.workers}</p>
      ) : (
        <ul class="queue">
          {workers.map((worker) => (
            <li key={worker.name}>
              <span class="queue-name words">
                <strong>{worker.name}</strong>
                <span class="faint">
                  {words.up} <Time at={worker.started_at} />, {words.seen} <Time at={worker.seen_at} />
                </span>
              </span>
              <span class="queue-tell faint">
                {words.slots(worker.jobs.length, worker.slots)}
                {running
                  .filter(({ job }) => worker.jobs.includes(job.id))
                  .map(({ job, run }) => (
                    <Link key={job.id} to={runPath(job.run, run !== null && run.job.id !== job.id ? job.id : null)}>
                      {run === null ? words.run : `${run.asset}, ${run.source.filename}`}
                    </Link>
                  ))}
              </span>
            </li>
          ))}
        </ul>
      )}
    </section>
  );
}
