// Beside the page: the SHA-256 of a piece of a file, so that a large one stops nothing.

/** What the page asks for: a piece. */
export type DigestOrder = { id: number; piece: Blob };
/** What it gets: the digest, or null where the piece could not be read. */
export type Digest = { id: number; sha256: Uint8Array | null };

async function sha256Of(piece: Blob): Promise<Uint8Array> {
  const bytes = new Uint8Array(await piece.arrayBuffer());
  // Browsers lend theirs to pages under HTTPS and on localhost only; many a site network has neither.
  if ("subtle" in crypto) return new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  const { sha256 } = await import("@noble/hashes/sha2.js");
  return sha256(bytes);
}

self.onmessage = ({ data: { id, piece } }: MessageEvent<DigestOrder>) => {
  sha256Of(piece)
    .catch(() => null)
    .then((sha256) => self.postMessage({ id, sha256 } satisfies Digest));
};
