// What a rig can see: the arithmetic of camera and laser plane, and what of it makes no sense.

import { number } from "../format.ts";
import { workTexts } from "../texts/work.ts";

/** A rig as the server's JSON has it. */
export interface RigJson {
  name: string;
  camera: {
    width_px: number;
    height_px: number;
    fx_px?: number;
    fy_px?: number;
    cx_px?: number;
    cy_px?: number;
    fov_deg?: number;
    distortion?: number[];
  };
  laser: {
    colour: string;
    line?: string;
    plane_normal?: [number, number, number];
    plane_offset_mm?: number;
    baseline_mm?: number;
    angle_deg?: number;
  };
}

export interface Geometry {
  width_px: number;
  height_px: number;
  fx_px: number;
  fy_px: number;
  cx_px: number;
  cy_px: number;
  distortion: number[];
  normal: [number, number, number];
  offset_mm: number;
  /** The line lies along the columns: it moves across them as the depth changes. */
  vertical: boolean;
  colour: string;
  fov_deg: [number, number];
  /** Along the axis that the line moves on: nearest and farthest distance at which the middle of the line is in the picture, mm; null: never. */
  range_mm: [number, number] | null;
}

/** Farther than this nobody measures, mm. */
const FARTHEST_MM = 100_000;

export function geometryOf(rig: RigJson): Geometry {
  const { camera, laser } = rig;
  const focal = camera.fov_deg === undefined ? 0 : camera.width_px / (2 * Math.tan((camera.fov_deg * Math.PI) / 360));
  const fx_px = camera.fx_px ?? focal;
  const fy_px = camera.fy_px ?? fx_px;
  const cx_px = camera.cx_px ?? (camera.width_px - 1) / 2;
  const cy_px = camera.cy_px ?? (camera.height_px - 1) / 2;
  const vertical = (laser.line ?? "vertical") !== "horizontal";
  const [normal, offset_mm] = planeOf(laser, vertical);
  const seen = { fx_px, fy_px, cx_px, cy_px, width_px: camera.width_px, height_px: camera.height_px, normal, offset_mm, vertical };
  return {
    ...seen,
    distortion: camera.distortion ?? [],
    colour: laser.colour,
    fov_deg: [view(camera.width_px, fx_px), view(camera.height_px, fy_px)],
    range_mm: rangeOf(seen),
  };
}

function view(size_px: number, focal_px: number): number {
  return (2 * Math.atan(size_px / 2 / focal_px) * 180) / Math.PI;
}

/** The plane in the camera's frame. The paper's form: X − Z/tan(angle) = baseline. */
function planeOf(laser: RigJson["laser"], vertical: boolean): [[number, number, number], number] {
  if (laser.plane_normal !== undefined && laser.plane_offset_mm !== undefined) {
    const length = Math.hypot(...laser.plane_normal) || 1;
    return [laser.plane_normal.map((part) => part / length) as [number, number, number], laser.plane_offset_mm / length];
  }
  const lean = -1 / Math.tan(((laser.angle_deg ?? 90) * Math.PI) / 180);
  const length = Math.hypot(1, lean);
  const across = vertical ? ([1, 0, lean] as const) : ([0, 1, lean] as const);
  return [across.map((part) => part / length) as [number, number, number], (laser.baseline_mm ?? 0) / length];
}

/** Distance at which the middle of the line is seen at a place of the picture, mm; null: never. */
export function distanceAt(rig: Pick<Geometry, "fx_px" | "fy_px" | "cx_px" | "cy_px" | "normal" | "offset_mm" | "vertical">, at_px: number): number | null {
  const ray = rig.vertical ? [(at_px - rig.cx_px) / rig.fx_px, 0] : [0, (at_px - rig.cy_px) / rig.fy_px];
  const slope = rig.normal[0] * ray[0]! + rig.normal[1] * ray[1]! + rig.normal[2];
  const z_mm = rig.offset_mm / slope;
  return Number.isFinite(z_mm) && z_mm > 0 ? z_mm : null;
}

