// The surface as points: the level of the map that has few enough of them, read from its tiles.

import { getTilesIndex, tilesFolder } from "../api.ts";
import { getTile } from "../api_tiles.ts";
import { depthsOf } from "../map/depths.ts";
import type { TilesIndex } from "../map/pyramid.ts";

export interface Points {
  /** x, y, z of each, mm. */
  positions: Float32Array;
  count: number;
  /** The middle of all, mm. */
  middle: [number, number, number];
  /** Half the longest side, mm. */
  radius: number;
  /** Depths at the ends of the colours, mm. */
  range: [number, number];
}

/** Points that any machine can draw. */
const MOST_POINTS = 250_000;

/** The finest level that is not too much. */
function levelFor(index: TilesIndex): number {
  const map = index.depth_map;
  const bottom = index.levels[0];
  if (bottom === undefined) return 0;
  const side = index.tile_side_px;
  const pixels = map ? map.width_px * map.height_px : (bottom.last_column - bottom.first_column + 1) * (bottom.last_row - bottom.first_row + 1) * side * side;
  const level = Math.ceil(Math.log2(pixels / MOST_POINTS) / 2);
  return Math.min(Math.max(level, 0), index.levels.length - 1);
}

/** Loads a job's points; null where there are none. */
export async function loadPoints(job: string, progress: (share: number) => void, signal: AbortSignal): Promise<Points | null> {
  const index = await getTilesIndex(tilesFolder(job));
  const range = index === null ? undefined : index.levels[levelFor(index)];
  if (index === null || range === undefined) return null;
  const addresses: [number, number][] = [];
  for (let column = range.first_column; column <= range.last_column; column += 1) {
    for (let row = range.first_row; row <= range.last_row; row += 1) addresses.push([column, row]);
  }
  const parts: Float32Array[] = [];
  for (const [done, [column, row]] of addresses.entries()) {
    progress(done / addresses.length);
    const bytes = await getTile(`${tilesFolder(job)}/depth/${range.level}/${column}_${row}.png`, !index.complete, signal);
    if (bytes !== null) parts.push(await pointsOf(bytes, index, range.level, column, row));
  }
  progress(1);
  const positions = new Float32Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    positions.set(part, at);
    at += part.length;
  }
  return positions.length === 0 ? null : described(positions, index.depth_range_mm ?? null);
}

async function pointsOf(bytes: Blob, index: TilesIndex, level: number, column: number, row: number): Promise<Float32Array> {
  const side = index.tile_side_px;
  const { depth_mm } = await depthsOf(bytes, index.depth_step_mm, index.depth_offset_mm);
  const { x0_mm, y0_mm, mm_per_px } = index.grid;
  const step = mm_per_px * 2 ** level;
  const half = (step - mm_per_px) / 2;
  const points = new Float32Array(3 * side * side);
  let count = 0;
  for (let at = 0; at < side * side; at += 1) {
    const z_mm = depth_mm[at]!;
    if (Number.isNaN(z_mm)) continue;
    points[count] = x0_mm + half + (column * side + (at % side)) * step;
    points[count + 1] = y0_mm + half + (row * side + Math.floor(at / side)) * step;
    points[count + 2] = z_mm;
    count += 3;
  }
  return points.slice(0, count);
}

function described(positions: Float32Array, range: [number, number] | null): Points {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let at = 0; at < positions.length; at += 1) {
    const axis = at % 3;
    low[axis] = Math.min(low[axis]!, positions[at]!);
    high[axis] = Math.max(high[axis]!, positions[at]!);
  }
  const [near, far] = range ?? [low[2]!, high[2]!];
  const middle: [number, number, number] = [(low[0]! + high[0]!) / 2, (low[1]! + high[1]!) / 2, (near + far) / 2];
  return { positions, count: positions.length / 3, middle, radius: Math.max(high[0]! - low[0]!, high[1]! - low[1]!) / 2, range: [near, far] };
}
