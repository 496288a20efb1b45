// What an upload must say beside its files: the asset, the rig, the recipe.

import { useId } from "preact/hooks";
import type { Recipe, Rig } from "../api.ts";
import { texts } from "../texts.ts";
import { Field } from "./field.tsx";

const words = texts.upload;

/** The rig select's value for "the file that was added"; no stored rig has such a name. */
export const RIG_FROM_FILE = "\0file";

/** What is filled in, and what is wrong with it (null: nothing, or not checked yet). */
export interface UploadValues {
  asset: string;
  rig: string;
  recipe: string;
}
type Problems = { asset: string | null; rig: string | null };

type Props = {
  values: UploadValues;
  problems: Problems;
  onChange: (change: Partial<UploadValues>) => void;
  assets: string[];
  rigFile: File | null;
  rigs: Rig[] | null;
  recipes: Recipe[] | null;
};

export function UploadFields({ values, problems, onChange, assets, rigFile, rigs, recipes }: Props) {
  const assetList = useId();
  return (
    <div class="fields">
      <Field label={words.asset} hint={words.assetHint} problem={problems.asset}>
        {(id, aria) => (
          <>
            <input id={id} {...aria} list={assetList} value={values.asset} autoComplete="off" onInput={(event) => onChange({ asset: event.currentTarget.value })} />
            <datalist id={assetList}>
              {assets.map((name) => (
                <option key={name} value={name} />
              ))}
            </datalist>
          </>
        )}
      </Field>
      <Field label={words.rig} hint={rigs?.length === 0 ? words.rigNone : words.rigHint} problem={problems.rig}>
        {(id, aria) => (
          <select id={id} {...aria} value={values.rig} onChange={(event) => onChange({ rig: event.currentTarget.value })}>
            <option value="">{words.rigChoose}</option>
            {rigFile !== null && <option value={RIG_FROM_FILE}>{words.rigFile(rigFile.name)}</option>}
            {rigs?.map(({ name }) => (
              <option key={name} value={name}>
                {name}
              </option>
            ))}
          </select>
        )}
      </Field>
      <Field label={words.recipe} hint={words.recipeHint} problem={null}>
        {(id, aria) => (
          <select id={id} {...aria} value={values.recipe} onChange={(event) => onChange({ recipe: event.currentTarget.value })}>
            {recipes?.map(({ name }) => (
              <option key={name} value={name}>
                {name}
              </option>
            ))}
          </select>
        )}
      </Field>
    </div>
  );
}
