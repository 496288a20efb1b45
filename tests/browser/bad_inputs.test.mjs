// What cannot be measured is refused in words, in the page, and the server goes on.

import assert from "node:assert/strict";
import { mkdir, readFile, writeFile } from "node:fs/promises";
import path from "node:path";
import { after, before, test } from "node:test";
import { dropFiles, getJson, keepPicture, openPage, rigForOtherSize, simulate, startBrowser, startServer, until } from "./support.mjs";

const ENDED_MS = 60_000;
let server, browser, run;

before(async () => {
  [server, run, browser] = await Promise.all([startServer(), simulate(), startBrowser()]);
});
after(async () => {
  await browser?.close();
  await run?.remove();
  await server?.stop();
});

/** Sends files and answers the message that the page shows: at once, or when the job has failed. */
async function refusal(page, files) {
  await page.goto("/send");
  await page.getByLabel("Choose files").setInputFiles(files);
  await page.getByLabel("Asset").fill("bad input");
  await page.getByRole("button", { name: "Send the run" }).click();
  const refused = page.getByRole("alert").first();
  const arrived = page.getByRole("link", { name: "Show the run" });
  await refused.or(arrived).first().waitFor({ timeout: ENDED_MS });
  if (await arrived.isVisible()) await arrived.click();
  await refused.waitFor({ timeout: ENDED_MS });
  const words = await refused.innerText();
  assert.ok(words.length > 40, `a message that helps: ${words}`);
  assert.doesNotMatch(words, /undefined|\[object|NaN|panicked/);
  return words;
}

/** The server still takes a good run. */
async function stillWell() {
  assert.ok((await fetch(`${server.url}/livez`)).ok);
}

test("a text file named .mp4", async () => {
  const { page, close } = await openPage(browser, server);
  const words = await refusal(page, [{ name: "notes.mp4", mimeType: "video/mp4", buffer: Buffer.from("These are notes, not a video.\n".repeat(50)) }, await asUpload(run.rig)]);
  assert.match(words, /notes\.mp4/);
  await keepPicture(page, "refused-text");
  await stillWell();
  await close();
});

test("an empty file", async () => {
  const { page, close } = await openPage(browser, server);
  const words = await refusal(page, [{ name: "empty.mp4", mimeType: "video/mp4", buffer: Buffer.alloc(0) }, await asUpload(run.rig)]);
  assert.match(words, /empty/);
  await stillWell();
  await close();
});

test("a rig for another image size: the message names both sizes", async () => {
  const { page, close } = await openPage(browser, server);
  const words = await refusal(page, [run.video, await rigForOtherSize(run.rig, run.folder)]);
  assert.match(words, /640/);
  assert.match(words, /1280/);
  await keepPicture(page, "refused-rig");
  await stillWell();
  await close();
});

test("a rig file that is none: the message names the field", async () => {
  const { page, close } = await openPage(browser, server);
  const broken = { name: "rig.toml", mimeType: "application/toml", buffer: Buffer.from('name = "x"\n[camera]\nwidth_px = "wide"\n') };
  assert.match(await refusal(page, [await asUpload(run.video), broken]), /width_px/);
  await stillWell();
  await close();
});

test("a file name with ../ and quotes does no harm and is shown as it is", async () => {
  const { page, close } = await openPage(browser, server);
  const name = `../../etc/"quoted" & <b>'s.mp4`;
  await page.goto("/send");
  // A browser's own chooser gives only the last part; a file made in the page may have any name.
  const video = (await readFile(run.video)).toString("base64");
  const rig = await readFile(run.rig, "utf8");
  const transfer = await page.evaluateHandle(
    ([fileName, base64, toml]) => {
      const data = new DataTransfer();
      data.items.add(new File([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))], fileName));
      data.items.add(new File([toml], "rig.toml"));
      return data;
    },
    [name, video, rig],
  );
  await page.locator(".drop").dispatchEvent("drop", { dataTransfer: transfer });
  await page.getByLabel("Asset").fill(`"asset" <i>../x</i>`);
  await page.getByRole("button", { name: "Send the run" }).click();
  await page.getByRole("link", { name: "Show the run" }).click({ timeout: ENDED_MS });
  await page.getByRole("tab", { name: "Files" }).waitFor({ timeout: ENDED_MS });
  const heading = await page.getByRole("heading", { level: 1 }).innerText();
  assert.match(heading, /"quoted" & <b>'s\.mp4$/);
  const [entry] = (await getJson(server, "/api/runs")).items;
  assert.equal(entry.source.filename, heading);
  const source = await fetch(new URL(entry.source.url, server.url));
  assert.deepEqual(Buffer.from(await source.arrayBuffer()), await readFile(run.video), "the original comes back");
  await close();
});

test("what the form itself can tell is said before anything is sent", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/send");
  await page.getByLabel("Choose files").setInputFiles([run.rig]);
  await page.getByRole("button", { name: "Send the run" }).click();
  await page.getByText("Add the video of the run.").waitFor();
  await page.getByText("Say which asset this is.").waitFor();
  await close();
});

test("a run that does not exist", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/runs/01234567-89ab-7def-8123-456789abcdef");
  await page.getByText("This run does not exist, or somebody deleted it.").waitFor();
  await page.goto("/no/such/page");
  await page.getByRole("heading", { name: "There is no such page" }).waitFor();
  await close();
});

test("a file let go beside the field does not replace the page", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  const folder = path.join(run.folder, "beside");
  await mkdir(folder);
  await writeFile(path.join(folder, "beside.mp4"), "x");
  await dropFiles(page, page.locator("body"), [path.join(folder, "beside.mp4")]);
  await page.getByText("beside.mp4").waitFor();
  await page.getByRole("heading", { name: "Send runs" }).waitFor();
  await close();
});

async function asUpload(file) {
  return { name: path.basename(file), mimeType: "application/octet-stream", buffer: await readFile(file) };
}
