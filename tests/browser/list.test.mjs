// The list of runs: thousands of them, searched, filtered, sorted, shared by a link.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { after, before, test } from "node:test";
import { getJson, keepPicture, openPage, simulate, soon, startBrowser, startServer, until } from "./support.mjs";

const RUNS = 2000;
const AT_ONCE = 16;
let server, browser, run;

before(async () => {
  [server, run, browser] = await Promise.all([startServer(["--workers", "0"]), simulate({ seconds: 1, size: "320x240" }), startBrowser()]);
  const rig = await readFile(run.rig, "utf8");
  let next = 0;
  const sender = async () => {
    while (next < RUNS) {
      const number = next;
      next += 1;
      const form = new FormData();
      const day = new Date(Date.UTC(2026, 0, 1 + (number % 200), 12));
      for (const [name, value] of Object.entries({ asset: `Sewer ${number % 7}`, rig, recorded_at: day.toISOString() })) form.append(name, value);
      form.append("file", new Blob([`no video ${number}`]), `run-${String(number).padStart(4, "0")}.mp4`);
      const response = await fetch(new URL("/api/runs", server.url), { method: "POST", body: form });
      assert.equal(response.status, 201, await response.text());
    }
  };
  await Promise.all(Array.from({ length: AT_ONCE }, sender));
});
after(async () => {
  await browser?.close();
  await run?.remove();
  await server?.stop();
});

test(`${RUNS} runs: only the rows in view exist, scrolling reaches the last one`, async (t) => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await page.getByRole("list", { name: "Runs" }).getByRole("listitem").first().waitFor();
  let most = 0;
  const started = performance.now();
  await until("the last run is in the list", 120_000, async () => {
    most = Math.max(most, await page.locator(".virtual > li").count());
    await page.evaluate(() => scrollTo(0, document.documentElement.scrollHeight));
    return (await page.getByRole("status").first().textContent()) === `${RUNS.toLocaleString("en")} runs`;
  });
  t.diagnostic(`${RUNS} runs loaded in ${((performance.now() - started) / 1000).toFixed(1)} s of scrolling; ${most} rows at most`);
  assert.ok(most < 120, `${most} rows exist at once`);
  const { items } = await getJson(server, "/api/runs?sort=created&limit=1");
  await soon("the last run is in view", async () => {
    // The last page may have made the list longer since it was scrolled.
    await page.evaluate(() => scrollTo(0, document.documentElement.scrollHeight));
    return page.getByText(items[0].source.filename).isVisible();
  });
  const positions = await page.locator(".virtual > li").evaluateAll((rows) => rows.map((row) => Number(row.getAttribute("aria-posinset"))));
  assert.equal(Math.max(...positions), RUNS);
  await close();
});

test("search, filters and order; the link shows the same list to somebody else", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  const rows = () => page.locator(".virtual > li .run-file").allTextContents();
  await page.getByRole("searchbox", { name: "Search runs" }).fill("run-0421");
  await soon("the one run is found", async () => (await rows()).join() === "run-0421.mp4");
  await page.getByRole("button", { name: "Clear filters" }).click();
  await page.getByLabel("Asset").selectOption("Sewer 3");
  await page.getByLabel("Order").selectOption("recorded");
  await page.getByLabel("Recorded from").fill("2026-02-01");
  await page.getByLabel("until").fill("2026-02-01");
  await soon("the list follows", async () => {
    const found = await rows();
    return found.length > 0 && found.every((name) => Number(name.slice(4, 8)) % 7 === 3 && Number(name.slice(4, 8)) % 200 === 31);
  });
  await page.getByLabel("State").selectOption("failed");
  await page.getByText("No run fits these filters.").waitFor();
  await page.getByLabel("State").selectOption("queued");
  await soon("they wait", async () => (await rows()).length > 0);
  await keepPicture(page, "runs-filtered");
  const shown = await rows();
  const other = await openPage(browser, server);
  await other.page.goto(page.url());
  await other.page.locator(".virtual > li").first().waitFor();
  assert.deepEqual(await other.page.locator(".virtual > li .run-file").allTextContents(), shown);
  await other.page.locator(".run-link").first().click();
  await other.page.getByRole("heading", { level: 1 }).waitFor();
  await other.page.goBack();
  await soon("back is where one was", async () => (await other.page.locator(".virtual > li .run-file").allTextContents()).join() === shown.join());
  await other.close();
  await close();
});

test("the list and a waiting run by keyboard alone", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await page.locator(".virtual > li").first().waitFor();
  await page.getByLabel("Order").focus();
  await page.keyboard.press("Tab");
  assert.equal(await page.evaluate(() => document.activeElement.className), "run-link");
  await page.keyboard.press("Enter");
  await page.waitForURL(/\/runs\//);
  await page.getByText("Waiting for a free worker").waitFor();
  await close();
});
