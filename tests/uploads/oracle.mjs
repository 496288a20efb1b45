// The reference: @tus/server on a folder. Prints its address, and runs until its stdin ends.
//   node oracle.mjs FOLDER MAX_BYTES KEPT_MS

import { FileStore } from "@tus/file-store";
import { Server } from "@tus/server";

const [directory, maxBytes, keptMs] = process.argv.slice(2);
const datastore = new FileStore({ directory, expirationPeriodInMilliseconds: Number(keptMs) });
const server = new Server({ path: "/api/uploads", datastore, relativeLocation: true, maxSize: Number(maxBytes) });
const listening = server.listen({ host: "127.0.0.1", port: 0 }, () => {
  console.log(`http://127.0.0.1:${listening.address().port}`);
});
process.stdin.resume();
process.stdin.on("end", () => process.exit(0));
