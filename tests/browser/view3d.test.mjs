// The 3D view shows the measured surface: pixels on the canvas that are there with it and not without it.

import assert from "node:assert/strict";
import { execFile } from "node:child_process";
import { existsSync } from "node:fs";
import { readFile } from "node:fs/promises";
import path from "node:path";
import { after, before, test } from "node:test";
import { setTimeout as sleep } from "node:timers/promises";
import { fileURLToPath } from "node:url";
import { promisify } from "node:util";
import { fetchProduct, getJson, jobEnds, keepPicture, openPage, sendRun, simulate, soon, startBrowser, startServer, until, walk } from "./support.mjs";

const rerun = path.resolve(path.dirname(fileURLToPath(import.meta.url)), "../../target/python/bin/rerun");
const DONE_MS = 120_000;

/** Share of the 3D view's pixels that the surface must colour, and how many times more than stand there without it. */
const SURFACE_SHARE = 0.02;
const SURFACE_TIMES = 5;
/** Share of the viewer's canvas that the pictures in an archive must make. */
const PICTURES_SHARE = 0.1;
/** And what its surface must make of it: the view of the space is a part of the layout, and seen from afar. */
const CLOUD_SHARE = 0.005;

let server, browser;

before(async () => {
  assert.ok(existsSync(rerun), `${rerun} is missing: run \`make setup\``);
  [server, browser] = await Promise.all([startServer(["--live-come-back-s", "2"]), startBrowser()]);
});
after(async () => {
  await browser?.close();
  await server?.stop();
});

test("a finished run: the surface is on the canvas, and its pixels are the surface's", async () => {
  const run = await simulate();
  const { page, close } = await openPage(browser, server);
  await jobEnds(server, (await send(page, run)).job.id);
  await page.getByRole("tab", { name: "Files" }).waitFor({ timeout: DONE_MS });
  const address = page.url();
  assert.equal(await page.locator("canvas").count(), 0, "nothing of the viewer is there before it is asked for");

  await page.getByRole("button", { name: "Open 3D view" }).click();
  await page.getByText("The whole recording is shown").waitFor({ timeout: DONE_MS });
  const withSurface = await settledShare(page);
  await keepPicture(page.locator(".view").first(), "view3d");

  const show = async (recording) => {
    await page.route("**/recording/*", (route) => route.fulfill({ body: recording, contentType: "application/octet-stream" }));
    await page.route("**/recording", (route) =>
      route.fulfill({ json: { segments: [{ number: 0, generation: 1, bytes: recording.length, url: "/recording/0" }], complete: true, recording: null } }),
    );
    await page.goto(address);
    await page.getByRole("button", { name: "Open 3D view" }).click();
    await page.getByText("The whole recording is shown").waitFor({ timeout: DONE_MS });
    return settledShare(page);
  };
  // The same recording without the surface's points must look different just there.
  const { items } = await getJson(server, `/api/runs?limit=1`);
  const whole = await fetchProduct(server, items[0].job.id, "recording.rrd", run.folder);
  const bareShare = await show(await without(["/world/surface"], whole));
  await keepPicture(page.locator(".view").first(), "view3d-without-surface");

  const shares = `coloured share of the 3D view: ${withSurface.toFixed(4)} with the surface, ${bareShare.toFixed(4)} without`;
  assert.ok(withSurface > SURFACE_SHARE, shares);
  assert.ok(withSurface > SURFACE_TIMES * bareShare, shares);

  // The archive, made a recording by rerun's own tool, is shown by the same viewer: the camera's video and the depth map.
  const archive = await fetchProduct(server, items[0].job.id, "archive.mcap", run.folder);
  const converted = path.join(run.folder, "converted.rrd");
  await promisify(execFile)(rerun, ["mcap", "convert", archive, "-o", converted]);
  await show(await readFile(converted));
  const shown = await keepPicture(page.locator(".view").first(), "view3d-archive");
  await show(await without(["/camera/video", "/depth_map/image"], converted));
  const bare = await keepPicture(page.locator(".view").first(), "view3d-archive-without-pictures");
  const share = await differenceOf(page, shown, bare);
  assert.ok(share > PICTURES_SHARE, `share of the view that the archive's pictures make: ${share}`);
  // In rerun's own layout the surface stands in the view of the space.
  await show(await without(["/surface", "/surface/overview", "/profile"], converted));
  const flat = await keepPicture(page.locator(".view").first(), "view3d-archive-without-surface");
  const cloudShare = await differenceOf(page, shown, flat);
  assert.ok(cloudShare > CLOUD_SHARE, `share of the view that the archive's surface makes: ${cloudShare}`);
  await run.remove();
  await close();
});

