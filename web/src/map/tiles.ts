// The tiles that are loaded: a bounded number, the ones in view first.

import { onWake, patienceMs } from "../awake.ts";
import { keyOf, type TileAddress, type TilesIndex } from "./pyramid.ts";
import type { Style } from "./colours.ts";
import type { Delivery, Order } from "./tile_worker.ts";

/** What is known of a tile. */
export interface Tile {
  address: TileAddress;
  /** Depths, mm; NaN where nothing was measured; null until loaded. */
  depth_mm: Float32Array | null;
  /** The depths painted. */
  picture: ImageBitmap | null;
  /** The wall's visible image, where it was asked for. */
  texture: ImageBitmap | null;
}

type Kind = "depth" | "texture";
interface Entry extends Tile {
  used: number;
  /** The style that `picture` has. */
  painted: number;
  /** What is on its way, by the number of its order. */
  pending: Partial<Record<Kind | "paint", number>>;
  /** Has changed since it was loaded. */
  stale: Record<Kind, boolean>;
  missing: Record<Kind, boolean>;
  retryAt: number;
}

/** Loaded tiles, at most: a quarter of a megabyte each for depths, picture and texture. */
const MOST_TILES = 180;
/** Requests at the same time: as many as a browser has connections to one host, less one for everything else. */
const MOST_REQUESTS = 5;
const RETRY_MS = 3000;
/** A whole tile may take so many times what the beginning of an answer may. */
const WHOLE_TILE = 3;

export class TileStore {
  private readonly worker = new Worker(new URL("./tile_worker.ts", import.meta.url), { type: "module" });
  private readonly entries = new Map<string, Entry>();
  private readonly orders = new Map<number, { entry: Entry; kind: Kind | "paint"; style: number }>();
  private nextOrder = 1;
  private clock = 0;
  private style: Style;
  private styleNumber = 1;
  private fetching = 0;
  private wishes: { address: TileAddress; texture: boolean }[] = [];
  private readonly waiting = new Map<string, ((tile: Tile | null) => void)[]>();
  private readonly noWake: () => void;

  constructor(
    private readonly folder: string,
    private index: TilesIndex,
    style: Style,
    private readonly changed: () => void,
  ) {
    this.style = style;
    this.worker.onmessage = (event: MessageEvent<Delivery>) => this.receive(event.data);
    // What was on its way when the machine fell asleep never comes: it is asked for again.
    this.noWake = onWake(() => [...this.orders].forEach(([id, { kind }]) => kind !== "paint" && this.send({ is: "stop", id })));
  }

  close(): void {
    this.noWake();
    this.worker.terminate();
    for (const entry of this.entries.values()) drop(entry);
    this.entries.clear();
    for (const waiting of this.waiting.values()) waiting.forEach((answer) => answer(null));
    this.waiting.clear();
  }

  /** A newer state of a pyramid that grows: what it names as changed is loaded anew, the old shown until then. */
  update(index: TilesIndex): void {
    const before = this.index;
    this.index = index;
    const listed = index.changed[0];
    const allListed = !index.complete && listed !== undefined && listed[0] <= before.revision + 1;
    const names = new Set(index.changed.filter(([revision]) => revision > before.revision).map(([, level, column, row]) => `${level}/${column}_${row}`));
    for (const [key, entry] of this.entries) {
      if (allListed && !names.has(key)) continue;
      entry.stale = { depth: true, texture: true };
      entry.missing = { depth: false, texture: false };
      entry.retryAt = 0;
    }
  }

  /** Paints anew with another style, tile by tile, those in view first. */
  restyle(style: Style): void {
    this.style = style;
    this.styleNumber += 1;
    this.pump();
  }

  /** A loaded tile. */
  get(address: TileAddress): Tile | undefined {
    const entry = this.entries.get(keyOf(address));
    if (entry !== undefined) entry.used = this.clock += 1;
    return entry;
  }

  /** What is in view now, the most wanted first; what nobody wants any more is no longer fetched. */
  want(wishes: { address: TileAddress; texture: boolean }[]): void {
    this.wishes = wishes;
    const keys = new Set(wishes.map(({ address }) => keyOf(address)));
    for (const [id, { entry, kind }] of this.orders) {
      const key = keyOf(entry.address);
      if (kind !== "paint" && !keys.has(key) && !this.waiting.has(key)) this.send({ is: "stop", id });
    }
    this.pump();
  }

  /** True while something in view is on its way. */
  busy(): boolean {
    return this.fetching > 0;
  }

  /** A tile with its depths, loaded if need be; null where there is none. */
  load(address: TileAddress): Promise<Tile | null> {
    const entry = this.entry(address);
    if (entry.depth_mm !== null && !entry.stale.depth) return Promise.resolve(entry);
    if (entry.missing.depth) return Promise.resolve(null);
    return new Promise((answer) => {
      const key = keyOf(address);
      this.waiting.set(key, [...(this.waiting.get(key) ?? []), answer]);
      this.pump();
    });
  }

