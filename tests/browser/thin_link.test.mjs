// On the link of a site, 2 Mbit/s and 150 ms: the list in 2 s, a readable map 3 s after opening a run.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { measuredRun, openPage, simulate, startBrowser, startServer, thinLink } from "./support.mjs";

const LIST_MS = 2000;
const MAP_MS = 3000;
/** A machine that is busy with other things can only be slower: the best of some tries counts. */
const TRIES = 4;
let server, browser, run, measured;

before(async () => {
  [server, run, browser] = await Promise.all([startServer(), simulate({ scene: "wall", seconds: 8, size: "1280x720" }), startBrowser()]);
  for (let number = 0; number < 6; number += 1) measured = await measuredRun(server, run, { asset: `wall ${number}` });
});
after(async () => {
  await browser?.close();
  await run?.remove();
  await server?.stop();
});

async function best(what, budgetMs, t, once) {
  const times = [];
  for (let number = 0; number < TRIES; number += 1) {
    const { page, close } = await openPage(browser, server);
    await thinLink(page);
    times.push(await once(page));
    await close();
    if (times.at(-1) <= budgetMs) break;
  }
  t.diagnostic(`${what}: ${times.map((ms) => `${(ms / 1000).toFixed(2)} s`).join(", ")}`);
  assert.ok(Math.min(...times) <= budgetMs, `${what} within ${budgetMs / 1000} s: ${times}`);
}

test("the list of runs", async (t) => {
  await best("the list", LIST_MS, t, async (page) => {
    const start = performance.now();
    await page.goto("/", { waitUntil: "commit" });
    await page.locator(".run-row .run-link").first().waitFor();
    return performance.now() - start;
  });
});

test("the first readable map, with nothing in the browser's cache", async (t) => {
  await best("the map", MAP_MS, t, async (page) => {
    const start = performance.now();
    await page.goto(`/runs/${measured.id}`, { waitUntil: "commit" });
    // Readable: in the middle of the map stands a colour of the depths.
    await page.waitForFunction(() => {
      const canvas = document.querySelector(".map-base");
      if (!canvas || canvas.width < 10) return false;
      const [r, g, b] = canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data;
      return Math.max(r, g, b) - Math.min(r, g, b) > 25;
    });
    return performance.now() - start;
  });
});
