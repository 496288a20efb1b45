// After the build: a brotli form beside every file, and the rerun viewer's, which the server sends to those who take it.

import { spawnSync } from "node:child_process";
import { copyFileSync, existsSync, mkdirSync, readdirSync, readFileSync, renameSync, statSync, writeFileSync } from "node:fs";
import path from "node:path";
import { brotliCompressSync, constants } from "node:zlib";
import type { Plugin } from "vite";

/** Smaller files gain nothing. */
const LEAST_BYTES = 600;
/** 0 to 11. The page's few files are worth the most; the viewer has 40 MB, and the last steps take minutes for a few per cent. */
const PAGE_EFFORT = 11;
const VIEWER_EFFORT = 9;
/** Largest window that every browser knows. */
const WINDOW_BITS = 24;

const repository = path.resolve(import.meta.dirname, "..");

export function brotli(): Plugin {
  let folder = "";
  return {
    name: "brotli",
    apply: "build",
    configResolved(config) {
      folder = path.resolve(config.root, config.build.outDir);
    },
    closeBundle() {
      for (const name of readdirSync(folder, { recursive: true, encoding: "utf8" })) {
        const file = path.join(folder, name);
        if (statSync(file).isFile() && /\.(js|css|html|svg)$/.test(name) && statSync(file).size >= LEAST_BYTES) {
          writeFileSync(`${file}.br`, compressed(readFileSync(file), PAGE_EFFORT));
        }
      }
      addViewer(folder);
    },
  };
}

function compressed(bytes: Buffer, effort: number): Buffer {
  return brotliCompressSync(bytes, { params: { [constants.BROTLI_PARAM_QUALITY]: effort, [constants.BROTLI_PARAM_LGWIN]: WINDOW_BITS, [constants.BROTLI_PARAM_SIZE_HINT]: bytes.length } });
}

/**
 * The viewer lies in a crate, at the version of the SDK; its brotli form is kept in `target`, since it takes a minute. Where
 * the pages are built without the crates at hand, as in a container of Node alone, the server sends the viewer in gzip.
 */
function addViewer(folder: string): void {
  const version = viewerVersion();
  if (version === null) return say("no Cargo.lock here");
  const kept = path.join(repository, "target", "viewer-brotli", version);
  const to = path.join(folder, "viewer", version);
  const names = ["re_viewer.js", "re_viewer_bg.wasm"];
  if (names.some((name) => !existsSync(path.join(kept, `${name}.br`)))) {
    const from = viewerFolder(version);
    if (from === null) return say("no cargo here that knows its crate");
    mkdirSync(kept, { recursive: true });
    for (const name of names) {
      const squeezed = path.join(kept, `${name}.br`);
      writeFileSync(`${squeezed}.new`, compressed(readFileSync(path.join(from, name)), VIEWER_EFFORT));
      renameSync(`${squeezed}.new`, squeezed);
    }
  }
  mkdirSync(to, { recursive: true });
  for (const name of names) copyFileSync(path.join(kept, `${name}.br`), path.join(to, `${name}.br`));
}

function say(why: string): void {
  console.warn(`The 3D viewer will be sent in gzip, not in brotli: ${why}.`);
}

/** The viewer's version, as the lock file has it; null where there is none. */
export function viewerVersion(): string | null {
  const file = path.join(repository, "Cargo.lock");
  if (!existsSync(file)) return null;
  const version = /name = "re_web_viewer_server"\nversion = "([^"]+)"/.exec(readFileSync(file, "utf8"))?.[1];
  if (version === undefined) throw new Error("Cargo.lock names no re_web_viewer_server: has the viewer's crate another name?");
  return version;
}

interface Metadata {
  packages: { name: string; version: string; manifest_path: string }[];
}

/** Where cargo keeps the crate that has the viewer in it; null without cargo. */
function viewerFolder(version: string): string | null {
  const answer = spawnSync("cargo", ["metadata", "--locked", "--format-version", "1"], { cwd: repository, encoding: "utf8", maxBuffer: 1 << 28 });
  if (answer.status !== 0) return null;
  const { packages } = JSON.parse(answer.stdout) as Metadata;
  const found = packages.find((each) => each.name === "re_web_viewer_server" && each.version === version);
  return found === undefined ? null : path.join(path.dirname(found.manifest_path), "web_viewer");
}
