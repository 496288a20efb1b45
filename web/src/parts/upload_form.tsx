// Sending runs: drop or choose files, say what they are, watch them go.

import { useId, useRef, useState } from "preact/hooks";
import { listRecipes, listRigs } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { go, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { ProblemBox } from "./problem.tsx";
import { RIG_FROM_FILE, UploadFields, type UploadValues } from "./upload_fields.tsx";
import { ChosenFiles, DropPlace, useDroppedFiles } from "./upload_files.tsx";
import { OutcomeLine, SendingProgress, useSender, type Outcome } from "./upload_sending.tsx";

const words = texts.upload;

type Props = { onArrived: () => void; assets: string[] };

export function UploadForm({ onArrived, assets }: Props) {
  const [videos, setVideos] = useState<File[]>([]);
  const [rigFile, setRigFile] = useState<File | null>(null);
  const [filledIn, setFilledIn] = useState<Partial<UploadValues>>({});
  const [checked, setChecked] = useState(false);
  const [outcomes, setOutcomes] = useState<Outcome[]>([]);
  const rigs = useLoaded("rigs", listRigs, once);
  const recipes = useLoaded("recipes", listRecipes, once);
  const sender = useSender();
  const form = useRef<HTMLFormElement>(null);
  const told = useRef<HTMLDivElement>(null);
  const heading = useId();

  const fill = (change: Partial<UploadValues>) => setFilledIn((before) => ({ ...before, ...change }));
  const add = (files: File[]) => {
    const rig = files.findLast(isRig);
    setVideos((before) => [...before, ...files.filter((file) => !isRig(file))]);
    setOutcomes([]);
    if (rig === undefined) return;
    setRigFile(rig);
    fill({ rig: RIG_FROM_FILE });
  };
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
  const dragging = useDroppedFiles(sender.sending === null ? add : null);

  const values = { asset: "", rig: "", recipe: recipes.value?.find((recipe) => recipe.default)?.name ?? "", ...filledIn };
  const rig = values.rig === RIG_FROM_FILE ? rigFile : values.rig;
  const missing = {
    video: videos.length === 0 ? words.missingVideo : null,
    asset: values.asset.trim() === "" ? words.missingAsset : null,
    rig: rig === null || rig === "" ? words.missingRig : null,
  };

  const submit = async () => {
    setChecked(true);
    if (rig === null || Object.values(missing).some((problem) => problem !== null)) {
      // To the first field with a message, once that has been drawn.
      requestAnimationFrame(() => form.current?.querySelector<HTMLElement>("[aria-invalid=true]")?.focus());
      return;
    }
    const { asset, recipe } = values;
    const ended = await sender.send(videos.map((video) => ({ video, rig, asset: asset.trim(), recipe })));
    onArrived();
    setOutcomes(ended);
    const arrived = ended.flatMap((outcome) => ("run" in outcome ? [outcome] : []));
    if (arrived.length === videos.length) clear();
    // What was refused stays chosen, so that the rig or the name can be mended and sent again.
    else setVideos(videos.filter((video) => arrived.every((outcome) => outcome.video !== video)));
    const only = ended.length === 1 ? arrived[0] : undefined;
    if (only) go(runPath(only.run));
    else requestAnimationFrame(() => told.current?.focus());
  };

  return (
    <section class={dragging ? "card upload dragging" : "card upload"} aria-labelledby={heading}>
      <h2 id={heading}>{words.heading}</h2>
      <div ref={told} tabIndex={-1} class="outcomes">
        {outcomes.map((outcome, index) => (
          <OutcomeLine key={index} outcome={outcome} />
        ))}
      </div>
      {sender.sending !== null ? (
        <SendingProgress sending={sender.sending} onStop={sender.stop} />
      ) : (
        <form
          ref={form}
          noValidate
          onSubmit={(event) => {
            event.preventDefault();
            void submit();
          }}
        >
          <DropPlace dragging={dragging} onFiles={add} />
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
                problems={checked ? missing : { asset: null, rig: null }}
                onChange={fill}
                assets={assets}
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
      )}
    </section>
  );
}

/** Rig files are known by their ending, as the rig file's format has it. */
function isRig(file: File): boolean {
  return /\.toml$/i.test(file.name);
}
