// The map of a run: what it shows is what depth.tif holds, and a person can measure on it.

import assert from "node:assert/strict";
import { readFile, writeFile } from "node:fs/promises";
import path from "node:path";
import { after, before, test } from "node:test";
import { fetchProduct, getJson, keepPicture, mapSettled, measuredRun, onPage, openPage, readWith, seriousViolations, simulate, soon, startBrowser, startServer } from "./support.mjs";

let server, browser, gauge, gaugeRun, pipe, pipeRun;

before(async () => {
  server = await startServer();
  [gauge, pipe, browser] = [await simulate({ scene: "step-gauge", seconds: 3, size: "1280x720" }), await simulate({ seconds: 3 }), await startBrowser()];
  gaugeRun = await measuredRun(server, gauge, { asset: "gauge", chainage_mm: "5000" });
  pipeRun = await measuredRun(server, pipe, { asset: "pipe", direction: "backward", chainage_mm: "2000" });
});
after(async () => {
  await browser?.close();
  await gauge?.remove();
  await pipe?.remove();
  await server?.stop();
});

/** depth.tif's values at places. */
async function truth(run, folder, places) {
  const tif = await fetchProduct(server, run.job.id, "depth.tif", folder);
  const file = path.join(folder, "places.json");
  await writeFile(file, JSON.stringify(places));
  return readWith("depth_at.py", tif, file);
}

async function openMap(run, query = "") {
  const opened = await openPage(browser, server);
  await opened.page.goto(`/runs/${run.id}${query}`);
  await mapSettled(opened.page);
  return opened;
}

/** The exact value that the page tells for the pointer's place, and that place. */
async function readAt(page, x, y) {
  await page.mouse.move(x, y);
  const value = page.locator(".readout .depth dd");
  await soon("the value under the pointer is known", async () => {
    const text = await value.textContent().catch(() => "…");
    return text !== "…" && !text.startsWith("≈");
  });
  const { z, x: x_mm, y: y_mm } = await value.evaluate((element) => ({ ...element.dataset }));
  return { z_mm: z === undefined ? null : Number(z), place: [Number(x_mm), Number(y_mm)] };
}

test("the value under the cursor is depth.tif's, at any zoom", async () => {
  const { page, close } = await openMap(pipeRun);
  const box = await page.locator(".map-top").boundingBox();
  const found = [];
  for (const zoom of [0, 2, -1]) {
    for (let press = 0; press < Math.abs(zoom); press += 1) await page.getByRole("button", { name: zoom > 0 ? "Zoom in" : "Zoom out" }).click();
    for (const [across, down] of [[0.2, 0.3], [0.5, 0.45], [0.52, 0.7], [0.8, 0.6], [0.35, 0.52]]) {
      found.push(await readAt(page, box.x + box.width * across, box.y + box.height * down));
    }
  }
  const expected = await truth(pipeRun, pipe.folder, found.map(({ place }) => place));
  let measured = 0;
  for (const [at, { z_mm, place }] of found.entries()) {
    assert.equal(z_mm === null, expected[at] === null, `measured or not at ${place}`);
    if (z_mm === null) continue;
    measured += 1;
    assert.ok(Math.abs(z_mm - expected[at]) <= 0.00051, `${z_mm} mm on the page, ${expected[at]} mm in depth.tif at ${place}`);
  }
  assert.ok(measured >= 8, `${measured} of ${found.length} places are measured`);
  const chainage = await page.locator(".readout dd").first().textContent();
  assert.ok(Math.abs(Number(chainage.replace(/[^\d.]/g, "")) - (2000 - found.at(-1).place[0])) < 0.1, `chainage falls along a backward run: ${chainage}`);
  await close();
});

