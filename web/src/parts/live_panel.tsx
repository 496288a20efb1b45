// A run while it is measured: the newest frame with the line found in it, the health of the work and of the link, the map as it grows.

import { useEffect, useRef, useState } from "preact/hooks";
import { getLiveFrame, isActive, listStreams, type Job, type LiveFrame, type LiveStream, type Run } from "../api.ts";
import { count, lengthMm, percent, duration } from "../format.ts";
import { useLoaded, type Followed } from "../hooks.ts";
import { lazy } from "../lazy.tsx";
import { runTexts } from "../texts/run.ts";

const MapPanel = lazy(async () => (await import("../map/map_panel.tsx")).MapPanel);
const words = runTexts.live;
const FRAME_MS = 1000;
const STREAM_MS = 2000;
/** Gaps of a stream that are listed. */
const GAPS_SHOWN = 5;

export function LivePanel({ run, job, live }: { run: Run; job: Job; live: Followed }) {
  const frame = useLoaded(`frame ${job.id}`, () => getLiveFrame(job.id), () => (isActive(job) ? FRAME_MS : null));
  // Only a robot's own stream has a link of its own to tell of.
  const streams = useLoaded(`streams ${job.priority}`, async () => (job.priority === "live" ? await listStreams() : []), () => (job.priority === "live" && isActive(job) ? STREAM_MS : null));
  const stream = streams.value?.find((each) => each.job === job.id) ?? null;
  return (
    <div class="live">
      <section aria-label={words.heading} class="live-picture">
        <h2>{words.heading}</h2>
        {frame.value === null ? <p class="faint">{words.waiting}</p> : <Picture {...frame.value} />}
      </section>
      <section aria-label={words.health} class="live-health">
        <h2>{words.health}</h2>
        <Health job={job} frame={frame.value?.about ?? null} stream={stream} connected={live.connected && frame.problem === null} run={run} />
      </section>
      <section aria-label={words.map} class="live-map">
        <h2>{words.map}</h2>
        <MapPanel run={run} job={job} revision={live.tiles} plain label={words.map} />
      </section>
    </div>
  );
}

/** The frame, and on it the line as it was found. */
function Picture({ about, picture }: { about: LiveFrame; picture: Blob }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    let gone = false;
    void createImageBitmap(picture).then((image) => {
      const element = canvas.current;
      const context = element?.getContext("2d");
      if (gone || !element || !context) return;
      [element.width, element.height] = [image.width, image.height];
      context.drawImage(image, 0, 0);
      context.fillStyle = "#ff2d55";
      const scale = image.width / about.width_px;
      for (const [u, v] of about.spots_px) context.fillRect((u + 0.5) * scale - 1, (v + 0.5) * scale - 1, 2, 2);
      image.close();
    });
    return () => {
      gone = true;
    };
  }, [picture]);
  const label = words.picture(about.frame, duration(about.time_s));
  return (
    <figure>
      <canvas ref={canvas} width={640} height={360} role="img" aria-label={label} data-frame={about.frame} />
      <figcaption class="faint">{label}</figcaption>
    </figure>
  );
}

type HealthProps = { run: Run; job: Job; frame: LiveFrame | null; stream: LiveStream | null; connected: boolean };

function Health({ run, job, frame, stream, connected }: HealthProps) {
  const heard = useRef({ frames: -1, at: performance.now() });
  const [now, setNow] = useState(() => performance.now());
  if (heard.current.frames !== job.frames) heard.current = { frames: job.frames, at: performance.now() };
  useEffect(() => {
    const timer = setInterval(() => setNow(performance.now()), 1000);
    return () => clearInterval(timer);
  }, []);
  const sign = run.direction === "backward" ? -1 : 1;
  const rows: [string, string, boolean?][] = [
    [words.link, connected ? words.up : words.down, !connected],
    ...(stream === null ? [] : streamRows(stream, job)),
    [words.frames, runTexts.progress.frames(job.frames, job.frames_total ?? null)],
    [words.rate, words.rateValue(job.frames_per_s)],
    [words.lag, words.lagValue(Math.max(now - heard.current.at, 0) / 1000)],
    ...(frame === null
      ? []
      : ([
          [words.found, percent(frame.rows_found / Math.max(frame.rows, 1)), frame.rows_found === 0],
          [words.along, frame.x_mm === null ? words.lost : lengthMm(run.chainage_mm + sign * frame.x_mm), frame.x_mm === null],
        ] as [string, string, boolean?][])),
    ...(job.warnings.length > 0 ? [[runTexts.quality.warnings, count(job.warnings.length), true] as [string, string, boolean]] : []),
  ];
  return (
    <dl class="health">
      {rows.map(([name, value, bad]) => (
        <div key={name} class={bad ? "bad" : ""}>
          <dt>{name}</dt>
          <dd>{value}</dd>
        </div>
      ))}
    </dl>
  );
}

/** What the robot's own link tells: what came, what is still on its way through the measuring, what never came. */
function streamRows(stream: LiveStream, job: Job): [string, string, boolean?][] {
  const missing = stream.missing as [number, number][];
  const lost = missing.reduce((sum, [first, last]) => sum + (last - first + 1), 0);
  const gaps = missing.slice(-GAPS_SHOWN).map(([first, last]) => words.gap(first, last));
  // The frames of a transport stream are counted only when they are decoded.
  const counted: [string, string][] = [
    [words.received, runTexts.progress.frames(stream.frames, null)],
    [words.behind, runTexts.progress.frames(Math.max(stream.frames - job.frames, 0), null)],
  ];
  return [
    [words.robot, stream.open ? words.robotUp : words.robotGone, !stream.open],
    ...(stream.kind === "frames" ? counted : []),
    [words.missing, lost === 0 ? words.nothingMissing : `${count(lost)} (${gaps.join(", ")})`, lost > 0],
  ];
}
