// Everything the pages ask of the server. The only file that fetches; shapes come from the OpenAPI document.

import type { components } from "./api.gen.ts";
import { onWake, patienceMs } from "./awake.ts";
import type { TilesIndex } from "./map/pyramid.ts";
import { heardOfSession } from "./session.ts";

type Schemas = components["schemas"];
export type Run = Schemas["Run"];
export type RunPage = Schemas["RunPage"];
export type Job = Schemas["Job"];
export type JobPage = Schemas["JobPage"];
export type JobState = Schemas["JobState"];
export type LogLine = Schemas["LogLine"];
export type Product = Schemas["Product"];
export type Recording = Schemas["Recording"];
export type RecordingSegment = Schemas["RecordingSegment"];
export type Rig = Schemas["Rig"];
export type Recipe = Schemas["Recipe"];
export type RecipeOption = Schemas["RecipeOption"];
export type Asset = Schemas["Asset"];
export type Worker = Schemas["Worker"];
export type LiveStream = Schemas["LiveStream"];
export type Problem = Schemas["Problem"];
export type CrossSection = Schemas["CrossSection"];
export type Trajectory = Schemas["Trajectory"];
export type Session = Schemas["Session"];
export type Scope = Schemas["Scope"];
export type Token = Schemas["Token"];
export type TokenWithSecret = Schemas["TokenWithSecret"];
export type RetentionPreview = Schemas["RetentionPreview"];
export type RetentionRules = Schemas["RetentionRules"];
export type Batch = Schemas["Batch"];
export type BatchWish = Schemas["BatchWish"];
export type BatchResult = Schemas["BatchResult"];
export type BatchResultPage = Schemas["BatchResultPage"];
export type Defect = Schemas["Defect"];
export type DefectPage = Schemas["DefectPage"];
export type DefectState = Schemas["DefectState"];
export type DefectChange = Schemas["DefectChange"];
export type DefectHistory = Schemas["DefectHistory"];
export type ChangeReport = Schemas["ChangeReport"];
export type Change = Schemas["Change"];

/** What we read of a job's `manifest.json`. A file of the product folder, not a shape of the HTTP interface. */
export interface Manifest {
  recipe: Record<string, unknown>;
  quality: {
    frames: number;
    frames_with_stripe: number;
    frames_tracked: number;
    rows_found: number;
    points: number;
    coverage: number;
    travel_mm: number;
    duration_s: number;
    /** What older jobs did not write down. */
    breaks?: number;
    frames_3_dof?: number;
    residual_px?: number | null;
    /** One standard deviation of the last place against the first; none where the way was broken or given. */
    drift?: { x_mm: number; y_mm: number; z_mm: number } | null;
  };
  resolution: { distance_mm: number; r_depth_mm: number } | null;
  gaps: { first_frame: number; last_frame: number; reason: string }[];
  /** Dense recordings of stretches of a long run, by the camera's way. */
  recordings?: { name: string; from_x_mm: number; to_x_mm: number }[];
}

/** What the server answered when it refused, or what kept us from reaching it. */
export class ApiError extends Error {
  override readonly name = "ApiError";
  constructor(readonly problem: Problem) {
    super(problem.detail);
  }
}

/** No answer at all: the only problem of ours, and the only one without a detail. */
export const UNREACHABLE: Problem = { type: "about:blank", title: "No answer from the server", detail: "", retryable: true };

/** The problem in any error, for showing. */
export function problemOf(error: unknown): Problem {
  if (error instanceof ApiError) return error.problem;
  return { type: "about:blank", title: "Unexpected error", detail: error instanceof Error ? error.message : String(error), retryable: false };
}

/** The problem in an answer that tells of no success. */
export function problemIn(status: number, body: string): Problem {
  try {
    const problem = JSON.parse(body) as Partial<Problem>;
    if (typeof problem.title === "string" && typeof problem.detail === "string") return problem as Problem;
  } catch {
    // A proxy's HTML page, for example: its status is all we can tell.
  }
  const title = `The server answered with status ${status}`;
  return { type: "about:blank", title, status, detail: body.slice(0, 200) || title, retryable: status >= 500 };
}

/** Requests that only read and wait for their answer: a sleep may have cut them without anybody being told. */
const reading = new Set<AbortController>();
onWake(() => reading.forEach((request) => request.abort()));