test("a cross-section's numbers are depth.tif's, on the page, in the clipboard and in the file", async () => {
  const { page, context, close } = await openMap(gaugeRun);
  await context.grantPermissions(["clipboard-read", "clipboard-write"]);
  await page.getByText("Section", { exact: true }).click();
  const { depth_map: map } = await getJson(server, `/api/jobs/${gaugeRun.job.id}/products/manifest.json`);
  const ends = [[0.3, 0.2], [0.7, 0.8]].map(([across, down]) => [map.x0_mm + across * map.width_px * map.mm_per_px, map.y0_mm + down * map.height_px * map.mm_per_px]);
  for (const [x_mm, y_mm] of ends) {
    const { x, y } = await onPage(page, x_mm, y_mm);
    await page.mouse.click(x, y);
  }
  await page.getByText(/values/).waitFor();
  await page.getByRole("img", { name: "Plot of the depth along the cut" }).locator("canvas").waitFor();
  await keepPicture(page, "cross-section");
  await page.getByRole("button", { name: "Copy the numbers" }).click();
  await page.getByRole("button", { name: "Copied" }).waitFor();
  const [head, ...lines] = (await page.evaluate(() => navigator.clipboard.readText())).split("\n").map((line) => line.split("\t"));
  assert.deepEqual(head, ["distance_mm", "chainage_mm", "x_mm", "y_mm", "z_mm"]);
  assert.ok(lines.length > 100, `${lines.length} values`);
  const expected = await truth(gaugeRun, gauge.folder, lines.map(([, , x, y]) => [Number(x), Number(y)]));
  for (const [at, [, chainage, x, , z]] of lines.entries()) {
    assert.equal(z === "" ? null : Math.fround(Number(z)), expected[at], `value ${at}`);
    assert.ok(Math.abs(Number(chainage) - 5000 - Number(x)) < 1e-6);
  }
  assert.ok(Math.hypot(Number(lines[0][2]) - ends[0][0], Number(lines[0][3]) - ends[0][1]) < 2 * map.mm_per_px, "it begins where it was drawn");
  const download = page.waitForEvent("download");
  await page.getByRole("link", { name: "Download as CSV" }).click();
  const csv = (await readFile(await (await download).path(), "utf8")).trim().split("\n").slice(1);
  const single = (text) => (text === "" ? null : Math.fround(Number(text))); // one number may be written in two ways
  assert.deepEqual(csv.map((line) => single(line.split(",")[4])), lines.map((line) => single(line[4])));
  assert.deepEqual(await seriousViolations(page), []);

  // Across and along: one click each.
  for (const tool of ["Section across", "Section along"]) {
    await page.getByText(tool, { exact: true }).click();
    const summary = await page.locator(".section-panel p").first().textContent();
    await page.locator(".map-top").click();
    await soon(`${tool} is shown`, async () => (await page.locator(".section-panel p").first().textContent()) !== summary);
  }
  await close();
});

test("measuring on the step gauge: distance and depth within a grid cell", async () => {
  const { page, close } = await openMap(gaugeRun);
  const { features, ...grid } = JSON.parse(await readFile(path.join(gauge.truth, "surface.json"), "utf8"));
  const steps = features.filter(({ kind, height_mm, height }) => /step/.test(kind ?? "") || height_mm !== undefined || height !== undefined);
  assert.ok(steps.length > 0, `the scene names its steps: ${JSON.stringify(features).slice(0, 300)} ${Object.keys(grid)}`);
  await page.getByText("Measure", { exact: true }).click();
  const { depth_map: map } = await getJson(server, `/api/jobs/${gaugeRun.job.id}/products/manifest.json`);
  const places = [[0.35, 0.1], [0.35, 0.9], [0.62, 0.33]].map(([across, down]) => [map.x0_mm + across * map.width_px * map.mm_per_px, map.y0_mm + down * map.height_px * map.mm_per_px]);
  const expected = await truth(gaugeRun, gauge.folder, places);
  for (const [from, to] of [[0, 1], [1, 2]]) {
    for (const at of [from, to]) {
      const { x, y } = await onPage(page, ...places[at]);
      await page.mouse.click(x, y);
    }
    const of = async (name) => Number(await page.locator(".measured dl div", { hasText: name }).locator("dd").getAttribute("data-mm"));
    await soon("the depths are known", async () => (await page.locator(".measured dl div", { hasText: "Straight" }).count()) === 1);
    const [dx, dy] = [places[to][0] - places[from][0], places[to][1] - places[from][1]];
    // A click hits a pixel of the screen: half of one at each end, in mm.
    const screen_mm = await page.locator(".map-top").evaluate((element) => element.striaMap.view.mm_per_css_px);
    assert.ok(Math.abs((await of("Distance")) - Math.hypot(dx, dy)) <= map.mm_per_px + screen_mm, "the distance");
    assert.ok(Math.abs((await of("Difference in depth")) - (expected[to] - expected[from])) <= map.mm_per_px, "the depth");
  }
  await keepPicture(page, "measured");
  await page.getByRole("button", { name: "Clear" }).click();
  assert.equal(await page.locator(".measured").count(), 0);
  await close();
});

