// Measuring again: a recipe to begin with, and every option of it in a form that the server's own list of options makes.

import { useMemo, useState } from "preact/hooks";
import { listOptions, listRecipes, listRigs, reprocess, type Job, type RecipeOption, type Run } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { tomlOf, valuesOf, withValues } from "../recipe_text.ts";
import { go, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { runTexts } from "../texts/run.ts";
import { ActionButton } from "./action_button.tsx";
import { asToml, OptionField, problemWith } from "./option_field.tsx";
import { ProblemBox } from "./problem.tsx";

const words = runTexts.again;

type Props = { run: Run; shown: Job; onChanged: () => void };
type Choices = Awaited<ReturnType<typeof loadChoices>>;

async function loadChoices() {
  const [recipes, rigs, options] = await Promise.all([listRecipes(), listRigs(), listOptions()]);
  return { recipes, rigs, options };
}

export function Reprocess(props: Props) {
  const choices = useLoaded("reprocess", loadChoices, once);
  return (
    <section class="again" aria-label={words.heading}>
      <h2>{words.heading}</h2>
      <p class="faint">{words.about}</p>
      {choices.problem && <ProblemBox problem={choices.problem} onRetry={choices.reload} />}
      {choices.value === null ? !choices.problem && <p role="status">{texts.waiting.list}</p> : <Form {...props} choices={choices.value} />}
    </section>
  );
}

function Form({ run, shown, onChanged, choices: { recipes, rigs, options } }: Props & { choices: Choices }) {
  const [recipe, setRecipe] = useState(() => (recipes.find(({ name }) => name === shown.recipe) ?? recipes.find((each) => each.default) ?? recipes[0])?.name ?? "");
  const [rig, setRig] = useState("");
  const [priority, setPriority] = useState("upload");
  const [changes, setChanges] = useState(() => new Map<string, string>());
  const [search, setSearch] = useState("");
  const base = recipes.find(({ name }) => name === recipe);
  const values = useMemo(() => valuesOf(base?.toml ?? ""), [base]);
  const groups = useMemo(() => grouped(options.filter((option) => matches(option, search))), [options, search]);
  const change = (key: string, value: string | null) => {
    const next = new Map(changes);
    if (value === null || value === values.get(key)) next.delete(key);
    else next.set(key, value);
    setChanges(next);
  };
  const wrong = options.some((option) => changes.has(option.key) && problemWith(option, changes.get(option.key)!) !== null);
  const start = async () => {
    const typed = options.flatMap((option) => (changes.has(option.key) ? [[option.key, asToml(changes.get(option.key)!, option)] as const] : []));
    const wanted = changes.size === 0 ? recipe : withValues(base?.toml ?? "", new Map(typed));
    const job = await reprocess(run.id, { recipe: wanted, priority: priority as "upload", ...(rig === "" ? {} : { rig }) });
    onChanged();
    go(runPath(run.id, job.id === run.job.id ? null : job.id));
  };
  return (
    <>
      <div class="fields">
        <label class="field">
          {words.recipe}
          <select value={recipe} onChange={(event) => setRecipe(event.currentTarget.value)}>
            {recipes.map(({ name }) => (
              <option key={name} value={name}>
                {name}
              </option>
            ))}
          </select>
        </label>
        <label class="field">
          {words.rig}
          <select value={rig} onChange={(event) => setRig(event.currentTarget.value)}>
            <option value="">{words.sameRig}</option>
            {rigs.map(({ name }) => (
              <option key={name} value={name}>
                {name}
              </option>
            ))}
          </select>
        </label>
        <label class="field">
          {words.priority}
          <select value={priority} onChange={(event) => setPriority(event.currentTarget.value)}>
            {Object.entries(words.priorities).map(([name, text]) => (
              <option key={name} value={name}>
                {text}
              </option>
            ))}
          </select>
        </label>
      </div>
      <details class="options">
        <summary>
          {words.options} <span class="faint">{words.changed(changes.size)}</span>
        </summary>
        <input type="search" value={search} placeholder={words.search} aria-label={words.search} onInput={(event) => setSearch(event.currentTarget.value)} />
        {[...groups].map(([group, members]) => (
          <fieldset key={group}>
            <legend>{words.groups[group] ?? group}</legend>
            {members.map((option) => (
              <OptionField key={option.key} option={option} base={values.get(option.key) ?? tomlOf(option.default)} value={changes.get(option.key) ?? null} onChange={(value) => change(option.key, value)} />
            ))}
          </fieldset>
        ))}
      </details>
      <p class="actions">
        <ActionButton class="primary" disabled={recipe === "" || wrong} action={start}>
          {words.start}
        </ActionButton>
      </p>
    </>
  );
}

function matches({ key, doc }: RecipeOption, search: string): boolean {
  const words = search.toLowerCase().split(/\s+/).filter((word) => word !== "");
  return words.every((word) => key.includes(word) || doc.toLowerCase().includes(word));
}

/** Options by the part of their key before the dot. */
function grouped(options: RecipeOption[]): Map<string, RecipeOption[]> {
  const groups = new Map<string, RecipeOption[]>();
  for (const option of options) {
    const group = option.key.includes(".") ? option.key.slice(0, option.key.indexOf(".")) : "";
    groups.set(group, [...(groups.get(group) ?? []), option]);
  }
  return groups;
}
