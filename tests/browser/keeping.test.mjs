// Who may come in and what is kept: logging in at a locked server, tokens, rules of keeping, and what is said about a run.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import { after, before, test } from "node:test";
import { getJson, keepPicture, openPage, sendRun, simulate, soon, startBrowser, startServer } from "./support.mjs";

let locked, open, browser, run, runs, evil;

before(async () => {
  [locked, open, run, browser] = await Promise.all([
    startServer(["--workers", "0"], { locked: true }),
    startServer(["--workers", "0", "--keep-days", "3650", "--quota-gb", "500"]),
    simulate({ seconds: 0.2, size: "320x240" }),
    startBrowser(),
  ]);
  runs = [];
  for (const asset of ["Old main", "New main"]) {
    const sent = await sendRun(open, run, { asset, chainage_mm: "1000" });
    // What waits for a worker is never deleted.
    await fetch(new URL(`/api/jobs/${sent.job.id}/cancel`, open.url), { method: "POST" });
    runs.push(sent);
  }
});
after(async () => {
  await browser?.close();
  evil?.closeAllConnections();
  evil?.close();
  await run?.remove();
  await locked?.stop();
  await open?.stop();
});

/** How the server answers somebody with this token. */
const statusOf = async (secret, path = "/api/runs", init = {}) => (await fetch(new URL(path, locked.url), { ...init, headers: { authorization: `Bearer ${secret}`, ...init.headers } })).status;

async function makeToken(page, name, { scopes }) {
  const form = page.getByRole("region", { name: "Make a token" });
  await form.getByLabel("Who will use it").fill(name);
  for (const box of await form.getByRole("checkbox").all()) await box.uncheck();
  for (const scope of scopes) await form.getByRole("checkbox", { name: new RegExp(`^${scope} `) }).check();
  await form.getByRole("button", { name: "Make it" }).click();
  return secretOf(page, name);
}

/** The secret as it is shown this once. */
async function secretOf(page, name) {
  const shown = page.getByRole("status", { name });
  const secret = await shown.locator("code").innerText();
  await shown.getByRole("button", { name: "I have kept it" }).click();
  await shown.waitFor({ state: "detached" });
  return secret;
}

/** Logs in by the form, as a person who was given a token. */
async function logIn(page, secret) {
  await page.getByLabel("Token", { exact: true }).fill(secret);
  await page.getByRole("button", { name: "Log in" }).click();
}

