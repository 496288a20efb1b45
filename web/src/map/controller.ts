// The map at work: keeps the view, hears pointer and keyboard, draws when something changed. Knows nothing of the page around it.

import type { Style } from "./colours.ts";
import { drawOverlay, drawTiles, MARKER_PX, readTheme, wishes, type Chainage, type Line, type Marker, type Overlay, type Theme } from "./painter.ts";
import { boundsOf, exists, levelAt, pixelAt, type Box, type Place, type TilesIndex } from "./pyramid.ts";
import { TileStore } from "./tiles.ts";
import { first, kept, toWorld, visible, whole, zoomed, type Size, type View } from "./window.ts";

/** What is under the pointer. */
export interface Hover {
  place: Place;
  /** Depth, mm; null where nothing was measured or nothing is loaded yet. */
  z_mm: number | null;
  /** From level 0: the very value of the depth map. Else the mean of a coarser pixel. */
  exact: boolean;
}

export interface Listener {
  view(view: View): void;
  hover(hover: Hover | null): void;
  /** A click or tap, or Enter for the middle of the map. */
  pick(place: Place): void;
  /** Whether everything in view is shown sharp. */
  settled(settled: boolean): void;
}

/** A press that moves no farther than this is a click, px. */
const CLICK_PX = 5;
const WHEEL_STEP = 0.0016;
const KEY_ZOOM = 1.6;
/** The pointer rests this long before the exact value is fetched, ms. */
const REST_MS = 120;

export class MapController {
  private view: View | null = null;
  private size: Size = { width: 0, height: 0 };
  private ratio = 1;
  private tiles: TileStore;
  private bounds: Box | null;
  private theme: Theme;
  private texture = 0;
  private overlay: Overlay = { markers: [], lines: [], cross: false, spot: null };
  private dirty = false;
  private rest: ReturnType<typeof setTimeout> | undefined;
  private pointers = new Map<number, { x: number; y: number }>();
  private pressed: { x: number; y: number } | null = null;
  private readonly stops: (() => void)[] = [];
  private closed = false;
  /** Nobody has moved the map yet: while it grows, its newest part stays in view. */
  private untouched: boolean;
  /** Pictures drawn so far; a test measures the rate. */
  frames = 0;

  constructor(
    private readonly base: HTMLCanvasElement,
    private readonly top: HTMLCanvasElement,
    private index: TilesIndex,
    folder: string,
    style: Style,
    private readonly chainage: Chainage,
    private readonly listener: Listener,
    start: View | null,
  ) {
    this.view = start;
    this.untouched = start === null && !index.complete;
    this.bounds = boundsOf(index);
    this.tiles = new TileStore(folder, index, style, () => this.draw());
    this.theme = readTheme(base);
    this.listen();
    this.resize();
  }

  close(): void {
    this.closed = true;
    clearTimeout(this.rest);
    this.stops.forEach((stop) => stop());
    this.tiles.close();
  }

  setIndex(index: TilesIndex): void {
    this.index = index;
    const had = this.bounds;
    this.bounds = boundsOf(index);
    this.tiles.update(index);
    if (had === null) this.resize();
    else if (this.untouched && this.bounds !== null && this.size.width > 0) this.view = first(this.bounds, this.size, true);
    this.draw();
  }

  setStyle(style: Style): void {
    this.tiles.restyle(style);
    this.draw();
  }

  setTexture(share: number): void {
    this.texture = share;
    this.draw();
  }

  setLines(lines: Line[]): void {
    this.overlay.lines = lines;
    this.draw();
  }

  setMarkers(markers: Marker[]): void {
    this.overlay.markers = markers;
    this.draw();
  }

  /** The marker at a place, as large as it is drawn. */
  markerAt(place: Place): Marker | null {
    if (this.view === null) return null;
    const reach_mm = (MARKER_PX + 4) * this.view.mm_per_css_px;
    const far = (marker: Marker) => Math.hypot(marker.x_mm - place.x_mm, marker.y_mm - place.y_mm);
    const near = this.overlay.markers.filter((marker) => far(marker) <= reach_mm).sort((a, b) => far(a) - far(b));
    return near[0] ?? null;
  }

  /** Brings a place into the middle; closer, where the map is too far away to see something of this extent. */
  lookAt({ x_mm, y_mm }: Place, extent_mm: number): void {
    const close = Math.max(extent_mm, 20) / 150;
    this.show({ x_mm, y_mm, mm_per_css_px: Math.min(this.view?.mm_per_css_px ?? close, close) });
  }

  setSpot(spot: Place | null): void {
    this.overlay.spot = spot;
    this.draw();
  }

