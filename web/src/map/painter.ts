// What the map's two canvases show: the tiles on the one, rulers and measurements on the other.

import { exists, levelAt, tileBox, tilesIn, type Box, type Place, type TileAddress, type TilesIndex } from "./pyramid.ts";
import type { TileStore } from "./tiles.ts";
import { RULER_PX, roundDown, SIDE_RULER_PX, toScreen, visible, type Size, type View } from "./window.ts";

/** Colours of the page's present scheme. */
export interface Theme {
  ground: string;
  hole: string;
  text: string;
  card: string;
  line: string;
  mark: string;
  halo: string;
  /** Another colour of the style sheet by its name. */
  of: (name: string) => string;
}

export function readTheme(element: Element): Theme {
  const style = getComputedStyle(element);
  const of = (name: string) => style.getPropertyValue(name).trim();
  return {
    ground: of("--map-ground"),
    hole: of("--map-hole"),
    text: of("--text"),
    card: of("--card"),
    line: of("--line"),
    mark: of("--mark"),
    halo: of("--halo"),
    of,
  };
}

const FONT = "12px system-ui, sans-serif";

/** The tiles that a view needs, the first to be loaded first: something of everything, then what is sharp. */
export function wishes(index: TilesIndex, box: Box, level: number): TileAddress[] {
  const top = index.levels.length - 1;
  const levels = [...new Set([top, Math.min(level + 1, top), level])];
  return levels.flatMap((each) => tilesIn(index, each, box));
}

export interface Scene {
  index: TilesIndex;
  tiles: TileStore;
  view: View;
  size: Size;
  ratio: number;
  bounds: Box;
  /** 0: depth only, 1: the visible image only. */
  texture: number;
}

/** Draws the tiles; where a tile is not there yet, what its coarser ones show. Answers the level and whether all of it is there. */
export function drawTiles(context: CanvasRenderingContext2D, scene: Scene, theme: Theme): { level: number; whole: boolean } {
  const { index, tiles, view, size, ratio, bounds, texture } = scene;
  const level = levelAt(index, view.mm_per_css_px / ratio);
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = theme.ground;
  context.fillRect(0, 0, context.canvas.width, context.canvas.height);
  const [left, top, width, height] = onDevice(view, size, ratio, bounds);
  context.fillStyle = theme.hole;
  context.fillRect(left, top, width, height);
  // Cells are shown as they are once they can be told apart.
  context.imageSmoothingEnabled = index.grid.mm_per_px * 2 ** level < (view.mm_per_css_px / ratio) * 2;
  context.imageSmoothingQuality = "low";
  const shown = visible(view, size);
  let whole = true;
  for (const address of tilesIn(index, level, shown)) {
    const place = onDevice(view, size, ratio, tileBox(index, address));
    const tile = tiles.get(address);
    if (texture < 1) {
      if (tile?.picture) context.drawImage(tile.picture, ...place);
      else whole = drawCoarser(context, scene, address, place, "picture") && whole;
    }
    if (texture > 0) {
      context.globalAlpha = texture;
      if (tile?.texture) context.drawImage(tile.texture, ...place);
      else whole = drawCoarser(context, scene, address, place, "texture") && whole;
      context.globalAlpha = 1;
    }
  }
  return { level, whole };
}

type Rectangle = [number, number, number, number];

/** A box in whole pixels of the device: neighbours share their edges, so that no seam shows. */
function onDevice(view: View, size: Size, ratio: number, box: Box): Rectangle {
  const from = toScreen(view, size, { x_mm: box.left, y_mm: box.top });
  const to = toScreen(view, size, { x_mm: box.right, y_mm: box.bottom });
  const [left, top] = [Math.round(from.x * ratio), Math.round(from.y * ratio)];
  return [left, top, Math.round(to.x * ratio) - left, Math.round(to.y * ratio) - top];
}

