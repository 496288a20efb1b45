// Every page in light and dark and at three widths: nothing overflows, everything can be read and has a name; and the first page is small.

import assert from "node:assert/strict";
import { gzipSync } from "node:zlib";
import { after, before, test } from "node:test";
import { getJson, jobEnds, mapSettled, measuredRun, openPage, sendRun, simulate, soon, startBrowser, startServer } from "./support.mjs";
import { lookAround } from "./looks.mjs";

const FIRST_PAGE_BYTES = 200_000;
let server, empty, browser, run, other, first, second, batch;

before(async () => {
  [server, empty, run, other, browser] = await Promise.all([startServer(), startServer(["--workers", "0"]), simulate(), simulate({ scene: "wall", seed: 2 }), startBrowser()]);
  first = await measuredRun(server, run, { asset: "a-name-without-any-space-".repeat(6) });
  second = await measuredRun(server, other, { asset: "Sewer 12, north", chainage_mm: "12500" });
  const post = async (path, body) => (await fetch(new URL(path, server.url), { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) })).json();
  batch = await post("/api/batches", { runs: [second.id], recipe: "paper", note: "The publication's way" });
  await post("/api/tokens", { name: "robot 7", scopes: ["ingest", "read"] });
  const made = await soon("the batch has its job", async () => (await getJson(server, `/api/jobs?run=${second.id}`)).items.find((job) => job.batch === batch.id));
  await jobEnds(server, made.id);
  // Two that cannot be measured: states and errors are part of the look.
  const bad = await sendRun(server, { ...run, video: run.rig }, { filename: "notes.mp4", asset: "Sewer 12, north" });
  await jobEnds(server, bad.job.id, "failed");
});
after(async () => {
  await browser?.close();
  await Promise.all([run?.remove(), other?.remove()]);
  await empty?.stop();
  await server?.stop();
});

test("the first page is small, squeezed, kept for ever and under a strict content security policy", async () => {
  const { page, close } = await openPage(browser, empty);
  const [bodies, answers] = [[], []];
  page.on("response", (response) => {
    if (new URL(response.url()).pathname.startsWith("/api/")) return;
    bodies.push(response.body());
    answers.push(response);
  });
  const answer = await page.goto("/");
  await page.getByText("No runs yet").waitFor();
  const bytes = (await Promise.all(bodies)).reduce((sum, body) => sum + gzipSync(body).length, 0);
  assert.ok(bytes < FIRST_PAGE_BYTES, `${bytes} bytes compressed`);
  const policy = answer.headers()["content-security-policy"] ?? "";
  assert.match(policy, /script-src [^;]*'self'/);
  assert.doesNotMatch(policy, /'unsafe-inline'|'unsafe-eval'|\*/);
  for (const response of answers.filter((each) => each.url().includes("/assets/"))) {
    assert.match(response.headers()["cache-control"], /immutable/, response.url());
    const asked = await fetch(response.url(), { headers: { "accept-encoding": "br" } });
    if ((await asked.arrayBuffer()).byteLength >= 600) assert.equal(asked.headers.get("content-encoding"), "br", response.url());
  }
  await close();
});

test("the viewer's wasm is squeezed in advance and kept for ever", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto(`/runs/${second.id}?tab=space`);
  const asked = page.waitForResponse(/re_viewer_bg\.wasm$/);
  await page.getByRole("button", { name: "Open 3D view" }).click();
  const wasm = await asked;
  assert.equal(wasm.headers()["content-encoding"], "br");
  assert.match(wasm.headers()["cache-control"], /immutable/);
  await close();
});

test("the empty pages teach what to do", async () => {
  await everyLook(empty, "runs-empty", "/", (page) => page.getByText("No runs yet").waitFor());
  await everyLook(empty, "live-empty", "/live", (page) => page.getByText("Nothing is being measured").waitFor());
  await everyLook(empty, "rigs-empty", "/settings/rigs", (page) => page.getByText("No rig is stored yet").waitFor());
  await everyLook(empty, "queue-empty", "/queue", (page) => page.getByText("No worker is there").waitFor());
});

