// The map of a job with everything around it: layers, colours, tools, what is measured. The address keeps what is shown.

import "./map.css";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Cut, Job, Run } from "../api.ts";
import { deviationFolder, getTilesIndex, isActive, tilesFolder } from "../api.ts";
import { copyText } from "../clipboard.ts";
import { useLoaded } from "../hooks.ts";
import { lazy } from "../lazy.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { readQuery, writeQuery } from "../router.tsx";
import { mapTexts } from "../texts/map.ts";
import type { Style } from "./colours.ts";
import { ColourRange } from "./colour_range.tsx";
import { MapController, type Hover } from "./controller.ts";
import { Measured, useMeasure, type Tool } from "./measure.tsx";
import type { Chainage, Line, Marker } from "./painter.ts";
import type { Place, TilesIndex } from "./pyramid.ts";
import { Layers, lookOf, type Look } from "./layers.tsx";
import { Readout } from "./readout.tsx";
import type { View } from "./window.ts";

/** The plot comes when somebody cuts the wall open. */
const SectionPanel = lazy(async () => (await import("./section_panel.tsx")).SectionPanel);
/** While a job runs its map is asked for so often, should no event come, ms. */
const GROWING_MS = 3000;
/** A range of colours narrower than this shows nothing but noise, mm. */
const LEAST_SPAN_MM = 0.2;
/** The address follows the view when it rests, ms. */
const ADDRESS_MS = 250;

type Props = {
  run: Run;
  job: Job;
  /** Grows when the map has changed. */
  revision?: number;
  /** A second map beside this one: moves with it. */
  link?: ViewLink;
  /** Less around the map. */
  plain?: boolean;
  label?: string;
  /** Shows how far the wall lies from its undamaged shape, instead of its depth. */
  deviation?: boolean;
  /** Numbered places, and who hears that one is clicked. */
  markers?: Marker[];
  onMarker?: (number: number) => void;
  /** How far its world lies from that of the first map it is linked to. */
  shift?: Place;
  /** What the map looks at when this changes. */
  target?: (Place & { extent_mm: number }) | null;
};

/** Maps that move together. */
export class ViewLink {
  /** The maps, each with how far its world lies from the first one's. */
  private readonly maps = new Map<MapController, Place>();
  join(map: MapController, shift: Place): () => void {
    this.maps.set(map, shift);
    return () => this.maps.delete(map);
  }
  place(map: MapController, shift: Place): void {
    this.maps.set(map, shift);
  }
  moved(from: MapController, view: View): void {
    const own = this.maps.get(from) ?? NO_SHIFT;
    for (const [map, { x_mm, y_mm }] of this.maps) {
      if (map !== from) map.setView({ ...view, x_mm: view.x_mm - own.x_mm + x_mm, y_mm: view.y_mm - own.y_mm + y_mm });
    }
  }
}

const NO_SHIFT: Place = { x_mm: 0, y_mm: 0 };

export function MapPanel(props: Props) {
  const { job, revision, deviation } = props;
  const folder = deviation ? deviationFolder(job.id) : tilesFolder(job.id);
  const index = useLoaded(`tiles ${folder} ${job.state}`, () => getTilesIndex(folder), (found) => (isActive(job) && !found?.complete ? GROWING_MS : null));
  const seen = useRef(revision);
  useEffect(() => {
    if (seen.current !== revision) index.reload();
    seen.current = revision;
  }, [revision]);
  // While the job writes its last products the map of a moment ago is still a map.
  const kept = useRef<{ folder: string; index: TilesIndex } | null>(null);
  if (index.value) kept.current = { folder, index: index.value };
  const shown = index.value ?? (kept.current?.folder === folder ? kept.current.index : null);
  if (shown !== null && shown.levels.length > 0) return <OpenMap key={folder} {...props} folder={folder} index={shown} />;
  return (
    <div class="map-empty">
      {index.problem && <ProblemBox problem={index.problem} onRetry={index.reload} />}
      {!index.problem && <p role="status">{isActive(job) ? mapTexts.notYet : index.value === undefined || shown === null ? (job.quality ? mapTexts.none : mapTexts.loading) : mapTexts.none}</p>}
    </div>
  );
}

