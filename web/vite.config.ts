import { defineConfig } from "vite";

// The pages are built into the binary. While working on them: `stria serve` beside `npm run dev`,
// which passes everything that is not a page on to the server.
const server = "http://127.0.0.1:8080";

export default defineConfig({
  build: {
    target: "es2022",
    // The content security policy allows no data: scripts or styles, so nothing is inlined.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
  },
  server: {
    proxy: { "/api": server, "/viewer": server },
  },
});
