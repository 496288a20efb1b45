// The list of runs: find one by its words, its state, its asset, its date; thousands of rows without lag. The address keeps what was asked for.

import { useEffect, useRef, useState } from "preact/hooks";
import { getRun, isActive, listAssets, listRuns, problemOf, productPath, type Problem, type Run, type RunFilter } from "../api.ts";
import { lengthMm, size } from "../format.ts";
import { once, useLoaded, useNarrow, useTitle } from "../hooks.ts";
import { CommandLine } from "../parts/command_line.tsx";
import { dayStart } from "../parts/days.ts";
import { farInWords, JobBar } from "../parts/job_bar.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { RunFilters } from "../parts/run_filters.tsx";
import { State } from "../parts/state.tsx";
import { Time } from "../parts/time.tsx";
import { Link, readQuery, runPath, writeQuery } from "../router.tsx";
import { onSession } from "../session.ts";
import { EXAMPLE_COMMAND, texts } from "../texts.ts";
import { VirtualList } from "../virtual_list.tsx";

/** Runs that are asked for at once: more than a screen has, and half a second on a thin link. */
const PAGE = 40;
const WORKING_MS = 2500;
const IDLE_MS = 15_000;
/** Typing rests this long before the server is asked. */
const TYPING_MS = 250;
/** Rows of the list, px; the style sheet's --row. */
const ROW_PX = 84;
const NARROW_ROW_PX = 112;

const NO_FILTER: RunFilter = { q: "", state: "", asset: "", from: "", to: "", sort: "" };

export function RunsView() {
  const [filter, setFilter] = useState<RunFilter>(readFilter);
  const assets = useLoaded("assets", listAssets, once);
  const runs = useRuns(filter);
  useTitle(texts.runs.title);
  const narrow = useNarrow();
  const change = (next: RunFilter) => {
    setFilter(next);
    writeQuery({ ...next });
  };
  // "Back" and links to the list change the address: the filters follow it.
  useEffect(() => {
    const moved = () => setFilter((before) => (same(before, readFilter()) ? before : readFilter()));
    addEventListener("popstate", moved);
    return () => removeEventListener("popstate", moved);
  }, []);
  const filtered = !same({ ...filter, sort: "" }, NO_FILTER);
  const empty = runs.items?.length === 0;
  return (
    <>
      <div class="title">
        <h1>{texts.runs.title}</h1>
        <span class="faint" role="status">
          {runs.items !== null && !empty && texts.runs.count(runs.items.length, runs.more)}
        </span>
      </div>
      {(!empty || filtered) && <RunFilters filter={filter} assets={assets.value ?? []} onChange={change} />}
      {runs.problem && <ProblemBox problem={runs.problem} onRetry={runs.reload} />}
      {runs.items === null && runs.problem === null && <Waiting />}
      {empty && !filtered && <Empty />}
      {empty && filtered && (
        <p class="empty">
          {texts.runs.nothing}{" "}
          <button type="button" class="quiet" onClick={() => change({ ...NO_FILTER, sort: filter.sort })}>
            {texts.runs.clear}
          </button>
        </p>
      )}
      {runs.items !== null && !empty && (
        <VirtualList label={texts.runs.list} items={runs.items} row={narrow ? NARROW_ROW_PX : ROW_PX} keyOf={(run) => run.id} onNearEnd={runs.loadMore}>
          {(run) => <RunRow run={run} />}
        </VirtualList>
      )}
      {runs.loading && runs.items !== null && <p class="faint">{texts.runs.loadingMore}</p>}
    </>
  );
}

function readFilter(): RunFilter {
  const query = readQuery();
  const of = (name: keyof RunFilter) => query.get(name) ?? "";
  return { q: of("q"), state: of("state"), asset: of("asset"), from: of("from"), to: of("to"), sort: of("sort") };
}

function same(a: RunFilter, b: RunFilter): boolean {
  return (Object.keys(a) as (keyof RunFilter)[]).every((name) => a[name] === b[name]);
}

