// One option of a recipe: its control follows from what values it takes.

import { useId } from "preact/hooks";
import type { RecipeOption } from "../api.ts";
import { tomlOf } from "../recipe_text.ts";
import { runTexts } from "../texts/run.ts";

const words = runTexts.again;

/** What is wrong with a value, in words; null where nothing is. */
export function problemWith({ range, unit }: RecipeOption, value: string): string | null {
  if (range.kind === "text") return unquoted(value).length <= range.max_chars ? null : words.bad(words.textRange(range.max_chars));
  if (range.kind !== "number") return null;
  const number = Number(value.trim());
  const good = value.trim() !== "" && Number.isFinite(number) && number >= range.min && number <= range.max && (!range.whole || Number.isInteger(number));
  return good ? null : words.bad((range.whole ? words.whole : "") + words.range(range.min, range.max, unit));
}

/** A text as people write it, from how TOML does. */
function unquoted(toml: string): string {
  return /^".*"$/.test(toml) ? (JSON.parse(toml) as string) : toml.replace(/^'(.*)'$/, "$1");
}

type Props = {
  option: RecipeOption;
  /** The recipe's own value, in TOML. */
  base: string;
  /** Another value, in TOML; null: none. */
  value: string | null;
  onChange: (value: string | null) => void;
};

export function OptionField({ option, base, value, onChange }: Props) {
  const id = useId();
  const problem = value === null ? null : problemWith(option, value);
  const aria = { id, "aria-describedby": `${id}-doc`, "aria-invalid": problem !== null };
  const shown = value ?? base;
  return (
    <div class={value === null ? "option" : "option changed"}>
      <label for={id}>
        <code>{option.key}</code>
        {option.unit !== "" && <span class="faint"> {option.unit}</span>}
      </label>
      <div class="option-control">
        {option.range.kind === "choice" && (
          <select {...aria} value={shown} onChange={(event) => onChange(event.currentTarget.value)}>
            {option.range.of.map((word) => (
              <option key={word} value={tomlOf(word)}>
                {word}
              </option>
            ))}
          </select>
        )}
        {option.range.kind === "flag" && (
          <select {...aria} value={shown} onChange={(event) => onChange(event.currentTarget.value)}>
            <option value="true">true</option>
            <option value="false">false</option>
          </select>
        )}
        {option.range.kind === "number" && <input {...aria} inputMode="decimal" autoComplete="off" value={shown} onInput={(event) => onChange(event.currentTarget.value)} />}
        {option.range.kind === "text" && <input {...aria} autoComplete="off" spellcheck={false} value={unquoted(shown)} onInput={(event) => onChange(tomlOf(event.currentTarget.value))} />}
        {value !== null && (
          <button type="button" class="quiet small" aria-label={`${words.reset}: ${option.key}`} title={words.reset} onClick={() => onChange(null)}>
            ↺
          </button>
        )}
      </div>
      <p id={`${id}-doc`} class={problem === null ? "faint" : "field-problem"}>
        {problem ?? option.doc}
        {problem === null && option.range.kind === "number" && ` (${words.range(option.range.min, option.range.max, option.unit)}; ${words.value(base)})`}
        {problem === null && option.range.kind !== "number" && ` (${words.value(base)})`}
      </p>
    </div>
  );
}

/** What was typed as TOML writes it: an option that takes fractions is written with a point. */
export function asToml(text: string, { range }: RecipeOption): string {
  if (range.kind !== "number") return text;
  const value = Number(text.trim());
  return !range.whole && Number.isInteger(value) ? value.toFixed(1) : `${value}`;
}