  setView(view: View): void {
    this.show(view, false);
  }

  showWhole(): void {
    if (this.bounds !== null) this.show(whole(this.bounds, this.size));
  }

  zoom(factor: number): void {
    if (this.view !== null) this.show(zoomed(this.view, this.size, factor, this.size.width / 2, this.size.height / 2));
  }

  /** The part of the world on the screen. */
  shown(): Box | null {
    return this.view === null ? null : visible(this.view, this.size);
  }

  /** The depth map's own value at a place, mm; null where nothing was measured. */
  async depthAt(place: Place): Promise<number | null> {
    const { tile, at } = pixelAt(this.index, place);
    if (!exists(this.index, tile)) return null;
    const z_mm = (await this.tiles.load(tile))?.depth_mm?.[at];
    return z_mm === undefined || Number.isNaN(z_mm) ? null : z_mm;
  }

  private show(view: View, tell = true): void {
    if (this.bounds === null) return;
    this.untouched &&= !tell;
    this.view = kept(view, this.bounds, this.size, this.index.grid.mm_per_px);
    if (tell) this.listener.view(this.view);
    this.draw();
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.base;
    if (width === 0 || height === 0) return;
    this.size = { width, height };
    this.ratio = Math.min(window.devicePixelRatio || 1, 2);
    for (const canvas of [this.base, this.top]) {
      canvas.width = Math.round(width * this.ratio);
      canvas.height = Math.round(height * this.ratio);
    }
    if (this.view === null && this.bounds !== null) this.view = first(this.bounds, this.size, this.untouched || this.chainage.sign < 0);
    else if (this.view !== null) this.show(this.view, false);
    this.draw();
  }

  private draw(): void {
    if (this.dirty || this.closed) return;
    this.dirty = true;
    requestAnimationFrame(() => {
      this.dirty = false;
      if (!this.closed) this.paint();
    });
  }

  private paint(): void {
    const { view, bounds, size, ratio, index, tiles, texture } = this;
    const [below, above] = [this.base.getContext("2d", { alpha: false }), this.top.getContext("2d")];
    if (view === null || bounds === null || below === null || above === null) return;
    const level = levelAt(index, view.mm_per_css_px / ratio);
    tiles.want(wishes(index, visible(view, size), level).map((address) => ({ address, texture: texture > 0 })));
    const { whole } = drawTiles(below, { index, tiles, view, size, ratio, bounds, texture }, this.theme);
    drawOverlay(above, { view, size, ratio }, this.overlay, this.chainage, this.theme);
    this.frames += 1;
    this.listener.settled(whole && !tiles.busy());
  }

  private at(event: { clientX: number; clientY: number }): { x: number; y: number } {
    const box = this.top.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  }

  /** Tells the value under the pointer: what is loaded at once, the exact one when the pointer rests. */
  private hover(x: number, y: number): void {
    clearTimeout(this.rest);
    if (this.view === null) return;
    const place = toWorld(this.view, this.size, x, y);
    const found = this.loadedDepth(place);
    this.listener.hover({ place, ...found });
    if (found.exact) return;
    this.rest = setTimeout(() => {
      const asked = this.view;
      void this.depthAt(place).then((z_mm) => {
        if (!this.closed && asked === this.view) this.listener.hover({ place, z_mm, exact: true });
      });
    }, REST_MS);
  }

  private loadedDepth(place: Place): { z_mm: number | null; exact: boolean } {
    const { tile, at } = pixelAt(this.index, place);
    if (!exists(this.index, tile)) return { z_mm: null, exact: true };
    const side = this.index.tile_side_px;
    const [x, y] = [tile.column * side + (at % side), tile.row * side + Math.floor(at / side)];
    for (let level = 0; level < this.index.levels.length; level += 1) {
      const [column, row] = [x >> level, y >> level];
      const address = { level, column: Math.floor(column / side), row: Math.floor(row / side) };
      const depth_mm = this.tiles.get(address)?.depth_mm;
      if (!depth_mm) continue;
      const z_mm = depth_mm[(row - address.row * side) * side + (column - address.column * side)];
      return { z_mm: z_mm === undefined || Number.isNaN(z_mm) ? null : z_mm, exact: level === 0 };
    }
    return { z_mm: null, exact: false };
  }

