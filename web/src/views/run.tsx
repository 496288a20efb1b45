// One run: how far it is, and its parts, each loaded when it is looked at: map, quality, path, 3D, files, measurements.

import type { ComponentChildren } from "preact";
import { useEffect } from "preact/hooks";
import { deleteRun, getRun, isActive, listJobs, listProducts, type Job, type Run } from "../api.ts";
import { lengthMm, percent } from "../format.ts";
import { once, useFollowed, useLoaded, useTitle, type Followed } from "../hooks.ts";
import { lazy } from "../lazy.tsx";
import { ConfirmButton } from "../parts/confirm_button.tsx";
import { EditRun, PinRun } from "../parts/edit_run.tsx";
import { JobLog } from "../parts/job_log.tsx";
import { JobProgress } from "../parts/job_progress.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { Products } from "../parts/products.tsx";
import { Quality } from "../parts/quality.tsx";
import { State } from "../parts/state.tsx";
import { Time } from "../parts/time.tsx";
import { go, Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { runTexts } from "../texts/run.ts";

/** Most people come for the map: it is on its way before the run is known. */
const mapOnItsWay = import("../map/map_panel.tsx");
const MapPanel = lazy(async () => (await mapOnItsWay.catch(() => import("../map/map_panel.tsx"))).MapPanel);
const PathPlots = lazy(async () => (await import("../parts/path_plots.tsx")).PathPlots);
const Space = lazy(async () => (await import("../parts/space.tsx")).Space);
const JobsPanel = lazy(async () => (await import("../parts/jobs_panel.tsx")).JobsPanel);
const DefectsPanel = lazy(async () => (await import("../parts/defects_panel.tsx")).DefectsPanel);
const LivePanel = lazy(async () => (await import("../parts/live_panel.tsx")).LivePanel);

const ACTIVE_MS = 5000;
const IDLE_MS = 60_000;

type Tab = Exclude<keyof typeof runTexts.tabs, "label">;
const TABS: Tab[] = ["live", "map", "defects", "quality", "path", "space", "files", "jobs", "log"];

/** The parts that a job has something for. */
function tabsOf(job: Job): Tab[] {
  if (isActive(job)) return ["live", "map", "space", "jobs", "log"];
  if (job.state === "done") return ["map", "defects", "quality", "path", "space", "files", "jobs", "log"];
  return ["jobs", "log"];
}

export function RunView({ run: id, job: chosen, tab: wanted }: { run: string; job: string | null; tab: string | null }) {
  const load = async () => {
    const [run, jobs] = await Promise.all([getRun(id), listJobs(id)]);
    return { run, jobs };
  };
  const loaded = useLoaded(`run ${id}`, load, ({ jobs }) => (jobs.some(isActive) ? ACTIVE_MS : IDLE_MS));
  const { run, jobs } = loaded.value ?? { run: null, jobs: [] };
  const asLoaded = jobs.find((job) => job.id === chosen) ?? run?.job ?? null;
  const live = useFollowed(asLoaded?.id ?? null, asLoaded !== null && isActive(asLoaded), loaded.reload);
  const job = live.job ?? asLoaded;
  useTitle(run === null ? texts.runs.title : `${run.asset}, ${run.source.filename}`);

  if (run === null || job === null) {
    return (
      <>
        <h1>{runTexts.run.one}</h1>
        {loaded.problem === null && <p role="status">{texts.waiting.run}</p>}
        {loaded.problem?.status === 404 && <p>{runTexts.run.gone}</p>}
        {loaded.problem && loaded.problem.status !== 404 && <ProblemBox problem={loaded.problem} onRetry={loaded.reload} />}
        <p>
          <Link to="/">{texts.unknownPage.back}</Link>
        </p>
      </>
    );
  }
  const tabs = tabsOf(job);
  const tab = tabs.find((each) => each === wanted) ?? tabs[0]!; // every job has a log at least
  return (
    <>
      <RunHeader run={run} job={job} />
      {job.id !== run.job.id && (
        <p class="notice">
          {runTexts.older} <Link to={runPath(run.id)}>{runTexts.newest}</Link>
        </p>
      )}
      {!live.connected && (
        <p class="notice warn" role="status">
          {texts.waiting.reconnecting}
        </p>
      )}
      {loaded.problem && <ProblemBox problem={loaded.problem} onRetry={loaded.reload} />}
      <JobProgress job={job} onChanged={loaded.reload} />
      <Tabs run={run} chosen={chosen} tabs={tabs} tab={tab} />
      <section id="part" class="card part" role="tabpanel" aria-label={runTexts.tabs[tab]} key={`${job.id} ${tab}`}>
        <Part tab={tab} run={run} job={job} jobs={jobs.map((other) => (other.id === job.id ? job : other))} live={live} onChanged={loaded.reload} />
      </section>
      <section class="danger actions">
        <EditRun run={run.id} onChanged={loaded.reload} />
        <PinRun run={run.id} />
        <ConfirmButton
          label={runTexts.run.delete}
          heading={runTexts.run.deleteHeading(run.source.filename)}
          body={runTexts.run.deleteBody}
          yes={runTexts.run.deleteYes}
          no={runTexts.run.deleteNo}
          action={async () => {
            await deleteRun(run.id);
            go("/");
          }}
        />
      </section>
    </>
  );
}

type PartProps = { tab: Tab; run: Run; job: Job; jobs: Job[]; live: Followed; onChanged: () => void };

function Part({ tab, run, job, jobs, live, onChanged }: PartProps) {
  switch (tab) {
    case "live":
      return <LivePanel run={run} job={job} live={live} />;
    case "map":
      return (
        <>
          {job.state === "done" && <Glance run={run} job={job} />}
          <MapPanel run={run} job={job} revision={live.tiles} />
        </>
      );
    case "defects":
      return <DefectsPanel run={run} job={job} />;
    case "quality":
      return <Quality job={job} />;
    case "path":
      return <PathPlots job={job} />;
    case "space":
      return <Space run={run} job={job} segments={live.segments} />;
    case "files":
      return <Files job={job} />;
    case "jobs":
      return <JobsPanel run={run} jobs={jobs} shown={job} onChanged={onChanged} />;
    case "log":
      return <JobLog job={job} />;
  }
}

function Tabs({ run, chosen, tabs, tab }: { run: Run; chosen: string | null; tabs: Tab[]; tab: Tab }) {
  // Arrow keys go from tab to tab, as in any list of tabs.
  const step = (event: KeyboardEvent) => {
    const by = event.key === "ArrowRight" ? 1 : event.key === "ArrowLeft" ? -1 : 0;
    if (by === 0) return;
    event.preventDefault();
    const next = tabs[(tabs.indexOf(tab) + by + tabs.length) % tabs.length]!;
    go(runPath(run.id, chosen, next));
    requestAnimationFrame(() => document.getElementById(`tab-${next}`)?.focus());
  };
  useEffect(() => document.getElementById(`tab-${tab}`)?.scrollIntoView({ block: "nearest", inline: "nearest" }), [tab]);
  return (
    <div class="tabs" role="tablist" aria-label={runTexts.tabs.label} onKeyDown={step}>
      {TABS.filter((each) => tabs.includes(each)).map((each) => (
        <Link key={each} id={`tab-${each}`} role="tab" to={runPath(run.id, chosen, each)} selected={each === tab} keepPlace>
          {runTexts.tabs[each]}
        </Link>
      ))}
    </div>
  );
}

function RunHeader({ run, job }: { run: Run; job: Job }) {
  return (
    <>
      <nav aria-label={runTexts.run.breadcrumb} class="crumbs">
        <Link to="/">{texts.runs.title}</Link> <span aria-hidden="true">›</span> <Link to={`/?asset=${encodeURIComponent(run.asset)}`}>{run.asset}</Link>
      </nav>
      <div class="title">
        <h1 class="words">{run.source.filename}</h1>
        <State state={job.state} />
      </div>
      {run.note !== "" && <p>{run.note}</p>}
      <dl class="facts">
        <Fact name={runTexts.run.recorded}>
          <Time at={run.recorded_at} />
        </Fact>
        <Fact name={runTexts.run.start}>{lengthMm(run.chainage_mm)}</Fact>
        <Fact name={runTexts.run.rig}>{job.rig}</Fact>
        <Fact name={runTexts.run.recipe}>{job.recipe}</Fact>
        <Fact name={runTexts.run.source}>
          <a href={run.source.url} download={run.source.filename}>
            {runTexts.run.sourceDownload(run.source.bytes)}
          </a>
        </Fact>
      </dl>
    </>
  );
}

function Fact({ name, children }: { name: string; children: ComponentChildren }) {
  return (
    <div>
      <dt>{name}</dt>
      <dd>{children}</dd>
    </div>
  );
}

/** The few figures that say whether to trust the map. */
function Glance({ run, job }: { run: Run; job: Job }) {
  const quality = job.quality as { rows_found: number; travel_mm: number; coverage: number; frames: number; frames_tracked: number; points: number } | null;
  if (quality === null || quality === undefined) return null;
  const steps = Math.max(quality.frames - 1, 1);
  const words = runTexts.glance;
  return (
    <dl class="glance" aria-label={words.label}>
      <Fact name={words.rows}>{percent(quality.rows_found)}</Fact>
      <Fact name={words.tracked}>{percent(Math.min(quality.frames_tracked / steps, 1))}</Fact>
      <Fact name={words.travel}>{lengthMm(quality.travel_mm)}</Fact>
      <Fact name={words.coverage}>{percent(quality.coverage)}</Fact>
      {job.warnings.length > 0 && (
        <Fact name={words.warnings}>
          <Link to={runPath(run.id, job.id === run.job.id ? null : job.id, "quality")} class="warn-link">
            {texts.runs.warnings(job.warnings.length)}
          </Link>
        </Fact>
      )}
    </dl>
  );
}

function Files({ job }: { job: Job }) {
  const products = useLoaded(`products ${job.id}`, () => listProducts(job.id), once);
  if (products.problem) return <ProblemBox problem={products.problem} onRetry={products.reload} />;
  if (products.value === null) return <p role="status">{texts.waiting.products}</p>;
  return <Products job={job} products={products.value.items} />;
}
