// How far a job is, why it stopped, and what can be done about it.

import { cancelJob, isActive, retryJob, type Job } from "../api.ts";
import { runTexts } from "../texts/run.ts";
import { ActionButton } from "./action_button.tsx";
import { farInWords, JobBar } from "./job_bar.tsx";
import { ProblemBox } from "./problem.tsx";
import { Warnings } from "./warnings.tsx";

type Props = { job: Job; onChanged: () => void };

export function JobProgress({ job, onChanged }: Props) {
  if (job.state === "done") return null;
  const act = (action: (job: string) => Promise<unknown>) => async () => {
    await action(job.id);
    onChanged();
  };
  return (
    <section class="card">
      <h2>{runTexts.progress.heading}</h2>
      {isActive(job) && (
        <>
          {job.attempt > 1 && <p>{runTexts.progress.attempt(job.attempt)}</p>}
          {job.error && <ProblemBox problem={job.error} heading={runTexts.progress.lastAttempt} />}
          <p role="status">{job.cancelling ? runTexts.progress.cancelling : stageInWords(job)}</p>
          {job.state === "running" && <Numbers job={job} />}
          <p class="actions">
            <ActionButton action={act(cancelJob)} disabled={job.cancelling}>
              {runTexts.progress.cancel}
            </ActionButton>
          </p>
        </>
      )}
      <Warnings warnings={job.warnings} />
      {job.state === "failed" && (
        <>
          {job.error && <ProblemBox problem={job.error} />}
          <p>{runTexts.progress.failedHint}</p>
        </>
      )}
      {job.state === "cancelled" && <p>{runTexts.progress.cancelled}</p>}
      {(job.state === "failed" || job.state === "cancelled") && (
        <p class="actions">
          <ActionButton action={act(retryJob)}>{runTexts.progress.retry}</ActionButton>
        </p>
      )}
    </section>
  );
}

function stageInWords(job: Job): string {
  if (job.state === "queued") return runTexts.progress.queued;
  return job.stage === "" ? runTexts.progress.starting : runTexts.progress.stage(job.stage);
}

function Numbers({ job }: { job: Job }) {
  const parts = [
    ...new Set([farInWords(job), runTexts.progress.frames(job.frames, job.frames_total ?? null)]),
    ...(job.frames_per_s > 0 ? [runTexts.progress.rate(job.frames_per_s)] : []),
    ...(job.time_left_s ? [runTexts.progress.left(job.time_left_s)] : []),
  ];
  return (
    <>
      <JobBar job={job} />
      <p class="faint">{parts.join(" · ")}</p>
    </>
  );
}
