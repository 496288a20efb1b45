// Sending runs: drop or choose files, say what they are, watch them go, one after the other.

import { useEffect, useId, useRef, useState } from "preact/hooks";
import { listRecipes, listRigs, problemOf, sendRun, type Problem } from "../api.ts";
import { size } from "../format.ts";
import { once, useLoaded } from "../hooks.ts";
import { go, Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { Field } from "./field.tsx";
import { ProblemBox } from "./problem.tsx";

/** The rig select's value for "the file that was added". */
const RIG_FROM_FILE = "\0file";

type Sending = { name: string; number: number; all: number; sent: number; bytes: number; sinceMs: number };
type Outcome = { name: string; run: string } | { name: string; problem: Problem } | { name: string; stopped: true };

type Props = { onArrived: () => void; assets: string[] };

export function UploadForm({ onArrived, assets }: Props) {
  const [videos, setVideos] = useState<File[]>([]);
  const [rigFile, setRigFile] = useState<File | null>(null);
  const [rig, setRig] = useState("");
  const [asset, setAsset] = useState("");
  const [recipe, setRecipe] = useState("");
  const [checked, setChecked] = useState(false);
  const [sending, setSending] = useState<Sending | null>(null);
  const [outcomes, setOutcomes] = useState<Outcome[]>([]);
  const stop = useRef<AbortController | null>(null);
  const form = useRef<HTMLFormElement>(null);
  const rigs = useLoaded("rigs", listRigs, once);
  const recipes = useLoaded("recipes", listRecipes, once);
  const assetList = useId();

  const add = (files: Iterable<File>) => {
    for (const file of files) {
      if (/\.toml$/i.test(file.name)) {
        setRigFile(file);
        setRig(RIG_FROM_FILE);
      } else setVideos((before) => [...before, file]);
    }
    setOutcomes([]);
  };
  const dragging = useDroppedFiles(sending === null ? add : null);

  const chosenRig = rig === RIG_FROM_FILE ? rigFile : rig;
  const missing = {
    video: videos.length === 0 ? texts.upload.missingVideo : null,
    rig: chosenRig === null || chosenRig === "" ? texts.upload.missingRig : null,
    asset: asset.trim() === "" ? texts.upload.missingAsset : null,
  };
  const clear = () => {
    setVideos([]);
    setRigFile(null);
    setRig("");
    setChecked(false);
  };

  const send = async () => {
    setChecked(true);
    if (missing.video !== null || missing.rig !== null || missing.asset !== null || !chosenRig) {
      // The first field with a message, once it has been drawn.
      requestAnimationFrame(() => form.current?.querySelector<HTMLElement>("[aria-invalid=true]")?.focus());
      return;
    }
    const ended: Outcome[] = [];
    stop.current = new AbortController();
    for (const [index, video] of videos.entries()) {
      const start: Sending = { name: video.name, number: index + 1, all: videos.length, sent: 0, bytes: video.size, sinceMs: performance.now() };
      setSending(start);
      try {
        const upload = { video, rig: chosenRig, asset: asset.trim(), recipe };
        const run = await sendRun(upload, (sent, bytes) => setSending({ ...start, sent, bytes }), stop.current.signal);
        ended.push({ name: video.name, run: run.id });
        onArrived();
      } catch (error) {
        if (stop.current.signal.aborted) {
          ended.push({ name: video.name, stopped: true });
          break;
        }
        ended.push({ name: video.name, problem: problemOf(error) });
      }
    }
    setSending(null);
    setOutcomes(ended);
    // What was refused stays chosen, so that the rig or the name can be mended and sent again.
    const arrived = new Set(ended.flatMap((outcome) => ("run" in outcome ? [outcome.name] : [])));
    setVideos(videos.filter((video) => !arrived.has(video.name)));
    if (arrived.size === videos.length) clear();
    const only = ended[0];
    if (ended.length === 1 && only && "run" in only) go(runPath(only.run));
  };

  return (
    <section class={dragging ? "card upload dragging" : "card upload"} aria-labelledby={`${assetList}-h`}>
      <h2 id={`${assetList}-h`}>{texts.upload.heading}</h2>
      {sending !== null ? (
        <SendingProgress sending={sending} onStop={() => stop.current?.abort()} />
      ) : (
        <form
          ref={form}
          noValidate
          onSubmit={(event) => {
            event.preventDefault();
            void send();
          }}
        >
          <div class="drop">
            <p class="drop-words">{dragging ? texts.upload.dropNow : texts.upload.drop}</p>
            <FileButton label={texts.upload.choose} onFiles={add} />
            <p class="faint">{texts.upload.hint}</p>
          </div>
          {(videos.length > 0 || rigFile !== null) && (
            <>
              <ChosenFiles
                files={[...videos, ...(rigFile === null ? [] : [rigFile])]}
                onRemove={(file) => {
                  setVideos(videos.filter((video) => video !== file));
                  if (file === rigFile) {
                    setRigFile(null);
                    setRig("");
                  }
                }}
              />
              {checked && missing.video !== null && (
                <p class="field-problem" role="alert">
                  {missing.video}
                </p>
              )}
              <div class="fields">
                <Field label={texts.upload.asset} hint={texts.upload.assetHint} problem={checked ? missing.asset : null}>
                  {(id, aria) => (
                    <>
                      <input id={id} {...aria} list={assetList} value={asset} autoComplete="off" onInput={(event) => setAsset(event.currentTarget.value)} />
                      <datalist id={assetList}>
                        {assets.map((name) => (
                          <option key={name} value={name} />
                        ))}
                      </datalist>
                    </>
                  )}
                </Field>
                <Field label={texts.upload.rig} hint={rigs.value?.length === 0 ? texts.upload.rigNone : texts.upload.rigHint} problem={checked ? missing.rig : null}>
                  {(id, aria) => (
                    <select id={id} {...aria} value={rig} onChange={(event) => setRig(event.currentTarget.value)}>
                      <option value="">{texts.upload.rigChoose}</option>
                      {rigFile !== null && <option value={RIG_FROM_FILE}>{texts.upload.rigFile(rigFile.name)}</option>}
                      {rigs.value?.map(({ name }) => (
                        <option key={name} value={name}>
                          {name}
                        </option>
                      ))}
                    </select>
                  )}
                </Field>
                <Field label={texts.upload.recipe} hint={texts.upload.recipeHint} problem={null}>
                  {(id, aria) => (
                    <select id={id} {...aria} value={recipe} onChange={(event) => setRecipe(event.currentTarget.value)}>
                      {recipes.value?.map(({ name }) => (
                        <option key={name} value={name}>
                          {name}
                        </option>
                      ))}
                    </select>
                  )}
                </Field>
              </div>
              {rigs.problem && <ProblemBox problem={rigs.problem} onRetry={rigs.reload} />}
              <p class="actions">
                <button type="submit" class="primary">
                  {texts.upload.send(videos.length)}
                </button>
                <button type="button" class="quiet" onClick={clear}>
                  {texts.upload.clear}
                </button>
              </p>
            </>
          )}
        </form>
      )}
      {outcomes.map((outcome) => (
        <OutcomeLine key={outcome.name} outcome={outcome} />
      ))}
    </section>
  );
}

/** True while files hover over the page; `take` gets them when they are let go. Null takes nothing. */
function useDroppedFiles(take: ((files: File[]) => void) | null): boolean {
  const [dragging, setDragging] = useState(false);
  const newest = useRef(take);
  newest.current = take;
  useEffect(() => {
    // The whole page takes the drop: a file let go beside the field must not replace the page.
    const over = (event: DragEvent) => {
      if (!event.dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      setDragging(newest.current !== null);
    };
    const left = (event: DragEvent) => {
      if (event.relatedTarget === null) setDragging(false);
    };
    const dropped = (event: DragEvent) => {
      if (!event.dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      setDragging(false);
      newest.current?.([...event.dataTransfer.files]);
    };
    addEventListener("dragover", over);
    addEventListener("dragleave", left);
    addEventListener("drop", dropped);
    return () => {
      removeEventListener("dragover", over);
      removeEventListener("dragleave", left);
      removeEventListener("drop", dropped);
    };
  }, []);
  return dragging;
}

function FileButton({ label, onFiles }: { label: string; onFiles: (files: File[]) => void }) {
  return (
    <label class="button">
      {label}
      <input
        type="file"
        multiple
        class="unseen"
        onChange={(event) => {
          onFiles([...(event.currentTarget.files ?? [])]);
          event.currentTarget.value = ""; // the same file may be chosen again after it was removed
        }}
      />
    </label>
  );
}

function ChosenFiles({ files, onRemove }: { files: File[]; onRemove: (file: File) => void }) {
  return (
    <ul class="chosen" aria-label={texts.upload.chosen}>
      {files.map((file) => (
        <li key={`${file.name} ${file.size}`}>
          <span class="words">{file.name}</span> <span class="faint">{size(file.size)}</span>
          <button type="button" class="quiet" aria-label={texts.upload.remove(file.name)} onClick={() => onRemove(file)}>
            ✕
          </button>
        </li>
      ))}
    </ul>
  );
}

function SendingProgress({ sending, onStop }: { sending: Sending; onStop: () => void }) {
  const seconds = (performance.now() - sending.sinceMs) / 1000;
  const bytesPerS = seconds > 0.2 ? sending.sent / seconds : 0;
  const leftS = bytesPerS > 0 ? (sending.bytes - sending.sent) / bytesPerS : null;
  const arrived = sending.sent >= sending.bytes;
  return (
    <div class="sending">
      <p role="status" class="words">
        {arrived ? texts.upload.arrived : texts.upload.sending(sending.name, sending.number, sending.all)}
      </p>
      <progress max={sending.bytes} value={sending.sent} aria-label={texts.upload.sending(sending.name, sending.number, sending.all)} />
      <p class="faint">{texts.upload.progress(sending.sent, sending.bytes, bytesPerS, arrived ? null : leftS)}</p>
      <p class="actions">
        <button type="button" onClick={onStop}>
          {texts.upload.cancel}
        </button>
      </p>
    </div>
  );
}

function OutcomeLine({ outcome }: { outcome: Outcome }) {
  if ("problem" in outcome) {
    const { problem } = outcome;
    return (
      <ProblemBox problem={problem} heading={texts.upload.refused(outcome.name)}>
        {problem.detail === "" && <p>{texts.problem.uploadCut}</p>}
      </ProblemBox>
    );
  }
  return (
    <p class="notice good" role="status">
      {"run" in outcome ? (
        <>
          {texts.upload.sent(outcome.name)} <Link to={runPath(outcome.run)}>{texts.upload.show}</Link>
        </>
      ) : (
        texts.upload.stopped(outcome.name)
      )}
    </p>
  );
}
