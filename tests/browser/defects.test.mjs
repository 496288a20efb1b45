// Defects: the list over all runs, what people decide, a run's own on its map, what changed between two runs.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { getJson, mapSettled, measuredRun, onPage, openPage, simulate, soon, startBrowser, startServer } from "./support.mjs";
import { lookAround } from "./looks.mjs";

let server, empty, browser, earlier, later, first, second, defects;

before(async () => {
  [server, empty, browser] = await Promise.all([startServer(), startServer(["--workers", "0"]), startBrowser({ plain: true })]);
  earlier = await simulate({ scene: "wall", seconds: 3, seed: 61, more: ["--wall-seed", "7"] });
  later = await simulate({ scene: "wall", seconds: 3, seed: 63, more: ["--wall-seed", "7", "--later"] });
  // The second robot says another chainage: its map lies 40 mm off.
  first = await measuredRun(server, earlier, { asset: "Gallery 3", chainage_mm: "12000", recorded_at: "2024-03-01T10:00:00Z" });
  second = await measuredRun(server, later, { asset: "Gallery 3", chainage_mm: "12000", recorded_at: "2025-03-01T10:00:00Z", filename: "later.mp4" });
  defects = (await getJson(server, `/api/defects?run=${first.id}&sort=chainage`)).items;
  assert.ok(defects.length > 3, "the simulated wall has defects");
});
after(async () => {
  await browser?.close();
  await Promise.all([earlier?.remove(), later?.remove()]);
  await empty?.stop();
  await server?.stop();
});

test("the list over all runs: filters, an address that keeps them, files", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await page.getByRole("link", { name: "Defects", exact: true }).click();
  const rows = page.getByRole("list", { name: "Defects" }).getByRole("listitem");
  await rows.first().waitFor();
  const all = (await getJson(server, "/api/defects?limit=1000")).items;
  assert.equal(await rows.count(), all.length);
  await page.getByRole("combobox", { name: "Kind" }).selectOption("dent");
  await page.getByLabel("Depth from, mm").fill("9");
  const wanted = all.filter((defect) => defect.kind === "dent" && Math.abs(defect.depth_mm) >= 9).length;
  assert.ok(wanted > 0 && wanted < all.length);
  await soon("only those are listed", async () => (await rows.count()) === wanted);
  const csv = await fetch(new URL(await page.getByRole("link", { name: "CSV" }).getAttribute("href"), server.url));
  assert.equal((await csv.text()).trim().split("\n").length, wanted + 1);
  const geojson = await fetch(new URL(await page.getByRole("link", { name: "GeoJSON" }).getAttribute("href"), server.url));
  assert.equal((await geojson.json()).features.length, wanted);
  await page.reload();
  await soon("the address keeps the filter", async () => (await rows.count()) === wanted);
  assert.equal(await page.getByLabel("Depth from, mm").inputValue(), "9");
  await page.getByLabel("Depth from, mm").fill("900");
  await page.getByText("No defect fits these filters.").waitFor();
  await page.getByRole("button", { name: "Clear filters" }).click();
  await soon("all are listed again", async () => (await rows.count()) === all.length);
  await close();
});

test("a decision by keyboard alone; what somebody else wrote meanwhile is not overwritten", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/defects?sort=chainage");
  const row = page.getByRole("list", { name: "Defects" }).getByRole("listitem").first();
  await row.getByRole("button", { name: /^Details/ }).focus();
  await page.keyboard.press("Enter");
  const dialog = page.getByRole("dialog");
  await dialog.getByLabel("State").selectOption("watched");
  await dialog.getByLabel("Comment").fill("seen by the bridge team");
  await dialog.getByRole("button", { name: "Save" }).focus();
  await page.keyboard.press("Enter");
  await dialog.getByText("Saved.").waitFor();
  const id = new URL(page.url()).searchParams.get("defect");
  const stored = await getJson(server, `/api/defects/${id}`);
  assert.deepEqual([stored.state, stored.comment], ["watched", "seen by the bridge team"]);
  // The same place in the other run.
  await dialog.getByRole("region", { name: "The same place in other runs" }).getByRole("row").nth(2).waitFor();
  // Somebody else decides while the dialog is open.
  const other = await fetch(new URL(`/api/defects/${id}`, server.url), { method: "PATCH", headers: { "content-type": "application/json" }, body: JSON.stringify({ state: "repaired" }) });
  assert.equal(other.status, 200);
  await dialog.getByLabel("Comment").fill("too late");
  await dialog.getByRole("button", { name: "Save" }).click();
  await dialog.getByText("Somebody else has changed it").waitFor();
  assert.equal((await getJson(server, `/api/defects/${id}`)).comment, "seen by the bridge team");
  // Theirs stands in the form; on top of it, it can be said again.
  assert.deepEqual([await dialog.getByLabel("State").inputValue(), await dialog.getByLabel("Comment").inputValue()], ["repaired", "seen by the bridge team"]);
  await dialog.getByLabel("Comment").fill("repaired in May");
  await dialog.getByRole("button", { name: "Save" }).click();
  await dialog.getByText("Saved.").waitFor();
  await page.keyboard.press("Escape");
  await dialog.waitFor({ state: "detached" });
  assert.match(await row.textContent(), /Repaired/);
  await close();
});

