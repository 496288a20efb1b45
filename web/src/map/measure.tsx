// Measuring on the map: two points and what lies between them, or a line to cut the wall open along.

import { useEffect, useMemo, useState } from "preact/hooks";
import type { Cut } from "../api.ts";
import { lengthMm } from "../format.ts";
import { mapTexts } from "../texts/map.ts";
import type { Line } from "./painter.ts";
import type { Box, Place } from "./pyramid.ts";

export type Tool = keyof typeof mapTexts.tool;

/** A point on the wall; `z_mm` is null where nothing was measured, undefined until it is known. */
interface Point extends Place {
  z_mm: number | null | undefined;
}

export interface Measure {
  points: Point[];
  cut: Cut | null;
  lines: Line[];
  /** A click on the map. */
  pick: (place: Place) => void;
  clear: () => void;
  clearCut: () => void;
}

const words = mapTexts.measured;

export function useMeasure(tool: Tool, depthAt: (place: Place) => Promise<number | null>, shown: () => Box | null, start: Cut | null): Measure {
  const [points, setPoints] = useState<Point[]>([]);
  const [cut, setCut] = useState<Cut | null>(start);
  const [begun, setBegun] = useState<Place | null>(null);
  useEffect(() => setBegun(null), [tool]);

  const pick = (place: Place) => {
    const box = shown();
    if (tool === "measure") {
      const point: Point = { ...place, z_mm: undefined };
      setPoints((before) => (before.length === 1 ? [before[0]!, point] : [point]));
      const known = (z_mm: number | null) => setPoints((now) => now.map((each) => (each === point ? { ...point, z_mm } : each)));
      depthAt(place).then(known, () => known(null));
    } else if (tool === "line") {
      if (begun === null) setBegun(place);
      else {
        setCut({ from_mm: [begun.x_mm, begun.y_mm], to_mm: [place.x_mm, place.y_mm] });
        setBegun(null);
      }
    } else if (tool === "across" && box !== null) {
      setCut({ from_mm: [place.x_mm, box.top], to_mm: [place.x_mm, box.bottom], across: true });
    } else if (tool === "along" && box !== null) {
      setCut({ from_mm: [box.left, place.y_mm], to_mm: [box.right, place.y_mm] });
    }
  };
  const lines = useMemo(() => {
    const all: Line[] = [];
    const line = (from: Place, to: Place, marks: boolean) => all.push({ from, to, marks });
    const [first, second] = points;
    if (first !== undefined) line(first, second ?? first, true);
    if (begun !== null) line(begun, begun, true);
    if (cut !== null) line({ x_mm: cut.from_mm[0], y_mm: cut.from_mm[1] }, { x_mm: cut.to_mm[0], y_mm: cut.to_mm[1] }, true);
    return all;
  }, [points, cut, begun]);
  return { points, cut, lines, pick, clear: () => setPoints([]), clearCut: () => setCut(null) };
}

export function Measured({ measure }: { measure: Measure }) {
  const [first, second] = measure.points;
  if (first === undefined) return null;
  return (
    <section class="measured" aria-label={words.heading}>
      <div class="panel-head">
        <h3>{words.heading}</h3>
        <button type="button" class="quiet small" onClick={measure.clear}>
          {mapTexts.clear}
        </button>
      </div>
      {second === undefined ? <p role="status">{words.first}</p> : <Between first={first} second={second} />}
    </section>
  );
}

function Between({ first, second }: { first: Point; second: Point }) {
  const [along, across] = [second.x_mm - first.x_mm, second.y_mm - first.y_mm];
  const flat = Math.hypot(along, across);
  const known = typeof first.z_mm === "number" && typeof second.z_mm === "number";
  const depth = known ? (second.z_mm as number) - (first.z_mm as number) : null;
  const waiting = first.z_mm === undefined || second.z_mm === undefined;
  const rows: [string, string, number | null][] = [
    [words.flat, lengthOf(flat), flat],
    [words.along, lengthOf(Math.abs(along)), Math.abs(along)],
    [words.up, lengthOf(Math.abs(across)), Math.abs(across)],
    [words.depth, depth === null ? (waiting ? "…" : words.hole) : words.deeper(depth), depth],
    ...(depth === null ? [] : [[words.straight, lengthOf(Math.hypot(flat, depth)), Math.hypot(flat, depth)] as [string, string, number]]),
  ];
  return (
    <dl class="facts" aria-live="polite">
      {rows.map(([name, text, value]) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd data-mm={value ?? undefined}>{text}</dd>
        </div>
      ))}
    </dl>
  );
}

/** Millimetres as long as a person measures in them. */
function lengthOf(mm: number): string {
  return mm < 10_000 ? words.mm(mm) : lengthMm(mm);
}
