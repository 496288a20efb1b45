// What the browser tests share: a server of their own, a simulated run, a browser that watches over every request.

import assert from "node:assert/strict";
import { execFile, spawn } from "node:child_process";
import { existsSync, readFileSync } from "node:fs";
import { mkdtemp, readFile, rm, writeFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { connect, createServer } from "node:net";
import { tmpdir } from "node:os";
import path from "node:path";
import { setTimeout as sleep } from "node:timers/promises";
import { fileURLToPath } from "node:url";
import { promisify } from "node:util";
import { chromium } from "playwright-core";

const repository = path.resolve(path.dirname(fileURLToPath(import.meta.url)), "../..");
const stria = process.env.STRIA_BIN ?? path.join(repository, "target/release/stria");
const chromiumPath = process.env.CHROMIUM_BIN ?? "/usr/bin/chromium";

/** Where screenshots go, for people to look at. */
const pictures = process.env.STRIA_PICTURES ?? path.join(repository, "target/browser");

const READY_MS = 60_000;

/** How long a page may take for what it does by itself: far more than it needs, for tests run on slow machines as well and never measure time. */
const SOON_MS = 60_000;

/**
 * Starts `stria serve` on a free port with an empty data folder; `stop` ends it and checks that it was still well. `locked`: with its
 * doors shut, as it is by default; `loginUrl` is what it printed, `newLogin` asks for another, `login` answers a program's headers.
 */
export async function startServer(flags = [], { locked = false } = {}) {
  need(stria, "run `make build`, or set STRIA_BIN");
  const folder = await mkdtemp(path.join(tmpdir(), "stria-browser-"));
  const url = `http://127.0.0.1:${await freePort()}`;
  const data = path.join(folder, "data");
  const child = spawn(stria, ["serve", "--listen", new URL(url).host, "--data", data, ...(locked ? [] : ["--without-authentication"]), ...flags], { stdio: ["ignore", "pipe", "pipe"] });
  let said = "";
  for (const stream of [child.stdout, child.stderr]) stream.on("data", (bytes) => (said += bytes));
  const ended = new Promise((done) => child.once("exit", (code, signal) => done(signal ?? code)));
  let gone = false;
  void ended.then(() => (gone = true));
  await until(`${stria} serve answers at ${url}`, READY_MS, async () => {
    assert.ok(!gone, `stria serve ended at once:\n${said}`);
    return (await fetch(`${url}/readyz`).catch(() => null))?.ok;
  });
  const stop = async () => {
    const well = !gone && (await fetch(`${url}/livez`).catch(() => null))?.ok;
    child.kill("SIGTERM");
    const end = await Promise.race([ended, sleep(10_000, "still running 10 s after SIGTERM", { ref: false })]);
    if (!gone) child.kill("SIGKILL");
    await rm(folder, { recursive: true, force: true });
    assert.ok(well, `the server no longer answered:\n${said}`);
    assert.equal(end, 0, `stria serve ended with ${end}:\n${said}`);
  };
  const command = async (...words) => (await promisify(execFile)(stria, ["token", ...words, "--data", data])).stdout;
  const newLogin = async () => new URL(/login\?code=\S+/.exec(await command("login"))[0], url);
  const login = async () => ({ authorization: `Bearer ${(await command("create", "test", "--scopes", "admin")).trim()}` });
  const loginUrl = locked && (await until("the server says where to log in", READY_MS, async () => /http\S+login\?code=\S+/.exec(said)?.[0]));
  return { url, stop, loginUrl, newLogin, login };
}

/** Makes a realistic run in a new folder: its video, its rig. `remove` takes the folder away. */
export async function simulate({ scene = "pipe", seconds = 2, size = "640x360", seed = 1, more = [] } = {}) {
  need(stria, "run `make build`, or set STRIA_BIN");
  const folder = await mkdtemp(path.join(tmpdir(), "stria-run-"));
  const out = path.join(folder, "run");
  await promisify(execFile)(stria, ["simulate", scene, "--out", out, "--seconds", `${seconds}`, "--size", size, "--seed", `${seed}`, ...more]);
  return {
    folder,
    video: path.join(out, "video.mp4"),
    rig: path.join(out, "rig.toml"),
    truth: path.join(out, "truth"),
    remove: () => rm(folder, { recursive: true, force: true }),
  };
}

/** A rig file like `rig` but for images of twice the width. */
export async function rigForOtherSize(rig, folder) {
  const text = await readFile(rig, "utf8");
  const other = text.replace(/^(\s*width_px\s*=\s*)(\d+)/m, (_, key, width) => `${key}${2 * Number(width)}`);
  assert.notEqual(other, text, "the rig file names its width");
  const file = path.join(folder, "other-size.toml");
  await writeFile(file, other);
  return file;
}

/**
 * Starts Chromium with a fresh profile; WebGL is drawn in software, so that it works on any machine. `plain`: without
 * WebGL, as Chromium itself runs where there is no graphics card: everything else is then drawn several times as fast.
 */
export async function startBrowser({ plain = false, flags = [] } = {}) {
  need(chromiumPath, "run `make setup`, which installs Chromium, or set CHROMIUM_BIN");
  const quiet = ["--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"];
  // A test looks at the memory of a tab, and at the clock: nothing may slow a page because nobody sees it.
  const awake = ["--disable-background-timer-throttling", "--disable-renderer-backgrounding", "--disable-backgrounding-occluded-windows"];
  const webgl = plain ? ["--disable-gpu"] : ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
  return chromium.launch({ executablePath: chromiumPath, args: ["--no-sandbox", ...quiet, ...awake, ...webgl, ...flags] });
}

/**
 * Opens a page. What must never happen is collected: a request to another host, something that the content security
 * policy had to stop, an error in a script. `close` closes the page and fails where there was any.
 */
export async function openPage(browser, server, options = {}) {
  const context = await browser.newContext({ baseURL: server.url, viewport: { width: 1440, height: 900 }, ...options });
  const violations = [];
  context.on("request", (request) => {
    const { protocol, origin } = new URL(request.url());
    if (origin !== server.url && protocol !== "blob:" && protocol !== "data:") violations.push(`request to ${request.url()}`);
  });
  context.on("console", (message) => {
    if (/content security policy|refused to/i.test(message.text())) violations.push(`console: ${message.text()}`);
  });
  context.on("weberror", (error) => violations.push(`error in a script: ${error.error().stack}`));
  context.setDefaultTimeout(SOON_MS);
  const page = await context.newPage();
  const close = async () => {
    await context.close();
    assert.deepEqual(violations, []);
  };
  return { page, context, close };
}

/**
 * The same server by a way that can go deaf: `deafen` leaves every connection of now open and lets nothing more through it, as a
 * laptop finds them when it wakes up; new ones work.
 */
export async function throughDeafWay(server) {
  const pairs = new Set();
  const way = createServer((near) => {
    const far = connect(new URL(server.url).port, "127.0.0.1");
    const pair = [near, far];
    pairs.add(pair);
    near.pipe(far);
    far.pipe(near);
    for (const end of pair) {
      end.on("error", () => pair.forEach((each) => each.destroy()));
      end.on("close", () => pairs.delete(pair));
    }
  });
  await new Promise((done) => way.listen(0, "127.0.0.1", done));
  const deafen = () => {
    for (const [near, far] of pairs) {
      near.unpipe(far).pause();
      far.unpipe(near).pause();
    }
    return pairs.size;
  };
  const stop = () => {
    pairs.forEach((pair) => pair.forEach((end) => end.destroy()));
    way.close();
  };
  return { url: `http://127.0.0.1:${way.address().port}`, deafen, stop };
}

/** Asks until it is true or there is a value; fails after a time, naming what it waited for. */
export async function until(what, withinMs, ask) {
  const end = Date.now() + withinMs;
  for (;;) {
    const answer = await ask();
    if (answer) return answer;
    if (Date.now() > end) assert.fail(`waited ${withinMs / 1000} s in vain: ${what}`);
    await sleep(50);
  }
}

/** What a page does by itself, without a job to wait for: asks until it is there. */
export const soon = (what, ask) => until(what, SOON_MS, ask);

/** JSON from the server, past the browser. */
export async function getJson(server, address) {
  const response = await fetch(new URL(address, server.url));
  assert.ok(response.ok, `${address}: HTTP ${response.status}`);
  return response.json();
}

/** Sends a run past the browser, in one request; answers it as the server shows it. */
export async function sendRun(server, run, fields = {}) {
  const form = new FormData();
  for (const [name, value] of Object.entries({ asset: "test wall", rig: await readFile(run.rig, "utf8"), ...fields })) form.append(name, value);
  form.append("file", new Blob([await readFile(run.video)]), fields.filename ?? path.basename(run.video));
  const response = await fetch(new URL("/api/runs", server.url), { method: "POST", body: form });
  assert.equal(response.status, 201, await response.clone().text());
  return response.json();
}

/** Waits for a job's end; answers the job. */
export async function jobEnds(server, job, state = "done") {
  const ended = await until(`job ${job} ends`, 180_000, async () => {
    const now = await getJson(server, `/api/jobs/${job}`);
    return !["queued", "running"].includes(now.state) && now;
  });
  assert.equal(ended.state, state, JSON.stringify(ended.error));
  return ended;
}

/**
 * A robot that walks at a share of its pace and streams what it sees, so that the run outlasts a test however fast the machine is;
 * `stop` ends it.
 */
export async function walk(server, run, stream, fields, pace = 0.5) {
  const rig = await readFile(run.rig, "utf8");
  const address = new URL(`/api/live/${stream}?${new URLSearchParams({ rig, ...fields })}`, server.url);
  const quiet = ["-hide_banner", "-loglevel", "error", "-nostdin"];
  const robot = spawn("ffmpeg", [...quiet, "-readrate", `${pace}`, "-i", run.video, "-q:v", "3", "-f", "mpjpeg", "-method", "POST", address.href]);
  const ended = new Promise((done, fail) => robot.once("exit", done).once("error", (error) => fail(new Error(`ffmpeg, which \`make setup\` installs: ${error.message}`))));
  const known = await Promise.race([ended.then(() => assert.fail("ffmpeg ended at once")), soon("the robot is seen", async () => (await getJson(server, "/api/live")).items.find((item) => item.stream === stream))]);
  const stop = async () => {
    robot.kill("SIGKILL");
    await ended;
  };
  return { run: known.run, job: known.job, stop };
}

/** A finished run. */
export async function measuredRun(server, run, fields = {}) {
  const sent = await sendRun(server, run, fields);
  await jobEnds(server, sent.job.id);
  return getJson(server, `/api/runs/${sent.id}`);
}

/** From now on the page has the link of a site: 2 Mbit/s, 150 ms from end to end and back. */
export async function thinLink(page) {
  const session = await page.context().newCDPSession(page);
  await session.send("Network.enable");
  const bytesPerS = 2_000_000 / 8;
  await session.send("Network.emulateNetworkConditions", { offline: false, latency: 150, downloadThroughput: bytesPerS, uploadThroughput: bytesPerS });
  return session;
}

const axe = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");

/** What axe-core finds serious or critical on the page as it is. */
export async function seriousViolations(page) {
  if (!(await page.evaluate(() => "axe" in globalThis))) await page.evaluate(axe); // past the content security policy, as the developer tools are
  const { violations } = await page.evaluate(() => globalThis.axe.run(document, { resultTypes: ["violations"] }));
  return violations
    .filter(({ impact }) => impact === "serious" || impact === "critical")
    .map(({ id, help, nodes }) => `${id}: ${help}: ${nodes.map(({ html }) => html.slice(0, 160)).join(" | ")}`);
}

/** The answer of one of the readers in tests/readers, which take files that we wrote apart with programs that we did not. */
export async function readWith(script, ...files) {
  const python = path.join(repository, "target/python/bin/python");
  need(python, "run `make setup`");
  const { stdout } = await promisify(execFile)(python, [path.join(repository, "tests/readers", script), ...files], { maxBuffer: 1 << 28 });
  return JSON.parse(stdout);
}

/** A product of a job in a file. */
export async function fetchProduct(server, job, name, folder) {
  const response = await fetch(new URL(`/api/jobs/${job}/products/${name}`, server.url));
  assert.ok(response.ok, `${name}: HTTP ${response.status}`);
  const file = path.join(folder, name);
  await writeFile(file, Buffer.from(await response.arrayBuffer()));
  return file;
}

/** The map on the page shows all that is in view, sharp. */
export async function mapSettled(page, within = page) {
  await within.locator(".map-top[data-ready]").first().waitFor();
  await within.locator(".map-loading[data-settled=true]").first().waitFor({ state: "attached" });
}

/** Where a place of the world is on the page, and the other way round: from the map's own view. */
export async function onPage(page, x_mm, y_mm) {
  const map = page.locator(".map-top").first();
  const box = await map.boundingBox();
  const view = await map.evaluate((element) => element.striaMap.view);
  return { x: box.x + box.width / 2 + (x_mm - view.x_mm) / view.mm_per_css_px, y: box.y + box.height / 2 + (y_mm - view.y_mm) / view.mm_per_css_px };
}

/** Lets files go over an element, as a person who drags them from a file manager. */
export async function dropFiles(page, target, files) {
  const contents = await Promise.all(files.map(async (file) => ({ name: path.basename(file), base64: (await readFile(file)).toString("base64") })));
  const transfer = await page.evaluateHandle((all) => {
    const data = new DataTransfer();
    for (const { name, base64 } of all) data.items.add(new File([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))], name));
    return data;
  }, contents);
  for (const event of ["dragenter", "dragover", "drop"]) await target.dispatchEvent(event, { dataTransfer: transfer });
}

/** Keeps a picture of the page or of a part of it for people to look at. */
export async function keepPicture(target, name) {
  return target.screenshot({ path: path.join(pictures, `${name}.png`), ...("goto" in target ? { fullPage: true } : {}) });
}

function need(file, otherwise) {
  assert.ok(existsSync(file), `${file} is missing: ${otherwise}`);
}

/** A port that was free a moment ago. */
function freePort() {
  return new Promise((done, failed) => {
    const probe = createServer();
    probe.once("error", failed);
    probe.listen(0, "127.0.0.1", () => {
      const { port } = probe.address();
      probe.close(() => done(port));
    });
  });
}
