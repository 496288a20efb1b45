// The list of runs, with sending new ones at its top.

import { useState } from "preact/hooks";
import { isActive, listRuns, productPath, type Run, type RunPage } from "../api.ts";
import { percent, size } from "../format.ts";
import { useLoaded, useTitle } from "../hooks.ts";
import { CommandLine } from "../parts/command_line.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { State } from "../parts/state.tsx";
import { Time } from "../parts/time.tsx";
import { UploadForm } from "../parts/upload_form.tsx";
import { Link, runPath } from "../router.tsx";
import { EXAMPLE_COMMAND, texts } from "../texts.ts";

const PAGE = 30;
const WORKING_MS = 1500;
const IDLE_MS = 10_000;

export function RunsView() {
  const [shown, setShown] = useState(PAGE);
  const runs = useLoaded("runs", () => firstRuns(shown), (page) => (page.items.some(isActive) ? WORKING_MS : IDLE_MS));
  useTitle(texts.runs.title);
  const showOlder = () => {
    setShown(shown + PAGE);
    runs.reload();
  };
  return (
    <>
      <h1>{texts.runs.title}</h1>
      <UploadForm onArrived={runs.reload} assets={[...new Set(runs.value?.items.map((run) => run.asset))]} />
      {runs.problem && <ProblemBox problem={runs.problem} onRetry={runs.reload} />}
      {runs.value === null && runs.problem === null && <p role="status">{texts.waiting.runs}</p>}
      {runs.value?.items.length === 0 && <Empty />}
      {runs.value !== null && runs.value.items.length > 0 && (
        <ul class="runs" aria-label={texts.runs.list}>
          {runs.value.items.map((run) => (
            <RunRow key={run.id} run={run} />
          ))}
        </ul>
      )}
      {runs.value?.next_cursor && (
        <p class="actions">
          <button type="button" onClick={showOlder}>
            {texts.runs.older}
          </button>
        </p>
      )}
    </>
  );
}

/** The newest runs, page by page, so that what is shown stays one list that can be loaded anew. */
async function firstRuns(wanted: number): Promise<RunPage> {
  const items: Run[] = [];
  let cursor: string | null = null;
  do {
    const page: RunPage = await listRuns(cursor, PAGE);
    items.push(...page.items);
    cursor = page.next_cursor ?? null;
  } while (cursor !== null && items.length < wanted);
  return { items, next_cursor: cursor };
}

function RunRow({ run }: { run: Run }) {
  const { job } = run;
  const { filename, bytes } = run.source;
  return (
    <li class="run-row">
      <div class="thumb">
        {job.state === "done" ? (
          <img src={productPath(job.id, "preview.png")} alt={texts.runs.previewOf(filename)} loading="lazy" decoding="async" />
        ) : (
          <span aria-hidden="true" />
        )}
      </div>
      <div class="run-words">
        <Link to={runPath(run.id)} class="run-link">
          <span class="run-asset">{run.asset}</span> <span class="words">{filename}</span>
        </Link>
        <span class="faint">
          <Time at={run.created_at} /> · {size(bytes)}
        </span>
      </div>
      <div class="run-state">
        <State state={job.state} />
        {job.state === "running" && (
          <span class="run-progress">
            <progress max={1} value={job.progress} aria-label={texts.progress.bar} /> {percent(job.progress)}
          </span>
        )}
        {job.warnings.length > 0 && <span class="faint">{texts.runs.warnings(job.warnings.length)}</span>}
        {job.error && <span class="faint clamp">{job.error.detail}</span>}
      </div>
    </li>
  );
}

function Empty() {
  return (
    <section class="empty">
      <h2>{texts.runs.emptyHeading}</h2>
      <p>{texts.runs.emptyBody}</p>
      <p>{texts.runs.emptyTry}</p>
      <CommandLine command={texts.runs.emptyTryCommand} />
      <p>{texts.runs.emptyCommand}</p>
      <CommandLine command={EXAMPLE_COMMAND(location.origin)} />
    </section>
  );
}
