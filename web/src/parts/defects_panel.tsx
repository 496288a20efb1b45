// A run's defects: numbered on the map and in a list, what could be seen, the report, the measures along the way.

import { useEffect, useMemo, useState } from "preact/hooks";
import { getDefectList, getSections, listDefects, listRuns, problemOf, productPath, type Defect, type Job, type Run } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { MapPanel } from "../map/map_panel.tsx";
import type { Marker } from "../map/painter.ts";
import { comparePath, go, readQuery, writeQuery } from "../router.tsx";
import { localTime } from "../format.ts";
import { defectTexts } from "../texts/defects.ts";
import { DefectDialog } from "./defect_dialog.tsx";
import { Plot } from "./plot.tsx";
import { ProblemBox } from "./problem.tsx";
import { Decision, Severity } from "./severity.tsx";

const words = defectTexts.run;
/** Defects that are shown of one run, the deepest; the files hold all. */
const MOST = 1000;

type Layer = keyof typeof words.layer;
const LAYERS = Object.keys(words.layer) as Layer[];

export function DefectsPanel({ run, job }: { run: Run; job: Job }) {
  const load = async () => {
    const file = await getDefectList(job.id);
    return { file, page: file === null ? null : await listDefects({ job: job.id, sort: "-depth" }, null, MOST) };
  };
  const loaded = useLoaded(`defects ${job.id}`, load, once);
  if (loaded.problem) return <ProblemBox problem={loaded.problem} onRetry={loaded.reload} />;
  if (loaded.value === null) return <p role="status">{defectTexts.waiting}</p>;
  const { file, page } = loaded.value;
  if (file === null || page === null) return <p>{words.notSearched}</p>;
  return (
    <>
      <div class="defects-head">
        <h2>{words.heading}</h2>
        <span class="actions">
          <a class="button small" href={productPath(job.id, "report.html")} target="_blank" rel="noopener" title={words.reportHint}>
            {words.report}
          </a>
          <CompareWith run={run} job={job} />
        </span>
      </div>
      <p class="faint">
        {page.items.length === 0 && `${words.none} `}
        {words.limit(file.detection_limit_mm)} {file.doubtful > 0 && words.doubtful(file.doubtful)} {file.omitted > 0 && words.omitted(file.omitted)} {page.next_cursor && words.more}
      </p>
      <Numbered run={run} job={job} defects={page.items} />
      <Sections job={job} />
    </>
  );
}

function Numbered({ run, job, defects: given }: { run: Run; job: Job; defects: Defect[] }) {
  const [defects, setDefects] = useState(() => [...given].sort((a, b) => a.number - b.number));
  const [chosen, setChosen] = useState<number | null>(() => Number(readQuery().get("no")) || null);
  const [open, setOpen] = useState<Defect | null>(null);
  const [target, setTarget] = useState<{ x_mm: number; y_mm: number; extent_mm: number } | null>(null);
  const [layer, setLayer] = useState<Layer>(() => (readQuery().get("layer") === "deviation" ? "deviation" : "wall"));
  const markers = useMemo<Marker[]>(() => defects.map(({ number, x_mm, y_mm, severity }) => ({ number, x_mm, y_mm, colour: `--${severity}`, chosen: number === chosen })), [defects, chosen]);
  useEffect(() => {
    if (chosen !== null) document.getElementById(`defect-${chosen}`)?.scrollIntoView({ block: "nearest" });
  }, [chosen]);
  const choose = (defect: Defect) => {
    setChosen(defect.number);
    setTarget({ x_mm: defect.x_mm, y_mm: defect.y_mm, extent_mm: Math.max(defect.length_mm, defect.width_mm) });
    writeQuery({ no: `${defect.number}` });
  };
  const put = (now: Defect) => {
    setDefects((before) => before.map((each) => (each.id === now.id ? now : each)));
    setOpen(now);
  };
  return (
    <>
      <div class="segments layer-choice" role="radiogroup" aria-label={words.layers}>
        {LAYERS.map((each) => (
          <label key={each} class={each === layer ? "on" : ""}>
            <input
              type="radio"
              name="defects-layer"
              class="unseen"
              checked={each === layer}
              onChange={() => {
                // The other map has colours of its own.
                writeQuery({ layer: each === "wall" ? null : each, range: null, look: null });
                setLayer(each);
              }}
            />
            {words.layer[each]}
          </label>
        ))}
      </div>
      {layer === "deviation" && <p class="faint">{words.layerHint}</p>}
      <MapPanel run={run} job={job} deviation={layer === "deviation"} markers={markers} onMarker={setChosen} target={target} label={words.mapLabel} />
      {defects.length > 0 && (
        <>
          <ol class="defect-list" aria-label={words.heading} tabIndex={0}>
            {defects.map((defect) => {
              const name = defectTexts.one(defect.number, defectTexts.kind(defect.kind));
              const place = defectTexts.place(defect.clock_h, defect.height_mm);
              return (
                <li key={defect.id} id={`defect-${defect.number}`} class={defect.number === chosen ? "picked" : ""}>
                  <button type="button" class="small number" aria-label={defectTexts.onMapOf(name)} aria-pressed={defect.number === chosen} onClick={() => choose(defect)}>
                    {defect.number}
                  </button>
                  <span class="words">
                    <Severity kind={defect.kind} severity={defect.severity} />
                    <span>
                      <strong>{defectTexts.depth(defect.depth_mm)}</strong>{" "}
                      <span class="faint">
                        {defectTexts.size(defect.length_mm, defect.width_mm)}, {defectTexts.at(defect.chainage_mm)}
                        {place !== "" && `, ${place}`}
                        {defect.code && ` · ${defect.code}`}
                        {defect.comment !== "" && ` · ${defect.comment}`}
                      </span>
                    </span>
                  </span>
                  <Decision state={defect.state} />
                  <button type="button" class="small" aria-label={defectTexts.open(name)} onClick={() => setOpen(defect)}>
                    {defectTexts.details}
                  </button>
                </li>
              );
            })}
          </ol>
          <p class="faint">{words.sign}</p>
        </>
      )}
      {open !== null && <DefectDialog key={open.id} defect={open} onChanged={put} onClose={() => setOpen(null)} />}
    </>
  );
}

