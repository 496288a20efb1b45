// What an upload must say beside its files: the asset, the rig, the recipe, where it begins.

import { useId } from "preact/hooks";
import type { Asset, Recipe, Rig } from "../api.ts";
import { uploadTexts } from "../texts/upload.ts";
import type { UploadFields as Values } from "../uploads.ts";
import { Field } from "./field.tsx";

const words = uploadTexts;

/** The rig select's value for "the file that was added"; no stored rig has such a name. */
export const RIG_FROM_FILE = "\0file";

/** What is wrong with what is filled in (null: nothing, or not checked yet). */
type Problems = Record<"asset" | "rig" | "chainage_mm", string | null>;

type Props = {
  values: Values;
  problems: Problems;
  onChange: (change: Partial<Values>) => void;
  assets: Asset[];
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
              {assets.map(({ name }) => (
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
      <Field label={words.chainage} hint={words.chainageHint} problem={problems.chainage_mm}>
        {(id, aria) => <input id={id} {...aria} inputMode="decimal" autoComplete="off" value={values.chainage_mm} onInput={(event) => onChange({ chainage_mm: event.currentTarget.value })} />}
      </Field>
      <Field label={words.direction} hint={words.directionHint} problem={null}>
        {(id, aria) => (
          <select id={id} {...aria} value={values.direction} onChange={(event) => onChange({ direction: event.currentTarget.value })}>
            {Object.entries(words.directions).map(([direction, text]) => (
              <option key={direction} value={direction}>
                {text}
              </option>
            ))}
          </select>
        )}
      </Field>
    </div>
  );
}