function drawCoarser(context: CanvasRenderingContext2D, { index, tiles }: Scene, address: TileAddress, place: Rectangle, layer: "picture" | "texture"): boolean {
  const side = index.tile_side_px;
  for (let up = 1; address.level + up < index.levels.length; up += 1) {
    const above = { level: address.level + up, column: address.column >> up, row: address.row >> up };
    if (!exists(index, above)) return false;
    const picture = tiles.get(above)?.[layer];
    if (!picture) continue;
    const part = side / 2 ** up;
    const column = address.column - (above.column << up);
    const row = address.row - (above.row << up);
    context.drawImage(picture, column * part, row * part, part, part, ...place);
    return false;
  }
  return false;
}

/** A way measured on the wall. */
export interface Line {
  from: Place;
  to: Place;
  /** Ends have marks, a section has none. */
  marks: boolean;
}

/** A numbered place on the wall. */
export interface Marker extends Place {
  number: number;
  /** A colour of the style sheet: `--minor` and so on. */
  colour: string;
  chosen: boolean;
}

export interface Overlay {
  markers: Marker[];
  lines: Line[];
  /** Where the keyboard would set a point. */
  cross: boolean;
  /** A place to point at, such as the plot's cursor. */
  spot: Place | null;
}

export interface Chainage {
  start_mm: number;
  /** -1 where the robot went backwards: chainage falls along x. */
  sign: 1 | -1;
}

export function drawOverlay(context: CanvasRenderingContext2D, scene: Pick<Scene, "view" | "size" | "ratio">, overlay: Overlay, chainage: Chainage, theme: Theme): void {
  const { view, size, ratio } = scene;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, size.width, size.height);
  context.font = FONT;
  drawMarkers(context, view, size, overlay.markers, theme);
  for (const line of overlay.lines) drawLine(context, view, size, line, theme);
  if (overlay.spot !== null) drawSpot(context, view, size, overlay.spot, theme);
  if (overlay.cross) drawCross(context, size, theme);
  drawRulers(context, view, size, chainage, theme);
  drawScaleBar(context, view, size, theme);
}

/** Twice: a wide line that stands out from any wall, and the line itself. */
function stroke(context: CanvasRenderingContext2D, theme: Theme, path: () => void): void {
  for (const [width, colour] of [
    [5, theme.halo],
    [2, theme.mark],
  ] as const) {
    context.lineWidth = width;
    context.strokeStyle = colour;
    context.beginPath();
    path();
    context.stroke();
  }
}

function drawLine(context: CanvasRenderingContext2D, view: View, size: Size, line: Line, theme: Theme): void {
  const from = toScreen(view, size, line.from);
  const to = toScreen(view, size, line.to);
  stroke(context, theme, () => {
    context.moveTo(from.x, from.y);
    context.lineTo(to.x, to.y);
  });
  if (!line.marks) return;
  for (const { x, y } of [from, to]) {
    stroke(context, theme, () => context.arc(x, y, 5, 0, 2 * Math.PI));
  }
}

/** Radius of a marker, px. */
export const MARKER_PX = 11;
/** Of more markers in view than these, only dots are drawn: their numbers would hide each other. */
const MOST_NUMBERS = 150;

function drawMarkers(context: CanvasRenderingContext2D, view: View, size: Size, markers: Marker[], theme: Theme): void {
  const box = visible(view, size);
  const shown = markers.filter(({ x_mm, y_mm }) => x_mm >= box.left && x_mm <= box.right && y_mm >= box.top && y_mm <= box.bottom);
  // The chosen one lies on top.
  shown.sort((a, b) => Number(a.chosen) - Number(b.chosen));
  const numbered = shown.length <= MOST_NUMBERS;
  context.textAlign = "center";
  context.textBaseline = "middle";
  for (const marker of shown) {
    const { x, y } = toScreen(view, size, marker);
    const radius = marker.chosen ? MARKER_PX + 3 : numbered ? MARKER_PX : 4;
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    context.fillStyle = theme.card;
    context.fill();
    context.lineWidth = marker.chosen ? 5 : 3;
    context.strokeStyle = theme.of(marker.colour);
    context.stroke();
    if (!numbered && !marker.chosen) continue;
    context.fillStyle = theme.text;
    context.fillText(`${marker.number}`, x, y + 0.5);
  }
}

