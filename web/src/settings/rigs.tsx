// Rigs: those that are stored, drawn and checked; and adding one.

import { useMemo, useState } from "preact/hooks";
import { createRig, listRigs, type Rig } from "../api.ts";
import { copyText } from "../clipboard.ts";
import { lengthMm, number } from "../format.ts";
import { once, useLoaded } from "../hooks.ts";
import { ActionButton } from "../parts/action_button.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { Time } from "../parts/time.tsx";
import { texts } from "../texts.ts";
import { workTexts } from "../texts/work.ts";
import { RigDrawing } from "./rig_drawing.tsx";
import { depthPerPixel, distortionInWords, geometryOf, usualDistance, warningsOf, type RigJson } from "./rig_geometry.ts";
import { readRigToml } from "./rig_toml.ts";

const words = workTexts.settings.rigs;

export function RigsSettings() {
  const rigs = useLoaded("rigs", listRigs, once);
  return (
    <>
      <p class="faint">{words.about}</p>
      <AddRig onStored={rigs.reload} />
      {rigs.problem && <ProblemBox problem={rigs.problem} onRetry={rigs.reload} />}
      {rigs.value === null && !rigs.problem && <p role="status">{texts.waiting.list}</p>}
      {rigs.value?.length === 0 && <p class="empty">{words.none}</p>}
      <div class="rigs">
        {rigs.value?.map((rig) => (
          <StoredRig key={rig.name} rig={rig} />
        ))}
      </div>
    </>
  );
}

function StoredRig({ rig }: { rig: Rig }) {
  const [copied, setCopied] = useState(false);
  return (
    <section class="card rig" aria-label={rig.name}>
      <div class="panel-head">
        <h2 class="words">{rig.name}</h2>
        <span class="faint">
          {words.since} <Time at={rig.created_at} />
        </span>
      </div>
      <RigFacts rig={rig.rig as RigJson} />
      <p class="actions">
        <button type="button" class="small" aria-live="polite" onClick={() => void copyText(rig.toml).then(() => setCopied(true))}>
          {copied ? words.copied : words.copy}
        </button>
      </p>
    </section>
  );
}

/** The drawing, the figures, and what should be checked. */
function RigFacts({ rig: given }: { rig: RigJson }) {
  const rig = useMemo(() => geometryOf(given), [given]);
  const warnings = warningsOf(rig, given);
  const distance = usualDistance(rig);
  const far = rig.range_mm === null ? "" : rig.range_mm[1] > 20_000 ? words.far : lengthMm(rig.range_mm[1]);
  const facts: [string, string][] = [
    [words.size, `${rig.width_px} × ${rig.height_px} px`],
    [words.fov, `${number(rig.fov_deg[0])}° × ${number(rig.fov_deg[1])}°`],
    ...(rig.range_mm === null ? [] : ([[words.range, `${lengthMm(rig.range_mm[0])} … ${far}`]] as [string, string][])),
    ...(distance === null ? [] : ([[words.resolution(distance), `${number(depthPerPixel(rig, distance))} mm`]] as [string, string][])),
    [words.distortion, distortionInWords(rig)],
  ];
  return (
    <>
      {warnings.length > 0 && (
        <div class="notice warn">
          <p class="notice-title">{words.warnings}</p>
          <ul>
            {warnings.map((warning) => (
              <li key={warning}>{warning}</li>
            ))}
          </ul>
        </div>
      )}
      <div class="rig-body">
        <RigDrawing rig={rig} />
        <dl class="facts column">
          {facts.map(([name, value]) => (
            <div key={name}>
              <dt>{name}</dt>
              <dd>{value}</dd>
            </div>
          ))}
        </dl>
      </div>
    </>
  );
}

function AddRig({ onStored }: { onStored: () => void }) {
  const [text, setText] = useState("");
  const [stored, setStored] = useState<string | null>(null);
  const read = useMemo(() => (text.trim() === "" ? null : readRigToml(text)), [text]);
  const choose = async (files: FileList | null) => {
    const file = files?.[0];
    if (file) setText(await file.text());
    setStored(null);
  };
  return (
    <details class="card" open={text !== "" || stored !== null}>
      <summary>{words.add}</summary>
      <p class="faint">{words.addHint}</p>
      <p>
        <label class="button">
          {words.choose}
          <input type="file" class="unseen" accept=".toml,.json" onChange={(event) => void choose(event.currentTarget.files)} />
        </label>
      </p>
      <label class="field">
        {words.text}
        <textarea rows={12} spellcheck={false} value={text} onInput={(event) => setText(event.currentTarget.value)} />
      </label>
      {read !== null && (read.rig === null ? <p class="field-problem">{words.notToml} {read.problem}</p> : <RigFacts rig={read.rig} />)}
      <p class="actions">
        <ActionButton
          class="primary"
          disabled={text.trim() === ""}
          action={async () => {
            const rig = await createRig(text);
            setStored(rig.name);
            setText("");
            onStored();
          }}
        >
          {words.store}
        </ActionButton>
      </p>
      {stored !== null && (
        <p class="notice good" role="status">
          {words.stored(stored)}
        </p>
      )}
    </details>
  );
}
