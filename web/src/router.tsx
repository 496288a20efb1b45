// Addresses: which view the page's path stands for, and links that change it without loading the page anew.

import type { ComponentChildren, JSX } from "preact";
import { useEffect, useState } from "preact/hooks";

/** What a path stands for. */
export type Route = { view: "runs" } | { view: "run"; run: string; job: string | null } | { view: "unknown"; path: string };

/** Reads a path and its query: `/`, `/runs/{id}`, `/runs/{id}?job={id}`. */
export function routeOf(location: { pathname: string; search: string }): Route {
  if (location.pathname === "/" || location.pathname === "/runs") return { view: "runs" };
  const run = /^\/runs\/([^/]+)\/?$/.exec(location.pathname)?.[1];
  if (run === undefined) return { view: "unknown", path: location.pathname };
  return { view: "run", run: decodeURIComponent(run), job: new URLSearchParams(location.search).get("job") };
}

/** The path of a run's page, with one of its jobs chosen or (null) the latest. */
export function runPath(run: string, job: string | null = null): string {
  return `/runs/${encodeURIComponent(run)}${job === null ? "" : `?job=${encodeURIComponent(job)}`}`;
}

/** Goes to another of our pages; `replace` leaves no step to go back to. */
export function go(path: string, replace = false): void {
  if (replace) history.replaceState(null, "", path);
  else history.pushState(null, "", path);
  dispatchEvent(new PopStateEvent("popstate"));
}

/** The current route; the component renders again when it changes. */
export function useRoute(): Route {
  const [route, setRoute] = useState(() => routeOf(location));
  useEffect(() => {
    const changed = () => setRoute(routeOf(location));
    addEventListener("popstate", changed);
    return () => removeEventListener("popstate", changed);
  }, []);
  return route;
}

type LinkProps = { to: string; class?: string; current?: boolean; label?: string; children: ComponentChildren };

/** A link to one of our own pages; a click with a modifier key opens it elsewhere, as in any page. */
export function Link({ to, current, label, children, ...rest }: LinkProps): JSX.Element {
  const follow = (event: MouseEvent) => {
    if (event.button !== 0 || event.metaKey || event.ctrlKey || event.shiftKey || event.altKey) return;
    event.preventDefault();
    go(to);
    scrollTo(0, 0);
  };
  return (
    <a href={to} onClick={follow} aria-current={current ? "page" : undefined} aria-label={label} {...rest}>
      {children}
    </a>
  );
}
