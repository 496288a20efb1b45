// Two measurements of one run side by side: maps that move together, what differs in the recipes, how they came out.

import { useMemo } from "preact/hooks";
import { getJob, getManifest, getRun, type Job, type ChangeReport, type Manifest, type Run } from "../api.ts";
import { lengthMm, count, localTime, percent } from "../format.ts";
import { once, useLoaded, useTitle } from "../hooks.ts";
import { MapPanel, ViewLink } from "../map/map_panel.tsx";
import type { Place } from "../map/pyramid.ts";
import { ChangePanel, changeMarkers, useChange } from "../parts/change_panel.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { leavesOf } from "../recipe_text.ts";
import { Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { runTexts } from "../texts/run.ts";

const words = runTexts.compare;

export function CompareView({ run: id, left, right }: { run: string; left: string | null; right: string | null }) {
  const load = async () => {
    const run = await getRun(id);
    const jobs = await Promise.all([getJob(left ?? ""), getJob(right ?? "")]);
    // They may be of two runs of one asset.
    const runs = await Promise.all(jobs.map((job) => (job.run === run.id ? run : getRun(job.run))));
    const manifests = jobs.every((job) => job.state === "done") ? await Promise.all(jobs.map((job) => getManifest(job.id))) : null;
    return { run, runs, jobs, manifests };
  };
  const loaded = useLoaded(`compare ${id} ${left} ${right}`, load, once);
  useTitle(words.heading);
  return (
    <>
      <nav aria-label={runTexts.run.breadcrumb} class="crumbs">
        <Link to="/">{texts.runs.title}</Link> <span aria-hidden="true">›</span> <Link to={runPath(id)}>{loaded.value?.run.source.filename ?? runTexts.run.one}</Link>
      </nav>
      <h1>{words.heading}</h1>
      {loaded.problem && <ProblemBox problem={loaded.problem} onRetry={loaded.reload} />}
      {loaded.value === null && !loaded.problem && <p role="status">{texts.waiting.list}</p>}
      {loaded.value && loaded.value.manifests === null && <p>{words.onlyDone}</p>}
      {loaded.value?.manifests && (
        <>
          <Maps runs={loaded.value.runs} jobs={loaded.value.jobs} />
          <Outcome jobs={loaded.value.jobs} manifests={loaded.value.manifests} />
          <Differences jobs={loaded.value.jobs} manifests={loaded.value.manifests} />
        </>
      )}
    </>
  );
}

/** Both maps, and what changed from the one to the other. */
function Maps({ runs, jobs }: { runs: Run[]; jobs: Job[] }) {
  // A run that went the other way shows the wall turned half about: its map moves alone.
  const turned = runs[0]?.direction !== runs[1]?.direction;
  const links = useMemo(() => (turned ? [new ViewLink(), new ViewLink()] : Array(2).fill(new ViewLink())) as ViewLink[], [turned]);
  const change = useChange(jobs[0]?.id ?? "", jobs[1]?.id ?? "");
  const report = change.value?.report ?? null;
  const shifts = useMemo(() => shiftsOf(runs, report), [runs, report]);
  const markers = useMemo(() => shifts.map((shift, side) => (report === null ? [] : changeMarkers(report, shift, turned && side === 1))), [shifts, report, turned]);
  const two = runs[0]?.id !== runs[1]?.id;
  return (
    <>
      <div class="pair">
        {jobs.map((job, side) => {
          const run = runs[side];
          const name = runTexts.jobs.job(job.recipe, job.rig);
          if (run === undefined) return null;
          return (
            <section key={`${side} ${job.id}`} class="card" aria-label={side === 0 ? words.left : words.right}>
              <h2 class="words">{two ? `${localTime(run.recorded_at)} · ${run.source.filename}` : name}</h2>
              <MapPanel run={run} job={job} link={links[side]!} plain shift={turned ? shifts[0]! : shifts[side]!} markers={markers[side]!} label={`${side === 0 ? words.left : words.right}: ${name}`} />
            </section>
          );
        })}
      </div>
      <p class="faint">{turned ? words.turned : words.together}</p>
      <ChangePanel change={change} />
    </>
  );
}

/**
 * How far each run's world lies from the earlier one's: by the chainages, and by how their surfaces were laid on each other.
 * Two measurements of one run have the same world.
 */
function shiftsOf([before, after]: Run[], report: ChangeReport | null): Place[] {
  if (before?.id === after?.id) return [{ x_mm: 0, y_mm: 0 }, { x_mm: 0, y_mm: 0 }];
  const sign = before?.direction === "backward" ? -1 : 1;
  const way_mm = before === undefined || after === undefined ? 0 : sign * (before.chainage_mm - after.chainage_mm);
  const laid = report?.registration;
  return [
    { x_mm: 0, y_mm: 0 },
    { x_mm: way_mm + (laid?.offset_x_mm ?? 0), y_mm: laid?.offset_y_mm ?? 0 },
  ];
}

type Pair = { jobs: Job[]; manifests: Manifest[] };

function Outcome({ jobs, manifests }: Pair) {
  const value = (manifest: Manifest, figure: string) => {
    const found = manifest.quality[figure as keyof Manifest["quality"]];
    const number = typeof found === "number" ? found : 0;
    if (figure === "rows_found" || figure === "coverage") return percent(number);
    return figure === "travel_mm" ? lengthMm(number) : count(number);
  };
  return (
    <section class="card">
      <h2>{words.quality}</h2>
      <Table
        head={words.figure}
        jobs={jobs}
        rows={Object.entries(words.figures).map(([figure, name]) => [name, ...manifests.map((manifest) => value(manifest, figure))])}
      />
    </section>
  );
}

function Differences({ jobs, manifests }: Pair) {
  const [left, right] = manifests.map(({ recipe }) => leavesOf(recipe));
  const keys = [...new Set([...(left?.keys() ?? []), ...(right?.keys() ?? [])])];
  const text = (value: unknown) => (typeof value === "string" ? value : JSON.stringify(value) ?? "–");
  const rows = keys.map((key) => [key, text(left?.get(key)), text(right?.get(key))]).filter(([, a, b]) => a !== b);
  if (jobs[0]?.rig !== jobs[1]?.rig) rows.unshift([words.rig, ...jobs.map(({ rig }) => rig)]);
  return (
    <section class="card">
      <h2>{words.differences}</h2>
      {rows.length === 0 ? <p>{words.same}</p> : <Table head={words.key} jobs={jobs} rows={rows} />}
    </section>
  );
}

function Table({ head, jobs, rows }: { head: string; jobs: Job[]; rows: string[][] }) {
  return (
    <div class="table-box" tabIndex={0} role="region" aria-label={head}>
      <table class="plain-table">
        <thead>
          <tr>
            <th scope="col">{head}</th>
            {jobs.map(({ recipe, rig }, side) => (
              <th key={side} scope="col">
                {side === 0 ? words.left : words.right}
                <span class="faint"> {runTexts.jobs.job(recipe, rig)}</span>
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {rows.map(([name, ...values]) => (
            <tr key={name}>
              <th scope="row">{name}</th>
              {values.map((value, side) => (
                <td key={side}>{value}</td>
              ))}
            </tr>
          ))}
        </tbody>
      </table>
    </div>
  );
}
