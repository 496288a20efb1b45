// A person sends runs through the page: several files, paused, cut off, gone on with after a reload.

import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { readFile, writeFile } from "node:fs/promises";
import { connect, createServer } from "node:net";
import path from "node:path";
import { after, before, test } from "node:test";
import { setTimeout as sleep } from "node:timers/promises";
import { dropFiles, getJson, jobEnds, keepPicture, openPage, simulate, soon, startBrowser, startServer, thinLink, until } from "./support.mjs";

const DONE_MS = 120_000;
/** Between two clicks on downloads: Chromium drops those of a page that starts more than ten in a second. */
const CLICK_MS = 150;
/** Large enough to be stopped on its way: half a minute on the link of a site. */
const BIG_BYTES = 8_000_000;
let server, browser, run, big;

before(async () => {
  [server, run, browser] = await Promise.all([startServer(), simulate({ seconds: 4 }), startBrowser()]);
  // A good video with something behind its end: FFmpeg does not mind, and the file is large.
  big = path.join(run.folder, "big.mp4");
  const video = await readFile(run.video);
  await writeFile(big, Buffer.concat([video, freeBox(BIG_BYTES - video.length)]));
});
after(async () => {
  await browser?.close();
  await run?.remove();
  await server?.stop();
});

/** MP4's own way to say "nothing": a box that readers skip. */
function freeBox(bytes) {
  const box = Buffer.alloc(bytes, 7);
  box.writeUInt32BE(bytes, 0);
  box.write("free", 4, "latin1");
  return box;
}

async function choose(page, files, asset) {
  await page.goto("/send");
  await page.getByLabel("Choose files").setInputFiles(files);
  await page.getByLabel("Asset").fill(asset);
  await page.getByRole("button", { name: /^Send/ }).last().click();
}

const item = (page, name) => page.locator(".upload-item", { hasText: name });
const sentBytes = async (page, name) => Number(await item(page, name).getByRole("progressbar").getAttribute("value"));

/** The run that the server made of a file, once it has. */
async function arrived(asset, count = 1, at = server) {
  return until(`${count} of ${asset} arrived`, 60_000, async () => {
    const { items } = await getJson(at, `/api/runs?asset=${encodeURIComponent(asset)}`);
    return items.length === count && items;
  });
}

async function sameSource(entry, file, at = server) {
  const source = Buffer.from(await (await fetch(new URL(entry.source.url, at.url))).arrayBuffer());
  assert.deepEqual(createHash("sha256").update(source).digest("hex"), createHash("sha256").update(await readFile(file)).digest("hex"));
}

test("files chosen with the button: sent, measured, shown, every file downloaded", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await page.getByText("No runs yet").waitFor();
  await page.getByRole("navigation", { name: "Main" }).getByRole("link", { name: "Send a run" }).click();
  await page.getByLabel("Choose files").setInputFiles([run.video, run.rig]);
  await page.getByLabel("Asset").fill("sewer 12, north");
  await page.getByLabel("Starts at, mm").fill("2500");
  await page.getByLabel("Direction").selectOption("backward");
  await page.getByRole("button", { name: "Send the run" }).click();
  await page.getByRole("link", { name: "Show the run" }).click();
  await page.getByRole("tab", { name: "Files" }).click({ timeout: DONE_MS });
  const [entry] = await arrived("sewer 12, north");
  assert.deepEqual([entry.chainage_mm, entry.direction], [2500, "backward"]);
  const products = (await getJson(server, `/api/jobs/${entry.job.id}/products`)).items.filter(({ name }) => !name.includes("/"));
  assert.ok(products.length >= 8, `products: ${products.map(({ name }) => name)}`);
  for (const { name, bytes, sha256 } of products) {
    const waiting = page.waitForEvent("download");
    await page.getByRole("link", { name: `Download ${name}`, exact: true }).click();
    const download = await waiting;
    const content = await readFile(await download.path());
    assert.equal(content.length, bytes, name);
    assert.equal(createHash("sha256").update(content).digest("hex"), sha256, name);
    assert.ok(download.suggestedFilename().endsWith(name), download.suggestedFilename());
    await sleep(CLICK_MS);
  }
  await close();
});

