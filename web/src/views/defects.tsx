// The defects of all runs: find, look at, decide. The address keeps what was asked for.

import { useEffect, useRef, useState } from "preact/hooks";
import { defectsFile, getDefect, listAssets, listDefects, problemOf, type Defect, type DefectFilter, type Problem } from "../api.ts";
import { once, useLoaded, useNarrow, useTitle } from "../hooks.ts";
import { CommandLine } from "../parts/command_line.tsx";
import { DefectDialog } from "../parts/defect_dialog.tsx";
import { DefectFilters } from "../parts/defect_filters.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { Decision, Severity } from "../parts/severity.tsx";
import { defectPath, Link, readQuery, writeQuery } from "../router.tsx";
import { defectTexts as words } from "../texts/defects.ts";
import { VirtualList } from "../virtual_list.tsx";

const PAGE = 50;
/** Typing rests this long before the server is asked. */
const TYPING_MS = 250;
/** Rows of the list with their gaps, px. */
const ROW_PX = 76;
const NARROW_ROW_PX = 146;

const NO_FILTER: DefectFilter = { q: "", asset: "", kind: "", severity: "", state: "", from_mm: "", to_mm: "", depth_min_mm: "", sort: "" };
const NAMES = Object.keys(NO_FILTER) as (keyof DefectFilter)[];

function readFilter(): DefectFilter {
  const query = readQuery();
  return Object.fromEntries(NAMES.map((name) => [name, query.get(name) ?? ""])) as unknown as DefectFilter;
}

const same = (a: DefectFilter, b: DefectFilter): boolean => NAMES.every((name) => a[name] === b[name]);

export function DefectsView() {
  const [filter, setFilter] = useState<DefectFilter>(readFilter);
  const [open, setOpen] = useState<string | null>(() => readQuery().get("defect"));
  const assets = useLoaded("assets", listAssets, once);
  const defects = useDefects(filter);
  const narrow = useNarrow();
  // Clearing begins the filters' own fields anew, too.
  const [cleared, setCleared] = useState(0);
  useTitle(words.title);
  const change = (next: DefectFilter) => {
    setFilter(next);
    writeQuery({ ...next });
  };
  const clear = () => {
    change({ ...NO_FILTER, sort: filter.sort });
    setCleared((n) => n + 1);
  };
  const show = (defect: string | null) => {
    setOpen(defect);
    writeQuery({ defect });
  };
  const filtered = !same({ ...filter, sort: "" }, NO_FILTER);
  const empty = defects.items?.length === 0;
  return (
    <>
      <div class="title">
        <h1>{words.title}</h1>
        <span class="faint" role="status">
          {defects.items !== null && !empty && words.count(defects.items.length, defects.more)}
        </span>
        {!empty && defects.items !== null && (
          <span class="actions">
            <a class="button small" href={defectsFile("csv", filter)} download="defects.csv" title={words.csvHint}>
              {words.csv}
            </a>
            <a class="button small" href={defectsFile("geojson", filter)} download="defects.geojson" title={words.geojsonHint}>
              {words.geojson}
            </a>
          </span>
        )}
      </div>
      {(!empty || filtered) && <DefectFilters key={cleared} filter={filter} assets={assets.value ?? []} onChange={change} onClear={clear} used={filtered} />}
      {defects.problem && <ProblemBox problem={defects.problem} onRetry={defects.reload} />}
      {defects.items === null && defects.problem === null && <p role="status">{words.waiting}</p>}
      {empty && !filtered && <Empty />}
      {empty && filtered && <p class="empty">{words.nothing}</p>}
      {defects.items !== null && !empty && (
        <VirtualList label={words.list} items={defects.items} row={narrow ? NARROW_ROW_PX : ROW_PX} keyOf={({ id }) => id} onNearEnd={defects.loadMore}>
          {(defect) => <DefectRow defect={defect} onOpen={() => show(defect.id)} />}
        </VirtualList>
      )}
      {open !== null && <OpenDefect key={open} id={open} known={defects.items?.find(({ id }) => id === open) ?? null} onChanged={defects.put} onClose={() => show(null)} />}
    </>
  );
}

