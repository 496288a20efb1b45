// What is being measured right now: each run's newest picture, to be watched.

import { useEffect, useState } from "preact/hooks";
import { getLiveFrame, getRun, listJobsIn, type Job, type Run } from "../api.ts";
import { useLoaded, useTitle } from "../hooks.ts";
import { CommandLine } from "../parts/command_line.tsx";
import { farInWords, JobBar } from "../parts/job_bar.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { State } from "../parts/state.tsx";
import { Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { runTexts } from "../texts/run.ts";
import { workTexts } from "../texts/work.ts";

const words = workTexts.live;
const FRESH_MS = 3000;
/** Jobs that are shown; more than people watch. */
const MOST = 24;

async function loadLive(): Promise<{ running: { job: Job; run: Run }[]; waiting: number }> {
  const [running, waiting] = await Promise.all([listJobsIn("running", MOST), listJobsIn("queued", 100)]);
  const runs = await Promise.all(running.items.map((job) => getRun(job.run).catch(() => null)));
  const both = running.items.flatMap((job, at) => (runs[at] ? [{ job, run: runs[at] }] : []));
  // A robot's own stream first: somebody waits for it.
  both.sort((a, b) => Number(b.job.priority === "live") - Number(a.job.priority === "live"));
  return { running: both, waiting: waiting.items.length };
}

export function LiveView() {
  const live = useLoaded("live", loadLive, () => FRESH_MS);
  useTitle(words.heading);
  return (
    <>
      <h1>{words.heading}</h1>
      <p class="faint">{words.about}</p>
      {live.problem && <ProblemBox problem={live.problem} onRetry={live.reload} />}
      {live.value === null && !live.problem && <p role="status">{texts.waiting.list}</p>}
      {live.value && live.value.running.length === 0 && <Empty />}
      <ul class="live-cards">
        {live.value?.running.map(({ job, run }) => (
          <li key={job.id} class="card live-card">
            <Newest job={job} />
            <p>
              <Link to={runPath(run.id, null, "live")} class="run-link" label={words.watch(`${run.asset}, ${run.source.filename}`)}>
                <span class="run-asset">{run.asset}</span> {run.source.filename}
              </Link>
            </p>
            <p class="run-progress">
              <State state={job.state} />
              <JobBar job={job} /> {farInWords(job)}
            </p>
            <p class="faint">{runTexts.progress.frames(job.frames, job.frames_total ?? null)}</p>
          </li>
        ))}
      </ul>
      {live.value && live.value.waiting > 0 && (
        <p>
          <Link to="/queue">{words.waiting(live.value.waiting)}</Link>
        </p>
      )}
    </>
  );
}

/** What to type for a stream. */
const FFMPEG = (server: string) => `ffmpeg -f v4l2 -i /dev/video0 -f mpjpeg -method POST "${server}/api/live/robot7?asset=Pipe%207&rig=gr3"`;
const ROBOT = (server: string) => `ffmpeg -f v4l2 -i /dev/video0 -f mpjpeg - | stria send - --live --stream robot7 --server ${server} --asset "Pipe 7" --rig gr3`;

function Empty() {
  return (
    <section class="empty">
      <p>{words.none}</p>
      <p>{words.how}</p>
      <CommandLine command={FFMPEG(location.origin)} />
      <p>{words.howRobot}</p>
      <CommandLine command={ROBOT(location.origin)} />
      <p class="faint">
        {words.howToken} <Link to="/settings/tokens">{words.tokens}</Link>
      </p>
    </section>
  );
}

function Newest({ job }: { job: Job }) {
  const frame = useLoaded(`frame ${job.id}`, () => getLiveFrame(job.id), () => FRESH_MS);
  const [url, setUrl] = useState<string | null>(null);
  const picture = frame.value?.picture;
  useEffect(() => {
    if (!picture) return undefined;
    const made = URL.createObjectURL(picture);
    setUrl(made);
    return () => URL.revokeObjectURL(made);
  }, [picture]);
  return <div class="live-thumb">{url !== null && <img src={url} alt="" />}</div>;
}