function autoRange(index: TilesIndex): [number, number] {
  const [near, far] = index.depth_range_mm ?? [0, 1];
  const widen = Math.max(LEAST_SPAN_MM - (far - near), 0) / 2;
  return [near - widen, far + widen];
}

function OpenMap({ run, job, index, link, plain, label, markers, onMarker, target, shift, deviation, folder }: Props & { index: TilesIndex; folder: string }) {
  const base = useRef<HTMLCanvasElement>(null);
  const top = useRef<HTMLCanvasElement>(null);
  const frame = useRef<HTMLDivElement>(null);
  const map = useRef<MapController | null>(null);
  const start = useMemo(() => readAddress(plain === true, deviation === true), []);
  const [look, setLook] = useState<Look>(start.look);
  const [chosen, setChosen] = useState<[number, number] | null>(start.range);
  const [hover, setHover] = useState<Hover | null>(null);
  const [settled, setSettled] = useState(false);
  const [tool, setTool] = useState<Tool>("move");
  const chainage: Chainage = useMemo(() => ({ start_mm: run.chainage_mm, sign: run.direction === "backward" ? -1 : 1 }), [run]);
  const range = chosen ?? autoRange(index);
  const style: Style = { near_mm: range[0], far_mm: range[1], relief: look.relief };
  const measure = useMeasure(tool, (place) => map.current?.depthAt(place) ?? Promise.resolve(null), () => map.current?.shown() ?? null, start.cut);
  const picked = (place: Place) => {
    const marker = tool === "move" ? map.current?.markerAt(place) : null;
    if (marker) onMarker?.(marker.number);
    else measure.pick(place);
  };
  const pick = useRef(picked);
  pick.current = picked;

  useEffect(() => {
    if (base.current === null || top.current === null) return undefined;
    let timer: ReturnType<typeof setTimeout> | undefined;
    const made = new MapController(base.current, top.current, index, folder, style, chainage, {
      view: (view) => {
        link?.moved(made, view);
        if (plain) return;
        clearTimeout(timer);
        timer = setTimeout(() => writeQuery({ at: `${view.x_mm.toFixed(1)},${view.y_mm.toFixed(1)},${view.mm_per_css_px.toPrecision(4)}` }), ADDRESS_MS);
      },
      hover: setHover,
      pick: (place) => pick.current(place),
      settled: setSettled,
    }, start.view);
    map.current = made;
    top.current.dataset["ready"] = "true";
    // For tests and for the curious: how many pictures were drawn.
    Object.assign(top.current, { striaMap: made });
    const leave = link?.join(made, shift ?? NO_SHIFT);
    return () => {
      clearTimeout(timer);
      leave?.();
      made.close();
      map.current = null;
    };
  }, []);
  useEffect(() => map.current?.setIndex(index), [index]);
  useEffect(() => map.current?.setStyle(style), [style.near_mm, style.far_mm, style.relief]);
  useEffect(() => map.current?.setTexture(look.image), [look.image]);
  const lines: Line[] = measure.lines;
  useEffect(() => map.current?.setLines(lines), [lines]);
  useEffect(() => {
    if (plain) return;
    writeQuery({
      look: look.image === 0 && look.relief === lookOf("depth").relief ? null : `${look.image.toFixed(2)},${look.relief.toFixed(2)}`,
      range: chosen === null ? null : chosen.map((mm) => mm.toFixed(2)).join(","),
      cut: measure.cut === null ? null : cutInAddress(measure.cut),
    });
  }, [look, chosen, measure.cut]);
  useEffect(() => {
    if (map.current !== null) link?.place(map.current, shift ?? NO_SHIFT);
  }, [shift]);
  useEffect(() => map.current?.setMarkers(markers ?? []), [markers]);
  useEffect(() => {
    if (target) map.current?.lookAt(target, target.extent_mm);
  }, [target]);
  const spot = (place: Place | null) => map.current?.setSpot(place);

  return (
    <div class={plain ? "map-panel plain" : "map-panel"} ref={frame}>
      {!plain && (
        <div class="map-bar">
          <Layers look={look} onChange={setLook} withImage={!deviation} />
          <ColourRange range={range} auto={autoRange(index)} chosen={chosen !== null} onChange={setChosen} />
        </div>
      )}
      <div class={`map-frame tool-${tool}`}>
        <canvas ref={base} class="map-base" aria-hidden="true" />
        <canvas ref={top} class="map-top" tabIndex={0} role="application" aria-label={label ?? mapTexts.label} />
        <div class="map-buttons">
          <button type="button" aria-label={mapTexts.zoomIn} title={mapTexts.zoomIn} onClick={() => map.current?.zoom(1.6)}>
            +
          </button>
          <button type="button" aria-label={mapTexts.zoomOut} title={mapTexts.zoomOut} onClick={() => map.current?.zoom(1 / 1.6)}>
            −
          </button>
          <button type="button" aria-label={mapTexts.whole} title={mapTexts.whole} onClick={() => map.current?.showWhole()}>
            ⤢
          </button>
        </div>
        <span class={settled ? "map-loading unseen" : "map-loading"} data-settled={settled}>
          {settled ? "" : mapTexts.sharpening}
        </span>
      </div>
      <Readout hover={hover} chainage={chainage} value={deviation ? mapTexts.cursor.deviation : mapTexts.cursor.depth} />
      {!plain && (
        <>
          <div class="map-tools">
            <ToolChoice tool={tool} onChange={setTool} />
            <span class="faint tool-hint">{mapTexts.toolHint[tool]}</span>
            <CopyLink />
          </div>
          <Measured measure={measure} />
          {measure.cut !== null &&
            (job.state === "done" ? (
              <SectionPanel job={job.id} cut={measure.cut} onSpot={spot} onClose={measure.clearCut} />
            ) : (
              <p class="faint">{mapTexts.section.afterwards}</p>
            ))}
        </>
      )}
    </div>
  );
}