function rangeOf(rig: Pick<Geometry, "fx_px" | "fy_px" | "cx_px" | "cy_px" | "normal" | "offset_mm" | "vertical" | "width_px" | "height_px">): [number, number] | null {
  const size = rig.vertical ? rig.width_px : rig.height_px;
  let [near, far] = [Infinity, 0];
  for (let at = 0; at < size; at += 1) {
    const z_mm = distanceAt(rig, at);
    if (z_mm === null) continue;
    near = Math.min(near, z_mm);
    far = Math.max(far, z_mm);
  }
  return far === 0 ? null : [near, Math.min(far, FARTHEST_MM)];
}

/** Depth that a shift of the line by one pixel means at a distance, mm. */
export function depthPerPixel(rig: Geometry, z_mm: number): number {
  const axis = rig.vertical ? 0 : 1;
  const focal = rig.vertical ? rig.fx_px : rig.fy_px;
  const middle = rig.vertical ? rig.cx_px : rig.cy_px;
  // The place where the line is seen at this distance: n·(u, 0, 1)·z = d.
  const at_px = middle + (focal * (rig.offset_mm / z_mm - rig.normal[2])) / rig.normal[axis];
  const [a, b] = [distanceAt(rig, at_px - 0.5), distanceAt(rig, at_px + 0.5)];
  return a === null || b === null ? Infinity : Math.abs(a - b);
}

/** A distance that a rig is likely used at: the near part of what it sees. */
export function usualDistance(rig: Geometry): number | null {
  if (rig.range_mm === null) return null;
  const [near, far] = rig.range_mm;
  return Math.min(Math.max(near * 1.6, near + 1), far);
}

const words = workTexts.settings.rigs.warn;

/** What a person should check, in words. */
export function warningsOf(rig: Geometry, given: RigJson): string[] {
  const found: string[] = [];
  if (rig.range_mm === null) found.push(words.nowhere);
  const distance = usualDistance(rig);
  if (distance !== null && depthPerPixel(rig, distance) > 5) found.push(words.thin(depthPerPixel(rig, distance)));
  if (Math.abs(rig.cx_px - rig.width_px / 2) > 0.12 * rig.width_px || Math.abs(rig.cy_px - rig.height_px / 2) > 0.12 * rig.height_px) found.push(words.centre);
  if (Math.abs(rig.fx_px / rig.fy_px - 1) > 0.05) found.push(words.aspect);
  if (rig.fov_deg[0] < 8 || rig.fov_deg[0] > 130) found.push(words.fov(rig.fov_deg[0]));
  const length = given.laser.plane_normal ? Math.hypot(...given.laser.plane_normal) : 1;
  if (Math.abs(length - 1) > 1e-3) found.push(words.normal);
  if (folds(rig)) found.push(words.distortion);
  return found;
}

/** Brown-Conrady: r(1 + k1 r² + k2 r⁴ + k3 r⁶) must grow up to the corner. */
function folds({ distortion, width_px, height_px, fx_px, fy_px }: Geometry): boolean {
  const [k1 = 0, k2 = 0, , , k3 = 0] = distortion;
  if (distortion.length === 0) return false;
  const corner = Math.hypot(width_px / 2 / fx_px, height_px / 2 / fy_px);
  let before = 0;
  for (let step = 1; step <= 100; step += 1) {
    const r = (corner * step) / 100;
    const bent = r * (1 + k1 * r ** 2 + k2 * r ** 4 + k3 * r ** 6);
    if (bent <= before) return true;
    before = bent;
  }
  return false;
}

/** Length of a lens's bending at the corner, in words. */
export function distortionInWords({ distortion }: Geometry): string {
  return distortion.every((k) => k === 0) ? workTexts.settings.rigs.none_distortion : distortion.map((k) => number(k)).join(", ");
}
