// One run: how far it is, what came out, how good it is, everything to download, and the 3D view.

import type { ComponentChildren } from "preact";
import { deleteRun, getRun, isActive, listJobs, listProducts, type Job, type Product, type Run } from "../api.ts";
import { lengthMm } from "../format.ts";
import { useFollowed, useLoaded, useTitle, once } from "../hooks.ts";
import { ConfirmButton } from "../parts/confirm_button.tsx";
import { JobLog } from "../parts/job_log.tsx";
import { JobList } from "../parts/job_list.tsx";
import { JobProgress } from "../parts/job_progress.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { Products } from "../parts/products.tsx";
import { Quality } from "../parts/quality.tsx";
import { State } from "../parts/state.tsx";
import { Time } from "../parts/time.tsx";
import { View3d } from "../parts/view3d.tsx";
import { go, Link } from "../router.tsx";
import { texts } from "../texts.ts";

const ACTIVE_MS = 5000;
const IDLE_MS = 60_000;

export function RunView({ run: id, job: chosen }: { run: string; job: string | null }) {
  const load = async () => ({ run: await getRun(id), jobs: await listJobs(id) });
  const loaded = useLoaded(`run ${id}`, load, ({ jobs }) => (jobs.some(isActive) ? ACTIVE_MS : IDLE_MS));
  const { run, jobs } = loaded.value ?? { run: null, jobs: [] };
  const asLoaded = jobs.find((job) => job.id === chosen) ?? run?.job ?? null;
  const live = useFollowed(asLoaded?.id ?? null, asLoaded !== null && isActive(asLoaded), loaded.reload);
  const job = live.job ?? asLoaded;
  const finished = job?.state === "done" ? job.id : null;
  const products = useLoaded(`products ${finished}`, async () => (finished === null ? [] : (await listProducts(finished)).items), once);
  useTitle(run === null ? texts.runs.title : `${run.asset}, ${run.source.filename}`);

  if (run === null || job === null) {
    return (
      <>
        <h1>{texts.run.one}</h1>
        {loaded.problem === null && <p role="status">{texts.waiting.run}</p>}
        {loaded.problem?.status === 404 && <p>{texts.run.gone}</p>}
        {loaded.problem && loaded.problem.status !== 404 && <ProblemBox problem={loaded.problem} onRetry={loaded.reload} />}
        <p>
          <Link to="/">{texts.unknownPage.back}</Link>
        </p>
      </>
    );
  }
  return (
    <>
      <RunHeader run={run} job={job} />
      {!live.connected && (
        <p class="notice" role="status">
          {texts.waiting.reconnecting}
        </p>
      )}
      {loaded.problem && <ProblemBox problem={loaded.problem} onRetry={loaded.reload} />}
      <JobProgress job={job} onChanged={loaded.reload} />
      {finished !== null && products.value === null && !products.problem && <p role="status">{texts.waiting.products}</p>}
      {products.problem && <ProblemBox problem={products.problem} onRetry={products.reload} />}
      {finished !== null && products.value && <Preview run={run} job={job} products={products.value} />}
      <View3d key={`${job.id} ${job.attempt}`} job={job} segments={live.segments} name={run.source.filename} />
      {finished !== null && products.value && (
        <>
          <Quality key={job.id} job={job} />
          <Products job={job} products={products.value} />
        </>
      )}
      <JobList run={run} jobs={jobs.map((other) => (other.id === job.id ? job : other))} shown={job.id} onChanged={loaded.reload} />
      <JobLog key={job.id} job={job} />
      <section class="danger">
        <ConfirmButton
          label={texts.run.delete}
          heading={texts.run.deleteHeading(run.source.filename)}
          body={texts.run.deleteBody}
          yes={texts.run.deleteYes}
          no={texts.run.deleteNo}
          action={async () => {
            await deleteRun(run.id);
            go("/");
          }}
        />
      </section>
    </>
  );
}

function RunHeader({ run, job }: { run: Run; job: Job }) {
  return (
    <>
      <nav aria-label={texts.run.breadcrumb} class="crumbs">
        <Link to="/">{texts.runs.title}</Link> <span aria-hidden="true">›</span> {run.asset}
      </nav>
      <div class="title">
        <h1 class="words">{run.source.filename}</h1>
        <State state={job.state} />
      </div>
      {run.note !== "" && <p>{run.note}</p>}
      <dl class="facts">
        <Fact name={texts.run.asset}>{run.asset}</Fact>
        <Fact name={texts.run.recorded}>
          <Time at={run.recorded_at} />
        </Fact>
        <Fact name={texts.run.start}>{lengthMm(run.chainage_mm)}</Fact>
        <Fact name={texts.run.rig}>{run.rig}</Fact>
        <Fact name={texts.run.source}>
          <a href={run.source.url} download={run.source.filename}>
            {texts.run.sourceDownload(run.source.bytes)}
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

function Preview({ run, job, products }: { run: Run; job: Job; products: Product[] }) {
  const picture = products.find((product) => product.name === "preview.png");
  return (
    <section class="card">
      <h2>{texts.result.heading}</h2>
      {picture ? (
        <figure class="preview">
          <a href={picture.url} title={texts.result.fullSize}>
            <img key={job.id} src={picture.url} alt={texts.result.alt(run.asset)} />
          </a>
          <figcaption class="faint">{texts.result.caption}</figcaption>
        </figure>
      ) : (
        <p>{texts.result.none}</p>
      )}
    </section>
  );
}
