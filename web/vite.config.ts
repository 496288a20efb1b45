import { defineConfig } from "vite";
import { brotli, viewerVersion } from "./brotli.ts";

// The pages are built into the binary. While working on them: `stria serve` beside `npm run dev`,
// which passes everything that is not a page on to the server.
const server = process.env["STRIA_SERVER"] ?? "http://127.0.0.1:8420";
const proxy = { "/api": server, "/viewer": server };

export default defineConfig({
  plugins: [brotli()],
  // The viewer's address names its version, so that browsers may keep it for ever; without it they ask again every time.
  define: { VIEWER_FOLDER: JSON.stringify(["/viewer", viewerVersion()].filter((part) => part !== null).join("/")) },
  build: {
    target: "es2022",
    // The content security policy allows no data: scripts or styles, so nothing is inlined.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
  },
  worker: { format: "es" },
  server: { proxy },
  preview: { proxy },
});
