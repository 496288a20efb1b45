// Recipes as the page reads and changes them: the server's TOML, one `key = value` a line under `[section]`s.

/** The values of a recipe by their dotted keys, as TOML writes them. */
export function valuesOf(toml: string): Map<string, string> {
  const values = new Map<string, string>();
  let section = "";
  for (const line of toml.split("\n")) {
    const heading = /^\[([\w.]+)\]\s*$/.exec(line)?.[1];
    if (heading !== undefined) section = `${heading}.`;
    const [, key, value] = /^(\w+)\s*=\s*(.+?)\s*$/.exec(line) ?? [];
    if (key !== undefined && value !== undefined) values.set(section + key, value);
  }
  return values;
}

/** A recipe with some values changed. */
export function withValues(toml: string, changes: Map<string, string>): string {
  let section = "";
  const lines = toml.split("\n").map((line) => {
    const heading = /^\[([\w.]+)\]\s*$/.exec(line)?.[1];
    if (heading !== undefined) section = `${heading}.`;
    const key = /^(\w+)\s*=/.exec(line)?.[1];
    const change = key === undefined ? undefined : changes.get(section + key);
    return change === undefined ? line : `${key} = ${change}`;
  });
  return lines.join("\n");
}

/** A JSON value as TOML writes it: numbers, words and flags look the same in both. */
export const tomlOf = (value: unknown): string => JSON.stringify(value);

/** The leaves of a nested object by their dotted keys. */
export function leavesOf(value: unknown, prefix = ""): Map<string, unknown> {
  const leaves = new Map<string, unknown>();
  if (typeof value !== "object" || value === null || Array.isArray(value)) return leaves.set(prefix, value);
  for (const [key, part] of Object.entries(value)) {
    for (const [name, leaf] of leavesOf(part, prefix === "" ? key : `${prefix}.${key}`)) leaves.set(name, leaf);
  }
  return leaves;
}
