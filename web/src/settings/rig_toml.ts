// A rig file as far as the drawing needs it. The server reads it properly; this only says early what will not do.

import type { RigJson } from "./rig_geometry.ts";

export type Read = { rig: RigJson; problem: null } | { rig: null; problem: string };

/** Reads `key = value` lines under `[camera]` and `[laser]`; values are numbers, words in quotes and lists of numbers. */
export function readRigToml(text: string): Read {
  const tables: Record<string, Record<string, unknown>> = { "": {}, camera: {}, laser: {} };
  let table = "";
  for (const [index, raw] of text.split("\n").entries()) {
    const line = raw.replace(/#.*$/, "").trim();
    if (line === "") continue;
    const heading = /^\[(\w+)\]$/.exec(line)?.[1];
    if (heading !== undefined) {
      table = heading;
      tables[table] ??= {};
      continue;
    }
    const [, key, value] = /^(\w+)\s*=\s*(.+)$/.exec(line) ?? [];
    if (key === undefined || value === undefined) return { rig: null, problem: `${index + 1}: ${raw.trim()}` };
    try {
      tables[table]![key] = JSON.parse(value.replace(/,\s*\]$/, "]").replace(/_/g, (found) => (/^["']/.test(value) ? found : "")));
    } catch {
      return { rig: null, problem: `${index + 1}: ${raw.trim()}` };
    }
  }
  const { width_px, height_px } = tables["camera"]!;
  if (typeof width_px !== "number" || typeof height_px !== "number") return { rig: null, problem: "camera.width_px, camera.height_px" };
  const rig = { ...tables[""], camera: tables["camera"], laser: tables["laser"] };
  return { rig: rig as unknown as RigJson, problem: null };
}
