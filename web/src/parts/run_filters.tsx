// What to look for among the runs.

import type { Asset, RunFilter } from "../api.ts";
import { Link } from "../router.tsx";
import { texts } from "../texts.ts";

const words = texts.runs;

type Props = { filter: RunFilter; assets: Asset[]; onChange: (filter: RunFilter) => void };

export function RunFilters({ filter, assets, onChange }: Props) {
  const set = (name: keyof RunFilter) => (event: { currentTarget: { value: string } }) => onChange({ ...filter, [name]: event.currentTarget.value });
  const used = filter.state + filter.asset + filter.from + filter.to + filter.q !== "";
  return (
    <form class="filters" role="search" onSubmit={(event) => event.preventDefault()}>
      <input type="search" class="search" aria-label={words.search} placeholder={words.searchHint} value={filter.q} onInput={set("q")} />
      <select aria-label={words.asset} value={filter.asset} onChange={set("asset")}>
        <option value="">{words.anyAsset}</option>
        {filter.asset !== "" && !assets.some(({ name }) => name === filter.asset) && <option value={filter.asset}>{filter.asset}</option>}
        {assets.map(({ name, runs }) => (
          <option key={name} value={name}>
            {words.assetRuns(name, runs)}
          </option>
        ))}
      </select>
      <select aria-label={words.state} value={filter.state} onChange={set("state")}>
        <option value="">{words.anyState}</option>
        {Object.entries(texts.state).map(([state, text]) => (
          <option key={state} value={state}>
            {text}
          </option>
        ))}
      </select>
      <label class="date">
        <span>{words.from}</span>
        <input type="date" value={filter.from} max={filter.to} onChange={set("from")} />
      </label>
      <label class="date">
        <span>{words.to}</span>
        <input type="date" value={filter.to} min={filter.from} onChange={set("to")} />
      </label>
      <select aria-label={words.sort} value={filter.sort === "" ? "-created" : filter.sort} onChange={(event) => onChange({ ...filter, sort: event.currentTarget.value === "-created" ? "" : event.currentTarget.value })}>
        {Object.entries(words.sorts).map(([sort, text]) => (
          <option key={sort} value={sort}>
            {text}
          </option>
        ))}
      </select>
      {used && (
        <button type="button" class="quiet" onClick={() => onChange({ q: "", state: "", asset: "", from: "", to: "", sort: filter.sort })}>
          {words.clear}
        </button>
      )}
      {used && <Link to={`/queue?${new URLSearchParams({ again: "1", ...filter, sort: "" })}`}>{words.again}</Link>}
    </form>
  );
}
