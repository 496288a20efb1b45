// Fetching a tile: apart from `api.ts`, so that the map's worker carries nothing else.

/** A tile's bytes; null where there is no such tile. `fresh`: ask the server whether it has changed. */
export async function getTile(url: string, fresh: boolean, signal: AbortSignal): Promise<Blob | null> {
  const response = await fetch(url, { signal, cache: fresh ? "no-cache" : "default" });
  if (response.status === 404) return null;
  if (!response.ok) throw new Error(`${url}: HTTP ${response.status}`);
  return response.blob();
}
