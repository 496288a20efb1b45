// Validates a glTF file with Khronos' validator and prints its report as one JSON object, with the corners of the mesh in
// metres as its own document gives them.
// usage: node gltf.mjs FILE
import { readFile } from "node:fs/promises";

import validator from "gltf-validator";

const bytes = new Uint8Array(await readFile(process.argv[2]));
const report = await validator.validateBytes(bytes, { maxIssues: 20 });
const length = new DataView(bytes.buffer, bytes.byteOffset).getUint32(12, true);
const gltf = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + length)));
const position = gltf.accessors[gltf.meshes[0].primitives[0].attributes.POSITION];
const [x, y, z] = gltf.nodes[0].translation;
const corner = (c) => [c[0] + x, c[1] + y, c[2] + z];
console.log(
  JSON.stringify({
    issues: report.issues,
    info: report.info,
    low: corner(position.min),
    high: corner(position.max),
    indices: gltf.accessors[gltf.meshes[0].primitives[0].indices].count,
  }),
);
