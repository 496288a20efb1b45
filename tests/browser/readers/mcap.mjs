// Reads an MCAP file with npm's @mcap/core by its index and prints what it holds as one JSON object.
// usage: node mcap.mjs FILE
import { open } from "node:fs/promises";

import { McapIndexedReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";

const file = await open(process.argv[2], "r");
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const bytes = new Uint8Array(Number(length));
    const { bytesRead } = await file.read(bytes, 0, bytes.length, Number(offset));
    if (bytesRead !== bytes.length) throw new Error(`${bytesRead} of ${length} bytes at ${offset}`);
    return bytes;
  },
};
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
const topics = {};
let last = 0n;
for await (const message of reader.readMessages()) {
  if (message.logTime < last) throw new Error(`a message of ${message.logTime} after ${last}`);
  last = message.logTime;
  const topic = reader.channelsById.get(message.channelId).topic;
  const found = (topics[topic] ??= { messages: 0, bytes: 0, first_ns: String(message.logTime) });
  found.messages += 1;
  found.bytes += message.data.byteLength;
  found.last_ns = String(message.logTime);
}
const attachments = [];
for await (const attachment of reader.readAttachments()) attachments.push(attachment.name);
console.log(JSON.stringify({ topics, attachments, messages: Number(reader.statistics.messageCount) }));
await file.close();
