// Measuring again, side by side, the queue and the rigs: what people do around a run.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { after, before, test } from "node:test";
import { getJson, jobEnds, keepPicture, mapSettled, measuredRun, openPage, sendRun, simulate, soon, startBrowser, startServer } from "./support.mjs";

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
  const job = await soon("the new job is there", async () => {
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
  await soon("both maps moved together", async () => {
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
  const ended = page.getByRole("region", { name: "Cancelled" }).getByRole("listitem").filter({ hasText: "waits for long" });
  await ended.getByText("Cancelled").waitFor();
  assert.equal((await getJson(idle, `/api/jobs/${waiting.job.id}`)).state, "cancelled");
  await ended.getByRole("button", { name: "Try again" }).click();
  await row.waitFor();
  assert.equal((await getJson(idle, `/api/jobs/${waiting.job.id}`)).state, "queued");
  await close();
});

test("what could not be measured says why, and can be tried again", async () => {
  const sent = await sendRun(server, { ...run, video: run.rig }, { filename: "notes.mp4", asset: "no video at all" });
  const failed = await jobEnds(server, sent.job.id, "failed");
  const { page, close } = await openPage(browser, server);
  await page.goto("/queue");
  const row = page.getByRole("region", { name: "Failed" }).getByRole("listitem").filter({ hasText: "no video at all" });
  await row.getByText(failed.error.detail).waitFor();
  await row.getByText(/^Given up after 1 attempt/).waitFor();
  const worker = page.getByRole("region", { name: "Workers" }).getByRole("listitem");
  await worker.getByText(/of \d+ places taken/).first().waitFor();
  await row.getByRole("button", { name: "Try again" }).click();
  await soon("it was tried again", async () => {
    const now = await getJson(server, `/api/jobs/${sent.job.id}`);
    return now.state === "failed" && now.finished_at !== failed.finished_at;
  });
  await close();
});

test("a batch: counted beforehand, made, and laid beside what was there", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/?asset=test%20wall");
  await page.getByRole("link", { name: "Measure these again" }).click();
  const batches = page.getByRole("region", { name: "Batches" });
  assert.equal(await batches.getByRole("combobox", { name: "Asset", exact: true }).inputValue(), "test wall");
  assert.ok(await batches.getByRole("button", { name: "Measure again" }).isDisabled(), "nobody starts what was not counted");
  await batches.getByLabel("Asset, file, rig or note").fill("no such words");
  await batches.getByRole("button", { name: "Count the runs" }).click();
  await batches.getByText("No run fits.").waitFor();
  await batches.getByLabel("Asset, file, rig or note").fill("");
  await batches.getByRole("combobox", { name: "Recipe", exact: true }).selectOption("paper");
  await batches.getByLabel("Note", { exact: true }).fill("the publication's way");
  await batches.getByRole("button", { name: "Count the runs" }).click();
  await batches.getByText("1 run fits.").waitFor();
  await keepPicture(page, "batch-counted");
  assert.equal((await getJson(server, "/api/batches")).items.length, 0, "counting makes nothing");
  await batches.getByRole("button", { name: "Measure 1 run again" }).click();
  const row = batches.getByRole("listitem").filter({ hasText: "the publication's way" });
  await row.getByText("1 done").waitFor({ timeout: 120_000 });
  await row.getByRole("link").click();
  await page.getByRole("heading", { name: "the publication's way" }).waitFor();
  const batch = (await getJson(server, "/api/batches")).items[0];
  const [result] = (await getJson(server, `/api/batches/${batch.id}/results`)).items;
  assert.ok(Object.keys(result.difference).length > 0, "there is a difference to show");
  for (const figure of ["rows_found", "coverage", "travel_mm", "points"]) {
    const cell = page.locator(`td[data-figure=${figure}]`);
    assert.equal(Number(await cell.getAttribute("data-difference")), result.difference[figure]);
    const [now, change] = [result.after[figure], result.difference[figure]];
    const sign = change === 0 ? "" : `${change < 0 ? "−" : "+"}${Math.abs(change).toLocaleString("en-US")}`;
    if (figure === "points") assert.equal((await cell.innerText()).replace(/\s/g, ""), `${now.toLocaleString("en-US")}${sign}`);
  }
  await keepPicture(page, "batch-done");
  await page.getByRole("link", { name: /^Compare with the one before/ }).click();
  await page.getByRole("heading", { name: "Two measurements side by side" }).waitFor();
  await close();
});

test("a batch is paused, goes on, and is cancelled for good", async () => {
  const waiting = await sendRun(idle, run, { asset: "for the batch" });
  const { page, close } = await openPage(browser, idle);
  await page.goto("/queue?again=1&asset=for%20the%20batch");
  const batches = page.getByRole("region", { name: "Batches" });
  await batches.getByLabel("Note", { exact: true }).fill("steered");
  await batches.getByRole("button", { name: "Count the runs" }).click();
  await batches.getByRole("button", { name: "Measure 1 run again" }).click();
  const row = batches.getByRole("listitem").filter({ hasText: "steered" });
  const job = await soon("the batch has its job", async () => (await getJson(idle, `/api/jobs?run=${waiting.id}`)).items.find(({ batch }) => batch));
  const stateIs = (state) => soon(`its job is ${state}`, async () => (await getJson(idle, `/api/jobs/${job.id}`)).state === state);
  await row.getByRole("button", { name: "Pause" }).click();
  await row.getByText("Paused", { exact: true }).waitFor();
  await row.getByText("1 held back").waitFor();
  await stateIs("paused");
  await row.getByRole("button", { name: "Go on" }).click();
  await row.getByText("1 waiting").waitFor();
  await stateIs("queued");
  await row.getByRole("button", { name: "Cancel" }).click();
  await page.getByRole("dialog").getByRole("button", { name: "Cancel the batch" }).click();
  await row.getByText("Cancelled", { exact: true }).waitFor();
  await stateIs("cancelled");
  assert.equal(await row.getByRole("button").count(), 0, "a cancelled batch cannot go on");
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
  await soon("six plots are drawn", async () => (await page.locator(".plot canvas").count()) === 6);
  const trajectory = await getJson(server, `/api/jobs/${done.job.id}/trajectory`);
  assert.equal(trajectory.columns.frame.length, trajectory.frames);
  await page.getByRole("tab", { name: "Files" }).click();
  await page.getByRole("link", { name: "Download depth.tif" }).waitFor();
  await page.getByRole("tab", { name: "Files" }).press("ArrowRight");
  const focused = () => page.evaluate(() => document.activeElement.textContent);
  await soon("the arrow has gone on to the next part", async () => (await focused()) === "Measurements");
  await close();
});
