// The surface in space: rerun's viewer for everything, or points for machines where that is too heavy. A long run has a recording of the
// whole, thinned out, and dense ones of its stretches: the address keeps which is shown.

import { useId, useState } from "preact/hooks";
import { getManifest, type Job, type Run } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { lazy } from "../lazy.tsx";
import { readQuery, writeQuery } from "../router.tsx";
import { runTexts } from "../texts/run.ts";
import { ProblemBox } from "./problem.tsx";
import { View3d } from "./view3d.tsx";

const words = runTexts.view;
const LightView = lazy(async () => (await import("../cloud/light_view.tsx")).LightView);

/** A stretch of a long run that has a recording of its own. */
interface Stretch {
  /** The recording's file. */
  name: string;
  /** The smaller and the larger chainage, mm. */
  from_mm: number;
  to_mm: number;
}

async function stretchesOf(run: Run, job: Job): Promise<Stretch[]> {
  if (job.state !== "done") return [];
  const { recordings = [] } = await getManifest(job.id);
  const sign = run.direction === "backward" ? -1 : 1;
  return recordings.map(({ name, from_x_mm, to_x_mm }) => {
    const [a, b] = [run.chainage_mm + sign * from_x_mm, run.chainage_mm + sign * to_x_mm];
    return { name, from_mm: Math.min(a, b), to_mm: Math.max(a, b) };
  });
}

export function Space({ run, job, segments }: { run: Run; job: Job; segments: number }) {
  const loaded = useLoaded(`stretches ${job.id} ${job.state}`, () => stretchesOf(run, job), once);
  const stretches = loaded.value ?? [];
  const [wanted, setWanted] = useState(readQuery().get("stretch"));
  // The address counts from 1, as the files do; what is not there is the whole.
  const shown = stretches.find((_, index) => `${index + 1}` === wanted) ?? null;
  const choose = (number: string) => {
    setWanted(number);
    writeQuery({ stretch: number });
  };
  return (
    <>
      {loaded.problem && <ProblemBox problem={loaded.problem} onRetry={loaded.reload} />}
      {stretches.length > 0 && <Choice stretches={stretches} shown={shown} onChange={choose} />}
      <View3d key={`${job.id} ${job.attempt}`} job={job} segments={segments} name={run.source.filename} stretch={shown?.name ?? null} />
      <LightView job={job} />
    </>
  );
}

function Choice({ stretches, shown, onChange }: { stretches: Stretch[]; shown: Stretch | null; onChange: (number: string) => void }) {
  const id = useId();
  return (
    <div class="field">
      <label for={id}>{words.stretch}</label>
      <select id={id} aria-describedby={`${id}-hint`} value={shown === null ? "" : `${stretches.indexOf(shown) + 1}`} onChange={(event) => onChange(event.currentTarget.value)}>
        <option value="">{words.stretchWhole}</option>
        {stretches.map(({ name, from_mm, to_mm }, index) => (
          <option key={name} value={`${index + 1}`}>
            {words.stretchOf(from_mm, to_mm)}
          </option>
        ))}
      </select>
      <p id={`${id}-hint`} class="faint">
        {words.stretchHint}
      </p>
    </div>
  );
}