/** A defect that the list may not hold: an address may name it. */
function OpenDefect({ id, known, onChanged, onClose }: { id: string; known: Defect | null; onChanged: (defect: Defect) => void; onClose: () => void }) {
  const [asked, setAsked] = useState<Defect | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  useEffect(() => {
    if (known === null) getDefect(id).then(setAsked, (error: unknown) => setProblem(problemOf(error)));
  }, [id]);
  const defect = known ?? asked;
  if (problem !== null) return <ProblemBox problem={problem} heading={problem.status === 404 ? words.gone : problem.title} onDismiss={onClose} />;
  if (defect === null) return null;
  const changed = (now: Defect) => {
    setAsked(now);
    onChanged(now);
  };
  return <DefectDialog defect={defect} onChanged={changed} onClose={onClose} />;
}

function DefectRow({ defect, onOpen }: { defect: Defect; onOpen: () => void }) {
  const place = words.place(defect.clock_h, defect.height_mm);
  const name = `${words.one(defect.number, words.kind(defect.kind))}, ${defect.asset}`;
  return (
    <article class="defect-row">
      <div class="defect-words">
        <Severity kind={defect.kind} severity={defect.severity} />
        <span>
          <strong>{words.depth(defect.depth_mm)}</strong> <span class="faint">{words.size(defect.length_mm, defect.width_mm)}</span>
        </span>
      </div>
      <div class="defect-words">
        <strong>{defect.asset}</strong>
        <span class="faint">
          {[`${words.chainage(defect.chainage_mm)}${place === "" ? "" : `, ${place}`}`, defect.code, defect.comment].filter(Boolean).join(" · ")}
        </span>
      </div>
      <div>
        <Decision state={defect.state} />
      </div>
      <div class="actions">
        <button type="button" class="small" aria-label={words.open(name)} onClick={onOpen}>
          {words.details}
        </button>
        <Link to={defectPath(defect)} class="button small" label={words.onMapOf(name)}>
          {words.map}
        </Link>
      </div>
    </article>
  );
}

function Empty() {
  return (
    <section class="empty">
      <h2>{words.emptyHeading}</h2>
      <p>{words.emptyBody}</p>
      <p>{words.emptyLimit}</p>
      <p>{words.emptyTry}</p>
      <CommandLine command={words.emptyTryCommand} />
    </section>
  );
}

interface Loaded {
  items: Defect[] | null;
  more: boolean;
  problem: Problem | null;
  loadMore: () => void;
  reload: () => void;
  /** A defect that has changed. */
  put: (defect: Defect) => void;
}

/** Defects by pages, as far as somebody has scrolled. */
function useDefects(filter: DefectFilter): Loaded {
  const [state, setState] = useState<{ items: Defect[] | null; cursor: string | null; problem: Problem | null }>({ items: null, cursor: null, problem: null });
  const [turn, setTurn] = useState(0);
  const now = useRef(state);
  now.current = state;
  const loading = useRef(false);
  const stopped = useRef(new AbortController());
  useEffect(() => {
    const stopper = (stopped.current = new AbortController());
    loading.current = true;
    const begin = () =>
      listDefects(filter, null, PAGE, stopper.signal).then(
        (page) => {
          loading.current = false;
          setState({ items: page.items, cursor: page.next_cursor ?? null, problem: null });
        },
        (error: unknown) => {
          if (!stopper.signal.aborted) setState((before) => ({ ...before, problem: problemOf(error) }));
        },
      );
    const timer = setTimeout(() => void begin(), now.current.items === null ? 0 : TYPING_MS);
    return () => {
      stopper.abort();
      clearTimeout(timer);
    };
  }, [JSON.stringify(filter), turn]);
  const loadMore = () => {
    const { cursor } = now.current;
    if (cursor === null || loading.current) return;
    loading.current = true;
    const { signal } = stopped.current;
    listDefects(filter, cursor, 2 * PAGE, signal).then(
      (page) => {
        loading.current = false;
        setState((before) => ({ items: [...(before.items ?? []), ...page.items], cursor: page.next_cursor ?? null, problem: null }));
      },
      (error: unknown) => {
        if (signal.aborted) return;
        loading.current = false;
        setState((before) => ({ ...before, problem: problemOf(error) }));
      },
    );
  };
  const put = (defect: Defect) => setState((before) => ({ ...before, items: before.items?.map((each) => (each.id === defect.id ? defect : each)) ?? null }));
  return { items: state.items, more: state.cursor !== null, problem: state.problem, loadMore, reload: () => setTurn((n) => n + 1), put };
}
