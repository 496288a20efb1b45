// Measuring many runs again: a filter, how many runs it takes, and then how far each batch is.

import { useState } from "preact/hooks";
import { countBatch, createBatch, listAssets, listBatches, listRecipes, listRigs, steerBatch, type Batch, type BatchWish, type JobState } from "../api.ts";
import { count } from "../format.ts";
import { once, useLoaded } from "../hooks.ts";
import { batchPath, Link, readQuery } from "../router.tsx";
import { texts } from "../texts.ts";
import { batchTexts } from "../texts/batches.ts";
import { ActionButton } from "./action_button.tsx";
import { ConfirmButton } from "./confirm_button.tsx";
import { dayStart } from "./days.ts";
import { ProblemBox } from "./problem.tsx";
import { Time } from "./time.tsx";

const words = batchTexts;
const FRESH_MS = 3000;
const IDLE_MS = 30_000;
const MOST = 20;

/** True while something may still happen to a batch by itself. */
export const moves = ({ state }: Batch): boolean => !["paused", "cancelled", "done"].includes(state);

export function Batches() {
  const batches = useLoaded("batches", () => listBatches(MOST), (items) => (items.some(moves) ? FRESH_MS : IDLE_MS));
  return (
    <section class="card" aria-label={words.heading}>
      <h2>{words.heading}</h2>
      <p class="faint">{words.about}</p>
      <MakeBatch onMade={batches.reload} />
      {batches.problem && <ProblemBox problem={batches.problem} onRetry={batches.reload} />}
      {batches.value?.length === 0 && <p class="faint">{words.none}</p>}
      <ul class="queue">
        {batches.value?.map((batch) => (
          <li key={batch.id}>
            <span class="queue-name words">
              <Link to={batchPath(batch.id)}>{words.name(batch)}</Link>
              <span class="faint">
                <Time at={batch.created_at} /> · {words.runs(batch.runs)}
              </span>
            </span>
            <span class="queue-tell">
              <BatchProgress batch={batch} />
            </span>
            <BatchState batch={batch} />
            <BatchActions batch={batch} onChanged={batches.reload} />
          </li>
        ))}
      </ul>
    </section>
  );
}

export function BatchState({ batch: { state } }: { batch: Batch }) {
  const like = { queueing: "queued", pausing: "queued", cancelling: "queued" } as Record<string, string>;
  return <span class={`state ${like[state] ?? state}`}>{words.state[state]}</span>;
}

/** How many jobs have ended, and the number of each kind. */
export function BatchProgress({ batch }: { batch: Batch }) {
  const of = (state: JobState) => batch.jobs[state] ?? 0;
  const kinds = (Object.keys(words.counts) as JobState[]).filter((state) => of(state) > 0);
  return (
    <>
      <progress max={Math.max(batch.runs, 1)} value={of("done") + of("failed") + of("cancelled")} aria-label={words.bar(words.name(batch))} />
      <span class="faint">{kinds.map((state) => `${count(of(state))} ${words.counts[state]}`).join(" · ")}</span>
    </>
  );
}

export function BatchActions({ batch, onChanged }: { batch: Batch; onChanged: () => void }) {
  const held = batch.state === "paused" || batch.state === "pausing";
  const over = batch.state === "done" || batch.state === "cancelled" || batch.state === "cancelling";
  if (over) return <span class="actions" />;
  return (
    <span class="actions">
      <ActionButton class="small" action={() => steerBatch(batch.id, held ? "resume" : "pause").then(onChanged)}>
        {held ? words.resume : words.pause}
      </ActionButton>
      <ConfirmButton class="small harm" label={words.cancel} heading={words.cancelHeading} body={words.cancelBody} yes={words.cancelYes} no={words.cancelNo} action={() => steerBatch(batch.id, "cancel").then(onChanged)} />
    </span>
  );
}

interface Wish {
  q: string;
  asset: string;
  state: string;
  from: string;
  to: string;
  withRig: string;
  withRecipe: string;
  rig: string;
  recipe: string;
  note: string;
}
const NOTHING: Wish = { q: "", asset: "", state: "", from: "", to: "", withRig: "", withRecipe: "", rig: "", recipe: "", note: "" };

/** What the list of runs was filtered by, when its link led here; null where somebody came by another way. */
function asked(): Wish | null {
  const query = readQuery();
  if (!query.has("again")) return null;
  const of = (name: string) => query.get(name) ?? "";
  return { ...NOTHING, q: of("q"), asset: of("asset"), state: of("state"), from: of("from"), to: of("to") };
}

