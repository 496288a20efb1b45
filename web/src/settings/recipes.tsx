// The built-in recipes, option by option, each with what it does.

import { useMemo, useState } from "preact/hooks";
import { listOptions, listRecipes, type RecipeOption } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { ProblemBox } from "../parts/problem.tsx";
import { tomlOf, valuesOf } from "../recipe_text.ts";
import { texts } from "../texts.ts";
import { workTexts } from "../texts/work.ts";

const words = workTexts.settings.recipes;

async function loadRecipes() {
  const [recipes, options] = await Promise.all([listRecipes(), listOptions()]);
  return { recipes, options };
}

export function RecipesSettings() {
  const loaded = useLoaded("recipes and options", loadRecipes, once);
  const [search, setSearch] = useState("");
  const [onlyChanged, setOnlyChanged] = useState(false);
  const values = useMemo(() => loaded.value?.recipes.map(({ toml }) => valuesOf(toml)) ?? [], [loaded.value]);
  if (loaded.problem) return <ProblemBox problem={loaded.problem} onRetry={loaded.reload} />;
  if (loaded.value === null) return <p role="status">{texts.waiting.list}</p>;
  const { recipes, options } = loaded.value;
  const differs = (option: RecipeOption) => new Set(values.map((each) => each.get(option.key))).size > 1;
  const shown = options.filter((option) => (option.key + option.doc).toLowerCase().includes(search.toLowerCase()) && (!onlyChanged || differs(option)));
  return (
    <>
      <p class="faint">{words.about}</p>
      <div class="filters">
        <input type="search" class="search" aria-label={words.find} placeholder={words.find} value={search} onInput={(event) => setSearch(event.currentTarget.value)} />
        <label class="check">
          <input type="checkbox" checked={onlyChanged} onChange={(event) => setOnlyChanged(event.currentTarget.checked)} /> {words.onlyChanged}
        </label>
      </div>
      <div class="table-box card" tabIndex={0} role="region" aria-label={words.option}>
        <table class="plain-table options">
          <thead>
            <tr>
              <th scope="col">{words.option}</th>
              {recipes.map((recipe) => (
                <th key={recipe.name} scope="col">
                  {recipe.name} {recipe.default && <span class="faint">{words.standard}</span>}
                </th>
              ))}
              <th scope="col">{words.unit}</th>
              <th scope="col">{words.what}</th>
            </tr>
          </thead>
          <tbody>
            {shown.map((option) => (
              <tr key={option.key}>
                <th scope="row">
                  <code>{option.key}</code>
                </th>
                {values.map((each, at) => {
                  const value = each.get(option.key) ?? tomlOf(option.default);
                  return (
                    <td key={at} data-recipe={recipes[at]?.name} class={value === tomlOf(option.default) || Number(value) === option.default ? "" : "changed"}>
                      {value.replaceAll('"', "")}
                    </td>
                  );
                })}
                <td>{option.unit}</td>
                <td>{option.doc}</td>
              </tr>
            ))}
          </tbody>
        </table>
      </div>
    </>
  );
}
