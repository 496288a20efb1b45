// A map of 100,000 × 1,500 px: it pans and zooms, and the tab stays small. The tiles come from a formula, made here and not by Stria,
// so that the run need not be simulated for an hour and every value is known.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { after, before, test } from "node:test";
import { deflateSync, crc32 } from "node:zlib";
import { keepPicture, mapSettled, measuredRun, onPage, openPage, simulate, startBrowser, startServer } from "./support.mjs";

const [WIDTH, HEIGHT, SIDE, MM] = [100_000, 1_500, 256, 0.5];
const LEVELS = Math.ceil(Math.log2(Math.ceil(WIDTH / SIDE))) + 1;
const MOST_MB = 400;
let server, browser, small, run;

before(async () => {
  [server, small, browser] = [await startServer(), await simulate({ seconds: 1, size: "320x240" }), await startBrowser({ plain: true })];
  run = await measuredRun(server, small);
});
after(async () => {
  await browser?.close();
  await small?.remove();
  await server?.stop();
});

/** Depth of a pixel of level 0, mm, in steps of the tiles; deterministic noise, so that no two tiles squeeze the same. */
function depth(column, row) {
  const noise = (Math.imul(column, 73856093) ^ Math.imul(row, 19349663)) & 255;
  return Math.round((850 + 15 * Math.sin(column / 130) * Math.cos(row / 170) + noise / 1000) * 1000) / 1000;
}

function tile(level, tileColumn, tileRow) {
  const scale = 2 ** level;
  const raw = Buffer.alloc(SIDE * (1 + 3 * SIDE));
  for (let y = 0; y < SIDE; y += 1) {
    for (let x = 0; x < SIDE; x += 1) {
      const [column, row] = [(tileColumn * SIDE + x) * scale, (tileRow * SIDE + y) * scale];
      if (column >= WIDTH || row >= HEIGHT) continue;
      raw.writeUIntBE(Math.round((depth(column, row) + 4000) * 1000), y * (1 + 3 * SIDE) + 1 + 3 * x, 3);
    }
  }
  const chunk = (kind, data) => {
    const body = Buffer.concat([Buffer.from(kind, "latin1"), data]);
    const [length, check] = [Buffer.alloc(4), Buffer.alloc(4)];
    length.writeUInt32BE(data.length);
    check.writeUInt32BE(crc32(body));
    return Buffer.concat([length, body, check]);
  };
  const head = Buffer.alloc(13);
  head.writeUInt32BE(SIDE, 0);
  head.writeUInt32BE(SIDE, 4);
  head.set([8, 2, 0, 0, 0], 8);
  return Buffer.concat([Buffer.from([137, 80, 78, 71, 13, 10, 26, 10]), chunk("IHDR", head), chunk("IDAT", deflateSync(raw, { level: 1 })), chunk("IEND", Buffer.alloc(0))]);
}

function index() {
  const last = (size, level) => Math.floor((size - 1) / SIDE) >> level;
  const levels = Array.from({ length: LEVELS }, (_, level) => ({ level, mm_per_px: MM * 2 ** level, first_column: 0, last_column: last(WIDTH, level), first_row: 0, last_row: last(HEIGHT, level) }));
  return {
    schema_version: 1, complete: true, tile_side_px: SIDE, grid: { x0_mm: 0, y0_mm: 0, mm_per_px: MM }, depth_step_mm: 0.001, depth_offset_mm: -4000,
    depth_range_mm: [835, 865], levels, depth_map: { x0_mm: 0, y0_mm: 0, mm_per_px: MM, width_px: WIDTH, height_px: HEIGHT }, revision: 1, changed: [],
  };
}

/** Memory of the page's own process, MB: what only it holds and its part of what is shared. */
async function tabMegabytes(pids) {
  let kilobytes = 0;
  for (const pid of pids) {
    const text = await readFile(`/proc/${pid}/smaps_rollup`, "utf8").catch(() => "");
    kilobytes += Number(/^Pss:\s+(\d+)/m.exec(text)?.[1] ?? 0);
  }
  return kilobytes / 1024;
}

