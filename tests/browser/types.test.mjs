// The pages' types are generated from the server's OpenAPI document; this says when they are not the same any more.

import assert from "node:assert/strict";
import { spawnSync } from "node:child_process";
import { existsSync } from "node:fs";
import path from "node:path";
import { test } from "node:test";
import { fileURLToPath } from "node:url";

const web = path.resolve(path.dirname(fileURLToPath(import.meta.url)), "../../web");

test("web/src/api.gen.ts is what server/openapi.json says", () => {
  assert.ok(existsSync(path.join(web, "node_modules")), "web/node_modules is missing: run `make build`");
  const check = spawnSync("npm", ["run", "--silent", "generate:check"], { cwd: web, encoding: "utf8" });
  assert.equal(check.status, 0, `run \`npm run generate\` in web/ and look at what changed\n${check.stdout}${check.stderr}`);
});
