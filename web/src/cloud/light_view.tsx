// The light 3D view: opened on request, turned by pointer or keyboard.

import { useEffect, useRef, useState } from "preact/hooks";
import { problemOf, type Job, type Problem } from "../api.ts";
import { ProblemBox } from "../parts/problem.tsx";
import { runTexts } from "../texts/run.ts";
import { loadPoints, type Points } from "./points.ts";
import { Scene, START, type Camera } from "./scene.ts";

const words = runTexts.space;
const EXAGGERATIONS = [1, 2, 5, 10];

export function LightView({ job }: { job: Job }) {
  const [open, setOpen] = useState(false);
  if (job.state === "failed" || job.state === "cancelled") return null;
  return (
    <section class="space">
      <h2>{words.light}</h2>
      <p>{words.lightAbout}</p>
      <p class="actions">
        <button type="button" onClick={() => setOpen(!open)}>
          {open ? words.lightClose : words.lightOpen}
        </button>
      </p>
      {open && <Open key={job.id} job={job} />}
    </section>
  );
}

function Open({ job }: { job: Job }) {
  const [points, setPoints] = useState<Points | null | undefined>(undefined);
  const [share, setShare] = useState(0);
  const [problem, setProblem] = useState<Problem | null>(null);
  useEffect(() => {
    const stopped = new AbortController();
    loadPoints(job.id, setShare, stopped.signal)
      .then(setPoints)
      .catch((error: unknown) => !stopped.signal.aborted && setProblem(problemOf(error)));
    return () => stopped.abort();
  }, [job.id]);
  if (problem) return <ProblemBox problem={problem} />;
  if (points === undefined) return <p role="status">{words.loading(share)}</p>;
  if (points === null) return <p>{runTexts.view.none}</p>;
  return <Cloud points={points} />;
}

function Cloud({ points }: { points: Points }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const camera = useRef<Camera>({ ...START });
  const draw = useRef<() => void>(() => undefined);
  const [failed, setFailed] = useState(false);
  const [exaggeration, setExaggeration] = useState(1);

  useEffect(() => {
    const element = canvas.current;
    if (element === null) return undefined;
    let scene: Scene;
    try {
      scene = new Scene(element, points, () => draw.current());
    } catch {
      setFailed(true);
      return undefined;
    }
    let waiting = false;
    draw.current = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => {
        waiting = false;
        scene.draw(camera.current);
      });
    };
    const resized = new ResizeObserver(() => draw.current());
    resized.observe(element);
    const stop = steer(element, camera, () => draw.current());
    return () => {
      stop();
      resized.disconnect();
      draw.current = () => undefined;
      scene.close();
    };
  }, [points]);
  useEffect(() => {
    camera.current.exaggeration = exaggeration;
    draw.current();
  }, [exaggeration]);

  if (failed) return <p>{words.noWebgl}</p>;
  return (
    <>
      <div class="view light">
        <canvas ref={canvas} tabIndex={0} role="application" aria-label={words.lightLabel} />
      </div>
      <p class="actions">
        <label>
          {words.exaggerate}{" "}
          <select value={exaggeration} onChange={(event) => setExaggeration(Number(event.currentTarget.value))}>
            {EXAGGERATIONS.map((factor) => (
              <option key={factor} value={factor}>
                {words.times(factor)}
              </option>
            ))}
          </select>
        </label>
        <span class="faint">{words.points(points.count)}</span>
      </p>
    </>
  );
}

/** Pointer, wheel and keys move the camera. */
function steer(element: HTMLElement, camera: { current: Camera }, moved: () => void): () => void {
  const stops: (() => void)[] = [];
  const on = <K extends keyof HTMLElementEventMap>(name: K, heard: (event: HTMLElementEventMap[K]) => void, options?: AddEventListenerOptions) => {
    element.addEventListener(name, heard, options);
    stops.push(() => element.removeEventListener(name, heard, options));
  };
  const change = (by: Partial<Camera>) => {
    Object.assign(camera.current, by);
    moved();
  };
  const closer = (factor: number) => change({ distance: Math.min(Math.max(camera.current.distance * factor, 0.15), 20) });
  const turned = (turn: number, tilt: number) =>
    change({ turn: camera.current.turn + turn, tilt: Math.min(Math.max(camera.current.tilt + tilt, -1.55), 1.55) });
  on("pointerdown", (event) => element.setPointerCapture(event.pointerId));
  on("pointermove", (event) => {
    if (!element.hasPointerCapture(event.pointerId)) return;
    if (event.shiftKey || event.buttons === 2) {
      const [x, y] = camera.current.shift;
      const scale = camera.current.distance / element.clientHeight;
      change({ shift: [x + event.movementX * scale, y - event.movementY * scale] });
    } else turned(event.movementX * 0.008, event.movementY * 0.008);
  });
  on("contextmenu", (event) => event.preventDefault());
  on(
    "wheel",
    (event) => {
      event.preventDefault();
      closer(Math.exp(event.deltaY * 0.0012));
    },
    { passive: false },
  );
  const keys: Record<string, () => void> = {
    ArrowLeft: () => turned(-0.12, 0),
    ArrowRight: () => turned(0.12, 0),
    ArrowUp: () => turned(0, -0.12),
    ArrowDown: () => turned(0, 0.12),
    "+": () => closer(1 / 1.25),
    "=": () => closer(1 / 1.25),
    "-": () => closer(1.25),
    "0": () => change({ ...START, exaggeration: camera.current.exaggeration }),
  };
  on("keydown", (event) => {
    const action = keys[event.key];
    if (action === undefined || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    action();
  });
  return () => stops.forEach((stop) => stop());
}
