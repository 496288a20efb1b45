// Measuring again, side by side, the queue and the rigs: what people do around a run.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { after, before, test } from "node:test";
import { getJson, jobEnds, keepPicture, mapSettled, measuredRun, openPage, sendRun, simulate, startBrowser, startServer, until } from "./support.mjs";

let server, idle, browser, run, done;

before(async () => {
  [server, idle, run, browser] = await Promise.all([startServer(), startServer(["--workers", "0"]), simulate({ scene: "wall" }), startBrowser()]);
  done = await measuredRun(server, run);
});
after(async () => {
  await browser?.close();
  await run?.remove();
  await idle?.stop();
  await server?.stop();
});

test("measuring again with one option changed, and the two side by side", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto(`/runs/${done.id}?tab=jobs`);
  await page.getByText("Nothing changed").click();
  const options = await getJson(server, "/api/options");
  await page.getByText("map.mm_per_px").waitFor();
  for (const { key } of options) assert.ok((await page.locator(".option code", { hasText: new RegExp(`^${key.replaceAll(".", "\\.")}$`) }).count()) === 1, `${key} is in the form`);
  const field = page.locator(".option", { hasText: "map.mm_per_px" }).getByRole("textbox");
  await field.fill("-3");
  await page.getByText(/Expected 0 to/).waitFor();
  assert.equal(await page.getByRole("button", { name: "Measure again" }).isDisabled(), true);
  await field.fill("4");
  await page.getByText("1 option changed").waitFor();
  await page.getByRole("button", { name: "Measure again" }).click();
  const job = await until("the new job is there", 10_000, async () => {
    const { items } = await getJson(server, `/api/jobs?run=${done.id}`);
    return items.length === 2 && items[0];
  });
  await jobEnds(server, job.id);
  const manifest = await getJson(server, `/api/jobs/${job.id}/products/manifest.json`);
  assert.equal(manifest.recipe.map.mm_per_px, 4);
  await page.goto(`/runs/${done.id}?tab=jobs`);
  await page.getByRole("link", { name: /^Compare/ }).click();
  for (const side of [0, 1]) await mapSettled(page, page.locator(".pair section").nth(side));
  const difference = page.getByRole("row", { name: /map\.mm_per_px/ });
  assert.deepEqual((await difference.getByRole("cell").allTextContents())[0], "4");
  const views = () => page.locator(".map-top").evaluateAll((maps) => maps.map((map) => ({ ...map.striaMap.view })));
  await page.getByRole("button", { name: "Zoom in" }).first().click();
  await until("both maps moved together", 5000, async () => {
    const [left, right] = await views();
    return Math.abs(left.mm_per_css_px - right.mm_per_css_px) < 1e-9 && Math.abs(left.x_mm - right.x_mm) < 1e-6;
  });
  await keepPicture(page, "compared");
  await close();
});

test("the queue: what waits is cancelled and taken up again", async () => {
  const waiting = await sendRun(idle, run, { asset: "waits for long" });
  const { page, close } = await openPage(browser, idle);
  await page.goto("/queue");
  const row = page.getByRole("region", { name: "Waiting" }).getByRole("listitem").filter({ hasText: "waits for long" });
  await row.getByText("No worker is there.").waitFor();
  await row.getByRole("button", { name: "Cancel" }).click();
  const ended = page.getByRole("region", { name: "Ended lately" }).getByRole("listitem").filter({ hasText: "waits for long" });
  await ended.getByText("Cancelled").waitFor();
  assert.equal((await getJson(idle, `/api/jobs/${waiting.job.id}`)).state, "cancelled");
  await ended.getByRole("button", { name: "Try again" }).click();
  await row.waitFor();
  assert.equal((await getJson(idle, `/api/jobs/${waiting.job.id}`)).state, "queued");
  await close();
});

test("a rig is drawn and checked before it is stored", async () => {
  const { page, close } = await openPage(browser, idle);
  await page.goto("/settings/rigs");
  await page.getByText("Add a rig").click();
  const rig = (await readFile(run.rig, "utf8")).replace(/^name = .*$/m, 'name = "drawn"');
  const text = page.getByLabel("Rig file (TOML)");
  await text.fill(rig.replace(/^plane_normal.*$/m, "plane_normal = [-1.0, 0.0, 0.0]").replace(/^plane_offset_mm.*$/m, "plane_offset_mm = 1e9"));
  await text.fill(rig.replace(/plane_normal = .*/, "plane_normal = [0.0, 0.0, -1.0]"));
  await page.getByText("The laser's plane never crosses what the camera sees").waitFor();
  await keepPicture(page, "rig-nonsense");
  await text.fill("this is no rig");
  await page.getByText("This cannot be read as a rig file.").waitFor();
  await text.fill(rig);
  await page.locator("details .rig-drawing .laser.seen").waitFor();
  await page.getByRole("button", { name: "Store this rig" }).click();
  await page.getByText("drawn is stored.").waitFor();
  await page.getByRole("region", { name: "drawn" }).locator(".laser.seen").waitFor();
  assert.ok((await getJson(idle, "/api/rigs")).items.some(({ name }) => name === "drawn"));
  await close();
});

test("the path's plots and every file of a finished run", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto(`/runs/${done.id}?tab=path`);
  await until("six plots are drawn", 10_000, async () => (await page.locator(".plot canvas").count()) === 6);
  const trajectory = await getJson(server, `/api/jobs/${done.job.id}/trajectory`);
  assert.equal(trajectory.columns.frame.length, trajectory.frames);
  await page.getByRole("tab", { name: "Files" }).click();
  await page.getByRole("link", { name: "Download depth.tif" }).waitFor();
  await page.getByRole("tab", { name: "Files" }).press("ArrowRight");
  const focused = () => page.evaluate(() => document.activeElement.textContent);
  await until("the arrow has gone on to the next part", 5_000, async () => (await focused()) === "Measurements");
  await close();
});