/** Asks, and reads the answer as the caller wants it. What is cut half-way is no answer. */
async function ask<T>(path: string, init: RequestInit | undefined, read: (response: Response) => T | Promise<T>): Promise<T> {
  const stopper = new AbortController();
  const caller = init?.signal;
  const stop = () => stopper.abort();
  caller?.addEventListener("abort", stop);
  if (caller?.aborted) stop();
  let patience: ReturnType<typeof setTimeout> | undefined;
  if (init?.method === undefined) {
    reading.add(stopper);
    patience = setTimeout(stop, patienceMs());
  }
  try {
    const response = await fetch(path, { ...init, signal: stopper.signal });
    clearTimeout(patience);
    if (response.status === 401) heardOfSession(false);
    if (response.ok) {
      heardOfSession(true);
      return await read(response);
    }
    throw new ApiError(problemIn(response.status, await response.text().catch(() => "")));
  } catch (error) {
    if (error instanceof ApiError || error instanceof SyntaxError || caller?.aborted) throw error;
    throw new ApiError(UNREACHABLE);
  } finally {
    clearTimeout(patience);
    reading.delete(stopper);
    caller?.removeEventListener("abort", stop);
  }
}

const request = (path: string, init?: RequestInit): Promise<Response> => ask(path, init, (response) => response);
const json = <T>(path: string, init?: RequestInit): Promise<T> => ask(path, init, async (response) => (await response.json()) as T);

