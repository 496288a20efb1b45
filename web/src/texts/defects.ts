// Words of the defects: their list over all runs, a run's own, what changed between two runs.

import type { DefectState } from "../api.ts";
import { count, lengthMm, number, percent } from "../format.ts";

const signed = (mm: number): string => `${mm > 0 ? "+" : mm < 0 ? "−" : ""}${Math.abs(mm).toLocaleString(undefined, { minimumFractionDigits: 1, maximumFractionDigits: 1 })}\u00a0mm`;

/** A chainage to the millimetre: people go there with a tape. */
const chainage = (mm: number): string => `${(mm / 1000).toLocaleString(undefined, { minimumFractionDigits: 3, maximumFractionDigits: 3 })}\u00a0m`;

/** Whole millimetres, with a true minus. */
const whole = (mm: number): string => `${Math.round(mm) < 0 ? "−" : ""}${Math.abs(Math.round(mm)).toLocaleString()}`;

/** Clock position as a clock shows it. */
function clock(hours: number): string {
  const minutes = Math.round(hours * 60);
  return `${((Math.floor(minutes / 60) + 11) % 12) + 1}:${`${minutes % 60}`.padStart(2, "0")}`;
}

export const defectTexts = {
  title: "Defects",
  list: "Defects",
  kinds: { dent: "Dent", bulge: "Bulge", step: "Step", hole: "Hole", missing_material: "Missing material" } as Record<string, string>,
  kind: (kind: string): string => defectTexts.kinds[kind] ?? kind,
  severities: { minor: "Minor", moderate: "Moderate", severe: "Severe" } as Record<string, string>,
  states: { open: "Open", acknowledged: "Acknowledged", watched: "Watched", repaired: "Repaired", dismissed: "No defect" } satisfies Record<DefectState, string>,
  count: (shown: number, more: boolean) => (more ? `${count(shown)} defects loaded, more below` : shown === 1 ? "1 defect" : `${count(shown)} defects`),
  search: "Search defects",
  searchHint: "Asset, comment, kind or code",
  anyKind: "Any kind",
  kindLabel: "Kind",
  anySeverity: "Any severity",
  severityLabel: "Severity",
  anyState: "Any state",
  stateLabel: "State",
  from: "Chainage from, m",
  to: "to, m",
  deeper: "Depth from, mm",
  sort: "Order",
  sorts: {
    "-created": "Newest runs first",
    created: "Oldest runs first",
    "-depth": "Deepest first",
    depth: "Shallowest first",
    chainage: "Chainage rising",
    "-chainage": "Chainage falling",
  } as Record<string, string>,
  csv: "CSV",
  csvHint: "This list as a table for spreadsheets",
  geojson: "GeoJSON",
  geojsonHint: "This list for GIS programs. Coordinates are local: chainage in m, height in m or clock in h",
  nothing: "No defect fits these filters.",
  emptyHeading: "No defects yet",
  emptyBody:
    "Every measured run is searched for dents, bulges, steps, holes and missing material. What is found stands here, over all runs, with its place, its depth and what people have decided about it.",
  emptyLimit: "A run without an entry is no promise: each run's Defects tab says how deep a defect must be to be seen there.",
  emptyTry: "To see some, send a simulated run along a damaged wall:",
  emptyTryCommand: "stria simulate damaged --out demo",
  waiting: "Waiting for the list of defects…",
  depth: (mm: number) => signed(mm),
  size: (length_mm: number, width_mm: number) => `${whole(length_mm)} × ${whole(width_mm)}\u00a0mm`,
  at: (chainage_mm: number) => `at ${chainage(chainage_mm)}`,
  chainage,
  place: (clock_h: number | null | undefined, height_mm: number | null | undefined) =>
    clock_h != null ? `${clock(clock_h)} o'clock` : height_mm != null ? `height ${whole(height_mm)}\u00a0mm` : "",
  map: "Map",
  onMap: "Show on the map",
  onMapOf: (words: string) => `Show on the map: ${words}`,
  open: (words: string) => `Details and decision: ${words}`,
  details: "Details",
  number: (number: number) => `No. ${number}`,
  one: (number: number, kind: string) => `No. ${number} · ${kind}`,
  facts: {
    asset: "Asset",
    place: "Place",
    depth: "Depth",
    size: "Length × width",
    area: "Area",
    volume: "Volume",
    slope: "Steepest slope",
    sure: "Confidence",
    code: "Code",
  },
  area: (mm2: number) => (mm2 >= 1e5 ? `${number(mm2 / 1e6)}\u00a0m²` : `${count(mm2)}\u00a0mm²`),
  volume: (mm3: number) => (mm3 >= 1e5 ? `${number(mm3 / 1e6)}\u00a0l` : `${count(mm3)}\u00a0mm³`),
  slope: (deg: number) => `${count(deg)}°`,
  sure: (share: number, atEdge: boolean) => `${percent(share)}${atEdge ? "; reaches the edge of what was seen" : ""}`,
  decision: "What people decided",
  comment: "Comment",
  save: "Save",
  saved: "Saved.",
  acknowledge: "Acknowledge",
  close: "Close",
  by: (who: string) => `by ${who}`,
  carried: "This was said of the same place in an earlier measurement of this run.",
  gone: "This defect does not exist any more.",
  history: "The same place in other runs",
  historyAlone: "No other run of this asset has passed this place in this direction.",
  historyRun: "Run of",
  historyDepth: "Depth",
  historyNothing: (limit_mm: number) => `nothing found (a dent of 20 mm radius shows from ${lengthMm(limit_mm)} on)`,
  historyThis: "this one",
  run: {
    heading: "Defects",
    none: "No defect was found.",
    limit: (mm: number) => `On this run a round dent of 20 mm radius must be ${lengthMm(mm)} deep to be listed; flatter ones are not told from the wall's own scatter.`,
    omitted: (defects: number) => `${count(defects)} shallower ones are not listed.`,
    doubtful: (places: number) => (places === 1 ? "1 place beside a gap was seen too little to be listed." : `${count(places)} places beside gaps were seen too little to be listed.`),
    notSearched: "This measurement was not searched for defects: too little was measured, or they were not asked for.",
    report: "Open the report",
    reportHint: "A page to print, in a new tab",
    more: "Only the deepest 1,000 are shown here. The files hold all.",
    sign: "+ lies away from the camera, − towards it.",
    mapLabel: "Map of the wall with the numbered defects. Arrow keys move, plus and minus zoom, 0 shows the whole map.",
    sections: "Along the way",
    sectionsAbout: "Each point stands for a stretch of the way.",
    chainage: "Chainage, m",
    layers: "Map",
    layer: { wall: "The wall", deviation: "Deviation" },
    layerHint: "How far the wall lies from its undamaged shape: bright stands out towards the camera, dark lies behind. Coarser than the depth map.",
    compare: "Compare with another run of this asset",
    compareNone: "There is no other measured run of this asset.",
    compareChoose: "Choose a run",
    plots: {
      radius_mm: "Radius, mm",
      ovality_percent: "Ovality, %",
      radius_loss_mm: "Loss of radius, mm",
      flatness_mm: "Flatness, mm",
      roughness_mm: "Roughness, mm",
    } as Record<string, string>,
  },
  change: {
    heading: "What changed on the wall",
    working: "Laying the two surfaces on each other…",
    about: (lod_mm: number, claimed_mm: number) =>
      `Left is before, right is after. 95 % of an unchanged surface differs by less than ${lengthMm(lod_mm)}; a change is claimed from ${lengthMm(claimed_mm)} on.`,
    none: "No change that could be told.",
    states: { new: "New", grown: "Grown", shrunk: "Shrunk", vanished: "Vanished", changed: "Changed, no defect in either", unchanged: "Unchanged" } as Record<string, string>,
    state: "What",
    before: "Before",
    after: "After",
    delta: "Change",
    place: "Place",
    area: "Area",
    no: (number: number, depth: string) => `No. ${number}, ${depth}`,
    unsure: (before: number, after: number) => `Of ${count(before)} defects before and ${count(after)} after, no change can be told: near the limit of what is seen, or not measured in the other run.`,
    registration: (agreeing: number, windows: number, sd_mm: number) => `Laid on each other by their relief in ${count(agreeing)} of ${count(windows)} windows, to ${lengthMm(sd_mm)}.`,
  },
} as const;
