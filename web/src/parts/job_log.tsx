// A job's log.

import { isActive, listLog, type Job } from "../api.ts";
import { utcTime } from "../format.ts";
import { useLoaded } from "../hooks.ts";
import { texts } from "../texts.ts";
import { runTexts } from "../texts/run.ts";
import { ProblemBox } from "./problem.tsx";

const FRESH_MS = 2000;

export function JobLog({ job }: { job: Job }) {
  return (
    <>
      <h2>{runTexts.log.heading}</h2>
      <Lines job={job} />
    </>
  );
}

function Lines({ job }: { job: Job }) {
  const log = useLoaded(`log ${job.id} ${job.state}`, () => listLog(job.id), () => (isActive(job) ? FRESH_MS : null));
  if (log.problem) return <ProblemBox problem={log.problem} onRetry={log.reload} />;
  if (log.value === null) return <p role="status">{texts.waiting.log}</p>;
  if (log.value.length === 0) return <p>{runTexts.log.empty}</p>;
  return (
    <pre class="log" tabIndex={0}>
      {log.value.map((line) => `${utcTime(line.at)}  ${line.text}`).join("\n")}
    </pre>
  );
}
