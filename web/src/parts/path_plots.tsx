// The robot's path and its jitter, as plots over time.

import { useMemo } from "preact/hooks";
import { getTrajectory, type Job, type Trajectory } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { texts } from "../texts.ts";
import { runTexts } from "../texts/run.ts";
import { Plot, type Series } from "./plot.tsx";
import { ProblemBox } from "./problem.tsx";

const words = runTexts.path;
/** Motion slower than this is going on, faster is jitter, s. */
const JITTER_S = 1;
const HEIGHT_PX = 190;

type Column = (number | null)[];

export function PathPlots({ job }: { job: Job }) {
  const trajectory = useLoaded(`trajectory ${job.id}`, () => getTrajectory(job.id), once);
  return (
    <>
      <h2>{words.heading}</h2>
      <p class="faint">{words.about}</p>
      {trajectory.problem && (trajectory.problem.status === 404 ? <p>{words.none}</p> : <ProblemBox problem={trajectory.problem} onRetry={trajectory.reload} />)}
      {trajectory.value === null && !trajectory.problem && <p role="status">{texts.waiting.list}</p>}
      {trajectory.value && <Plots trajectory={trajectory.value} />}
    </>
  );
}

function Plots({ trajectory }: { trajectory: Trajectory }) {
  const plots = useMemo(() => plotsOf(trajectory.columns as Record<string, Column>), [trajectory]);
  return (
    <>
      {trajectory.every > 1 && <p class="faint">{words.every(trajectory.every)}</p>}
      <div class="plots">
        {plots.map(({ heading, y, series, note }) => (
          <figure key={heading}>
            <figcaption>
              <strong>{heading}</strong>
              {note !== "" && <span class="faint">{note}</span>}
            </figcaption>
            <Plot x={series.time} series={series.lines} xLabel={words.time} yLabel={y} label={heading} height={HEIGHT_PX} />
          </figure>
        ))}
      </div>
    </>
  );
}

function plotsOf(columns: Record<string, Column>) {
  const of = (name: string): Column => columns[name] ?? [];
  const time = of("time_s").map((seconds) => seconds ?? 0);
  const line = (label: string, values: Column, colour: string): Series => ({ label, values, colour });
  const plot = (heading: string, y: string, lines: Series[], note = "") => ({ heading, y, series: { time, lines }, note });
  const spread = (lines: Series[], unit: string) => `${words.spread}: ${lines.map(({ label, values }) => words.rms(label, deviation(values), unit)).join(", ")}`;
  const sway = [line(words.y, jitter(of("y_mm"), time), "--plot-1"), line(words.z, jitter(of("z_mm"), time), "--plot-2")];
  const turns = [line(words.roll, of("roll_deg"), "--plot-1"), line(words.pitch, of("pitch_deg"), "--plot-2"), line(words.yaw, of("yaw_deg"), "--plot-3")];
  return [
    plot(words.x, words.travel, [line(words.x, of("x_mm"), "--plot-1")]),
    plot(words.speedHeading, words.speed, [line(words.speedHeading, speeds(of("x_mm"), time), "--plot-1")]),
    plot(words.swayHeading, words.sway, sway, spread(sway, "mm")),
    plot(words.turnHeading, words.turn, turns, spread(turns.map((each) => ({ ...each, values: jitter(each.values, time) })), "°")),
    plot(words.foundHeading, words.found, [line(words.rows, of("rows_found"), "--plot-1")]),
    plot(words.trackedHeading, words.tracked, [line(words.tracked, of("tracked"), "--plot-1")]),
  ];
}

/** What remains of a motion without its mean over a second around each moment. */
function jitter(values: Column, time: number[]): Column {
  let [first, last, sum, count] = [0, 0, 0, 0];
  return values.map((value, at) => {
    const now = time[at] ?? 0;
    for (; last < values.length && (time[last] ?? 0) <= now + JITTER_S / 2; last += 1) {
      const entering = values[last];
      if (entering != null) [sum, count] = [sum + entering, count + 1];
    }
    for (; (time[first] ?? 0) < now - JITTER_S / 2; first += 1) {
      const leaving = values[first];
      if (leaving != null) [sum, count] = [sum - leaving, count - 1];
    }
    return value == null || count === 0 ? null : value - sum / count;
  });
}

/** mm/s between frames, as the mean over a quarter of a second. */
function speeds(values: Column, time: number[]): Column {
  const step = Math.max(time.findIndex((seconds) => seconds >= 0.125), 1);
  return values.map((_, at) => {
    const [before, after] = [Math.max(at - step, 0), Math.min(at + step, values.length - 1)];
    const [from, to] = [values[before], values[after]];
    const seconds = (time[after] ?? 0) - (time[before] ?? 0);
    return from == null || to == null || seconds <= 0 ? null : (to - from) / seconds;
  });
}

function deviation(values: Column): number {
  const known = values.filter((value): value is number => value != null);
  if (known.length === 0) return 0;
  const mean = known.reduce((sum, value) => sum + value, 0) / known.length;
  return Math.sqrt(known.reduce((sum, value) => sum + (value - mean) ** 2, 0) / known.length);
}
