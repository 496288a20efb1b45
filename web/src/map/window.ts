// Which part of the world the screen shows, and moving it.

import type { Box, Place } from "./pyramid.ts";

/** The middle of the screen in the world, and how many mm a pixel of the page (not of the device) stands for. */
export interface View extends Place {
  mm_per_css_px: number;
}

export interface Size {
  width: number;
  height: number;
}

/** A cell of the map is never drawn larger than this many pixels. */
const LARGEST_CELL_PX = 24;
/** Rulers at the upper and left rim take their part of the screen, px. */
export const RULER_PX = 24;
export const SIDE_RULER_PX = 46;
/** Share of the rest that the whole map fills. */
const FILL = 0.96;
/** Lower than this, a map shown whole tells nothing: it is shown from its start instead. */
const READABLE_PX = 90;

export function toScreen(view: View, size: Size, place: Place): { x: number; y: number } {
  return {
    x: (place.x_mm - view.x_mm) / view.mm_per_css_px + size.width / 2,
    y: (place.y_mm - view.y_mm) / view.mm_per_css_px + size.height / 2,
  };
}

export function toWorld(view: View, size: Size, x: number, y: number): Place {
  return { x_mm: view.x_mm + (x - size.width / 2) * view.mm_per_css_px, y_mm: view.y_mm + (y - size.height / 2) * view.mm_per_css_px };
}

/** What the screen shows. */
export function visible(view: View, size: Size): Box {
  const first = toWorld(view, size, 0, 0);
  const last = toWorld(view, size, size.width, size.height);
  return { left: first.x_mm, top: first.y_mm, right: last.x_mm, bottom: last.y_mm };
}

/** The whole map, in the middle of what the rulers leave free. */
export function whole(box: Box, size: Size): View {
  const [width, height] = [size.width - SIDE_RULER_PX, size.height - RULER_PX];
  const mm_per_css_px = Math.max((box.right - box.left) / (width * FILL), (box.bottom - box.top) / (height * FILL), 1e-6);
  return centred((box.left + box.right) / 2, (box.top + box.bottom) / 2, mm_per_css_px);
}

/** A view with a place in the middle of what the rulers leave free. */
function centred(x_mm: number, y_mm: number, mm_per_css_px: number): View {
  return { x_mm: x_mm - (SIDE_RULER_PX / 2) * mm_per_css_px, y_mm: y_mm - (RULER_PX / 2) * mm_per_css_px, mm_per_css_px };
}

/** What a person sees first: the whole map, or of a long one the start at its full height. `fromRight`: it starts at the right. */
export function first(box: Box, size: Size, fromRight: boolean): View {
  const all = whole(box, size);
  if ((box.bottom - box.top) / all.mm_per_css_px >= READABLE_PX) return all;
  const mm_per_css_px = (box.bottom - box.top) / (size.height * 0.8);
  const half = ((size.width - SIDE_RULER_PX) / 2) * mm_per_css_px * FILL;
  return centred(fromRight ? box.right - half : box.left + half, (box.top + box.bottom) / 2, mm_per_css_px);
}

/** Zooms by a factor (above 1: closer) around a place on the screen. */
export function zoomed(view: View, size: Size, factor: number, x: number, y: number): View {
  const fixed = toWorld(view, size, x, y);
  const mm_per_css_px = view.mm_per_css_px / factor;
  return {
    x_mm: fixed.x_mm - (x - size.width / 2) * mm_per_css_px,
    y_mm: fixed.y_mm - (y - size.height / 2) * mm_per_css_px,
    mm_per_css_px,
  };
}

/** The view with its middle on the map and its scale between the whole map and a few cells. */
export function kept(view: View, box: Box, size: Size, mm_per_px: number): View {
  const largest = whole(box, size).mm_per_css_px * 1.5;
  const wanted = Math.min(Math.max(view.mm_per_css_px, mm_per_px / LARGEST_CELL_PX), Math.max(largest, mm_per_px / LARGEST_CELL_PX));
  return {
    x_mm: Math.min(Math.max(view.x_mm, box.left), box.right),
    y_mm: Math.min(Math.max(view.y_mm, box.top), box.bottom),
    mm_per_css_px: wanted,
  };
}

/** Largest of 1, 2, 5 times a power of ten that is no larger than `value`. */
export function roundDown(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].map((digit) => digit * power).find((round) => round <= value * (1 + 1e-9)) ?? power;
}
