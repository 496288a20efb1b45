// A person sends runs through the page and gets at their results.

import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { readFile } from "node:fs/promises";
import { after, before, test } from "node:test";
import { dropFiles, getJson, keepPicture, openPage, simulate, startBrowser, startServer, until } from "./support.mjs";

const DONE_MS = 120_000;
let server, browser, run;

before(async () => {
  [server, run, browser] = await Promise.all([startServer(), simulate({ seconds: 4 }), startBrowser()]);
});
after(async () => {
  await browser?.close();
  await run?.remove();
  await server?.stop();
});

test("files chosen with the button: progress is seen, the result is shown, every file can be downloaded", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await page.getByText("No runs yet").waitFor();
  await page.getByLabel("Choose files").setInputFiles([run.video, run.rig]);
  await page.getByLabel("Asset").fill("sewer 12, north");
  await page.getByRole("button", { name: "Send the run" }).click();

  await page.waitForURL(/\/runs\/[^/]+$/);
  const seen = new Set();
  await until("the run is done", DONE_MS, async () => {
    const bar = page.getByRole("progressbar", { name: "Progress of the measurement" });
    const value = await bar.getAttribute("value", { timeout: 100 }).catch(() => null);
    if (value !== null) seen.add(Number(value));
    return page.getByRole("heading", { name: "Files to download" }).isVisible();
  });
  assert.ok([...seen].some((value) => value > 0 && value < 1), `progress moved on: ${[...seen]}`);

  const preview = page.getByRole("img", { name: "depth picture of sewer 12, north" });
  await until("the preview has been loaded", 10_000, () => preview.evaluate((image) => image.complete && image.naturalWidth > 100));
  await page.getByText("The laser line was found at").waitFor();
  await page.getByText("The robot travelled").waitFor();
  await keepPicture(page, "run-done");

  const job = (await getJson(server, `/api/runs/${new URL(page.url()).pathname.split("/").at(-1)}`)).job.id;
  const products = (await getJson(server, `/api/jobs/${job}/products`)).items.filter(({ name }) => !name.includes("/"));
  assert.ok(products.length >= 8, `products: ${products.map(({ name }) => name)}`);
  for (const { name, bytes, sha256 } of products) {
    const waiting = page.waitForEvent("download");
    await page.getByRole("link", { name: `Download ${name}` }).click();
    const download = await waiting;
    const content = await readFile(await download.path());
    assert.equal(content.length, bytes, name);
    assert.equal(createHash("sha256").update(content).digest("hex"), sha256, name);
    assert.ok(download.suggestedFilename().endsWith(name), download.suggestedFilename());
  }
  await close();
});

test("files dropped on the page; the run shows in the list and can be deleted", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await dropFiles(page, page.locator(".drop"), [run.video, run.rig]);
  await page.getByLabel("Asset").fill("dropped wall");
  await page.getByRole("button", { name: "Send the run" }).click();
  await page.waitForURL(/\/runs\//);
  await page.getByRole("heading", { name: "Files to download" }).waitFor({ timeout: DONE_MS });

  await page.getByRole("navigation", { name: "Main" }).getByRole("link", { name: "Runs" }).click();
  const row = page.getByRole("listitem").filter({ hasText: "dropped wall" });
  await row.getByText("Done").waitFor();
  const thumbnail = row.getByRole("img");
  await until("the list's picture has been loaded", 10_000, () => thumbnail.evaluate((image) => image.complete && image.naturalWidth > 0));
  await row.getByRole("link").click();

  await page.getByRole("button", { name: "Delete this run" }).click();
  await page.getByRole("button", { name: "Keep it" }).click();
  await page.getByRole("button", { name: "Delete this run" }).click();
  await page.getByRole("button", { name: "Delete for good" }).click();
  await page.getByRole("heading", { name: "Runs" }).waitFor();
  await until("the run is gone from the list", 10_000, async () => (await row.count()) === 0);
  await close();
});

test("several videos go one after the other", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await page.getByLabel("Choose files").setInputFiles([run.video, run.rig]);
  await page.getByLabel("Choose files").setInputFiles([
    { name: "second.mp4", mimeType: "video/mp4", buffer: await readFile(run.video) },
  ]);
  await page.getByLabel("Asset").fill("two at once");
  await page.getByRole("button", { name: "Send 2 runs" }).click();
  await page.getByText("second.mp4 has arrived").waitFor();
  await until("both are in the list", 10_000, async () => (await page.getByRole("listitem").filter({ hasText: "two at once" }).count()) === 2);
  await close();
});

test("from the empty form to the result by keyboard alone", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await tabTo(page, "Choose files");
  const chooser = page.waitForEvent("filechooser");
  await page.keyboard.press("Space");
  await (await chooser).setFiles([run.video, run.rig]);
  await tabTo(page, "Send the run");
  await page.keyboard.press("Enter");
  await page.getByText("Say which asset this is.").waitFor();
  await until("the keyboard stands in the field that is missing", 2000, async () => (await focusedName(page)) === "Asset");
  await page.keyboard.type("by keyboard");
  await page.keyboard.press("Enter");

  await page.waitForURL(/\/runs\//);
  await page.getByRole("heading", { name: "Files to download" }).waitFor({ timeout: DONE_MS });
  await tabTo(page, "Download depth.tif");
  const download = page.waitForEvent("download");
  await page.keyboard.press("Enter");
  assert.match((await download).url(), /depth\.tif$/);
  await close();
});

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