test("a run that is being measured: the surface is on the canvas before the job has ended", async () => {
  const run = await simulate({ seconds: 30 });
  const robot = await walk(server, run, "walker", { asset: "seen in 3D" });
  const { page, close } = await openPage(browser, server);
  await page.goto(`/runs/${robot.run}?tab=space`);
  await page.getByRole("button", { name: "Open 3D view" }).click();
  await page.getByText(/^Live: \d+ parts? received/).waitFor({ timeout: DONE_MS });
  const share = await until("the surface shows while the job runs", DONE_MS, async () => {
    const now = await colouredShare(page);
    const { job } = await getJson(server, `/api/runs/${robot.run}`);
    assert.equal(job.state, "running", `the job ended before its surface was seen (share ${now})`);
    return now > SURFACE_SHARE / 4 && now;
  });
  assert.ok(share > 0);
  await keepPicture(page.locator(".view").first(), "view3d-live");
  await robot.stop();
  await page.getByText("The whole recording is shown").waitFor({ timeout: DONE_MS });
  await run.remove();
  await close();
});

test("a long run has a recording of each stretch: one is chosen by chainage, the address keeps it, only it is loaded", async () => {
  const run = await simulate({ seconds: 3 });
  const recipe = "[recording]\nbudget_mb = 5.0\nstretch_m = 0.15\nimages_per_s = 240.0\npoints_per_profile = 8192\n";
  const sent = await sendRun(server, run, { asset: "long main", recipe, chainage_mm: "500", direction: "backward" });
  await jobEnds(server, sent.job.id);
  const { recordings } = await getJson(server, `/api/jobs/${sent.job.id}/products/manifest.json`);
  assert.ok(recordings.length >= 3, "the recipe makes this run a long one");
  const { page, close } = await openPage(browser, server);
  const asked = [];
  page.on("request", (request) => asked.push(new URL(request.url()).pathname.split("/").at(-1)));
  await page.goto(`/runs/${sent.id}?tab=space&stretch=2`);
  const choice = page.getByLabel("Part of the run");
  await choice.waitFor();
  assert.equal(await choice.locator("option").count(), recordings.length + 1);
  // The chainage falls along this run.
  const ends = [500 - recordings[1].to_x_mm, 500 - recordings[1].from_x_mm].map((mm) => `${Math.round(mm)}\u00a0mm`);
  assert.equal(await choice.locator("option:checked").textContent(), ends.join(" to "));
  await page.getByRole("button", { name: "Open 3D view" }).click();
  await page.getByText("This part of the run is shown, with every step.").waitFor({ timeout: DONE_MS });
  assert.deepEqual(asked.filter((name) => name.endsWith(".rrd") || name === "recording"), [recordings[1].name]);
  await choice.selectOption({ index: 3 });
  await page.getByText("This part of the run is shown, with every step.").waitFor({ timeout: DONE_MS });
  await soon("the third is loaded", async () => asked.includes(recordings[2].name));
  assert.match(page.url(), /[?&]stretch=3/);
  await page.reload();
  await choice.waitFor();
  assert.equal(await choice.inputValue(), "3");
  await choice.selectOption({ label: "The whole run, thinned out" });
  assert.ok(!page.url().includes("stretch"));
  await run.remove();
  await close();
});

test("the keyboard gets out of the 3D view, and it closes and opens again", async () => {
  const run = await simulate();
  const { page, close } = await openPage(browser, server);
  await jobEnds(server, (await send(page, run)).job.id);
  await page.getByRole("tab", { name: "Files" }).waitFor({ timeout: DONE_MS });
  for (let round = 0; round < 2; round += 1) {
    await page.getByRole("button", { name: "Open 3D view" }).click();
    await page.getByText("The whole recording is shown").waitFor({ timeout: DONE_MS });
    await page.locator("canvas").click();
    await page.keyboard.press("Escape");
    assert.equal(await page.evaluate(() => document.activeElement?.textContent), "Close 3D view");
    await page.keyboard.press("Enter");
    await page.locator("canvas").waitFor({ state: "detached" });
  }
  await run.remove();
  await close();
});

/** Sends a run and opens its 3D part. */
async function send(page, run) {
  const sent = await sendRun(server, run, { asset: "seen in 3D" });
  await page.goto(`/runs/${sent.id}?tab=space`);
  return sent;
}

/** A recording with some of its entities taken out, by rerun's own tool. */
async function without(entities, recording) {
  const bare = `${recording}.bare.rrd`;
  await promisify(execFile)(rerun, ["rrd", "filter", ...entities.flatMap((entity) => ["--drop-entity", entity]), "-o", bare, recording]);
  return readFile(bare);
}

