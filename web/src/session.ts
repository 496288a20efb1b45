// Whether the server still knows who this browser is: sessions end while pages are open.

type Listener = (loggedIn: boolean) => void;
const listeners = new Set<Listener>();
let loggedIn = true;

/** What an answer told: it was let in, or nobody is logged in any more. */
export function heardOfSession(now: boolean): void {
  if (now === loggedIn) return;
  loggedIn = now;
  [...listeners].forEach((listener) => listener(now));
}

/** Calls the listener when the session ends and when somebody has logged in again, until the returned function is called. */
export function onSession(listener: Listener): () => void {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

/** Where to log in, and then come back to this very address. */
export function loginPath(): string {
  return `/login?next=${encodeURIComponent(location.pathname + location.search)}`;
}
