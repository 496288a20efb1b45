// Checksums of pieces of files, worked out beside the page.

import type { Digest, DigestOrder } from "./digest_worker.ts";

let worker: Worker | null = null;
let nextId = 1;
const waiting = new Map<number, (sha256: Uint8Array | null) => void>();

function open(): Worker {
  const made = new Worker(new URL("./digest_worker.ts", import.meta.url), { type: "module" });
  made.onmessage = ({ data: { id, sha256 } }: MessageEvent<Digest>) => {
    waiting.get(id)?.(sha256);
    waiting.delete(id);
  };
  // Without its code nobody ever answers: the next piece tries again.
  made.onerror = () => {
    worker = null;
    for (const answer of waiting.values()) answer(null);
    waiting.clear();
  };
  return made;
}

/** tus' `Upload-Checksum` of a piece; null where it could not be worked out. */
export async function checksumOf(piece: Blob): Promise<string | null> {
  worker ??= open();
  const id = nextId;
  nextId += 1;
  const sha256 = await new Promise<Uint8Array | null>((answer) => {
    waiting.set(id, answer);
    worker?.postMessage({ id, piece } satisfies DigestOrder);
  });
  return sha256 === null ? null : `sha256 ${btoa(String.fromCharCode(...sha256))}`;
}