/** A key that nobody else uses. (`crypto.randomUUID` exists only under HTTPS and on localhost.) */
function newKey(): string {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** A creating request: the same key makes a repeated request the same result. */
function creating(body?: unknown): RequestInit {
  const headers: Record<string, string> = { "idempotency-key": newKey() };
  if (body === undefined) return { method: "POST", headers };
  return { method: "POST", headers: { ...headers, "content-type": "application/json" }, body: JSON.stringify(body) };
}

const at = encodeURIComponent;

/** Which runs to list, in which order; what is empty does not matter. */
export interface RunFilter {
  q: string;
  state: string;
  asset: string;
  from: string;
  to: string;
  sort: string;
}

/** A page of runs; `cursor` is null for the first. */
export function listRuns(filter: RunFilter, cursor: string | null, limit: number, signal?: AbortSignal): Promise<RunPage> {
  const query = new URLSearchParams({ limit: `${limit}` });
  for (const [name, value] of Object.entries(filter)) if (value !== "") query.set(name, value as string);
  if (cursor !== null) query.set("cursor", cursor);
  return json(`/api/runs?${query}`, signal ? { signal } : undefined);
}

/** Which defects to list, in which order; what is empty does not matter. */
export interface DefectFilter {
  q: string;
  asset: string;
  kind: string;
  severity: string;
  state: string;
  from_mm: string;
  to_mm: string;
  depth_min_mm: string;
  sort: string;
}

function defectQuery(filter: Partial<DefectFilter> & { job?: string }): URLSearchParams {
  const query = new URLSearchParams();
  for (const [name, value] of Object.entries(filter)) if (value !== undefined && value !== "") query.set(name, value);
  return query;
}

/** A page of defects; `cursor` is null for the first. */
export function listDefects(filter: Partial<DefectFilter> & { job?: string }, cursor: string | null, limit: number, signal?: AbortSignal): Promise<DefectPage> {
  const query = defectQuery(filter);
  query.set("limit", `${limit}`);
  if (cursor !== null) query.set("cursor", cursor);
  return json(`/api/defects?${query}`, signal ? { signal } : undefined);
}

/** The address of the same list as a file. */
export const defectsFile = (format: "csv" | "geojson", filter: Partial<DefectFilter>): string => `/api/defects.${format}?${defectQuery(filter)}`;
export const getDefect = (defect: string): Promise<Defect> => json(`/api/defects/${at(defect)}`);
export const getDefectHistory = (defect: string): Promise<DefectHistory> => json(`/api/defects/${at(defect)}/history`);

/** What a change was made from: where it has another version by now, the server changes nothing and answers with this status. */
export const CHANGED_MEANWHILE = 412;
const changing = (method: "PATCH" | "PUT" | "DELETE", version: string, body?: unknown): RequestInit => ({
  method,
  headers: { "if-match": `"${version}"`, ...(body === undefined ? {} : { "content-type": "application/json" }) },
  ...(body === undefined ? {} : { body: JSON.stringify(body) }),
});

/** Changes what people say about a defect where it still is what it was. */
export const changeDefect = ({ id, version }: Defect, change: DefectChange): Promise<Defect> => json(`/api/defects/${at(id)}`, changing("PATCH", version, change));

/** What changed between two jobs; null while the server works it out. */
export async function getChange(before: string, after: string): Promise<ChangeReport | null> {
  const response = await request(`/api/jobs/${at(after)}/change?before=${at(before)}`);
  return response.status === 202 ? null : ((await response.json()) as ChangeReport);
}

/** Where the map of that change lies. */
export const differenceFile = (before: string, after: string): string => `/api/jobs/${at(after)}/change/difference.tif?before=${at(before)}`;

/** What we read of a job's `defects.json`: what it could have seen. */
export interface DefectListFile {
  detection_limit_mm: number;
  doubtful: number;
  omitted: number;
}

/** A job's own list of defects; null where it was not searched for any. */
export async function getDefectList(job: string): Promise<DefectListFile | null> {
  try {
    return await json<DefectListFile>(productPath(job, "defects.json"));
  } catch (error) {
    if (error instanceof ApiError && error.problem.status === 404) return null;
    throw error;
  }
}

/** `sections.csv` of a job, column by column; null where a place has no value. */
export async function getSections(job: string): Promise<Map<string, (number | null)[]>> {
  const text = await (await request(productPath(job, "sections.csv"))).text();
  const [head, ...lines] = text.trim().split("\n").map((line) => line.split(","));
  return new Map((head ?? []).map((name, column) => [name, lines.map((line) => (line[column] ? Number(line[column]) : null))]));
}

/** All pages of a list that is not long. */
async function everyPage<T>(path: string): Promise<T[]> {
  const items: T[] = [];
  let cursor: string | null | undefined = null;
  do {
    const page: { items: T[]; next_cursor?: string | null } = await json(`${path}?limit=1000${cursor ? `&cursor=${at(cursor)}` : ""}`);
    items.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor);
  return items;
}

/** Every asset, by name; more than a page of them is rare. */
export const listAssets = (): Promise<Asset[]> => everyPage("/api/assets");

export const getSession = (): Promise<Session> => json("/api/session");
export const logOut = (): Promise<Response> => request("/api/session", { method: "DELETE" });

/** Every token, the newest first, without its secret. */
export const listTokens = (): Promise<Token[]> => everyPage("/api/tokens");
export const createToken = (wish: Schemas["TokenWish"]): Promise<TokenWithSecret> => json("/api/tokens", creating(wish));
export const rotateToken = (token: string, overlap_s: number): Promise<TokenWithSecret> => json(`/api/tokens/${at(token)}/rotate`, creating({ overlap_s }));
export const revokeToken = (token: string): Promise<Token> => json(`/api/tokens/${at(token)}`, { method: "DELETE" });

/** Rules of keeping; what is not said does not matter. */
export type KeepingRules = { keep_days?: number; quota_gb?: number };
/** The rules that hold, and what they would delete now. */
export const getRetention = (): Promise<RetentionPreview> => json("/api/retention");
/** What these rules alone would delete now. */
export function previewRetention(rules: KeepingRules): Promise<RetentionPreview> {
  const query = new URLSearchParams(Object.entries(rules).map(([name, value]) => [name, `${value}`]));
  return json(`/api/retention?exactly=true&${query}`);
}
/** Makes rules hold on every server, where those that hold are still of this version. */
export const storeRetention = (rules: KeepingRules, version: string): Promise<RetentionPreview> => json("/api/retention", changing("PUT", version, rules));
/** Lets the servers' own settings hold again. */
export const forgetRetention = (version: string): Promise<RetentionPreview> => json("/api/retention", changing("DELETE", version));

/** The first jobs of a state, the newest first. */
export const listJobsIn = (state: JobState, limit: number): Promise<JobPage> => json(`/api/jobs?state=${state}&limit=${limit}`);

/** Batches, the newest first. */
export const listBatches = async (limit: number): Promise<Batch[]> => (await json<Schemas["BatchPage"]>(`/api/batches?limit=${limit}`)).items;
export const getBatch = (batch: string): Promise<Batch> => json(`/api/batches/${at(batch)}`);
export const createBatch = (wish: BatchWish): Promise<Batch> => json("/api/batches", creating(wish));
/** How many runs a batch would take. */
export const countBatch = async (wish: BatchWish): Promise<number> => (await json<Schemas["BatchPreview"]>("/api/batches", creating({ ...wish, dry_run: true }))).runs;
export const steerBatch = (batch: string, to: "pause" | "resume" | "cancel"): Promise<Batch> => json(`/api/batches/${at(batch)}/${to}`, creating());
export const listResults = (batch: string, cursor: string | null): Promise<BatchResultPage> =>
  json(`/api/batches/${at(batch)}/results?limit=50${cursor === null ? "" : `&cursor=${at(cursor)}`}`);
export const getJob = (job: string): Promise<Job> => json(`/api/jobs/${at(job)}`);
export const listWorkers = (): Promise<Worker[]> => json("/api/workers");
export const listOptions = (): Promise<RecipeOption[]> => json("/api/options");
export const createRig = (toml: string): Promise<Rig> =>
  json("/api/rigs", { method: "POST", headers: { "idempotency-key": newKey(), "content-type": "application/toml" }, body: toml });

/** What can be changed about a run. */
export type RunChange = Schemas["RunChange"];
const runPath = (run: string): string => `/api/runs/${at(run)}`;

/** Changes a run where it still is what it was. */
export const changeRun = ({ id, version }: Run, change: RunChange): Promise<Run> =>
  json(runPath(id), changing("PATCH", version, change));

/** A pinned run is kept whatever the rules say. */
export const isPinned = async (run: string): Promise<boolean> => (await json<Schemas["Pin"]>(`${runPath(run)}/pin`)).pinned;
export const setPinned = (run: string, pinned: boolean): Promise<Response> => request(`${runPath(run)}/pin`, { method: pinned ? "PUT" : "DELETE" });

/** Where to cut the wall open, mm in the world; `across`: at one chainage, through the whole map. */
export interface Cut {
  from_mm: [number, number];
  to_mm: [number, number];
  across?: boolean;
}

/** The address of a cross-section. */
export function profilePath(job: string, cut: Cut, format?: "csv"): string {
  const query = new URLSearchParams({ from: cut.from_mm.map((mm) => mm.toFixed(3)).join(), to: cut.to_mm.map((mm) => mm.toFixed(3)).join() });
  if (format !== undefined) query.set("format", format);
  return `/api/jobs/${at(job)}/profile?${query}`;
}
export const getProfile = (job: string, cut: Cut, signal: AbortSignal): Promise<CrossSection> => json(profilePath(job, cut), { signal });
export const getTrajectory = (job: string): Promise<Trajectory> => json(`/api/jobs/${at(job)}/trajectory`);

/** Where a job's tiles are, also while it runs. */
export const tilesFolder = (job: string): string => `/api/jobs/${at(job)}/tiles`;

/** Where the tiles are that show how far the wall lies from its undamaged shape. */
export const deviationFolder = (job: string): string => `/api/jobs/${at(job)}/residual`;

/** What tiles a folder has; null where there are none (yet). */
export async function getTilesIndex(folder: string): Promise<TilesIndex | null> {
  try {
    return await json<TilesIndex>(`${folder}/tiles.json`, { cache: "no-cache" });
  } catch (error) {
    if (error instanceof ApiError && error.problem.status === 404) return null;
    throw error;
  }
}

/** The streams of robots that walk now, or did lately. */
export const listStreams = async (): Promise<LiveStream[]> => (await json<Schemas["LiveStreamPage"]>("/api/live")).items;

/** The newest frame of a job that runs: the stripe found in it, as `core/src/export/live_frame.rs` writes it. */
export interface LiveFrame {
  frame: number;
  time_s: number;
  width_px: number;
  height_px: number;
  spots_px: [number, number][];
  rows_found: number;
  rows: number;
  x_mm: number | null;
}

/** The newest frame and its picture; null where there is none. */
export async function getLiveFrame(job: string): Promise<{ about: LiveFrame; picture: Blob } | null> {
  const folder = `/api/jobs/${at(job)}/live`;
  try {
    const picture = await ask(`${folder}/frame.jpg`, { cache: "no-cache" }, (response) => response.blob());
    return { about: await json<LiveFrame>(`${folder}/frame.json`, { cache: "no-cache" }), picture };
  } catch (error) {
    if (error instanceof ApiError && error.problem.status === 404) return null;
    throw error;
  }
}
export const getRun = (run: string): Promise<Run> => json(runPath(run));
export const deleteRun = (run: string): Promise<Response> => request(runPath(run), { method: "DELETE" });

/** A run's jobs, the newest first. */
export const listJobs = async (run: string): Promise<Job[]> => (await json<JobPage>(`/api/jobs?run=${at(run)}`)).items;

/** A new job for a run; what is left out stays as in its latest job. */
export const reprocess = (run: string, change: Schemas["Reprocess"]): Promise<Job> =>
  json(`/api/runs/${at(run)}/jobs`, creating(change));
export const cancelJob = (job: string): Promise<Response> => request(`/api/jobs/${at(job)}/cancel`, creating());
export const retryJob = (job: string): Promise<Response> => request(`/api/jobs/${at(job)}/retry`, creating());

export const listRigs = async (): Promise<Rig[]> => (await json<Schemas["RigPage"]>("/api/rigs")).items;
export const listRecipes = (): Promise<Recipe[]> => json("/api/recipes");

/** A job's whole log. */
export const listLog = (job: string): Promise<LogLine[]> => everyPage(`/api/jobs/${at(job)}/log`);

/** A job's products: files at the top of the folder first, tiles after them; one page is enough for the files. */
export const listProducts = (job: string): Promise<Schemas["ProductPage"]> => json(`/api/jobs/${at(job)}/products`);
export const getManifest = (job: string): Promise<Manifest> => json(productPath(job, "manifest.json"));

export const getRecording = (job: string): Promise<Recording> => json(`/api/jobs/${at(job)}/recording`);
export const getBytes = (path: string): Promise<Uint8Array> => ask(path, undefined, async (response) => new Uint8Array(await response.arrayBuffer()));

/** A large file of our own server, telling how many bytes have come, of all where the server says so. */
export async function getLarge(path: string, progress: (loadedBytes: number, totalBytes: number | null) => void): Promise<Response> {
  const response = await request(path);
  // Content-Length counts compressed bytes where the server compresses, so it tells the total only where it does not.
  const length = response.headers.get("content-encoding") === null ? response.headers.get("content-length") : null;
  let loadedBytes = 0;
  const counting = new TransformStream<Uint8Array, Uint8Array>({
    transform(chunk, controller) {
      loadedBytes += chunk.byteLength;
      progress(loadedBytes, length === null ? null : Number(length));
      controller.enqueue(chunk);
    },
  });
  return new Response(response.body?.pipeThrough(counting) ?? null, { headers: response.headers });
}

/** The address of a product, for links and images. */
export function productPath(job: string, name: string): string {
  return `/api/jobs/${at(job)}/products/${name.split("/").map(at).join("/")}`;
}

/** True while something may still happen to a job by itself. */
export function isActive({ state }: { state: JobState }): boolean {
  return state === "queued" || state === "running";
}

/** What a job says while it goes on. */
export interface JobListener {
  /** The job as it is now. */
  job(job: Job): void;
  /** A recording segment may be fetched. */
  segment(): void;
  /** The map has grown. */
  tile(): void;
  /** The stream of events is connected, or was lost and is being tried again. */
  connected(connected: boolean): void;
}

const RECONNECT_MS = 3000;
/** A job that is at work and says nothing for so long may be a dead connection, ms. */
const SILENT_MS = 60_000;
const LOOK_MS = 2000;

/** Follows a job's events until the returned function is called; connects again whenever the connection is lost. */
export function followJob(job: string, listener: JobListener): () => void {
  let source: EventSource;
  let timer: ReturnType<typeof setTimeout> | undefined;
  let ended = false;
  let heardAt = Date.now();
  const connect = () => {
    heardAt = Date.now();
    source = new EventSource(`/api/jobs/${at(job)}/events`);
    source.onopen = () => listener.connected(true);
    source.onerror = () => {
      listener.connected(false);
      // The browser tries again by itself unless the server's answer was not a stream (a proxy's 502, for example).
      if (source.readyState === EventSource.CLOSED && !ended) timer = setTimeout(connect, RECONNECT_MS);
    };
    const on = (name: string, heard: (data: string) => void) =>
      source.addEventListener(name, (event) => {
        heardAt = Date.now();
        heard((event as MessageEvent<string>).data);
      });
    const heardJob = (data: string) => {
      const now = JSON.parse(data) as Job;
      if (!isActive(now)) stop(); // the server ends the stream here; no need to come back
      listener.job(now);
    };
    on("state", heardJob);
    on("progress", heardJob);
    on("segment", () => listener.segment());
    on("tile", () => listener.tile());
  };
  // After a sleep or a cut a connection may look alive for minutes: whoever comes back to the page gets a new one.
  const anew = () => {
    if (document.hidden || ended) return;
    clearTimeout(timer);
    source.close();
    connect();
  };
  const watch = setInterval(() => {
    const waits = source.readyState === EventSource.CONNECTING ? patienceMs() : SILENT_MS;
    if (Date.now() - heardAt > waits) anew();
  }, LOOK_MS);
  const noWake = onWake(anew);
  const stop = () => {
    ended = true;
    noWake();
    removeEventListener("online", anew);
    document.removeEventListener("visibilitychange", anew);
    clearInterval(watch);
    clearTimeout(timer);
    source.close();
  };
  connect();
  addEventListener("online", anew);
  document.addEventListener("visibilitychange", anew);
  return stop;
}