/** Dates as the form has them, as times that the server compares: from the day's start, until the day's end, both local. */
function asked(filter: RunFilter): RunFilter {
  return { ...filter, from: dayStart(filter.from, 0), to: dayStart(filter.to, 1) };
}

interface Runs {
  items: Run[] | null;
  more: boolean;
  loading: boolean;
  problem: Problem | null;
  loadMore: () => void;
  reload: () => void;
}

/** Runs by pages, as far as somebody has scrolled; what is at work and what is new is kept fresh. */
function useRuns(filter: RunFilter): Runs {
  const [state, setState] = useState<{ items: Run[] | null; cursor: string | null; loading: boolean; problem: Problem | null }>({ items: null, cursor: null, loading: true, problem: null });
  const [turn, setTurn] = useState(0);
  const now = useRef(state);
  now.current = state;
  const key = JSON.stringify(filter);
  const stopped = useRef(new AbortController());

  useEffect(() => {
    const stopper = (stopped.current = new AbortController());
    let timer: ReturnType<typeof setTimeout> | undefined;
    const wait = (ms: number, then: () => Promise<void>) => {
      timer = setTimeout(() => (document.hidden ? wait(ms, then) : void then()), ms);
    };
    const freshen = async () => {
      try {
        await refresh(asked(filter), now.current.items ?? [], stopper.signal, (items) => setState((before) => ({ ...before, items, problem: null })));
      } catch (error) {
        if (!stopper.signal.aborted) setState((before) => ({ ...before, problem: problemOf(error) }));
      }
      if (!stopper.signal.aborted) wait(now.current.items?.some(isActive) ? WORKING_MS : IDLE_MS, freshen);
    };
    const begin = async () => {
      try {
        const page = await listRuns(asked(filter), null, PAGE, stopper.signal);
        setState({ items: page.items, cursor: page.next_cursor ?? null, loading: false, problem: null });
      } catch (error) {
        if (stopper.signal.aborted) return;
        setState((before) => ({ ...before, loading: false, problem: problemOf(error) }));
        if (problemOf(error).retryable) wait(WORKING_MS, begin);
        return;
      }
      wait(now.current.items?.some(isActive) ? WORKING_MS : IDLE_MS, freshen);
    };
    // The first list at once; then typing is waited for.
    if (now.current.items === null) void begin();
    else wait(TYPING_MS, begin);
    const noSession = onSession((loggedIn) => loggedIn && setTurn((n) => n + 1));
    return () => {
      noSession();
      stopper.abort();
      clearTimeout(timer);
    };
  }, [key, turn]);

  const loadMore = () => {
    const { cursor, loading, items } = now.current;
    if (cursor === null || loading || items === null) return;
    const { signal } = stopped.current;
    now.current = { ...now.current, loading: true };
    setState((before) => ({ ...before, loading: true }));
    listRuns(asked(filter), cursor, 2 * PAGE, signal).then(
      (page) => setState((before) => ({ items: joined(before.items ?? [], page.items), cursor: page.next_cursor ?? null, loading: false, problem: null })),
      (error: unknown) => !signal.aborted && setState((before) => ({ ...before, loading: false, problem: problemOf(error) })),
    );
  };
  return { ...state, more: state.cursor !== null, loadMore, reload: () => setTurn((n) => n + 1) };
}

function joined(before: Run[], more: Run[]): Run[] {
  const known = new Set(before.map(({ id }) => id));
  return [...before, ...more.filter(({ id }) => !known.has(id))];
}

