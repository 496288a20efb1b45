// Sending runs by tus: one after the other, beside whatever page is open; pausable; a cut link or a reload loses nothing.
//
// The list lives as long as the page. What a reload leaves behind is found in the browser's own storage, where tus keeps
// the addresses of unfinished uploads: choosing the same file again goes on where it stopped.

import { useEffect, useState } from "preact/hooks";
import type { HttpRequest, PreviousUpload, Upload as TusUpload } from "tus-js-client";
import { problemIn, problemOf, UNREACHABLE, type Problem } from "./api.ts";
import { checksumOf } from "./digest.ts";
import { heardOfSession, onSession } from "./session.ts";

/** What is said about a run when it is sent. */
export interface UploadFields {
  asset: string;
  rig: string;
  recipe: string;
  chainage_mm: string;
  direction: string;
}

export type UploadState = "waiting" | "sending" | "paused" | "cut" | "sent" | "refused" | "lost";

/** One file on its way. */
export interface Item {
  id: number;
  name: string;
  bytes: number;
  sent: number;
  state: UploadState;
  /** Over the last seconds; 0 while nothing is known. */
  bytes_per_s: number;
  asset: string;
  /** Why it was refused. */
  problem: Problem | null;
  /** The run that it became. */
  run: string | null;
}

const ENDPOINT = "/api/uploads";
/** Waits after a cut, ms; the last one is repeated until the link is back or somebody stops. */
const RETRY_MS = [0, 1000, 2000, 5000, 10_000, 20_000, 30_000];
/** The rate is that of the last seconds. */
const RATE_S = 8;
/** A connection that takes nothing for so long is dead, although nobody has said so; it is looked for so often, ms. */
const STALLED_MS = 20_000;
const LOOK_MS = 5000;
/** Nobody is logged in any more: what arrived stays, and it goes on when somebody is. */
const UNAUTHORIZED = 401;
/** A piece arrived as other bytes than were sent. */
const OTHER_BYTES = 460;
/** So often in a row: then it is not the way that spoils it. */
const MOST_SPOILT = 5;
/**
 * Each piece goes with its checksum, and counts as a whole: it takes some seconds on the link as it is, so that a cut costs no more
 * than those, and between two pieces little time is lost. Bytes.
 */
const [PIECE_S, LEAST_PIECE, FIRST_PIECE, MOST_PIECE] = [3, 64 * 1024, 256 * 1024, 16 * 1024 * 1024];

interface Entry extends Item {
  file: File | null;
  fields: UploadFields | null;
  tus: TusUpload | null;
  previous: PreviousUpload | null;
  marks: { at: number; sent: number }[];
  /** When the last byte went out, ms since the page began. */
  movedMs: number;
  /** Grows whenever it is stopped: what was prepared before is not sent any more. */
  turn: number;
  /** When the piece on its way began, ms since the page began. */
  pieceMs: number;
  /** Pieces in a row that arrived as other bytes. */
  spoilt: number;
}

let entries: Entry[] = [];
let nextId = 1;
const listeners = new Set<() => void>();
let told = false;

function changed(): void {
  if (told) return;
  told = true;
  // Progress comes in bursts: people are told once a frame.
  requestAnimationFrame(() => {
    told = false;
    listeners.forEach((listener) => listener());
  });
}

function update(entry: Entry, change: Partial<Entry>): void {
  Object.assign(entry, change);
  changed();
}

/** All uploads of this page, kept fresh. */
export function useUploads(): Item[] {
  const [, setTurn] = useState(0);
  useEffect(() => {
    const listener = () => setTurn((turn) => turn + 1);
    listeners.add(listener);
    return () => void listeners.delete(listener);
  }, []);
  return entries;
}

/** Puts files in the line. */
export function sendFiles(files: File[], fields: UploadFields): void {
  for (const file of files) {
    entries.push({ ...empty(file.name, file.size), asset: fields.asset, file, fields });
  }
  changed();
  next();
}

function empty(name: string, bytes: number): Entry {
  const id = nextId;
  nextId += 1;
  return { id, name, bytes, sent: 0, state: "waiting", bytes_per_s: 0, asset: "", problem: null, run: null, file: null, fields: null, tus: null, previous: null, marks: [], movedMs: 0, turn: 0, pieceMs: 0, spoilt: 0 };
}