function drawSpot(context: CanvasRenderingContext2D, view: View, size: Size, place: Place, theme: Theme): void {
  const { x, y } = toScreen(view, size, place);
  stroke(context, theme, () => context.arc(x, y, 6, 0, 2 * Math.PI));
}

function drawCross(context: CanvasRenderingContext2D, size: Size, theme: Theme): void {
  const [x, y] = [size.width / 2, size.height / 2];
  stroke(context, theme, () => {
    context.moveTo(x - 12, y);
    context.lineTo(x + 12, y);
    context.moveTo(x, y - 12);
    context.lineTo(x, y + 12);
  });
}

/** A length for a ruler whose steps are `step_mm`: metres where the steps are. */
function onRuler(mm: number, step_mm: number): string {
  const [value, step, unit] = step_mm >= 100 ? [mm / 1000, step_mm / 1000, "m"] : [mm, step_mm, "mm"];
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return `${(Math.abs(value) < step / 1000 ? 0 : value).toLocaleString(undefined, { minimumFractionDigits: digits, maximumFractionDigits: digits })} ${unit}`;
}

function drawRulers(context: CanvasRenderingContext2D, view: View, size: Size, { start_mm, sign }: Chainage, theme: Theme): void {
  const scale = view.mm_per_css_px;
  context.fillStyle = theme.card;
  context.globalAlpha = 0.92;
  context.fillRect(0, 0, size.width, RULER_PX);
  context.fillRect(0, RULER_PX, SIDE_RULER_PX, size.height - RULER_PX);
  context.globalAlpha = 1;
  context.fillStyle = theme.text;
  context.strokeStyle = theme.text;
  context.lineWidth = 1;
  context.beginPath();

  const step = roundDown(Math.min(160, size.width / 3) * scale);
  const box = visible(view, size);
  const ends = [start_mm + sign * box.left, start_mm + sign * box.right] as const;
  context.textAlign = "left";
  context.textBaseline = "middle";
  for (let at = Math.ceil(Math.min(...ends) / step) * step; at <= Math.max(...ends); at += step) {
    const x = Math.round(toScreen(view, size, { x_mm: (at - start_mm) / sign, y_mm: 0 }).x) + 0.5;
    if (x < SIDE_RULER_PX) continue;
    context.moveTo(x, RULER_PX - 8);
    context.lineTo(x, RULER_PX);
    context.fillText(onRuler(at, step), x + 4, RULER_PX / 2);
  }
  const rise = roundDown(90 * scale);
  for (let at = Math.ceil(box.top / rise) * rise; at <= box.bottom; at += rise) {
    const y = Math.round(toScreen(view, size, { x_mm: 0, y_mm: at }).y) + 0.5;
    if (y < RULER_PX + 8) continue;
    context.moveTo(SIDE_RULER_PX - 6, y);
    context.lineTo(SIDE_RULER_PX, y);
    context.textAlign = "right";
    context.fillText(onRuler(at, rise).replace(/ .*$/, ""), SIDE_RULER_PX - 8, y);
  }
  context.stroke();
  context.textAlign = "left";
  context.fillText(rise >= 100 ? "m" : "mm", 6, RULER_PX / 2);
}

function drawScaleBar(context: CanvasRenderingContext2D, view: View, size: Size, theme: Theme): void {
  const length_mm = roundDown(Math.min(180, size.width / 4) * view.mm_per_css_px);
  const length = length_mm / view.mm_per_css_px;
  const [x, y] = [size.width - length - 18, size.height - 14];
  const words = onRuler(length_mm, length_mm >= 1000 ? 1000 : length_mm);
  context.fillStyle = theme.card;
  context.globalAlpha = 0.92;
  context.fillRect(x - 10, y - 26, length + 20, 34);
  context.globalAlpha = 1;
  context.strokeStyle = theme.text;
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(x, y - 5);
  context.lineTo(x, y);
  context.lineTo(x + length, y);
  context.lineTo(x + length, y - 5);
  context.stroke();
  context.fillStyle = theme.text;
  context.textAlign = "center";
  context.textBaseline = "bottom";
  context.fillText(words, x + length / 2, y - 4);
}