/** Runs in the page: drags the map for some seconds, a move a frame; how many pictures the map drew, and in what time. */
async function drag(map) {
  const [{ left, top, width, height }, moves] = [map.getBoundingClientRect(), 120];
  const at = (type, share) =>
    map.dispatchEvent(new PointerEvent(type, { pointerId: 1, button: 0, buttons: 1, bubbles: true, clientX: left + width * share, clientY: top + height * (0.5 + 0.05 * share) }));
  map.setPointerCapture = () => undefined; // no real pointer is down
  const [before, start] = [map.striaMap.frames, performance.now()];
  for (let turn = 0; turn < moves; turn += 1) {
    const share = 0.9 - 0.8 * ((turn % 40) / 39);
    if (turn % 40 === 0) at("pointerdown", share);
    at("pointermove", share);
    if (turn % 40 === 39) at("pointerup", share);
    await new Promise(requestAnimationFrame);
  }
  return { moves, drawn: map.striaMap.frames - before, seconds: (performance.now() - start) / 1000 };
}

test("100,000 × 1,500 px pan and zoom smoothly in a small tab, and the value under the cursor is right", async (t) => {
  const { page, close } = await openPage(browser, server);
  await page.route("**/tiles/tiles.json", (route) => route.fulfill({ json: index() }));
  await page.route(/\/tiles\/depth\//, (route) => {
    const [, level, column, row] = /depth\/(\d+)\/(-?\d+)_(-?\d+)\.png/.exec(route.request().url());
    return route.fulfill({ body: tile(Number(level), Number(column), Number(row)), contentType: "image/png" });
  });
  const session = await browser.newBrowserCDPSession();
  await page.goto(`/runs/${run.id}`);
  await mapSettled(page);
  await keepPicture(page, "big-map");
  const renderers = (await session.send("SystemInfo.getProcessInfo")).processInfo.filter(({ type }) => type === "renderer").map(({ id }) => id);
  const box = await page.locator(".map-top").boundingBox();
  let most = 0;
  const rates = [];
  // A person at work: along the wall, closer, along, back out. The hand is the page's own, so that nothing but the page sets the pace.
  for (const zoom of [0, 900, 900, -1400, -800]) {
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    for (let step = 0; step < 12 && zoom !== 0; step += 1) await page.mouse.wheel(0, -zoom / 12);
    rates.push(await page.locator(".map-top").evaluate(drag));
    most = Math.max(most, await tabMegabytes(renderers));
  }
  await page.getByRole("button", { name: "Whole map" }).click();
  await mapSettled(page);
  await keepPicture(page, "big-map-whole");
  most = Math.max(most, await tabMegabytes(renderers));
  t.diagnostic(`pictures a second while dragging: ${rates.map(({ drawn, seconds }) => (drawn / seconds).toFixed(0)).join(", ")}; ${most.toFixed(0)} MB at most`);
  assert.ok(most > 20, "the memory was read");
  assert.ok(most < MOST_MB, `${most.toFixed(0)} MB`);
  for (const { drawn, moves } of rates) assert.ok(drawn > moves * 0.8, `${drawn} pictures for ${moves} moves of the hand`);

  for (const [column, row] of [[77_123, 411], [12_345, 1_099], [99_990, 3]]) {
    const middle = [column * MM, row * MM];
    await page.goto(`/runs/${run.id}?at=${middle[0]},${middle[1]},0.5`);
    await mapSettled(page);
    const { x, y } = await onPage(page, ...middle);
    await page.mouse.move(x, y);
    const value = page.locator(".readout .depth dd[data-z]");
    await value.waitFor();
    const found = await value.evaluate((element) => ({ ...element.dataset }));
    const expected = depth(Math.round(Number(found.x) / MM), Math.round(Number(found.y) / MM));
    assert.ok(Math.abs(Number(found.z) - expected) < 0.0006, `${found.z} for ${expected}`);
  }
  await close();
});
