// Files that were let go on any page wait here for the page that sends them.

type Taker = (files: File[]) => void;

let waiting: File[] = [];
let taker: Taker | null = null;

/** Hands files to the page for sending, now or when it opens. */
export function keepFiles(files: File[]): void {
  if (taker !== null) taker(files);
  else waiting.push(...files);
}

/** Takes what waits and what comes, until the returned function is called. */
export function takeFiles(take: Taker): () => void {
  taker = take;
  if (waiting.length > 0) take(waiting.splice(0));
  return () => {
    if (taker === take) taker = null;
  };
}
