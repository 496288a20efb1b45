// What is said about a run, to be set right: its asset, where it begins, which way, when, and a note. And a pin.

import { useId, useRef, useState } from "preact/hooks";
import { CHANGED_MEANWHILE, changeRun, getRun, isPinned, listAssets, problemOf, setPinned, type Problem, type Run, type RunChange } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { runTexts } from "../texts/run.ts";
import { uploadTexts } from "../texts/upload.ts";
import { ActionButton } from "./action_button.tsx";
import { Field } from "./field.tsx";
import { ProblemBox } from "./problem.tsx";

const words = runTexts.edit;

/** What the form holds; times are local, as such a form has them. */
interface Values {
  asset: string;
  chainage_mm: string;
  direction: Run["direction"];
  recorded_at: string;
  note: string;
}

/** A time of the server as a form of this place has it, to the second. */
function local(rfc3339: string): string {
  const time = new Date(rfc3339);
  return new Date(time.getTime() - time.getTimezoneOffset() * 60_000).toISOString().slice(0, 19);
}

const valuesOf = ({ asset, chainage_mm, direction, recorded_at, note }: Run): Values => ({ asset, chainage_mm: `${chainage_mm}`, direction, recorded_at: local(recorded_at), note });

/** Only what is other than before. */
function changeOf(values: Values, before: Values): RunChange {
  const differs = (name: keyof Values) => values[name].trim() !== before[name];
  return {
    ...(differs("asset") ? { asset: values.asset.trim() } : {}),
    ...(differs("chainage_mm") ? { chainage_mm: Number(values.chainage_mm) } : {}),
    ...(differs("direction") ? { direction: values.direction } : {}),
    ...(differs("recorded_at") ? { recorded_at: new Date(values.recorded_at).toISOString() } : {}),
    ...(differs("note") ? { note: values.note.trim() } : {}),
  };
}

type Opened = { run: Run; assets: string[] };

export function EditRun({ run, onChanged }: { run: string; onChanged: () => void }) {
  const dialog = useRef<HTMLDialogElement>(null);
  const heading = useId();
  const [opened, setOpened] = useState<Opened | null>(null);
  const [values, setValues] = useState<Values | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const load = async () => {
    const [now, assets] = await Promise.all([getRun(run), listAssets()]);
    setOpened({ run: now, assets: assets.map(({ name }) => name) });
    setValues(valuesOf(now));
  };
  const open = async () => {
    await load();
    setProblem(null);
    dialog.current?.showModal();
  };
  const save = async () => {
    if (values === null || opened === null) return;
    try {
      await changeRun(opened.run, changeOf(values, valuesOf(opened.run)));
      dialog.current?.close();
      onChanged();
    } catch (error) {
      const found = problemOf(error);
      if (found.status === CHANGED_MEANWHILE) await load();
      setProblem(found);
    }
  };
  return (
    <>
      <ActionButton action={open}>{words.open}</ActionButton>
      <dialog ref={dialog} aria-labelledby={heading} class="edit-run">
        <h2 id={heading}>{words.heading}</h2>
        {problem && <ProblemBox problem={problem} {...(problem.status === CHANGED_MEANWHILE ? { heading: words.meanwhile } : {})} />}
        {values !== null && opened !== null && <Form values={values} assets={opened.assets} onChange={(change) => setValues({ ...values, ...change })} />}
        <p class="actions">
          <button type="button" onClick={() => dialog.current?.close()}>
            {words.leave}
          </button>
          <ActionButton class="primary" disabled={values === null || wrong(values)} action={save}>
            {words.save}
          </ActionButton>
        </p>
      </dialog>
    </>
  );
}

const badNumber = (text: string): boolean => text.trim() === "" || !Number.isFinite(Number(text));
const badTime = (text: string): boolean => Number.isNaN(new Date(text).getTime());
const wrong = (values: Values): boolean => values.asset.trim() === "" || badNumber(values.chainage_mm) || badTime(values.recorded_at);

function Form({ values, assets, onChange }: { values: Values; assets: string[]; onChange: (change: Partial<Values>) => void }) {
  const list = useId();
  return (
    <>
      <Field label={uploadTexts.asset} hint={uploadTexts.assetHint} problem={values.asset.trim() === "" ? words.noAsset : null}>
        {(id, aria) => (
          <>
            <input id={id} {...aria} list={list} autoComplete="off" value={values.asset} onInput={(event) => onChange({ asset: event.currentTarget.value })} />
            <datalist id={list}>
              {assets.map((name) => (
                <option key={name} value={name} />
              ))}
            </datalist>
          </>
        )}
      </Field>
      <div class="fields">
        <Field label={uploadTexts.chainage} hint={uploadTexts.chainageHint} problem={badNumber(values.chainage_mm) ? uploadTexts.badChainage : null}>
          {(id, aria) => <input id={id} {...aria} inputMode="decimal" autoComplete="off" value={values.chainage_mm} onInput={(event) => onChange({ chainage_mm: event.currentTarget.value })} />}
        </Field>
        <Field label={uploadTexts.direction} hint={uploadTexts.directionHint} problem={null}>
          {(id, aria) => (
            <select id={id} {...aria} value={values.direction} onChange={(event) => onChange({ direction: event.currentTarget.value as Run["direction"] })}>
              {Object.entries(uploadTexts.directions).map(([direction, text]) => (
                <option key={direction} value={direction}>
                  {text}
                </option>
              ))}
            </select>
          )}
        </Field>
      </div>
      <Field label={words.recorded} hint={words.recordedHint} problem={badTime(values.recorded_at) ? words.badTime : null}>
        {(id, aria) => <input id={id} {...aria} type="datetime-local" step={1} value={values.recorded_at} onInput={(event) => onChange({ recorded_at: event.currentTarget.value })} />}
      </Field>
      <Field label={words.note} hint={words.noteHint} problem={null}>
        {(id, aria) => <textarea id={id} {...aria} rows={3} value={values.note} onInput={(event) => onChange({ note: event.currentTarget.value })} />}
      </Field>
    </>
  );
}

/** Keeps a run whatever the rules of keeping say. */
export function PinRun({ run }: { run: string }) {
  const pinned = useLoaded(`pin ${run}`, () => isPinned(run), once);
  if (pinned.value === null) return null;
  return (
    <>
      <ActionButton action={() => setPinned(run, !pinned.value).then(pinned.reload)}>{pinned.value ? words.unpin : words.pin}</ActionButton>
      <span class="faint" role="status">
        {pinned.value && words.pinned}
      </span>
    </>
  );
}