test("layers fade into each other and the colours' range can be set", async () => {
  const { page, close } = await openMap(pipeRun);
  const middle = () =>
    page.locator(".map-base").evaluate((canvas) => {
      const { data } = canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height * 0.62, 1, 1);
      return [...data.slice(0, 3)];
    });
  // Chromium may draw a canvas anew once it has been read often: a step of brightness is no other colour.
  const same = (a, b) => a.every((part, at) => Math.abs(part - b[at]) <= 2);
  const saturation = (rgb) => Math.max(...rgb) - Math.min(...rgb);
  const depth = await middle();
  assert.ok(saturation(depth) > 30, `depth is coloured: ${depth}`);
  await page.getByText("Relief", { exact: true }).first().click();
  const relief = await soon("the relief is gray", async () => {
    const now = await middle();
    return saturation(now) < 6 && now;
  });
  await page.getByText("Image", { exact: true }).click();
  await mapSettled(page);
  const image = await soon("the image is shown", async () => {
    const now = await middle();
    return !same(now, relief) && now;
  });
  await page.getByLabel("Fade to image").fill("0.5");
  await page.getByText("Depth", { exact: true }).first().click();
  let now = null;
  await soon(`depth is back: ${depth}`, async () => same((now = await middle()), depth)).catch((error) => assert.fail(`${error.message}, not ${now}`));
  await page.getByLabel("nearest, mm").fill("100");
  await page.getByLabel("nearest, mm").press("Enter");
  await soon("another range, another colour", async () => !same(await middle(), depth));
  await page.getByRole("button", { name: "Auto" }).click();
  await soon("the automatic range again", async () => same(await middle(), depth));
  assert.ok(!same(image, depth), `the image is not the depth: ${image}`);
  await close();
});

test("a link restores place, zoom, layer, range and section", async () => {
  const { page, close } = await openMap(gaugeRun);
  await page.getByText("Image", { exact: true }).click();
  await page.getByRole("button", { name: "Zoom in" }).click();
  const box = await page.locator(".map-top").boundingBox();
  await page.mouse.move(box.x + 400, box.y + 200);
  await page.mouse.down();
  await page.mouse.move(box.x + 300, box.y + 230, { steps: 4 });
  await page.mouse.up();
  await page.getByText("Section across", { exact: true }).click();
  await page.mouse.click(box.x + 500, box.y + 250);
  await page.getByLabel("farthest, mm").fill("470");
  await page.getByLabel("farthest, mm").press("Enter");
  await soon("the address says all of it", () => ["at=", "look=", "range=", "cut="].every((word) => page.url().includes(word)));
  const view = await page.locator(".map-top").evaluate((element) => element.striaMap.view);
  const other = await openPage(browser, server);
  await other.page.goto(page.url());
  await mapSettled(other.page);
  const restored = await other.page.locator(".map-top").evaluate((element) => element.striaMap.view);
  for (const name of ["x_mm", "y_mm", "mm_per_css_px"]) assert.ok(Math.abs(restored[name] - view[name]) <= Math.max(0.06, Math.abs(view[name]) * 1e-3), `${name}: ${restored[name]} for ${view[name]}`);
  assert.equal(await other.page.getByLabel("farthest, mm").inputValue(), "470");
  assert.equal(await other.page.getByRole("radio", { name: "Image" }).isChecked(), true);
  await other.page.getByRole("heading", { name: "Cross-section" }).waitFor();
  await other.close();
  await close();
});

test("the map works by keyboard alone", async () => {
  const { page, close } = await openMap(gaugeRun);
  const map = page.getByRole("application", { name: /Map of the wall/ });
  const view = () => map.evaluate((element) => ({ ...element.striaMap.view }));
  await map.focus();
  const before = await view();
  await page.keyboard.press("+");
  await page.keyboard.press("ArrowRight");
  const moved = await view();
  assert.ok(moved.mm_per_css_px < before.mm_per_css_px && moved.x_mm > before.x_mm);
  await page.getByRole("radio", { name: "Measure" }).focus();
  await page.keyboard.press("Space");
  await map.focus();
  await page.keyboard.press("Enter");
  await page.keyboard.press("ArrowDown");
  await page.keyboard.press("Enter");
  await page.getByRole("region", { name: "Measured" }).getByText("Distance").waitFor();
  await page.keyboard.press("0");
  assert.ok(Math.abs((await view()).mm_per_css_px - before.mm_per_css_px) < 1e-9);
  await close();
});
