// A run that is being measured grows on the page, without a reload, and catches up after the link was cut and after a sleep.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { setTimeout as sleep } from "node:timers/promises";
import { getJson, jobEnds, keepPicture, mapSettled, openPage, sendRun, simulate, soon, startBrowser, startServer, throughDeafWay, until, walk } from "./support.mjs";

const CUT_MS = 20_000;
const ASLEEP_MS = 4000;
let server, browser, run;

before(async () => {
  [server, run, browser] = await Promise.all([startServer(["--live-come-back-s", "2"]), simulate({ scene: "wall", seconds: 60, size: "320x180" }), startBrowser()]);
});
after(async () => {
  await browser?.close();
  await run?.remove();
  await server?.stop();
});

/** Right end of what the map shows to be there, mm. */
const end = (page) => page.locator(".map-top").evaluate((element) => element.striaMap.bounds?.right ?? 0);
const frame = (page) => page.locator(".live-picture canvas").getAttribute("data-frame").then(Number);

const RECIPE = 'method = "paper"\n[map]\ntile_frames = 15\n';

test("frame, line, health and map grow; a cut of 20 s and an hour's sleep are caught up with, and an end that nobody heard", async () => {
  const robot = await walk(server, run, "walker", { asset: "watched", recipe: RECIPE });
  const way = await throughDeafWay(server);
  const { page, context, close } = await openPage(browser, way);
  await page.clock.install();
  await page.goto("/live");
  await page.getByRole("link", { name: /^Watch watched/ }).click();
  await page.locator(".live-picture canvas[data-frame]").waitFor();
  await page.locator(".live-map .map-top").waitFor();
  const [firstEnd, firstFrame] = [await end(page), await frame(page)];
  const marked = await page.locator(".live-picture canvas").evaluate((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let marks = 0;
    for (let at = 0; at < data.length; at += 4) marks += Number(data[at] === 255 && data[at + 1] === 45 && data[at + 2] === 85);
    return marks;
  });
  assert.ok(marked > 100, `the line is drawn on the frame: ${marked} pixels`);
  const grownEnd = await until("the map grows", 60_000, async () => (await end(page)) > firstEnd + 20 && end(page));
  await soon("the frames go on", async () => (await frame(page)) > firstFrame);
  await keepPicture(page, "live");

  await context.setOffline(true);
  await page.getByText("The connection to the server was lost").or(page.getByText("Cut: trying again")).first().waitFor({ timeout: CUT_MS });
  await sleep(CUT_MS);
  const cutEnd = await end(page);
  assert.equal((await getJson(server, `/api/jobs/${robot.job}`)).state, "running", "the run outlasts the cut");
  await context.setOffline(false);
  await soon("the map has caught up", async () => (await end(page)) > cutEnd + 20);
  assert.ok(cutEnd >= grownEnd);
  await page.getByText("Connected").waitFor();
  await keepPicture(page, "live-after-cut");
  assert.equal(await page.getByText(/^0\s%$/).count(), 0, "nobody knows how long a stream will be");

  // The lid is shut for an hour: the page stands still, its connections die without a word, its clock goes on.
  const cdp = await context.newCDPSession(page);
  const sleeps = async (during) => {
    await cdp.send("Page.setWebLifecycleState", { state: "frozen" });
    await during();
    await cdp.send("Page.setWebLifecycleState", { state: "active" });
    await page.clock.fastForward("01:00:00");
  };
  const [beforeSleep, frameBefore] = [await end(page), await frame(page)];
  await sleeps(async () => {
    assert.ok(way.deafen() > 0, "there was a connection to lose");
    await sleep(ASLEEP_MS);
  });
  await soon("the map has caught up after the sleep", async () => (await end(page)) > beforeSleep + 20);
  await soon("the frames have, too", async () => (await frame(page)) > frameBefore);

  // The run ends while nobody hears it.
  await sleeps(async () => {
    way.deafen();
    await robot.stop();
    await jobEnds(server, robot.job);
  });
  await page.getByRole("tab", { name: "Files" }).waitFor();
  await page.locator(".glance").waitFor();
  await mapSettled(page);
  await keepPicture(page, "live-after-sleep");
  await close();
  way.stop();
});

test("the end of a run is seen without a reload: the live part becomes the finished map", async () => {
  const short = await simulate({ scene: "wall", seconds: 4 });
  const sent = await sendRun(server, short, { asset: "ends" });
  const { page, close } = await openPage(browser, server);
  await page.goto(`/runs/${sent.id}`);
  await jobEnds(server, sent.job.id);
  await page.getByRole("tab", { name: "Files" }).waitFor();
  await page.locator(".glance").waitFor();
  await page.locator(".map-top").waitFor();
  await short.remove();
  await close();
});
