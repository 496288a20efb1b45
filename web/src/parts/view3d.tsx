// The 3D view: the rerun viewer on a canvas, opened on request, fed with the job's recording while it grows.

import { useEffect, useRef, useState } from "preact/hooks";
import { getBytes, getRecording, isActive, problemOf, productPath, type Job, type Problem } from "../api.ts";
import { runTexts } from "../texts/run.ts";
import { startViewer, viewerRuns, type Viewer } from "../viewer.ts";
import { ProblemBox } from "./problem.tsx";

const words = runTexts.view;

/** Segments are announced by events; this is how long we wait where an announcement got lost. */
const POLL_MS = 2000;
const PANIC_CHECK_MS = 2000;

type Props = {
  job: Job;
  segments: number;
  name: string;
  /** The recording of one stretch of a long run, by its file's name; null: that of the whole. */
  stretch: string | null;
};

export function View3d(props: Props) {
  const [open, setOpen] = useState(false);
  const { job } = props;
  if (job.state === "failed" || job.state === "cancelled") return null;
  return (
    <section class="space">
      <h2>{words.heading}</h2>
      {!viewerRuns() && <p>{words.old}</p>}
      {viewerRuns() && !open && (
        <>
          <p>{isActive(job) ? words.aboutLive : words.about}</p>
          <p class="actions">
            <button type="button" class="primary" onClick={() => setOpen(true)}>
              {words.open}
            </button>
          </p>
        </>
      )}
      {open && <OpenView key={props.stretch} {...props} onClose={() => setOpen(false)} />}
    </section>
  );
}

type Phase =
  | { is: "loading"; loadedBytes: number; totalBytes: number | null }
  | { is: "starting" }
  | { is: "showing"; parts: number; complete: boolean }
  | { is: "stretch" }
  | { is: "crashed" };

function OpenView({ job, segments, name, stretch, onClose }: Props & { onClose: () => void }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const closeButton = useRef<HTMLButtonElement>(null);
  const wake = useRef<() => void>(() => undefined);
  const [phase, setPhase] = useState<Phase>({ is: "starting" });
  const [problem, setProblem] = useState<Problem | null>(null);

  // The button that opened the view is gone: the keyboard goes on where it can be closed.
  useEffect(() => closeButton.current?.focus(), []);

  useEffect(() => {
    const stopped = new AbortController();
    let viewer: Viewer | null = null;
    const crashCheck = setInterval(() => viewer?.failure() != null && setPhase({ is: "crashed" }), PANIC_CHECK_MS);
    const run = async () => {
      if (canvas.current === null) return;
      viewer = await startViewer(canvas.current, name, (loadedBytes, totalBytes) => setPhase({ is: "loading", loadedBytes, totalBytes }));
      if (stopped.signal.aborted) return viewer.close();
      closeButton.current?.focus(); // the viewer takes the focus when it starts
      const woken = () => new Promise<void>((go) => {
        wake.current = go;
        setTimeout(go, POLL_MS);
      });
      const progress = (parts: number, complete: boolean) => setPhase({ is: "showing", parts, complete });
      if (stretch === null) return feed(viewer, job.id, stopped.signal, woken, progress);
      progress(0, false);
      const bytes = await getBytes(productPath(job.id, stretch));
      if (stopped.signal.aborted || viewer.failure() !== null) return;
      viewer.send(bytes);
      setPhase({ is: "stretch" });
    };
    run().catch((error: unknown) => {
      if (!stopped.signal.aborted) setProblem(problemOf(error));
    });
    return () => {
      stopped.abort();
      clearInterval(crashCheck);
      if (viewer?.failure() === null) viewer.close();
    };
  }, [job.id]);

  useEffect(() => wake.current(), [segments, job.state]);

  return (
    <>
      <p class="actions view-bar">
        <button type="button" ref={closeButton} onClick={onClose}>
          {words.close}
        </button>
        <span role="status" class="faint">
          {phaseInWords(phase)}
        </span>
      </p>
      {problem && <ProblemBox problem={problem} />}
      {/* The viewer takes every key while it has the focus; Escape gives the focus back. */}
      <div
        class="view"
        onKeyDownCapture={(event) => {
          if (event.key === "Escape") closeButton.current?.focus();
        }}
      >
        <canvas ref={canvas} role="application" aria-label={words.canvas} />
      </div>
      <p class="faint">{words.keys}</p>
    </>
  );
}

function phaseInWords(phase: Phase): string {
  switch (phase.is) {
    case "loading":
      return words.loading(phase.loadedBytes, phase.totalBytes);
    case "starting":
      return words.starting;
    case "crashed":
      return words.crashed;
    case "stretch":
      return words.stretchShown;
    case "showing":
      if (phase.complete) return phase.parts === 0 ? words.none : words.whole(phase.parts);
      return phase.parts === 0 ? words.waiting : words.live(phase.parts);
  }
}

/** Sends the recording's segments to the viewer in their order, until the recording is complete. */
async function feed(
  viewer: Viewer,
  job: string,
  stopped: AbortSignal,
  woken: () => Promise<void>,
  progress: (parts: number, complete: boolean) => void,
): Promise<void> {
  let parts = 0;
  let generation: number | undefined;
  while (!stopped.aborted) {
    const recording = await getRecording(job);
    // Another attempt at the job began the recording anew: it is sent from its start.
    if (recording.segments[0]?.generation !== generation) parts = 0;
    generation = recording.segments[0]?.generation;
    for (const segment of recording.segments.slice(parts)) {
      const bytes = await getBytes(segment.url);
      if (stopped.aborted || viewer.failure() !== null) return;
      viewer.send(bytes);
      parts += 1;
      progress(parts, false);
    }
    if (parts === 0 && recording.complete && recording.recording) {
      viewer.send(await getBytes(recording.recording));
      parts = 1;
    }
    progress(parts, recording.complete);
    if (recording.complete) return;
    await woken();
  }
}