test("files dropped on the list go to the page for sending; the run shows in the list and can be deleted", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await dropFiles(page, page.locator("body"), [run.video, run.rig]);
  await page.getByLabel("Asset").fill("dropped wall");
  await page.getByRole("button", { name: "Send the run" }).click();
  const [entry] = await arrived("dropped wall");
  await jobEnds(server, entry.job.id);
  await page.getByRole("navigation", { name: "Main" }).getByRole("link", { name: "Runs" }).click();
  const row = page.getByRole("listitem").filter({ hasText: "dropped wall" });
  await row.getByText("Done").waitFor();
  const thumbnail = row.getByRole("img");
  await soon("the list's picture has been loaded", () => thumbnail.evaluate((image) => image.complete && image.naturalWidth > 0));
  await row.getByRole("link").click();
  await page.getByRole("button", { name: "Delete this run" }).click();
  await page.getByRole("button", { name: "Keep it" }).click();
  await page.getByRole("button", { name: "Delete this run" }).click();
  await page.getByRole("button", { name: "Delete for good" }).click();
  await page.getByRole("heading", { name: "Runs" }).waitFor();
  await soon("the run is gone from the list", async () => (await row.count()) === 0);
  await close();
});

test("several videos go one after the other, beside other pages", async () => {
  const { page, close } = await openPage(browser, server);
  const second = { name: "second.mp4", mimeType: "video/mp4", buffer: await readFile(run.video) };
  await page.goto("/send");
  await page.getByLabel("Choose files").setInputFiles([run.video, run.rig]);
  await page.getByLabel("Choose files").setInputFiles([second]);
  await page.getByLabel("Asset").fill("two at once");
  await page.getByRole("button", { name: "Send 2 runs" }).click();
  await page.getByRole("navigation", { name: "Main" }).getByRole("link", { name: "Queue" }).click();
  await arrived("two at once", 2);
  await page.getByRole("link", { name: "Send a run" }).click();
  await item(page, "second.mp4").getByText("Has arrived").waitFor();
  await close();
});

test("paused, gone on with, cut off, and whole in the end", async () => {
  const { page, context, close } = await openPage(browser, server);
  const link = await thinLink(page);
  await choose(page, [big, run.rig], "a large one");
  await soon("it is on its way", async () => (await sentBytes(page, "big.mp4")) > 500_000);
  await item(page, "big.mp4").getByText(/left/).waitFor();
  await keepPicture(page, "sending");
  await item(page, "big.mp4").getByRole("button", { name: /^Pause/ }).click();
  await item(page, "big.mp4").getByText("Paused").waitFor();
  const paused = await sentBytes(page, "big.mp4");
  await item(page, "big.mp4").getByRole("button", { name: /^Go on/ }).click();
  await soon("it goes on from there", async () => (await sentBytes(page, "big.mp4")) > paused + 200_000);
  await context.setOffline(true);
  await item(page, "big.mp4").getByText("The link is down").waitFor();
  const cut = await sentBytes(page, "big.mp4");
  assert.ok(cut >= paused, "nothing that arrived is lost");
  await link.send("Network.emulateNetworkConditions", { offline: false, latency: 0, downloadThroughput: -1, uploadThroughput: -1 });
  await context.setOffline(false);
  const [entry] = await arrived("a large one");
  await sameSource(entry, big);
  await jobEnds(server, entry.job.id);
  await close();
});

test("a reload in the middle: the same file again goes on where it stopped", async () => {
  const { page, close } = await openPage(browser, server);
  const link = await thinLink(page);
  await choose(page, [big, run.rig], "after a reload");
  await soon("half a megabyte is there", async () => (await sentBytes(page, "big.mp4")) > 500_000);
  page.on("dialog", (dialog) => dialog.accept()); // "leave the page?"
  await page.reload();
  await item(page, "big.mp4").getByText("Was interrupted").waitFor();
  const offsets = [];
  page.on("request", (request) => {
    if (request.method() !== "PATCH") return;
    offsets.push(Number(request.headers()["upload-offset"]));
    assert.match(request.headers()["upload-checksum"] ?? "none", /^sha256 /);
  });
  await link.send("Network.emulateNetworkConditions", { offline: false, latency: 0, downloadThroughput: -1, uploadThroughput: -1 });
  await page.getByLabel("Choose files").setInputFiles([big]);
  const [entry] = await arrived("after a reload");
  assert.ok(offsets[0] > 100_000, `it went on at ${offsets[0]}`);
  await sameSource(entry, big);
  await close();
});