function ToolChoice({ tool, onChange }: { tool: Tool; onChange: (tool: Tool) => void }) {
  return (
    <div class="segments" role="radiogroup" aria-label={mapTexts.tools}>
      {(Object.keys(mapTexts.tool) as Tool[]).map((each) => (
        <label key={each} class={each === tool ? "on" : ""}>
          <input type="radio" name="map-tool" class="unseen" checked={each === tool} onChange={() => onChange(each)} />
          {mapTexts.tool[each]}
        </label>
      ))}
    </div>
  );
}

function CopyLink() {
  const [copied, setCopied] = useState(false);
  const copy = async () => {
    await copyText(location.href);
    setCopied(true);
    setTimeout(() => setCopied(false), 2000);
  };
  return (
    <button type="button" class="quiet small" aria-live="polite" onClick={() => void copy()}>
      {copied ? mapTexts.linkCopied : mapTexts.link}
    </button>
  );
}

function cutInAddress(cut: Cut): string {
  return [...cut.from_mm, ...cut.to_mm].map((mm) => mm.toFixed(2)).join(",");
}

/** What the address says about the map; nonsense in it counts as not said. */
function readAddress(plain: boolean, deviation: boolean): { view: View | null; look: Look; range: [number, number] | null; cut: Cut | null } {
  const query = plain ? new URLSearchParams() : readQuery();
  const numbers = (name: string, count: number): number[] | null => {
    const values = (query.get(name) ?? "").split(",").map(Number);
    return query.has(name) && values.length === count && values.every(Number.isFinite) ? values : null;
  };
  const [x_mm, y_mm, mm_per_css_px] = numbers("at", 3) ?? [];
  const [image, relief] = numbers("look", 2) ?? [];
  const [near, far] = numbers("range", 2) ?? [];
  const cut = numbers("cut", 4);
  // Each kind of map has its own colours; the deviation comes without the image.
  const own = (readQuery().get("layer") === "deviation") === deviation;
  const share = (value: number) => Math.min(Math.max(value, 0), 1);
  return {
    view: x_mm !== undefined && y_mm !== undefined && mm_per_css_px !== undefined && mm_per_css_px > 0 ? { x_mm, y_mm, mm_per_css_px } : null,
    look: image !== undefined && relief !== undefined && own ? { image: share(image), relief: share(relief) } : lookOf("depth"),
    range: own && near !== undefined && far !== undefined && near < far ? [near, far] : null,
    cut: cut === null ? null : { from_mm: [cut[0]!, cut[1]!], to_mm: [cut[2]!, cut[3]!] },
  };
}
