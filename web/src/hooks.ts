// What several views need: the page's title, data that is loaded and kept fresh, a job followed live.

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { followJob, isActive, problemOf, type Job, type Problem } from "./api.ts";
import { onSession } from "./session.ts";
import { texts } from "./texts.ts";

/** Names the browser's tab. */
export function useTitle(title: string): void {
  useEffect(() => {
    document.title = `${title} · ${texts.product}`;
  }, [title]);
}

/** True in a window as narrow as a phone's: where the style sheet's narrow rules hold. */
export function useNarrow(): boolean {
  const query = useMemo(() => matchMedia("(max-width: 46rem)"), []);
  const [narrow, setNarrow] = useState(query.matches);
  useEffect(() => {
    const changed = () => setNarrow(query.matches);
    query.addEventListener("change", changed);
    return () => query.removeEventListener("change", changed);
  }, []);
  return narrow;
}

/** For data that is loaded once. */
export const once = () => null;

/** Data from the server: the last good value, and what went wrong since, if anything. */
export interface Loaded<T> {
  value: T | null;
  problem: Problem | null;
  reload: () => void;
}

const RETRY_MS = 3000;

/**
 * Loads when shown and whenever `key` changes, again after `everyMs` of the last value (null: once), and after a failure until it works.
 * Rests while nobody looks at the page.
 */
export function useLoaded<T>(key: string, load: () => Promise<T>, everyMs: (value: T) => number | null): Loaded<T> {
  const [state, setState] = useState<{ key: string; value: T | null; problem: Problem | null }>({ key, value: null, problem: null });
  const [turn, setTurn] = useState(0);
  const newest = useRef({ load, everyMs });
  newest.current = { load, everyMs };

  useEffect(() => {
    let timer: ReturnType<typeof setTimeout> | undefined;
    let stopped = false;
    const later = (ms: number) => {
      timer = setTimeout(() => (document.hidden ? later(ms) : void attempt()), ms);
    };
    const attempt = async () => {
      try {
        const value = await newest.current.load();
        if (stopped) return;
        setState({ key, value, problem: null });
        const ms = newest.current.everyMs(value);
        if (ms !== null) later(ms);
      } catch (error) {
        if (stopped) return;
        const problem = problemOf(error);
        setState((before) => ({ key, value: before.key === key ? before.value : null, problem }));
        if (problem.retryable) later(RETRY_MS);
      }
    };
    void attempt();
    // Whoever has logged in again wants to see what was refused.
    const noSession = onSession((loggedIn) => loggedIn && setTurn((n) => n + 1));
    return () => {
      stopped = true;
      noSession();
      clearTimeout(timer);
    };
  }, [key, turn]);

  const current = state.key === key;
  return {
    value: current ? state.value : null,
    problem: current ? state.problem : null,
    reload: () => setTurn((n) => n + 1),
  };
}

/** What following a job has told so far. */
export interface Followed {
  /** The newest state heard, or null before the first. */
  job: Job | null;
  /** Recording segments announced while following. */
  segments: number;
  /** How often the map has grown while following. */
  tiles: number;
  connected: boolean;
}

const NOTHING_HEARD: Followed = { job: null, segments: 0, tiles: 0, connected: true };

/** Follows a job live while `active`; `onEnd` is called when it has come to its end. */
export function useFollowed(job: string | null, active: boolean, onEnd: () => void): Followed {
  const [heard, setHeard] = useState<Followed>(NOTHING_HEARD);
  useEffect(() => {
    setHeard(NOTHING_HEARD);
    if (job === null || !active) return undefined;
    return followJob(job, {
      job: (now) => {
        setHeard((before) => ({ ...before, job: now }));
        if (!isActive(now)) onEnd();
      },
      segment: () => setHeard((before) => ({ ...before, segments: before.segments + 1 })),
      tile: () => setHeard((before) => ({ ...before, tiles: before.tiles + 1 })),
      connected: (connected) => setHeard((before) => ({ ...before, connected })),
    });
  }, [job, active]);
  return heard;
}