/** What is at work is asked for by name, what is new by the first page's head: a list of thousands is never loaded again. */
async function refresh(filter: RunFilter, items: Run[], signal: AbortSignal, found: (items: Run[]) => void): Promise<void> {
  const newestFirst = filter.sort === "" || filter.sort === "-created";
  const head = await listRuns(filter, null, newestFirst ? 10 : 1, signal);
  const working = items.filter((run) => isActive(run) && !head.items.some(({ id }) => id === run.id)).slice(0, 20);
  const fresh = new Map([...head.items, ...(await Promise.all(working.map(({ id }) => getRun(id).catch(() => null))))].flatMap((run) => (run === null ? [] : [[run.id, run] as const])));
  if (signal.aborted) return;
  // A run that the head no longer names although it should was deleted.
  const last = head.items.at(-1)?.id ?? "";
  const gone = (run: Run) => newestFirst && run.id >= last && !fresh.has(run.id);
  const kept = items.filter((run) => !gone(run)).map((run) => fresh.get(run.id) ?? run);
  const added = newestFirst ? head.items.filter(({ id }) => !items.some((run) => run.id === id)) : [];
  found([...added, ...kept]);
}

/** Below these shares somebody should look before trusting a map. */
const GOOD_ROWS = 0.9;
const FAIR_ROWS = 0.5;

function RunRow({ run }: { run: Run }) {
  const { job } = run;
  const { filename, bytes } = run.source;
  const quality = job.quality as { rows_found: number; travel_mm: number; points: number } | null | undefined;
  return (
    <article class="run-row">
      <div class="thumb">
        {job.state === "done" && (quality?.points ?? 0) > 0 ? (
          <img src={productPath(job.id, "thumbnail.jpg")} alt={texts.runs.previewOf(filename)} width="160" height="80" loading="lazy" decoding="async" />
        ) : (
          <span aria-hidden="true" />
        )}
      </div>
      <div class="run-words">
        <Link to={runPath(run.id)} class="run-link">
          <span class="run-asset">{run.asset}</span> <span class="run-file">{filename}</span>
        </Link>
        <span class="faint run-about">
          <Time at={run.recorded_at} /> · {texts.runs.at(lengthMm(run.chainage_mm))} <span class="run-bytes">· {size(bytes)}</span>
        </span>
      </div>
      <div class="run-quality">
        {job.state === "done" && quality && <Quality rows={quality.rows_found} travel_mm={quality.travel_mm} points={quality.points} warnings={job.warnings.length} />}
        {job.state === "running" && (
          <span class="run-progress">
            <JobBar job={job} /> {farInWords(job)}
          </span>
        )}
        {job.error && <span class="faint clamp">{job.error.detail}</span>}
      </div>
      <div class="run-state">
        <State state={job.state} />
      </div>
    </article>
  );
}

function Quality({ rows, travel_mm, points, warnings }: { rows: number; travel_mm: number; points: number; warnings: number }) {
  const grade = points === 0 || rows < FAIR_ROWS ? "poor" : rows < GOOD_ROWS ? "fair" : "good";
  return (
    <>
      <span class="run-grade">
        <span class={`grade ${grade}`}>{texts.runs.quality[grade]}</span> {warnings > 0 && <span class="warn-words">{texts.runs.warnings(warnings)}</span>}
      </span>
      <span class="faint">{points === 0 ? texts.runs.nothingMeasured : `${texts.runs.travel(travel_mm)}, ${texts.runs.rows(rows)}`}</span>
    </>
  );
}

/** The shape of what comes: the page does not jump when it is there. */
function Waiting() {
  return (
    <div role="status" class="waiting-rows">
      <span class="unseen">{texts.waiting.runs}</span>
      {[0, 1, 2, 3].map((row) => (
        <div key={row} class="run-row ghost" />
      ))}
    </div>
  );
}

function Empty() {
  return (
    <section class="empty">
      <h2>{texts.runs.emptyHeading}</h2>
      <p>{texts.runs.emptyBody}</p>
      <p>
        <Link to="/send" class="button primary">
          {texts.nav.send}
        </Link>
      </p>
      <p>{texts.runs.emptyTry}</p>
      <CommandLine command={texts.runs.emptyTryCommand} />
      <p>{texts.runs.emptyCommand}</p>
      <CommandLine command={EXAMPLE_COMMAND(location.origin)} />
    </section>
  );
}