/** Share of the pixels that differ clearly between two pictures of the same size. */
async function differenceOf(page, ...pictures) {
  return page.evaluate(async (base64) => {
    const read = async (text) => {
      const image = await createImageBitmap(new Blob([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], { type: "image/png" }));
      const context = new OffscreenCanvas(image.width, image.height).getContext("2d");
      context.drawImage(image, 0, 0);
      return context.getImageData(0, 0, image.width, image.height).data;
    };
    const [one, other] = await Promise.all(base64.map(read));
    let different = 0;
    for (let at = 0; at < one.length; at += 4) different += Number(Math.max(...[0, 1, 2].map((of) => Math.abs(one[at + of] - other[at + of]))) > 50);
    return different / (one.length / 4);
  }, pictures.map((picture) => picture.toString("base64")));
}

/** The coloured share once it has stopped changing. */
async function settledShare(page) {
  let before = -1;
  for (let turn = 0; turn < 30; turn += 1) {
    await sleep(700);
    const now = await colouredShare(page);
    if (before >= 0 && Math.abs(now - before) < 0.002 && turn >= 3) return now;
    before = now;
  }
  return before;
}

/**
 * Share of the pixels with a strong colour in the 3D view, which the recording's layout puts at the top left. The
 * surface is drawn from red over yellow and green to blue; ground, grid and letters are gray or pale.
 */
async function colouredShare(page) {
  const picture = (await page.locator("canvas").screenshot()).toString("base64");
  return page.evaluate(async (base64) => {
    const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
    const image = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
    const [width, height] = [Math.floor(image.width * 0.54), Math.floor(image.height * 0.55)];
    const context = new OffscreenCanvas(width, height).getContext("2d");
    context.drawImage(image, 0, 0);
    const { data } = context.getImageData(0, 0, width, height);
    let coloured = 0;
    for (let at = 0; at < data.length; at += 4) {
      const [r, g, b] = [data[at], data[at + 1], data[at + 2]];
      if (Math.max(r, g, b) - Math.min(r, g, b) > 70) coloured += 1;
    }
    return coloured / (width * height);
  }, picture);
}

test("the light view draws the surface, turns it, and needs no viewer", async () => {
  const run = await simulate({ scene: "wall" });
  const { page, close } = await openPage(browser, server);
  await jobEnds(server, (await send(page, run)).job.id);
  const asked = [];
  page.on("request", (request) => asked.push(request.url()));
  await page.getByRole("tab", { name: "Files" }).waitFor({ timeout: DONE_MS });
  await page.getByRole("button", { name: "Open light view" }).click();
  await page.getByText(/[\d,]+ points/).waitFor();
  const canvas = page.locator(".view.light canvas");
  const drawn = () =>
    canvas.evaluate((canvas) => {
      const gl = canvas.getContext("webgl");
      const pixels = new Uint8Array(4 * canvas.width * canvas.height);
      gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      let [count, sum] = [0, 0];
      for (let at = 0; at < pixels.length; at += 4) {
        if (pixels[at + 3] === 0) continue;
        count += 1;
        sum = (sum * 31 + pixels[at] + 7 * pixels[at + 1] + at) % 1_000_003;
      }
      return { share: count / (pixels.length / 4), sum, lost: gl.isContextLost(), size: [canvas.width, canvas.height] };
    });
  const isDrawn = async (when) => {
    let last;
    const seen = soon(`points are drawn ${when}`, async () => (last = await drawn()).share > 0.1 && last);
    return seen.catch((error) => assert.fail(`${error.message}; the canvas: ${JSON.stringify(last)}`));
  };
  const first = await isDrawn("at first");
  await keepPicture(page.locator(".view.light"), "light-view");
  await canvas.press("ArrowLeft");
  await soon("it turns", async () => (await drawn()).sum !== first.sum);

  // What a driver that is reset does to every page: the picture is gone, the graphics card's memory too.
  await canvas.evaluate(
    (canvas) =>
      new Promise((lost) => {
        window.driver = canvas.getContext("webgl").getExtension("WEBGL_lose_context");
        canvas.addEventListener("webglcontextlost", () => lost(), { once: true });
        window.driver.loseContext();
      }),
  );
  assert.deepEqual([(await drawn()).lost, (await drawn()).share], [true, 0]);
  await page.evaluate(() => window.driver.restoreContext());
  await isDrawn("after the driver's reset");
  assert.ok(asked.every((url) => !url.includes("/viewer/")), "nothing of the viewer was loaded");
  await run.remove();
  await close();
});