/** Another measured run of the asset, to be laid beside this one. */
function CompareWith({ run, job }: { run: Run; job: Job }) {
  const load = async () => (await listRuns({ q: "", asset: run.asset, state: "done", from: "", to: "", sort: "-recorded" }, null, 100)).items;
  const runs = useLoaded(`runs of ${run.asset}`, load, once);
  const others = runs.value?.filter(({ id, direction }) => id !== run.id && direction === run.direction) ?? [];
  if (others.length === 0) return runs.value === null ? null : <span class="faint">{words.compareNone}</span>;
  const choose = (id: string) => {
    const other = others.find((each) => each.id === id);
    if (other === undefined) return;
    const [before, after] = other.recorded_at < run.recorded_at ? [other.job.id, job.id] : [job.id, other.job.id];
    go(comparePath(run.id, before, after));
  };
  return (
    <select aria-label={words.compare} value="" onChange={(event) => choose(event.currentTarget.value)}>
      <option value="">{words.compare}</option>
      {others.map(({ id, recorded_at, source }) => (
        <option key={id} value={id}>
          {localTime(recorded_at)} · {source.filename}
        </option>
      ))}
    </select>
  );
}

function Sections({ job }: { job: Job }) {
  const sections = useLoaded(`sections ${job.id}`, () => getSections(job.id).catch((error: unknown) => (problemOf(error).status === 404 ? new Map<string, (number | null)[]>() : Promise.reject(error))), once);
  const plots = useMemo(() => plotsOf(sections.value), [sections.value]);
  if (sections.problem) return <ProblemBox problem={sections.problem} onRetry={sections.reload} />;
  if (plots === null) return null;
  return (
    <>
      <h2>{words.sections}</h2>
      <p class="faint">{words.sectionsAbout}</p>
      <div class="plots">
        {plots.lines.map(({ label, series }) => (
          <figure key={label}>
            <figcaption>
              <strong>{label}</strong>
            </figcaption>
            <Plot x={plots.x} series={series} xLabel={words.chainage} yLabel={label} label={label} height={190} />
          </figure>
        ))}
      </div>
    </>
  );
}

function plotsOf(columns: Map<string, (number | null)[]> | null) {
  const chainage = columns?.get("chainage_mm") ?? [];
  if (columns === null || chainage.length < 2) return null;
  // A plot's x rises, whichever way the robot went.
  const order = chainage.map((_, at) => at).sort((a, b) => (chainage[a] ?? 0) - (chainage[b] ?? 0));
  const lines = Object.entries(words.plots).flatMap(([name, label]) => {
    const values = columns.get(name);
    if (values === undefined || values.every((value) => value === null)) return [];
    return [{ label, series: [{ label, values: order.map((at) => values[at] ?? null), colour: "--plot-1" }] }];
  });
  return { x: order.map((at) => (chainage[at] ?? 0) / 1000), lines };
}

