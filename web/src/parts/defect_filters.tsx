// What to look for among the defects. Chainages are typed in metres, as people say them.

import { useState } from "preact/hooks";
import type { Asset, DefectFilter } from "../api.ts";
import { texts } from "../texts.ts";
import { defectTexts as words } from "../texts/defects.ts";

type Props = { filter: DefectFilter; assets: Asset[]; onChange: (filter: DefectFilter) => void; onClear: () => void; used: boolean };

export function DefectFilters({ filter, assets, onChange, onClear, used }: Props) {
  const set = (name: keyof DefectFilter) => (event: { currentTarget: { value: string } }) => onChange({ ...filter, [name]: event.currentTarget.value });
  const choice = (name: "kind" | "severity" | "state", label: string, any: string, names: Record<string, string>) => (
    <select aria-label={label} value={filter[name]} onChange={set(name)}>
      <option value="">{any}</option>
      {Object.entries(names).map(([value, text]) => (
        <option key={value} value={value}>
          {text}
        </option>
      ))}
    </select>
  );
  return (
    <form class="filters" role="search" onSubmit={(event) => event.preventDefault()}>
      <input type="search" class="search" aria-label={words.search} placeholder={words.searchHint} value={filter.q} onInput={set("q")} />
      <select aria-label={texts.runs.asset} value={filter.asset} onChange={set("asset")}>
        <option value="">{texts.runs.anyAsset}</option>
        {filter.asset !== "" && !assets.some(({ name }) => name === filter.asset) && <option value={filter.asset}>{filter.asset}</option>}
        {assets.map(({ name }) => (
          <option key={name} value={name}>
            {name}
          </option>
        ))}
      </select>
      {choice("kind", words.kindLabel, words.anyKind, words.kinds)}
      {choice("severity", words.severityLabel, words.anySeverity, words.severities)}
      {choice("state", words.stateLabel, words.anyState, words.states)}
      <Figure label={words.deeper} value={filter.depth_min_mm} scale={1} onChange={(depth_min_mm) => onChange({ ...filter, depth_min_mm })} />
      <Figure label={words.from} value={filter.from_mm} scale={1000} onChange={(from_mm) => onChange({ ...filter, from_mm })} />
      <Figure label={words.to} value={filter.to_mm} scale={1000} onChange={(to_mm) => onChange({ ...filter, to_mm })} />
      <select aria-label={words.sort} value={filter.sort === "" ? "-created" : filter.sort} onChange={(event) => onChange({ ...filter, sort: event.currentTarget.value === "-created" ? "" : event.currentTarget.value })}>
        {Object.entries(words.sorts).map(([sort, text]) => (
          <option key={sort} value={sort}>
            {text}
          </option>
        ))}
      </select>
      {used && (
        <button type="button" class="quiet" onClick={onClear}>
          {texts.runs.clear}
        </button>
      )}
    </form>
  );
}

/** A number that is typed; what is no number is not asked for. `scale`: the filter's units in one of what is typed. */
function Figure({ label, value, scale, onChange }: { label: string; value: string; scale: number; onChange: (value: string) => void }) {
  const [typed, setTyped] = useState(value === "" ? "" : `${Number(value) / scale}`);
  const numberOf = (text: string) => (text.trim() === "" ? null : Number(text.replace(",", ".")));
  const shown = value === "" && numberOf(typed) !== null && Number.isFinite(numberOf(typed)) ? "" : typed;
  const bad = Number.isNaN(numberOf(typed));
  return (
    <label class="figure">
      <span>{label}</span>
      <input
        inputMode="decimal"
        autoComplete="off"
        value={shown}
        aria-invalid={bad}
        onInput={(event) => {
          const text = event.currentTarget.value;
          const number = numberOf(text);
          setTyped(text);
          onChange(number === null || !Number.isFinite(number) ? "" : `${number * scale}`);
        }}
      />
    </label>
  );
}
