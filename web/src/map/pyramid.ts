// Where tiles lie: the numbers of `tiles.json` and the arithmetic between millimetres, levels and tiles.

/** `tiles.json` of a job, as `core/src/export/tiles.rs` writes it. */
export interface TilesIndex {
  complete: boolean;
  tile_side_px: number;
  /** The centre of pixel (0, 0) of tile (0, 0), and the size of a pixel at level 0. */
  grid: { x0_mm: number; y0_mm: number; mm_per_px: number };
  depth_step_mm: number;
  depth_offset_mm: number;
  depth_range_mm: [number, number] | null;
  levels: TileLevel[];
  depth_map: { x0_mm: number; y0_mm: number; mm_per_px: number; width_px: number; height_px: number } | null;
  revision: number;
  /** The newest changes: revision, level, column, row. */
  changed: [number, number, number, number][];
}

export interface TileLevel {
  level: number;
  mm_per_px: number;
  first_column: number;
  last_column: number;
  first_row: number;
  last_row: number;
}

/** A rectangle of the world, mm; x runs to the right, y down. */
export interface Box {
  left: number;
  top: number;
  right: number;
  bottom: number;
}

export interface Place {
  x_mm: number;
  y_mm: number;
}

/** A tile's address. */
export interface TileAddress {
  level: number;
  column: number;
  row: number;
}

export const keyOf = ({ level, column, row }: TileAddress): string => `${level}/${column}_${row}`;

/** The part of the world that the map covers; null while nothing is there. */
export function boundsOf(index: TilesIndex): Box | null {
  const map = index.depth_map;
  if (map !== null) {
    const half = map.mm_per_px / 2;
    return {
      left: map.x0_mm - half,
      top: map.y0_mm - half,
      right: map.x0_mm - half + map.width_px * map.mm_per_px,
      bottom: map.y0_mm - half + map.height_px * map.mm_per_px,
    };
  }
  const bottom = index.levels[0];
  if (bottom === undefined) return null;
  const first = tileBox(index, { level: 0, column: bottom.first_column, row: bottom.first_row });
  const last = tileBox(index, { level: 0, column: bottom.last_column, row: bottom.last_row });
  return { left: first.left, top: first.top, right: last.right, bottom: last.bottom };
}

/** What a tile covers. Pixel centres are at whole numbers, so a tile begins half a pixel of level 0 before its first. */
export function tileBox(index: TilesIndex, { level, column, row }: TileAddress): Box {
  const { x0_mm, y0_mm, mm_per_px } = index.grid;
  const side = index.tile_side_px * mm_per_px * 2 ** level;
  const left = x0_mm - mm_per_px / 2 + column * side;
  const top = y0_mm - mm_per_px / 2 + row * side;
  return { left, top, right: left + side, bottom: top + side };
}

/** The level to show at a scale, mm per pixel of the screen: the coarsest that is not seen to be coarse. */
export function levelAt(index: TilesIndex, mmPerScreenPx: number): number {
  const wanted = Math.floor(Math.log2(mmPerScreenPx / index.grid.mm_per_px) + 0.4);
  return Math.max(0, Math.min(wanted, index.levels.length - 1));
}

/** The tiles of a level that a box touches, those nearest its middle first. */
export function tilesIn(index: TilesIndex, level: number, box: Box): TileAddress[] {
  const range = index.levels[level];
  if (range === undefined) return [];
  const { x0_mm, y0_mm, mm_per_px } = index.grid;
  const side = index.tile_side_px * mm_per_px * 2 ** level;
  const at = (mm: number, origin: number) => Math.floor((mm - origin + mm_per_px / 2) / side);
  const columns = [Math.max(at(box.left, x0_mm), range.first_column), Math.min(at(box.right, x0_mm), range.last_column)] as const;
  const rows = [Math.max(at(box.top, y0_mm), range.first_row), Math.min(at(box.bottom, y0_mm), range.last_row)] as const;
  const tiles: TileAddress[] = [];
  for (let column = columns[0]; column <= columns[1]; column += 1) {
    for (let row = rows[0]; row <= rows[1]; row += 1) tiles.push({ level, column, row });
  }
  const middle = [(columns[0] + columns[1]) / 2, (rows[0] + rows[1]) / 2] as const;
  const far = (tile: TileAddress) => Math.hypot(tile.column - middle[0], tile.row - middle[1]);
  return tiles.sort((a, b) => far(a) - far(b));
}

/** The tile of level 0 that holds a place, and the pixel in it. */
export function pixelAt(index: TilesIndex, { x_mm, y_mm }: Place): { tile: TileAddress; at: number } {
  const side = index.tile_side_px;
  const column = Math.round((x_mm - index.grid.x0_mm) / index.grid.mm_per_px);
  const row = Math.round((y_mm - index.grid.y0_mm) / index.grid.mm_per_px);
  const tile = { level: 0, column: Math.floor(column / side), row: Math.floor(row / side) };
  return { tile, at: (row - tile.row * side) * side + (column - tile.column * side) };
}

/** True where the map has such a tile at all. */
export function exists(index: TilesIndex, { level, column, row }: TileAddress): boolean {
  const range = index.levels[level];
  return (
    range !== undefined && column >= range.first_column && column <= range.last_column && row >= range.first_row && row <= range.last_row
  );
}