test("a locked server: the one-time address, tokens shown once, renewed with an overlap, revoked", async () => {
  const { page, context, close } = await openPage(browser, locked);
  await page.goto("/settings/tokens");
  assert.match(page.url(), /\/login\?next=%2Fsettings%2Ftokens$|\/login\?next=\/settings\/tokens$/, "who is nobody is asked to log in");
  await page.goto(locked.loginUrl);
  await page.getByText("No runs yet").waitFor();
  const stranger = await openPage(browser, locked);
  await stranger.page.goto(locked.loginUrl);
  await stranger.page.getByText("was used already").waitFor();
  await stranger.close();

  await page.goto("/settings/tokens");
  await page.getByText(/^Logged in as .* \(.*admin/).waitFor();
  await page.getByText("There is no token yet.").waitFor();
  const secret = await makeToken(page, "robot-7", { scopes: ["ingest", "read"] });
  assert.equal(await statusOf(secret), 200);
  assert.equal(await statusOf(secret, "/api/tokens"), 403, "it may do no more than was ticked");
  await page.reload();
  const list = page.getByRole("list", { name: "Tokens" }).first();
  const row = list.getByRole("listitem").filter({ hasText: "robot-7" });
  await row.getByText("last used today").waitFor();
  await row.getByText("ingest, read").waitFor();
  assert.ok(!(await page.content()).includes(secret), "the secret is shown once");
  const year = new Date(Date.now() + 365 * 86_400_000).getFullYear();
  await row.getByText(`valid until`).waitFor();
  assert.ok((await row.innerText()).includes(`${year}`), await row.innerText());
  await keepPicture(page, "tokens-made");

  await row.getByRole("button", { name: "Renew robot-7" }).click();
  await page.getByRole("dialog").getByRole("button", { name: "Renew it" }).click();
  const second = await secretOf(page, "robot-7");
  assert.deepEqual([await statusOf(secret), await statusOf(second)], [200, 200], "both open while they overlap");
  assert.equal(await list.getByRole("listitem").count(), 2);
  // The newest stands first.
  await list.getByRole("button", { name: "Renew robot-7" }).first().click();
  await page.getByRole("dialog").getByLabel("The old one still opens for").selectOption({ label: "no time: at once it opens nothing" });
  await page.getByRole("dialog").getByRole("button", { name: "Renew it" }).click();
  const third = await secretOf(page, "robot-7");
  assert.deepEqual([await statusOf(second), await statusOf(third)], [401, 200]);

  await list.getByRole("button", { name: "Revoke robot-7" }).first().click();
  await page.getByRole("dialog").getByText("shut out at once").waitFor();
  await page.getByRole("dialog").getByRole("button", { name: "Revoke it" }).click();
  await page.getByText("2 tokens that open nothing any more").click();
  await page.getByText("revoked today").waitFor();
  assert.deepEqual([await statusOf(third), await statusOf(secret)], [401, 200]);

  // Whoever may not make tokens is told so.
  const reader = await makeToken(page, "office", { scopes: ["read"] });
  const other = await openPage(browser, locked);
  await other.page.goto("/settings/tokens");
  await logIn(other.page, reader);
  await other.page.getByText("Logged in as office (read)").waitFor();
  await other.page.getByRole("alert").getByText(/admin/).waitFor();
  await other.close();

  await page.getByRole("button", { name: "Log out" }).click();
  await page.getByLabel("Token", { exact: true }).waitFor();
  assert.equal((await context.cookies()).filter(({ name }) => name === "stria_session").length, 0);
  await close();
});

test("a session that ends is said, leads to the log-in and back, and the page goes on by itself after a log-in elsewhere", async () => {
  const admin = await locked.login();
  const made = async (name) => (await (await fetch(new URL("/api/tokens", locked.url), { method: "POST", headers: { ...admin, "content-type": "application/json" }, body: JSON.stringify({ name, scopes: ["read", "operate"] }) })).json());
  const [first, second] = [await made("first"), await made("second")];
  const revoke = (token) => fetch(new URL(`/api/tokens/${token.id}`, locked.url), { method: "DELETE", headers: admin });
  const { page, context, close } = await openPage(browser, locked);
  await page.goto("/queue");
  await logIn(page, first.secret);
  await page.getByText("Nothing waits.").waitFor();
  await page.getByText("Measure many runs again").click();
  await page.getByLabel("Note", { exact: true }).fill("half written");
  await revoke(first);
  const out = page.getByRole("alert").filter({ hasText: "You are not logged in any more" });
  await out.waitFor();
  await keepPicture(page, "logged-out");
  assert.equal(await out.getByRole("link", { name: "Log in" }).getAttribute("href"), "/login?next=%2Fqueue");

  const tab = await context.newPage();
  await tab.goto("/login");
  await logIn(tab, second.secret);
  await tab.getByText("No runs yet").waitFor();
  await tab.close();
  await page.bringToFront();
  await out.waitFor({ state: "detached" });
  assert.equal(await page.getByLabel("Note", { exact: true }).inputValue(), "half written");

  await revoke(second);
  await out.getByRole("link", { name: "Log in" }).click();
  const third = await made("third");
  await logIn(page, third.secret);
  await page.waitForURL("**/queue");
  await page.getByText("Nothing waits.").waitFor();
  await close();
});

test("another site's page that is open in the same browser can do nothing", async () => {
  evil = createServer((_, response) => response.setHeader("content-type", "text/html").end("<title>evil</title>"));
  await new Promise((done) => evil.listen(0, "127.0.0.1", done));
  const context = await browser.newContext();
  const page = await context.newPage();
  await page.goto((await locked.newLogin()).href);
  const [headers, rig] = [await locked.login(), await readFile(run.rig, "utf8")];
  const runsThere = async () => (await (await fetch(new URL("/api/runs", locked.url), { headers })).json()).items.length;
  const sendFromPage = () =>
    page.evaluate(
      async ({ url, rig }) => {
        const form = new FormData();
        for (const [name, value] of Object.entries({ asset: "evil", rig })) form.append(name, value);
        form.append("file", new Blob(["no video"]), "evil.mp4");
        return fetch(url, { method: "POST", mode: "no-cors", credentials: "include", body: form }).then(({ status }) => status, () => "refused");
      },
      { url: `${locked.url}/api/runs`, rig },
    );
  await page.goto(`http://127.0.0.1:${evil.address().port}/`);
  assert.notEqual(await sendFromPage(), 201);
  assert.equal(await runsThere(), 0);
  await page.goto(locked.url);
  assert.equal(await sendFromPage(), 201, "our own page may");
  assert.equal(await runsThere(), 1);
  await context.close();

});

test("rules of keeping say beforehand what goes, are stored for every server, and given up again; what is pinned stays", async () => {
  const { page, close } = await openPage(browser, open);
  await page.goto("/settings/retention");
  const held = page.getByRole("region", { name: "The rules that hold" });
  await held.getByText("more than 3,650 days ago").waitFor();
  await held.getByText("more than 500 GB").waitFor();
  await held.getByText("this server's own settings, from how it was started").waitFor();
  await held.getByText("Nothing would be deleted.").waitFor();
  const other = page.getByRole("region", { name: "Other rules" });
  const [days, gb, show, keep] = [other.getByLabel("Keep for, days"), other.getByLabel("Store at most, GB"), other.getByRole("button", { name: "Show what would go" }), other.getByRole("button", { name: "Keep by these rules" })];
  assert.equal(await keep.count(), 0, "nothing is stored that nobody looked at");
  await days.fill("many");
  await other.getByText("Expected a number of 0 or more.").waitFor();
  await days.fill("0");
  await gb.fill("");
  await show.click();
  const preview = await getJson(open, "/api/retention?exactly=true&keep_days=0");
  assert.equal(preview.runs, 2);
  await other.getByText(/^2 runs would be deleted/).waitFor();
  assert.ok(await keep.isDisabled(), "rules that keep nothing are not stored");
  assert.deepEqual(await other.getByRole("rowheader").allTextContents(), ["Old main", "New main"]);
  await other.getByRole("button", { name: /^Pin the run of Old main/ }).click();
  await other.getByText(/^1 run would be deleted/).waitFor();
  assert.deepEqual(await other.getByRole("rowheader").allTextContents(), ["New main"]);
  assert.equal((await getJson(open, `/api/runs/${runs[0].id}/pin`)).pinned, true);

  // Less room than is taken: what would go is said, the fields no longer fit what was looked at, somebody else is faster.
  await days.fill("");
  await gb.fill("0.000001");
  assert.equal(await keep.count(), 0);
  await show.click();
  await other.getByText(/^1 run would be deleted/).waitFor();
  await keepPicture(page, "retention-tried");
  await keep.click();
  const dialog = other.getByRole("dialog");
  await dialog.getByRole("heading", { name: /^Delete 1 run/ }).waitFor();
  await keepPicture(page, "retention-asked");
  await dialog.getByRole("button", { name: "Leave it as it is" }).click();
  await days.fill("400");
  await gb.fill("");
  await show.click();
  const put = (rules) => fetch(new URL("/api/retention", open.url), { method: "PUT", headers: { "content-type": "application/json" }, body: JSON.stringify(rules) });
  assert.equal((await put({ keep_days: 700 })).status, 200);
  await keep.click();
  await dialog.getByRole("button", { name: "Keep by them" }).click();
  await dialog.getByRole("alert").getByText("Somebody else has changed it").waitFor();
  await held.getByText("more than 700 days ago").waitFor();
  await dialog.getByRole("button", { name: "Keep by them" }).click();
  await held.getByText("more than 400 days ago").waitFor();
  await held.getByText(/^They were stored by anyone and hold on every server/).waitFor();
  await other.getByText("These rules hold now.").waitFor();
  const { rules } = await getJson(open, "/api/retention");
  assert.deepEqual([rules.origin, rules.keep_days, rules.quota_gb ?? null, rules.own_keep_days], ["stored", 400, null, 3650]);
  await keepPicture(page, "retention-stored");

  await held.getByRole("button", { name: "Use the server's own settings again" }).click();
  await held.getByRole("dialog").getByText("more than 3,650 days ago").waitFor();
  await held.getByRole("dialog").getByText("Nothing would be deleted.").waitFor();
  await held.getByRole("dialog").getByRole("button", { name: "Use them" }).click();
  await held.getByText(/own settings, from how they were started, hold again, by the word of anyone/).waitFor();
  await held.getByText("more than 3,650 days ago").first().waitFor();
  assert.equal((await getJson(open, "/api/retention")).rules.origin, "server");
  assert.equal((await getJson(open, "/api/runs")).items.length, 2, "nothing went");

  await page.goto(`/runs/${runs[0].id}`);
  await page.getByText("Pinned: it is kept whatever the rules say.").waitFor();
  await page.getByRole("button", { name: "Let the rules decide" }).click();
  await page.getByRole("button", { name: "Keep for good" }).waitFor();
  assert.equal((await getJson(open, `/api/runs/${runs[0].id}/pin`)).pinned, false);
  await close();
});

test("what is said about a run is set right, and never over what somebody else wrote", async () => {
  const id = runs[1].id;
  const { page, close } = await openPage(browser, open, { timezoneId: "Asia/Tokyo" });
  await page.goto(`/runs/${id}`);
  const form = page.getByRole("dialog", { name: "What is said about this run" });
  await page.getByRole("button", { name: "Change details" }).click();
  await form.getByLabel("Starts at, mm").fill("12.5 m");
  await form.getByText("Expected a length in mm").waitFor();
  assert.ok(await form.getByRole("button", { name: "Save" }).isDisabled());
  await form.getByLabel("Starts at, mm").fill("12500");
  await form.getByLabel("Asset").fill("Main, renamed");
  await form.getByLabel("Direction").selectOption({ label: "Chainage falls" });
  await form.getByLabel("Recorded").fill("2026-03-01T09:30:00");
  await form.getByLabel("Note").fill("after the flood");
  await keepPicture(page, "run-edited");
  await form.getByRole("button", { name: "Save" }).click();
  await form.waitFor({ state: "hidden" });
  await page.getByRole("link", { name: "Main, renamed" }).waitFor();
  await page.getByText("after the flood").waitFor();
  const now = await getJson(open, `/api/runs/${id}`);
  const said = ({ asset, chainage_mm, direction, recorded_at, note }) => [asset, chainage_mm, direction, new Date(recorded_at).toISOString(), note];
  assert.deepEqual(said(now), ["Main, renamed", 12_500, "backward", "2026-03-01T00:30:00.000Z", "after the flood"]);
  assert.ok(!(await getJson(open, "/api/assets")).items.some(({ name }) => name === "New main"), "an asset without runs is gone");

  await page.getByRole("button", { name: "Change details" }).click();
  await form.getByLabel("Note").fill("mine");
  await fetch(new URL(`/api/runs/${id}`, open.url), { method: "PATCH", headers: { "content-type": "application/json" }, body: JSON.stringify({ note: "theirs" }) });
  await form.getByRole("button", { name: "Save" }).click();
  await form.getByText("Somebody else has changed it meanwhile").waitFor();
  assert.equal(await form.getByLabel("Note").inputValue(), "theirs");
  assert.equal((await getJson(open, `/api/runs/${id}`)).note, "theirs");
  await form.getByLabel("Note").fill("ours");
  await form.getByRole("button", { name: "Save" }).click();
  await form.waitFor({ state: "hidden" });
  await soon("the note is ours", async () => (await getJson(open, `/api/runs/${id}`)).note === "ours");
  const log = (await getJson(open, "/api/audit")).items.filter(({ method, path }) => method === "PATCH" && path.endsWith(id));
  assert.deepEqual(log.map(({ status }) => status), [200, 412, 200, 200], "every try is in the audit log");
  await close();
});