function find(id: number): Entry | undefined {
  return entries.find((entry) => entry.id === id);
}

export function pause(id: number): void {
  const entry = find(id);
  if (!entry || entry.state === "sent" || entry.state === "refused") return;
  stop(entry);
  update(entry, { state: "paused", bytes_per_s: 0, marks: [] });
  next();
}

export function resume(id: number): void {
  const entry = find(id);
  if (entry?.file) update(entry, { state: "waiting", problem: null });
  next();
}

/** Takes an upload out of the list; what the server has of it is thrown away. */
export async function discard(id: number): Promise<void> {
  const entry = find(id);
  if (!entry) return;
  entries = entries.filter((other) => other !== entry);
  changed();
  next();
  if (entry.state === "sent") return;
  entry.turn += 1;
  try {
    if (entry.tus) await entry.tus.abort(true);
    else if (entry.previous?.uploadUrl) await (await import("tus-js-client")).Upload.terminate(entry.previous.uploadUrl);
  } catch {
    // It runs out by itself on the server.
  }
  if (entry.previous) forget(entry.previous);
}

/** Takes what has arrived out of the list. */
export function clearSent(): void {
  entries = entries.filter(({ state }) => state !== "sent");
  changed();
}

/** Starts the first that waits, if nothing is being sent. */
function next(): void {
  if (entries.some(({ state }) => state === "sending")) return;
  const entry = entries.find(({ state }) => state === "waiting");
  if (entry?.file) void begin(entry, entry.file);
}

async function begin(entry: Entry, file: File): Promise<void> {
  update(entry, { state: "sending", marks: [], movedMs: performance.now() });
  try {
    const tus = await import("tus-js-client");
    if (entry.tus === null) {
      entry.tus = make(tus, entry, file);
      entry.previous ??= newest(await entry.tus.findPreviousUploads());
      if (entry.previous) entry.tus.resumeFromPreviousUpload(entry.previous);
    }
    // Paused while the code was on its way.
    if (entry.state === "sending") entry.tus.start();
  } catch (error) {
    update(entry, { state: "refused", problem: problemOf(error) });
    next();
  }
}

function newest(uploads: PreviousUpload[]): PreviousUpload | null {
  return uploads.sort((a, b) => a.creationTime.localeCompare(b.creationTime)).at(-1) ?? null;
}

function make(tus: typeof import("tus-js-client"), entry: Entry, file: File): TusUpload {
  const metadata: Record<string, string> = { filename: file.name, filetype: file.type || "application/octet-stream" };
  for (const [name, value] of Object.entries(entry.fields ?? {})) if (value !== "") metadata[name] = value as string;
  const upload: TusUpload = new tus.Upload(file, {
    endpoint: ENDPOINT,
    metadata,
    retryDelays: [...RETRY_MS, ...Array.from({ length: 500 }, () => RETRY_MS.at(-1)!)],
    removeFingerprintOnSuccess: true,
    chunkSize: FIRST_PIECE,
    onBeforeRequest: (request) => withChecksum(entry, upload, file, request),
    onChunkComplete: (bytes) => {
      entry.spoilt = 0;
      const seconds = Math.max((performance.now() - entry.pieceMs) / 1000, 0.001);
      upload.options.chunkSize = Math.round(Math.min(Math.max((bytes / seconds) * PIECE_S, LEAST_PIECE), MOST_PIECE));
    },
    onShouldRetry: (error) => {
      const status = error.originalResponse?.getStatus() ?? 0;
      if (status === OTHER_BYTES) entry.spoilt += 1;
      // No answer, a busy server, another connection still at it: the cut is not the file's fault.
      const again = status === 0 || status >= 500 || status === 409 || status === 423 || status === 429 || status === 408 || (status === OTHER_BYTES && entry.spoilt < MOST_SPOILT);
      if (again && entry.state === "sending") update(entry, { state: "cut", bytes_per_s: 0, marks: [] });
      return again && entry.state !== "paused";
    },
    onProgress: (sent, bytes) => {
      if (entry.state === "cut") entry.state = "sending";
      update(entry, { movedMs: performance.now(), sent, bytes: bytes ?? entry.bytes, bytes_per_s: rate(entry, sent) });
    },
    onError: (error) => {
      const response = "originalResponse" in error ? error.originalResponse : null;
      if (response?.getStatus() === UNAUTHORIZED) {
        heardOfSession(false);
        return cut(entry);
      }
      update(entry, { state: "refused", problem: response ? problemIn(response.getStatus(), response.getBody()) : UNREACHABLE });
      next();
    },
    onSuccess: ({ lastResponse }) => {
      update(entry, { state: "sent", sent: entry.bytes, run: lastResponse.getHeader("Stria-Run") ?? null });
      next();
    },
  });
  return upload;
}

