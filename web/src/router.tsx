// Addresses: which view the page's path stands for, and links that change it without loading the page anew.

import type { ComponentChildren, JSX } from "preact";
import { useEffect, useState } from "preact/hooks";
import type { Defect } from "./api.ts";

/** What a path stands for. */
export type Route =
  | { view: "runs" }
  | { view: "send" }
  | { view: "live" }
  | { view: "queue" }
  | { view: "batch"; batch: string }
  | { view: "defects" }
  | { view: "settings"; section: string }
  | { view: "run"; run: string; job: string | null; tab: string | null }
  | { view: "compare"; run: string; left: string | null; right: string | null }
  | { view: "unknown"; path: string };

const PLAIN: Record<string, Route> = {
  "/": { view: "runs" },
  "/runs": { view: "runs" },
  "/send": { view: "send" },
  "/live": { view: "live" },
  "/queue": { view: "queue" },
  "/defects": { view: "defects" },
  "/settings": { view: "settings", section: "rigs" },
};

/** Reads a path and its query. */
export function routeOf(location: { pathname: string; search: string }): Route {
  const path = location.pathname.replace(/(.)\/$/, "$1");
  const plain = PLAIN[path];
  if (plain !== undefined) return plain;
  const query = new URLSearchParams(location.search);
  const [, first, second, third, more] = path.split("/");
  const unknown: Route = { view: "unknown", path: location.pathname };
  if (second === undefined || more !== undefined) return unknown;
  if (first === "settings" && third === undefined) return { view: "settings", section: second };
  if (first === "batches" && third === undefined) return { view: "batch", batch: decodeURIComponent(second) };
  if (first !== "runs") return unknown;
  const run = decodeURIComponent(second);
  if (third === undefined) return { view: "run", run, job: query.get("job"), tab: query.get("tab") };
  return third === "compare" ? { view: "compare", run, left: query.get("left"), right: query.get("right") } : unknown;
}

/** The path of a run's page, with one of its jobs chosen or (null) the latest, and one of the page's parts. */
export function runPath(run: string, job: string | null = null, tab: string | null = null): string {
  const query = new URLSearchParams();
  if (job !== null) query.set("job", job);
  if (tab !== null) query.set("tab", tab);
  return `/runs/${encodeURIComponent(run)}${query.size === 0 ? "" : `?${query}`}`;
}

/** The path of a batch's page. */
export const batchPath = (batch: string): string => `/batches/${encodeURIComponent(batch)}`;

/** A run's defects with one of them in the middle of the map. */
export function defectPath({ run, job, current, number, x_mm, y_mm, length_mm, width_mm }: Defect): string {
  const query = new URLSearchParams({ tab: "defects", no: `${number}` });
  if (!current) query.set("job", job);
  // So close that it takes about a third of the map.
  query.set("at", `${x_mm.toFixed(1)},${y_mm.toFixed(1)},${Math.max(length_mm, width_mm, 20) / 150}`);
  return `/runs/${encodeURIComponent(run)}?${query.toString().replaceAll("%2C", ",")}`;
}

/** Two jobs side by side: of one run, or of two runs of one asset. */
export function comparePath(run: string, left: string, right: string): string {
  return `/runs/${encodeURIComponent(run)}/compare?${new URLSearchParams({ left, right })}`;
}

/** Goes to another of our pages; `replace` leaves no step to go back to. */
export function go(path: string, replace = false): void {
  if (replace) history.replaceState(null, "", path);
  else history.pushState(null, "", path);
  dispatchEvent(new PopStateEvent("popstate"));
}

/** What the address says behind its question mark. */
export function readQuery(): URLSearchParams {
  return new URLSearchParams(location.search);
}

/** Changes what the address says, so that it can be shared and found again after a reload; null takes a word out. The view stays. */
export function writeQuery(change: Record<string, string | null>): void {
  const query = readQuery();
  for (const [name, value] of Object.entries(change)) {
    if (value === null || value === "") query.delete(name);
    else query.set(name, value);
  }
  // Commas are allowed in a query and easier to read than their codes.
  const text = query.toString().replaceAll("%2C", ",");
  const path = `${location.pathname}${text === "" ? "" : `?${text}`}`;
  if (path !== `${location.pathname}${location.search}`) history.replaceState(history.state, "", path);
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

type LinkProps = { to: string; id?: string; class?: string; current?: boolean; label?: string; keepPlace?: boolean; role?: "tab"; selected?: boolean; children: ComponentChildren };

/** A link to one of our own pages; a click with a modifier key opens it elsewhere, as in any page. */
export function Link({ to, current, label, keepPlace, selected, children, ...rest }: LinkProps): JSX.Element {
  const follow = (event: MouseEvent) => {
    if (event.button !== 0 || event.metaKey || event.ctrlKey || event.shiftKey || event.altKey) return;
    event.preventDefault();
    go(to);
    if (!keepPlace) scrollTo(0, 0);
  };
  return (
    <a href={to} onClick={follow} aria-current={current ? "page" : undefined} aria-selected={selected} aria-label={label} {...rest}>
      {children}
    </a>
  );
}
