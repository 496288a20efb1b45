// One batch: how far it is, and what it made of each run beside what was there.

import { useState } from "preact/hooks";
import { getBatch, getRun, listResults, type BatchResult, type Run } from "../api.ts";
import { count, lengthMm } from "../format.ts";
import { useLoaded, useTitle } from "../hooks.ts";
import { ActionButton } from "../parts/action_button.tsx";
import { BatchActions, BatchProgress, BatchState, moves } from "../parts/batches.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { State } from "../parts/state.tsx";
import { Time } from "../parts/time.tsx";
import { comparePath, Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { batchTexts } from "../texts/batches.ts";
import { runTexts } from "../texts/run.ts";
import { workTexts } from "../texts/work.ts";

const words = batchTexts;
const FRESH_MS = 3000;
const IDLE_MS = 60_000;

/** How each figure is written, and its difference: shares differ by points, not per cent. */
const FIGURES: Record<string, { value: (n: number) => string; difference: (n: number) => string }> = {
  rows_found: { value: (n) => `${(n * 100).toFixed(1)} %`, difference: words.points },
  coverage: { value: (n) => `${(n * 100).toFixed(1)} %`, difference: words.points },
  travel_mm: { value: lengthMm, difference: lengthMm },
  points: { value: count, difference: count },
};

interface Row {
  result: BatchResult;
  run: Run | null;
}

async function pageOf(batch: string, cursor: string | null): Promise<{ rows: Row[]; next: string | null }> {
  const page = await listResults(batch, cursor);
  const rows = await Promise.all(page.items.map(async (result) => ({ result, run: await getRun(result.run).catch(() => null) })));
  return { rows, next: page.next_cursor ?? null };
}

export function BatchView({ batch: id }: { batch: string }) {
  const load = async () => {
    const [batch, first] = await Promise.all([getBatch(id), pageOf(id, null)]);
    return { batch, first };
  };
  const loaded = useLoaded(`batch ${id}`, load, ({ batch }) => (moves(batch) ? FRESH_MS : IDLE_MS));
  const [later, setLater] = useState<{ rows: Row[]; next: string | null } | null>(null);
  const batch = loaded.value?.batch ?? null;
  useTitle(batch === null ? words.heading : words.name(batch));
  const next = later === null ? (loaded.value?.first.next ?? null) : later.next;
  const rows = [...(loaded.value?.first.rows ?? []), ...(later?.rows ?? [])];
  const more = async () => {
    const page = await pageOf(id, next);
    setLater((before) => ({ rows: [...(before?.rows ?? []), ...page.rows], next: page.next }));
  };
  return (
    <>
      <nav aria-label={runTexts.run.breadcrumb} class="crumbs">
        <Link to="/queue">{workTexts.queue.heading}</Link> <span aria-hidden="true">›</span> {words.heading}
      </nav>
      {loaded.problem && <ProblemBox problem={loaded.problem} onRetry={loaded.reload} />}
      {batch === null && !loaded.problem && <p role="status">{texts.waiting.list}</p>}
      {batch && (
        <>
          <div class="title">
            <h1 class="words">{words.name(batch)}</h1>
            <BatchState batch={batch} />
          </div>
          <section class="card batch-head" aria-label={words.heading}>
            <p>
              <Time at={batch.created_at} /> · {words.runs(batch.runs)}
            </p>
            <BatchProgress batch={batch} />
            <BatchActions batch={batch} onChanged={loaded.reload} />
          </section>
          <section class="card" aria-label={words.results}>
            <h2>{words.results}</h2>
            <p class="faint">{words.resultsAbout}</p>
            {rows.length === 0 ? <p>{words.noResults}</p> : <Results rows={rows} />}
            {next !== null && (
              <p class="actions">
                <ActionButton action={more}>{words.more}</ActionButton>
              </p>
            )}
          </section>
        </>
      )}
    </>
  );
}

const figureName = (figure: string): string => runTexts.compare.figures[figure] ?? figure;

function Results({ rows }: { rows: Row[] }) {
  const figures = Object.keys(FIGURES).filter((figure) => rows.some(({ result }) => result.difference[figure] !== undefined || after(result, figure) !== null));
  return (
    <>
      <Sums rows={rows} figures={figures} />
      <div class="table-box" tabIndex={0} role="region" aria-label={words.results}>
        <table class="plain-table">
          <thead>
            <tr>
              {[words.run, words.stateHead, ...figures.map(figureName), words.compare].map((head) => (
                <th key={head} scope="col">
                  {head}
                </th>
              ))}
            </tr>
          </thead>
          <tbody>
            {rows.map(({ result, run }) => (
              <tr key={result.job}>
                <th scope="row" class="words">
                  <Link to={runPath(result.run, run?.job.id === result.job ? null : result.job)}>{run === null ? words.gone : `${run.asset}, ${run.source.filename}`}</Link>
                </th>
                <td>
                  <State state={result.state} />
                </td>
                {figures.map((figure) => (
                  <Figure key={figure} result={result} figure={figure} />
                ))}
                <td>
                  {result.base_job && result.before != null && result.after != null && (
                    <Link to={comparePath(result.run, result.base_job, result.job)} label={words.compareOf(run?.source.filename ?? result.run)}>
                      {words.compare}
                    </Link>
                  )}
                </td>
              </tr>
            ))}
          </tbody>
        </table>
      </div>
    </>
  );
}

function after(result: BatchResult, figure: string): number | null {
  const value = (result.after as Record<string, unknown> | null | undefined)?.[figure];
  return typeof value === "number" ? value : null;
}

function Figure({ result, figure }: { result: BatchResult; figure: string }) {
  const [value, difference] = [after(result, figure), result.difference[figure]];
  const write = FIGURES[figure]!;
  return (
    <td data-figure={figure} data-difference={difference}>
      {value !== null && write.value(value)}
      {difference !== undefined && difference !== 0 && <span class="difference faint">{words.signed(difference, write.difference)}</span>}
    </td>
  );
}

/** In how many runs each figure went up, and in how many down. */
function Sums({ rows, figures }: { rows: Row[]; figures: string[] }) {
  const sums = figures.flatMap((figure) => {
    const differences = rows.flatMap(({ result }) => (result.difference[figure] === undefined ? [] : [result.difference[figure]]));
    if (differences.length === 0) return [];
    return [words.better(figureName(figure), differences.filter((each) => each > 0).length, differences.filter((each) => each < 0).length, differences.length)];
  });
  return (
    <ul aria-label={words.sums}>
      {sums.map((sum) => (
        <li key={sum}>{sum}</li>
      ))}
    </ul>
  );
}