  private entry(address: TileAddress): Entry {
    const key = keyOf(address);
    let entry = this.entries.get(key);
    if (entry === undefined) {
      entry = {
        address,
        depth_mm: null,
        picture: null,
        texture: null,
        used: 0,
        painted: 0,
        pending: {},
        stale: { depth: true, texture: true },
        missing: { depth: false, texture: false },
        retryAt: 0,
      };
      this.entries.set(key, entry);
      this.makeRoom();
    }
    entry.used = this.clock += 1;
    return entry;
  }

  private makeRoom(): void {
    if (this.entries.size <= MOST_TILES) return;
    const wanted = new Set(this.wishes.map(({ address }) => keyOf(address)));
    const idle = [...this.entries].filter(([key, entry]) => Object.keys(entry.pending).length === 0 && !wanted.has(key) && !this.waiting.has(key));
    idle.sort(([, a], [, b]) => a.used - b.used);
    for (const [key, entry] of idle.slice(0, this.entries.size - MOST_TILES)) {
      drop(entry);
      this.entries.delete(key);
    }
  }

  /** Sends as many orders as may be under way. */
  private pump(): void {
    for (const key of this.waiting.keys()) {
      const entry = this.entries.get(key);
      if (entry !== undefined) this.fetch(entry, "depth");
    }
    for (const { address, texture } of this.wishes) {
      const entry = this.entry(address);
      this.fetch(entry, "depth");
      if (texture) this.fetch(entry, "texture");
      if (entry.depth_mm !== null && entry.painted !== this.styleNumber) this.repaint(entry);
    }
  }

  private fetch(entry: Entry, kind: Kind): void {
    if (!entry.stale[kind] || entry.missing[kind] || entry.pending[kind] !== undefined) return;
    if (this.fetching >= MOST_REQUESTS || performance.now() < entry.retryAt) return;
    // The depths say where the image has holes: they come first.
    if (kind === "texture" && entry.depth_mm === null && !entry.missing.depth) return;
    const { level, column, row } = entry.address;
    const id = this.order(entry, kind);
    const fresh = !this.index.complete;
    this.fetching += 1;
    setTimeout(() => this.orders.has(id) && this.send({ is: "stop", id }), WHOLE_TILE * patienceMs());
    const name = kind === "depth" ? `depth/${level}/${column}_${row}.png` : `texture/${level}/${column}_${row}.jpg`;
    const url = `${this.folder}/${name}`;
    if (kind === "texture") this.send({ is: "texture", id, url, fresh, depth_mm: entry.depth_mm });
    else {
      const { depth_step_mm: step_mm, depth_offset_mm: offset_mm } = this.index;
      this.send({ is: "depth", id, url, step_mm, offset_mm, mm_per_px: this.mmPerPx(level), style: this.style, fresh });
    }
  }

  private repaint(entry: Entry): void {
    if (entry.pending.paint !== undefined || entry.pending.depth !== undefined || entry.depth_mm === null) return;
    const id = this.order(entry, "paint");
    const { style, index } = this;
    this.send({ is: "paint", id, depth_mm: entry.depth_mm, side: index.tile_side_px, mm_per_px: this.mmPerPx(entry.address.level), style });
  }

  private mmPerPx(level: number): number {
    return this.index.grid.mm_per_px * 2 ** level;
  }

  private order(entry: Entry, kind: Kind | "paint"): number {
    const id = this.nextOrder;
    this.nextOrder += 1;
    entry.pending[kind] = id;
    if (kind !== "paint") entry.stale[kind] = false;
    this.orders.set(id, { entry, kind, style: this.styleNumber });
    return id;
  }

  private send(order: Order): void {
    this.worker.postMessage(order);
  }

  private receive(delivery: Delivery): void {
    const order = this.orders.get(delivery.id);
    if (order === undefined) return;
    const { entry, kind, style } = order;
    this.orders.delete(delivery.id);
    delete entry.pending[kind];
    if (kind !== "paint") this.fetching -= 1;
    if (delivery.is === "done") {
      if (kind === "texture") {
        entry.texture?.close();
        entry.texture = delivery.picture;
      } else {
        entry.picture?.close();
        entry.picture = delivery.picture;
        entry.painted = style;
        entry.depth_mm = delivery.depth_mm ?? entry.depth_mm;
      }
    } else if (kind !== "paint") {
      if (delivery.is === "missing") entry.missing[kind] = true;
      else {
        entry.stale[kind] = true;
        const key = keyOf(entry.address);
        if (this.waiting.has(key) || this.wishes.some(({ address }) => keyOf(address) === key)) {
          entry.retryAt = performance.now() + RETRY_MS;
          setTimeout(() => this.pump(), RETRY_MS + 50);
        }
      }
    }
    if (kind === "depth" && delivery.is !== "failed") this.answer(entry);
    this.pump();
    this.changed();
  }

  private answer(entry: Entry): void {
    const key = keyOf(entry.address);
    const waiting = this.waiting.get(key);
    this.waiting.delete(key);
    waiting?.forEach((answer) => answer(entry.depth_mm === null ? null : entry));
  }
}

function drop(entry: Entry): void {
  entry.picture?.close();
  entry.texture?.close();
}