function wishOf(wish: Wish): BatchWish {
  const said = (text: string) => (text.trim() === "" ? null : text.trim());
  return {
    filter: {
      q: said(wish.q),
      asset: said(wish.asset),
      state: said(wish.state) as JobState | null,
      from: said(dayStart(wish.from, 0)),
      to: said(dayStart(wish.to, 1)),
      rig: said(wish.withRig),
      recipe: said(wish.withRecipe),
    },
    rig: said(wish.rig),
    recipe: said(wish.recipe),
    note: wish.note.trim(),
  };
}

async function loadChoices() {
  const [assets, rigs, recipes] = await Promise.all([listAssets(), listRigs(), listRecipes()]);
  return { assets: assets.map(({ name }) => name), rigs: rigs.map(({ name }) => name), recipes: recipes.map(({ name }) => name) };
}

function MakeBatch({ onMade }: { onMade: () => void }) {
  const [open, setOpen] = useState(() => asked() !== null);
  return (
    <details class="make-batch" open={open} onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>{words.make}</summary>
      {open && <Form onMade={onMade} />}
    </details>
  );
}

function Form({ onMade }: { onMade: () => void }) {
  const [wish, setWish] = useState(() => asked() ?? NOTHING);
  const [counted, setCounted] = useState<number | null>(null);
  const choices = useLoaded("batch choices", loadChoices, once);
  const set = (change: Partial<Wish>) => {
    setWish({ ...wish, ...change });
    setCounted(null);
  };
  const make = async () => {
    await createBatch(wishOf(wish));
    setWish(NOTHING);
    setCounted(null);
    onMade();
  };
  const choose = (name: "asset" | "withRig" | "withRecipe" | "rig" | "recipe", label: string, none: string, of: string[] | undefined) => (
    <label class="field">
      {label}
      <select value={wish[name]} onChange={(event) => set({ [name]: event.currentTarget.value })}>
        <option value="">{none}</option>
        {wish[name] !== "" && !of?.includes(wish[name]) && <option value={wish[name]}>{wish[name]}</option>}
        {of?.map((each) => (
          <option key={each} value={each}>
            {each}
          </option>
        ))}
      </select>
    </label>
  );
  return (
    <>
      {choices.problem && <ProblemBox problem={choices.problem} onRetry={choices.reload} />}
      <fieldset class="batch-part">
        <legend>{words.filter}</legend>
        <div class="fields">
          {choose("asset", texts.runs.asset, texts.runs.anyAsset, choices.value?.assets)}
          <label class="field">
            {texts.runs.searchHint}
            <input type="search" value={wish.q} onInput={(event) => set({ q: event.currentTarget.value })} />
          </label>
          <label class="field">
            {texts.runs.state}
            <select value={wish.state} onChange={(event) => set({ state: event.currentTarget.value })}>
              <option value="">{texts.runs.anyState}</option>
              {Object.entries(texts.state).map(([state, text]) => (
                <option key={state} value={state}>
                  {text}
                </option>
              ))}
            </select>
          </label>
          <label class="field">
            {texts.runs.from}
            <input type="date" value={wish.from} max={wish.to} onChange={(event) => set({ from: event.currentTarget.value })} />
          </label>
          <label class="field">
            {texts.runs.to}
            <input type="date" value={wish.to} min={wish.from} onChange={(event) => set({ to: event.currentTarget.value })} />
          </label>
          {choose("withRig", words.withRig, words.anyRig, choices.value?.rigs)}
          {choose("withRecipe", words.withRecipe, words.anyRecipe, choices.value?.recipes)}
        </div>
      </fieldset>
      <fieldset class="batch-part">
        <legend>{words.change}</legend>
        <div class="fields">
          {choose("recipe", words.recipe, words.asBefore, choices.value?.recipes)}
          {choose("rig", words.rig, words.asBefore, choices.value?.rigs)}
          <label class="field">
            {words.note}
            <input value={wish.note} placeholder={words.noteHint} onInput={(event) => set({ note: event.currentTarget.value })} />
          </label>
        </div>
      </fieldset>
      <p role="status">{counted !== null && words.counted(counted)}</p>
      <p class="actions">
        <ActionButton action={async () => setCounted(await countBatch(wishOf(wish)))}>{words.countThem}</ActionButton>
        {/* Nobody starts thousands of jobs without having seen their number. */}
        <ActionButton class="primary" disabled={counted === null || counted === 0} action={make}>
          {counted === null || counted === 0 ? words.startUncounted : words.start(counted)}
        </ActionButton>
      </p>
    </>
  );
}