test("a piece that the way spoils is refused and sent again, also where the browser lends the page no checksums", async () => {
  // A name of a site's network without HTTPS: no secure context. Some proxy is trusted, so that the server answers to any name.
  const [site, guest] = await Promise.all([startServer(["--workers", "0", "--trusted-proxy", "192.0.2.1"]), startBrowser({ flags: ["--host-resolver-rules=MAP site.test 127.0.0.1"] })]);
  const way = await throughSpoilingWay(site);
  const { page, close } = await openPage(guest, way);
  const pieces = [];
  page.on("response", async (response) => {
    const request = response.request();
    if (request.method() === "PATCH") pieces.push([response.status(), request.headers()["upload-checksum"] ?? "none"]);
  });
  await choose(page, [big, run.rig], "by a bad way");
  assert.equal(await page.evaluate(() => "subtle" in crypto), false);
  await item(page, "big.mp4").getByText("Has arrived").waitFor();
  const [entry] = await arrived("by a bad way", 1, site);
  await sameSource(entry, big, site);
  assert.ok(way.spoilt(), "a byte became another on the way");
  assert.equal(pieces.filter(([status]) => status === 460).length, 1, JSON.stringify(pieces));
  assert.ok(pieces.every(([, checksum]) => /^sha256 [\w+/]{43}=$/.test(checksum)), JSON.stringify(pieces));
  assert.equal(pieces.at(-1)[0], 204);
  await close();
  way.stop();
  await guest.close();
  await site.stop();
});

test("from the empty form to the result by keyboard alone", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/send");
  // Asked for before the way there: the browser must know of it when the key comes.
  const chooser = page.waitForEvent("filechooser");
  await tabTo(page, "Choose files");
  await page.keyboard.press("Space");
  await (await chooser).setFiles([run.video, run.rig]);
  await page.getByRole("button", { name: "Send the run" }).waitFor();
  await tabTo(page, "Send the run");
  await page.keyboard.press("Enter");
  await page.getByText("Say which asset this is.").waitFor();
  await soon("the keyboard stands in the field that is missing", async () => (await focusedName(page)) === "Asset");
  await page.keyboard.type("by keyboard");
  await page.keyboard.press("Enter");
  await page.getByRole("link", { name: "Show the run" }).waitFor();
  await tabTo(page, "Show the run");
  await page.keyboard.press("Enter");
  await page.getByRole("tab", { name: "Files" }).waitFor({ timeout: DONE_MS });
  await tabTo(page, "Files");
  await page.keyboard.press("Enter");
  await page.getByRole("link", { name: "Download depth.tif" }).waitFor();
  await tabTo(page, "Download depth.tif");
  const download = page.waitForEvent("download");
  await page.keyboard.press("Enter");
  assert.match((await download).url(), /depth\.tif$/);
  await close();
});

/** The same server by a way on which one byte becomes another, once: in the middle of the first large packet that goes to the server. */
async function throughSpoilingWay(server) {
  let spoilt = false;
  const ends = new Set();
  const way = createServer((near) => {
    const far = connect(new URL(server.url).port, "127.0.0.1");
    for (const end of [near, far]) {
      ends.add(end);
      end.on("error", () => [near, far].forEach((each) => each.destroy()));
    }
    near.on("data", (packet) => {
      if (!spoilt && packet.length > 16_000) {
        packet[packet.length >> 1] ^= 1;
        spoilt = true;
      }
      far.write(packet);
    });
    near.on("end", () => far.end());
    far.pipe(near);
  });
  await new Promise((done) => way.listen(0, "127.0.0.1", done));
  const stop = () => {
    ends.forEach((end) => end.destroy());
    way.close();
  };
  return { url: `http://site.test:${way.address().port}`, spoilt: () => spoilt, stop };
}

/** Presses Tab until the focus is on the named control. */
async function tabTo(page, name) {
  for (let presses = 0; presses < 80; presses += 1) {
    if ((await focusedName(page)) === name) return;
    await page.keyboard.press("Tab");
  }
  assert.fail(`'${name}' cannot be reached with Tab`);
}

/** What a screen reader calls the focused control, as far as labels and text tell. */
function focusedName(page) {
  return page.evaluate(() => {
    const at = document.activeElement;
    return (at?.getAttribute("aria-label") ?? at?.labels?.[0]?.textContent ?? at?.textContent ?? "").trim();
  });
}
