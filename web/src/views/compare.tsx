// Two measurements of one run side by side: maps that move together, what differs in the recipes, how they came out.

import { useMemo } from "preact/hooks";
import { getJob, getManifest, getRun, type Job, type Manifest } from "../api.ts";
import { lengthMm, count, percent } from "../format.ts";
import { once, useLoaded, useTitle } from "../hooks.ts";
import { MapPanel, ViewLink } from "../map/map_panel.tsx";
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
    const manifests = jobs.every((job) => job.state === "done") ? await Promise.all(jobs.map((job) => getManifest(job.id))) : null;
    return { run, jobs, manifests };
  };
  const loaded = useLoaded(`compare ${id} ${left} ${right}`, load, once);
  const link = useMemo(() => new ViewLink(), []);
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
          <div class="pair">
            {loaded.value.jobs.map((job, side) => (
              <section key={`${side} ${job.id}`} class="card" aria-label={side === 0 ? words.left : words.right}>
                <h2>{runTexts.jobs.job(job.recipe, job.rig)}</h2>
                <MapPanel run={loaded.value!.run} job={job} link={link} plain label={`${side === 0 ? words.left : words.right}: ${runTexts.jobs.job(job.recipe, job.rig)}`} />
              </section>
            ))}
          </div>
          <p class="faint">{words.together}</p>
          <Outcome jobs={loaded.value.jobs} manifests={loaded.value.manifests} />
          <Differences jobs={loaded.value.jobs} manifests={loaded.value.manifests} />
        </>
      )}
    </>
  );
}

type Pair = { jobs: Job[]; manifests: Manifest[] };

function Outcome({ jobs, manifests }: Pair) {
  const value = (manifest: Manifest, figure: string) => {
    const number = manifest.quality[figure as keyof Manifest["quality"]];
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
