// Every page in light and dark and at three widths: nothing overflows, everything can be read and has a name.

import assert from "node:assert/strict";
import { gzipSync } from "node:zlib";
import { after, before, test } from "node:test";
import { keepPicture, openPage, simulate, startBrowser, startServer, until } from "./support.mjs";

const SIZES = [
  { width: 1440, height: 900 },
  { width: 768, height: 1024 },
  { width: 360, height: 740 },
];
const FIRST_PAGE_BYTES = 200_000;
let server, browser, run, runPath;

before(async () => {
  [server, run, browser] = await Promise.all([startServer(), simulate(), startBrowser()]);
});
after(async () => {
  await browser?.close();
  await run?.remove();
  await server?.stop();
});

test("the first page is small and under a strict content security policy", async () => {
  const { page, close } = await openPage(browser, server);
  const bodies = [];
  page.on("response", (response) => {
    if (!new URL(response.url()).pathname.startsWith("/api/")) bodies.push(response.body());
  });
  const answer = await page.goto("/");
  await page.getByText("No runs yet").waitFor();
  const bytes = (await Promise.all(bodies)).reduce((sum, body) => sum + gzipSync(body).length, 0);
  assert.ok(bytes < FIRST_PAGE_BYTES, `${bytes} bytes compressed`);
  const policy = answer.headers()["content-security-policy"] ?? "";
  assert.match(policy, /script-src [^;]*'self'/);
  assert.doesNotMatch(policy, /'unsafe-inline'|'unsafe-eval'|\*/);
  await close();
});

test("the empty list teaches what to do, at every size in both colour schemes", async () => {
  await everyLook("runs-empty", "/", (page) => page.getByText("No runs yet").waitFor());
});

test("the list and a run's page, at every size in both colour schemes", async () => {
  const { page, close } = await openPage(browser, server);
  await page.goto("/");
  await page.getByLabel("Choose files").setInputFiles([run.video, run.rig]);
  await page.getByLabel("Asset").fill("a-name-without-any-space-".repeat(6));
  await page.getByRole("button", { name: "Send the run" }).click();
  await page.waitForURL(/\/runs\//);
  runPath = new URL(page.url()).pathname;
  await page.getByRole("heading", { name: "Files to download" }).waitFor({ timeout: 60_000 });
  await close();
  await everyLook("runs", "/", (each) => each.getByText("Done").first().waitFor());
  await everyLook("run", runPath, (each) => each.getByText("The laser line was found at").waitFor());
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

/** Looks at a page in all sizes and schemes: keeps a picture, checks what a program can check. */
async function everyLook(name, address, ready) {
  for (const colorScheme of ["light", "dark"]) {
    for (const viewport of SIZES) {
      const look = `${name}-${viewport.width}-${colorScheme}`;
      const { page, close } = await openPage(browser, server, { colorScheme, viewport });
      await page.goto(address);
      await ready(page);
      await until("pictures are loaded", 10_000, () => page.evaluate(() => [...document.images].every((image) => image.complete || image.loading === "lazy")));
      await keepPicture(page, look);
      assert.equal(await page.evaluate(() => document.documentElement.scrollWidth - innerWidth), 0, `${look}: nothing sticks out to the side`);
      assert.deepEqual(await page.evaluate(faults), [], look);
      await close();
    }
  }
}

/** Runs in the page: text with too little contrast (WCAG AA) and controls without a name. */
function faults() {
  const found = [];
  const parse = (colour) => (colour.match(/[\d.]+/g) ?? []).map(Number);
  const luminance = ([r, g, b]) => {
    const linear = [r, g, b].map((c) => (c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4));
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
  };
  const ground = (element) => {
    for (let at = element; at; at = at.parentElement) {
      const colour = parse(getComputedStyle(at).backgroundColor);
      if (colour.length === 3 || colour[3] === 1) return colour;
    }
    return [255, 255, 255];
  };
  for (const element of document.querySelectorAll("body *")) {
    const text = [...element.childNodes].some((node) => node.nodeType === Node.TEXT_NODE && node.textContent.trim() !== "");
    if (!text || element.closest("noscript, script, :disabled") || element.getClientRects().length === 0) continue;
    const [light, dark] = [luminance(parse(getComputedStyle(element).color)), luminance(ground(element))].sort((a, b) => b - a);
    const contrast = (light + 0.05) / (dark + 0.05);
    if (contrast < 4.5) found.push(`contrast ${contrast.toFixed(2)}: ${element.textContent.trim().slice(0, 40)}`);
  }
  for (const control of document.querySelectorAll("a, button, input, select, progress, img, canvas")) {
    const name = control.getAttribute("aria-label") ?? control.getAttribute("alt") ?? control.labels?.[0]?.textContent ?? (control.textContent || control.querySelector("img")?.alt || "");
    const decoration = control.matches("img[alt='']");
    if (!decoration && name.trim() === "") found.push(`no name: ${control.outerHTML.slice(0, 80)}`);
  }
  return found;
}
