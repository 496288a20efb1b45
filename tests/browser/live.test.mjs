// A run that is being measured grows on the page, without a reload, and catches up after the link was cut.

import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { readFile } from "node:fs/promises";
import { after, before, test } from "node:test";
import { setTimeout as sleep } from "node:timers/promises";
import { getJson, jobEnds, keepPicture, openPage, sendRun, simulate, startBrowser, startServer, until } from "./support.mjs";

const CUT_MS = 20_000;
let server, browser, run;

before(async () => {
  [server, run, browser] = await Promise.all([startServer(), simulate({ scene: "wall", seconds: 60 }), startBrowser()]);
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

/** A robot that walks at half its pace, so that the run outlasts the test however fast the machine is; `stop` ends it. */
async function walk(stream, fields) {
  const rig = await readFile(run.rig, "utf8");
  const address = new URL(`/api/live/${stream}?${new URLSearchParams({ rig, ...fields })}`, server.url);
  const quiet = ["-hide_banner", "-loglevel", "error", "-nostdin"];
  const robot = spawn("ffmpeg", [...quiet, "-readrate", "0.5", "-i", run.video, "-q:v", "3", "-f", "mpjpeg", "-method", "POST", address.href]);
  const ended = new Promise((done, fail) => robot.once("exit", done).once("error", (error) => fail(new Error(`ffmpeg, which \`make setup\` installs: ${error.message}`))));
  const known = await Promise.race([ended.then(() => assert.fail("ffmpeg ended at once")), until("the robot is seen", 20_000, async () => (await getJson(server, "/api/live")).items.find((item) => item.stream === stream))]);
  const stop = async () => {
    robot.kill("SIGKILL");
    await ended;
  };
  return { job: known.job, stop };
}

test("frame, line, health and map grow; a cut of 20 s is caught up with", async () => {
  const robot = await walk("walker", { asset: "watched", recipe: RECIPE });
  const { page, context, close } = await openPage(browser, server);
  await page.goto("/live");
  await page.getByRole("link", { name: /^Watch watched/ }).click();
  await page.locator(".live-picture canvas[data-frame]").waitFor({ timeout: 60_000 });
  await page.locator(".live-map .map-top").waitFor({ timeout: 60_000 });
  const [firstEnd, firstFrame] = [await end(page), await frame(page)];
  const marked = await page.locator(".live-picture canvas").evaluate((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let marks = 0;
    for (let at = 0; at < data.length; at += 4) marks += Number(data[at] === 255 && data[at + 1] === 45 && data[at + 2] === 85);
    return marks;
  });
  assert.ok(marked > 100, `the line is drawn on the frame: ${marked} pixels`);
  const grownEnd = await until("the map grows", 60_000, async () => (await end(page)) > firstEnd + 20 && end(page));
  await until("the frames go on", 20_000, async () => (await frame(page)) > firstFrame);
  await keepPicture(page, "live");

  await context.setOffline(true);
  await page.getByText("The connection to the server was lost").or(page.getByText("Cut: trying again")).first().waitFor({ timeout: CUT_MS });
  await sleep(CUT_MS);
  const cutEnd = await end(page);
  assert.equal((await getJson(server, `/api/jobs/${robot.job}`)).state, "running", "the run outlasts the cut");
  await context.setOffline(false);
  await until("the map has caught up", 30_000, async () => (await end(page)) > cutEnd + 20);
  assert.ok(cutEnd >= grownEnd);
  await page.getByText("Connected").waitFor();
  await keepPicture(page, "live-after-cut");
  await fetch(new URL(`/api/jobs/${robot.job}/cancel`, server.url), { method: "POST" });
  await page.getByText("Somebody cancelled this job").waitFor({ timeout: 20_000 });
  await robot.stop();
  await close();
});

test("the end of a run is seen without a reload: the live part becomes the finished map", async () => {
  const short = await simulate({ scene: "wall", seconds: 4 });
  const sent = await sendRun(server, short, { asset: "ends" });
  const { page, close } = await openPage(browser, server);
  await page.goto(`/runs/${sent.id}`);
  await jobEnds(server, sent.job.id);
  await page.getByRole("tab", { name: "Files" }).waitFor({ timeout: 20_000 });
  await page.locator(".glance").waitFor();
  await page.locator(".map-top").waitFor();
  await short.remove();
  await close();
});
