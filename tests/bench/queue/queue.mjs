// graphile_worker on the PostgreSQL of DATABASE_URL: the same figures as server/src/queue/rate.rs, in one line of JSON.

import { performance } from "node:perf_hooks";
import { Logger, makeWorkerUtils, run } from "graphile-worker";

const JOBS = 2000;
const AT_ONCE = 4;
const STARTS = 50;
const connectionString = process.env.DATABASE_URL;
const logger = new Logger(() => () => {});
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

const utils = await makeWorkerUtils({ connectionString, logger });
await utils.migrate();

const enqueued = performance.now();
for (let i = 0; i < JOBS; i += 1) await utils.addJob("nothing", { i });
const enqueueS = (performance.now() - enqueued) / 1000;

/** A runner whose tasks tell when they start. */
async function runner(started) {
  const taskList = { nothing: async (payload) => started(payload.i, performance.now()) };
  return await run({ connectionString, logger, concurrency: AT_ONCE, noHandleSignals: true, pollInterval: 1000, taskList });
}

let done = 0;
let allDone;
const everything = new Promise((resolve) => (allDone = resolve));
const begun = performance.now();
const busy = await runner(() => {
  done += 1;
  if (done === JOBS) allDone();
});
await everything;
await busy.stop(); // every job is written down as done
const workS = (performance.now() - begun) / 1000;

const starts = new Map();
const idle = await runner((i, at) => starts.set(i, at));
await sleep(500);
const waits = [];
for (let i = 0; i < STARTS; i += 1) {
  await sleep(20 + ((i * 37) % 100));
  const at = performance.now();
  await utils.addJob("nothing", { i });
  while (!starts.has(i)) await sleep(1);
  waits.push(starts.get(i) - at);
}
await idle.stop();
await utils.release();
waits.sort((a, b) => a - b);
const figures = {
  enqueue_per_s: JOBS / enqueueS,
  jobs_per_s: JOBS / workS,
  start_ms: waits[STARTS / 2],
  start_p95_ms: waits[Math.floor((STARTS * 95) / 100)],
};
console.log(`FIGURES ${JSON.stringify(figures)}`);