  private listen(): void {
    const on = <K extends keyof HTMLElementEventMap>(target: HTMLElement, name: K, heard: (event: HTMLElementEventMap[K]) => void, options?: AddEventListenerOptions) => {
      target.addEventListener(name, heard, options);
      this.stops.push(() => target.removeEventListener(name, heard, options));
    };
    const observer = new ResizeObserver(() => this.resize());
    observer.observe(this.base);
    const scheme = matchMedia("(prefers-color-scheme: dark)");
    const dress = () => {
      this.theme = readTheme(this.base);
      this.draw();
    };
    scheme.addEventListener("change", dress);
    this.stops.push(() => observer.disconnect(), () => scheme.removeEventListener("change", dress));

    on(this.top, "pointerdown", (event) => {
      if (event.button !== 0) return;
      this.top.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, this.at(event));
      this.pressed = this.pointers.size === 1 ? this.at(event) : null;
    });
    on(this.top, "pointermove", (event) => this.moved(event));
    const up = (event: PointerEvent) => {
      const at = this.at(event);
      if (this.pointers.delete(event.pointerId) && event.type === "pointerup" && this.pressed !== null && this.view !== null) {
        this.listener.pick(toWorld(this.view, this.size, at.x, at.y));
      }
      this.pressed = null;
    };
    on(this.top, "pointerup", up);
    on(this.top, "pointercancel", up);
    on(this.top, "pointerleave", () => {
      clearTimeout(this.rest);
      this.listener.hover(null);
    });
    on(
      this.top,
      "wheel",
      (event) => {
        if (this.view === null) return;
        event.preventDefault();
        const { x, y } = this.at(event);
        const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 : 1;
        // A pinch on a touch pad comes as a wheel with Control, in small steps.
        const step = event.deltaY * lines * WHEEL_STEP * (event.ctrlKey ? 6 : 1);
        this.show(zoomed(this.view, this.size, Math.exp(-step), x, y));
        this.hover(x, y);
      },
      { passive: false },
    );
    on(this.top, "dblclick", (event) => {
      const { x, y } = this.at(event);
      if (this.view !== null) this.show(zoomed(this.view, this.size, event.shiftKey ? 1 / 2 : 2, x, y));
    });
    on(this.top, "keydown", (event) => this.key(event));
    on(this.top, "focus", () => this.setCross(this.top.matches(":focus-visible")));
    on(this.top, "blur", () => this.setCross(false));
  }

  private setCross(cross: boolean): void {
    this.overlay.cross = cross;
    if (cross) this.hover(this.size.width / 2, this.size.height / 2);
    this.draw();
  }

  private moved(event: PointerEvent): void {
    const now = this.at(event);
    const before = this.pointers.get(event.pointerId);
    if (before === undefined || this.view === null) {
      if (event.pointerType !== "touch") this.hover(now.x, now.y);
      return;
    }
    if (this.pressed !== null && Math.hypot(now.x - this.pressed.x, now.y - this.pressed.y) <= CLICK_PX) return;
    this.pressed = null;
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.pointers.set(event.pointerId, now);
    const other = others[0];
    let view = this.view;
    if (other !== undefined) {
      const [was, is] = [Math.hypot(before.x - other.x, before.y - other.y), Math.hypot(now.x - other.x, now.y - other.y)];
      view = zoomed(view, this.size, is / Math.max(was, 1), other.x, other.y);
    } else {
      const scale = view.mm_per_css_px;
      view = { ...view, x_mm: view.x_mm - (now.x - before.x) * scale, y_mm: view.y_mm - (now.y - before.y) * scale };
    }
    this.show(view);
  }

  private key(event: KeyboardEvent): void {
    const { view } = this;
    if (view === null || event.ctrlKey || event.metaKey || event.altKey) return;
    const share = event.shiftKey ? 0.5 : 0.1;
    const across = this.size.width * view.mm_per_css_px * share;
    const down = this.size.height * view.mm_per_css_px * share;
    const by = (x: number, y: number) => this.show({ ...view, x_mm: view.x_mm + x, y_mm: view.y_mm + y });
    const actions: Record<string, () => void> = {
      ArrowLeft: () => by(-across, 0),
      ArrowRight: () => by(across, 0),
      ArrowUp: () => by(0, -down),
      ArrowDown: () => by(0, down),
      "+": () => this.zoom(KEY_ZOOM),
      "=": () => this.zoom(KEY_ZOOM),
      "-": () => this.zoom(1 / KEY_ZOOM),
      "0": () => this.showWhole(),
      Home: () => this.bounds && by(this.bounds.left - view.x_mm, 0),
      End: () => this.bounds && by(this.bounds.right - view.x_mm, 0),
      Enter: () => this.view && this.listener.pick(this.view),
    };
    const action = actions[event.key];
    if (action === undefined) return;
    event.preventDefault();
    action();
    this.setCross(true);
  }
}