test("a run's defects stand numbered on its map, at their places", async () => {
  const { page, close } = await openPage(browser, server);
  const deepest = defects.reduce((a, b) => (Math.abs(a.depth_mm) > Math.abs(b.depth_mm) ? a : b));
  await page.goto(`/defects?sort=-depth&asset=Gallery%203`);
  await page.getByRole("link", { name: /^Show on the map/ }).first().click();
  await mapSettled(page);
  const view = () => page.locator(".map-top").evaluate((element) => element.striaMap.view);
  assert.ok(Math.hypot((await view()).x_mm - deepest.x_mm, (await view()).y_mm - deepest.y_mm) < 30, "the link looks at its place");

  await page.goto(`/runs/${first.id}?tab=defects`);
  await mapSettled(page);
  const list = page.getByRole("list", { name: "Defects" }).getByRole("listitem");
  assert.equal(await list.count(), defects.length);
  await page.getByText(/On this run a round dent of 20 mm radius must be/).waitFor();
  const third = defects[2];
  await list.nth(2).getByRole("button", { name: /^Show on the map/ }).click();
  await soon("the map looks there", async () => Math.hypot((await view()).x_mm - third.x_mm, (await view()).y_mm - third.y_mm) < 1);
  assert.equal(await list.nth(2).getAttribute("class"), "picked");
  // A click on another's mark chooses it; a ring of its colour is drawn where the defect is.
  await page.getByRole("button", { name: "Whole map" }).click();
  await mapSettled(page);
  const fourth = defects[3];
  const place = await onPage(page, fourth.x_mm, fourth.y_mm);
  await page.mouse.click(place.x, place.y);
  await soon("the click chose it", async () => (await list.nth(3).getAttribute("class")) === "picked");
  // The residual map as a layer: what it tells under the pointer is about the defect's depth, without the wall's distance.
  await page.getByRole("radio", { name: "Deviation" }).check({ force: true });
  await list.nth(2).getByRole("button", { name: /^Show on the map/ }).click();
  await mapSettled(page);
  await page.locator(".map-top").scrollIntoViewIfNeeded();
  const middle = await onPage(page, third.x_mm, third.y_mm);
  await page.mouse.move(middle.x, middle.y);
  const told = page.locator(".readout .depth dd");
  const deviation = await soon("the value is known", async () => Number(await told.getAttribute("data-z").catch(() => null)) || null);
  assert.ok(Math.abs(deviation - third.depth_mm) < Math.max(1.5, 0.4 * Math.abs(third.depth_mm)), `${deviation} mm at a defect of ${third.depth_mm} mm`);
  assert.equal(new URL(page.url()).searchParams.get("layer"), "deviation");
  // The report opens in a page of its own, where nothing of it can run.
  const opened = page.context().waitForEvent("page");
  await page.getByRole("link", { name: "Open the report" }).click();
  const report = await opened;
  await report.getByRole("heading", { name: "Inspection report" }).waitFor();
  const answer = await fetch(report.url());
  assert.match(answer.headers.get("content-security-policy"), /default-src 'none'.*sandbox/);
  assert.ok(await report.evaluate(() => [...document.images].length > 0 && [...document.images].every((image) => image.complete && image.naturalWidth > 0)));
  await close();
});

test("two runs of an asset side by side show what changed", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto(`/runs/${second.id}?tab=defects`);
  const choice = page.getByRole("combobox", { name: "Compare with another run of this asset" });
  await choice.selectOption(first.id);
  await page.waitForURL(/compare/);
  assert.equal(new URL(page.url()).searchParams.get("left"), first.job.id, "the earlier one is on the left");
  const table = page.getByRole("region", { name: "What changed on the wall" });
  await table.waitFor();
  const words = await table.getByRole("row").allTextContents();
  assert.equal(words.filter((row) => /New|Grown/.test(row)).length, 2, words.join("\n"));
  assert.equal(words.filter((row) => /Shrunk|Vanished|Changed/.test(row)).length, 0, words.join("\n"));
  await close();
});

test("in light and dark and at three widths", async () => {
  await lookAround(browser, empty, "defects-empty", "/defects", (page) => page.getByText("No defects yet").waitFor());
  await lookAround(browser, server, "defects", "/defects", (page) => page.getByRole("listitem").first().waitFor());
  await lookAround(browser, server, "defect", `/defects?defect=${defects[1].id}`, (page) => page.getByRole("dialog").getByRole("row").nth(2).waitFor());
  await lookAround(browser, server, "run-defects", `/runs/${first.id}?tab=defects&no=3`, async (page) => {
    await mapSettled(page);
    await page.locator(".plot canvas").first().waitFor();
  });
  await lookAround(browser, server, "run-deviation", `/runs/${first.id}?tab=defects&layer=deviation`, mapSettled);
  await lookAround(browser, server, "change", `/runs/${second.id}/compare?left=${first.job.id}&right=${second.job.id}`, async (page) => {
    for (const side of [0, 1]) await mapSettled(page, page.locator(".pair section").nth(side));
    await page.getByRole("region", { name: "What changed on the wall" }).waitFor();
  });
});
