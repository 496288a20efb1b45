// All measurements of a run: look at an earlier one, lay two side by side, measure again.

import type { Job, Run } from "../api.ts";
import { duration, secondsBetween } from "../format.ts";
import { comparePath, Link, runPath } from "../router.tsx";
import { runTexts } from "../texts/run.ts";
import { Reprocess } from "./reprocess.tsx";
import { State } from "./state.tsx";
import { Time } from "./time.tsx";

const words = runTexts.jobs;

type Props = { run: Run; jobs: Job[]; shown: Job; onChanged: () => void };

export function JobsPanel({ run, jobs, shown, onChanged }: Props) {
  return (
    <>
      <h2>{words.heading}</h2>
      <ul class="jobs">
        {jobs.map((job) => (
          <li key={job.id} class={job.id === shown.id ? "current" : ""}>
            <span class="job-name">
              <strong>{words.job(job.recipe, job.rig)}</strong> <State state={job.state} />
            </span>
            <span class="faint">
              <Time at={job.created_at} />
              {job.started_at && job.finished_at && ` · ${words.took(duration(secondsBetween(job.started_at, job.finished_at)))}`}
            </span>
            {job.id === shown.id ? (
              <span class="faint">{words.shown}</span>
            ) : (
              <span class="actions">
                <Link to={runPath(run.id, job.id)} label={`${words.show}: ${words.job(job.recipe, job.rig)}`}>
                  {words.show}
                </Link>
                {job.state === "done" && shown.state === "done" && (
                  <Link to={comparePath(run.id, shown.id, job.id)} label={words.compareWith(words.job(job.recipe, job.rig))}>
                    {words.compare}
                  </Link>
                )}
              </span>
            )}
          </li>
        ))}
      </ul>
      <Reprocess run={run} shown={shown} onChanged={onChanged} />
    </>
  );
}