test("the lists, sending, queue and settings", async () => {
  await everyLook(server, "runs", "/", (page) => page.locator(".state.done").first().waitFor());
  await everyLook(server, "send", "/send", (page) => page.getByText("Choose files").last().waitFor());
  await everyLook(server, "queue", "/queue", async (page) => {
    await page.getByText("Failed").first().waitFor();
    await page.getByText("Measure many runs again").click();
    await page.getByText("Count the runs").waitFor();
  });
  await everyLook(server, "rigs", "/settings/rigs", (page) => page.locator(".rig-drawing svg").first().waitFor());
  await everyLook(server, "tokens", "/settings/tokens", (page) => page.getByRole("region", { name: "Tokens" }).getByText("robot 7", { exact: true }).waitFor());
  await everyLook(server, "retention", "/settings/retention", async (page) => {
    await page.getByLabel("Keep for, days").fill("0");
    await page.getByRole("button", { name: "Show what would go" }).click();
    await page.getByRole("button", { name: /^Pin the run/ }).first().waitFor();
  });
  await everyLook(server, "batch", `/batches/${batch.id}`, (page) => page.locator("td[data-difference]").first().waitFor());
  await everyLook(server, "recipes", "/settings/recipes", (page) => page.getByText("spot.choice").first().waitFor());
});

test("a run's parts", async () => {
  await everyLook(server, "run-map", `/runs/${first.id}`, mapSettled);
  await everyLook(server, "run-quality", `/runs/${first.id}?tab=quality`, (page) =>
    page.getByText(/places may have drifted by [\d.]+\s+mm along the way/).waitFor());
  await everyLook(server, "run-path", `/runs/${second.id}?tab=path`, (page) => page.locator(".plot canvas").nth(5).waitFor());
  await everyLook(server, "run-3d", `/runs/${second.id}?tab=space`, async (page) => {
    await page.getByRole("button", { name: "Open light view" }).click();
    await page.getByText(/[\d,]+ points/).waitFor();
  });
  await everyLook(server, "run-files", `/runs/${second.id}?tab=files`, (page) => page.getByText("depth.tif").waitFor());
  await everyLook(server, "run-jobs", `/runs/${second.id}?tab=jobs`, async (page) => {
    await page.getByText("Options", { exact: false }).last().click();
    await page.getByText("spot.choice").waitFor();
  });
  await everyLook(server, "run-log", `/runs/${second.id}?tab=log`, (page) => page.getByText("is done").last().waitFor());
});

test("two measurements side by side", async () => {
  const { items } = await (await fetch(new URL(`/api/jobs?run=${second.id}`, server.url))).json();
  await everyLook(server, "compare", `/runs/${second.id}/compare?left=${items[0].id}&right=${items[1].id}`, async (page) => {
    for (const side of [0, 1]) await mapSettled(page, page.locator(".pair section").nth(side));
    await page.getByRole("row", { name: /^method/ }).waitFor();
  });
});

test("times are local and carry UTC", async () => {
  const { page, close } = await openPage(browser, server, { timezoneId: "Asia/Tokyo", locale: "en-GB" });
  await page.goto("/");
  const time = page.locator("time").first();
  await time.waitFor();
  const utc = new Date(await time.getAttribute("datetime"));
  assert.equal(await time.getAttribute("title"), `${utc.toISOString().slice(0, 19).replace("T", " ")} UTC`);
  const tokyo = utc.toLocaleTimeString("en-GB", { timeZone: "Asia/Tokyo", hour: "2-digit", minute: "2-digit" });
  assert.ok((await time.innerText()).endsWith(tokyo), `${await time.innerText()} is ${tokyo} in Tokyo`);
  await close();
});

const everyLook = (at, name, address, ready) => lookAround(browser, at, name, address, ready);
