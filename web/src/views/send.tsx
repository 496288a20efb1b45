// Sending runs: drop or choose files, say what they are, watch them go.

import { useEffect, useId, useRef, useState } from "preact/hooks";
import { listAssets, listRecipes, listRigs } from "../api.ts";
import { once, useLoaded, useTitle } from "../hooks.ts";
import { ProblemBox } from "../parts/problem.tsx";
import { RIG_FROM_FILE, UploadFields } from "../parts/upload_fields.tsx";
import { ChosenFiles, DropPlace } from "../parts/upload_files.tsx";
import { UploadList } from "../parts/upload_list.tsx";
import { uploadTexts } from "../texts/upload.ts";
import { findUnfinished, rejoin, sendFiles, useUploads, type UploadFields as Values } from "../uploads.ts";
import { keepFiles, takeFiles } from "../uploads_inbox.ts";

const words = uploadTexts;
const NOTHING: Values = { asset: "", rig: "", recipe: "", chainage_mm: "", direction: "forward" };

export function SendView() {
  const [videos, setVideos] = useState<File[]>([]);
  const [rigFile, setRigFile] = useState<File | null>(null);
  const [filledIn, setFilledIn] = useState<Partial<Values>>({});
  const [checked, setChecked] = useState(false);
  const rigs = useLoaded("rigs", listRigs, once);
  const recipes = useLoaded("recipes", listRecipes, once);
  const assets = useLoaded("assets", listAssets, once);
  const uploads = useUploads();
  const form = useRef<HTMLFormElement>(null);
  const heading = useId();
  useTitle(words.heading);

  const fill = (change: Partial<Values>) => setFilledIn((before) => ({ ...before, ...change }));
  const add = (files: File[]) => {
    const rig = files.findLast(isRig);
    const fresh = rejoin(files.filter((file) => !isRig(file)));
    setVideos((before) => [...before, ...fresh]);
    if (rig === undefined) return;
    setRigFile(rig);
    fill({ rig: RIG_FROM_FILE });
  };
  const newest = useRef(add);
  newest.current = add;
  useEffect(() => {
    let stop: (() => void) | null = null;
    let gone = false;
    // What was interrupted is known before files are taken: one of them may be its rest.
    void findUnfinished().finally(() => {
      if (!gone) stop = takeFiles((files) => newest.current(files));
    });
    return () => {
      gone = true;
      stop?.();
    };
  }, []);
  const remove = (file: File) => {
    setVideos(videos.filter((video) => video !== file));
    if (file !== rigFile) return;
    setRigFile(null);
    fill({ rig: "" });
  };
  const clear = () => {
    setVideos([]);
    setRigFile(null);
    setFilledIn({});
    setChecked(false);
  };

  const values = { ...NOTHING, recipe: recipes.value?.find((recipe) => recipe.default)?.name ?? "", ...filledIn };
  const missing = {
    video: videos.length === 0 ? words.missingVideo : null,
    asset: values.asset.trim() === "" ? words.missingAsset : null,
    rig: values.rig === "" ? words.missingRig : null,
    chainage_mm: values.chainage_mm.trim() !== "" && !Number.isFinite(Number(values.chainage_mm)) ? words.badChainage : null,
  };

  const submit = async () => {
    setChecked(true);
    if (Object.values(missing).some((each) => each !== null)) {
      // To the first field with a message, once that has been drawn.
      requestAnimationFrame(() => form.current?.querySelector<HTMLElement>("[aria-invalid=true]")?.focus());
      return;
    }
    // The rig file travels with what is said about each run; the server checks it before any byte is sent.
    const rig = values.rig === RIG_FROM_FILE && rigFile !== null ? await rigFile.text() : values.rig;
    sendFiles(videos, { ...values, asset: values.asset.trim(), chainage_mm: values.chainage_mm.trim(), rig });
    clear();
  };

  return (
    <>
      <h1>{words.heading}</h1>
      <UploadList items={uploads} />
      <section class="card upload" aria-labelledby={heading}>
        <h2 id={heading} class="unseen">
          {words.what}
        </h2>
        <form
          ref={form}
          noValidate
          onSubmit={(event) => {
            event.preventDefault();
            void submit();
          }}
        >
          <DropPlace onFiles={keepFiles} />
          {(videos.length > 0 || rigFile !== null) && (
            <>
              <ChosenFiles files={rigFile === null ? videos : [...videos, rigFile]} onRemove={remove} />
              {checked && missing.video !== null && (
                <p class="field-problem" role="alert">
                  {missing.video}
                </p>
              )}
              <UploadFields
                values={values}
                problems={checked ? missing : { asset: null, rig: null, chainage_mm: null }}
                onChange={fill}
                assets={assets.value ?? []}
                rigFile={rigFile}
                rigs={rigs.value}
                recipes={recipes.value}
              />
              {rigs.problem && <ProblemBox problem={rigs.problem} onRetry={rigs.reload} />}
              <p class="actions">
                <button type="submit" class="primary">
                  {words.send(videos.length)}
                </button>
                <button type="button" class="quiet" onClick={clear}>
                  {words.clear}
                </button>
              </p>
            </>
          )}
        </form>
      </section>
    </>
  );
}

/** Rig files are known by their ending, as the rig file's format has it. */
function isRig(file: File): boolean {
  return /\.toml$/i.test(file.name);
}
