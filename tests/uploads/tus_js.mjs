// Sends a file with tus-js-client as a program would use it, and prints what became of it as JSON.
//   node tus_js.mjs ENDPOINT FILE METADATA_JSON

import { createReadStream } from "node:fs";
import { Upload } from "tus-js-client";

const [endpoint, file, metadata] = process.argv.slice(2);
const became = {};
const upload = new Upload(createReadStream(file), {
  endpoint,
  metadata: JSON.parse(metadata),
  retryDelays: Array(1000).fill(20),
  onAfterResponse(_request, response) {
    for (const name of ["Stria-Run", "Stria-Job"]) became[name] = response.getHeader(name) ?? became[name];
  },
  onError(error) {
    console.error(String(error));
    process.exit(1);
  },
  onSuccess() {
    console.log(JSON.stringify({ url: upload.url, run: became["Stria-Run"], job: became["Stria-Job"] }));
  },
});
upload.start();