/** Says with a piece what its bytes are, so that the server takes no others. Without one it goes all the same. */
async function withChecksum(entry: Entry, upload: TusUpload, file: File, request: HttpRequest): Promise<void> {
  const offset = Number(request.getHeader("Upload-Offset"));
  if (request.getMethod() !== "PATCH" || !Number.isFinite(offset)) return;
  const turn = entry.turn;
  const checksum = await checksumOf(file.slice(offset, Math.min(offset + (upload.options.chunkSize ?? file.size), file.size)));
  // Stopped meanwhile: tus would send it all the same, beside what comes next.
  if (turn !== entry.turn) return new Promise(() => undefined);
  entry.pieceMs = performance.now();
  if (checksum !== null) request.setHeader("Upload-Checksum", checksum);
}

function rate(entry: Entry, sent: number): number {
  const now = performance.now() / 1000;
  entry.marks.push({ at: now, sent });
  entry.marks = entry.marks.filter(({ at }) => at >= now - RATE_S);
  const first = entry.marks[0];
  return first && now - first.at > 0.5 ? (sent - first.sent) / (now - first.at) : 0;
}

/** Shows what an earlier visit to the page left unfinished; the files themselves must be chosen again. */
export async function findUnfinished(): Promise<void> {
  const { defaultOptions } = await import("tus-js-client");
  const found = (await defaultOptions.urlStorage?.findAllUploads()) ?? [];
  for (const previous of found) {
    const known = entries.some((entry) => entry.previous?.urlStorageKey === previous.urlStorageKey || (entry.name === previous.metadata["filename"] && entry.bytes === previous.size));
    if (known || previous.metadata["filename"] === undefined) continue;
    entries.push({ ...empty(previous.metadata["filename"], previous.size ?? 0), state: "lost", asset: previous.metadata["asset"] ?? "", previous });
  }
  changed();
}

/** Goes on with unfinished uploads whose files are among these; answers the others. */
export function rejoin(files: File[]): File[] {
  const others = files.filter((file) => {
    const entry = entries.find(({ state, name, bytes }) => state === "lost" && name === file.name && bytes === file.size);
    if (entry === undefined) return true;
    const { asset = "", rig = "", recipe = "", chainage_mm = "", direction = "" } = entry.previous?.metadata ?? {};
    update(entry, { file, state: "waiting", fields: { asset, rig, recipe, chainage_mm, direction } });
    return false;
  });
  next();
  return others;
}

function forget({ urlStorageKey }: PreviousUpload): void {
  void import("tus-js-client").then(({ defaultOptions }) => defaultOptions.urlStorage?.removeUpload(urlStorageKey));
}

/** A page that sends something asks before it is left. */
addEventListener("beforeunload", (event) => {
  if (entries.some(({ state }) => state === "sending" || state === "waiting" || state === "cut")) event.preventDefault();
});

/** Lets go of a connection that is dead; what arrived stays. */
function cut(entry: Entry): void {
  stop(entry);
  update(entry, { state: "cut", bytes_per_s: 0, marks: [] });
}

function stop(entry: Entry): void {
  entry.turn += 1;
  void entry.tus?.abort();
}

/** Takes up what was cut. */
function goOn(): void {
  for (const entry of entries) if (entry.state === "cut") update(entry, { state: "waiting" });
  next();
}

onSession((loggedIn) => loggedIn && goOn());
addEventListener("offline", () => entries.filter(({ state }) => state === "sending").forEach(cut));
addEventListener("online", () => {
  entries.filter(({ state }) => state === "sending").forEach(cut);
  goOn();
});
setInterval(() => {
  const stalled = entries.filter(({ state, movedMs }) => (state === "sending" || state === "cut") && performance.now() - movedMs > STALLED_MS);
  if (stalled.length === 0 || !navigator.onLine) return;
  stalled.forEach(cut);
  goOn();
}, LOOK_MS);
