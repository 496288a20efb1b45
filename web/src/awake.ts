// A machine that slept, or a page that was frozen, wakes up with connections that look alive and are dead: who waits for an answer is told.

/** How often the clock is looked at, ms. */
const LOOK_MS = 5000;
/** A look that comes so late, ms, means sleep: browsers let hidden pages wait for a minute, and no longer. */
const SLEPT_MS = 90_000;

/** After a sleep, for so long, the browser may still use connections that are dead, ms. */
const DROWSY_MS = 60_000;
/** How long an answer is waited for, ms: while connections may be dead, and otherwise. */
const WAIT_MS = { drowsy: 4000, awake: 40_000 };

const listeners = new Set<() => void>();
let wokeAt = Number.NEGATIVE_INFINITY;
function wake(): void {
  wokeAt = Date.now();
  [...listeners].forEach((listener) => listener());
}

let lookedAt = Date.now();
setInterval(() => {
  const slept = Date.now() - lookedAt > SLEPT_MS;
  lookedAt = Date.now();
  if (slept) wake();
}, LOOK_MS);
// A browser that froze the page itself says so.
document.addEventListener("resume", wake);
addEventListener("pageshow", (event) => event.persisted && wake());

/** How long to wait for an answer before its connection counts as dead, ms. */
export const patienceMs = (): number => (Date.now() - wokeAt < DROWSY_MS ? WAIT_MS.drowsy : WAIT_MS.awake);

/** Calls the listener after every sleep, until the returned function is called. */
export function onWake(listener: () => void): () => void {
  listeners.add(listener);
  return () => listeners.delete(listener);
}
