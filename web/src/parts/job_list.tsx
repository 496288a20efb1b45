// All jobs of a run: look at an earlier one, or measure again with another recipe.

import { useState } from "preact/hooks";
import { listRecipes, listRigs, reprocess, type Job, type Run } from "../api.ts";
import { duration, secondsBetween } from "../format.ts";
import { once, useLoaded } from "../hooks.ts";
import { go, Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { ActionButton } from "./action_button.tsx";
import { State } from "./state.tsx";
import { Time } from "./time.tsx";

const words = texts.jobs;

type Props = { run: Run; jobs: Job[]; shown: string; onChanged: () => void };

export function JobList({ run, jobs, shown, onChanged }: Props) {
  const recipes = useLoaded("recipes", listRecipes, once);
  const rigs = useLoaded("rigs", listRigs, once);
  const [picked, setPicked] = useState<string | null>(null);
  const [rig, setRig] = useState("");
  const recipe = picked ?? recipes.value?.find((other) => other.default)?.name ?? "";
  return (
    <section class="card">
      <h2>{words.heading}</h2>
      <ul class="jobs">
        {jobs.map((job) => (
          <li key={job.id} class={job.id === shown ? "current" : ""}>
            <span>
              <strong>{words.job(job.recipe, job.rig)}</strong> <State state={job.state} />
            </span>
            <span class="faint">
              <Time at={job.created_at} />
              {job.started_at && job.finished_at && ` · ${words.took(duration(secondsBetween(job.started_at, job.finished_at)))}`}
            </span>
            {job.id === shown ? (
              <span class="faint">{words.shown}</span>
            ) : (
              <Link to={runPath(run.id, job.id)} label={`${words.show}: ${words.job(job.recipe, job.rig)}`}>
                {words.show}
              </Link>
            )}
          </li>
        ))}
      </ul>
      <div class="actions">
        <label>
          {words.again}{" "}
          <select value={recipe} onChange={(event) => setPicked(event.currentTarget.value)}>
            {recipes.value?.map(({ name }) => (
              <option key={name} value={name}>
                {name}
              </option>
            ))}
          </select>
        </label>
        <label>
          {words.withRig}{" "}
          <select value={rig} onChange={(event) => setRig(event.currentTarget.value)}>
            <option value="">{words.sameRig}</option>
            {rigs.value?.map(({ name }) => (
              <option key={name} value={name}>
                {name}
              </option>
            ))}
          </select>
        </label>
        <ActionButton
          disabled={recipe === ""}
          action={async () => {
            const job = await reprocess(run.id, rig === "" ? { recipe } : { recipe, rig });
            onChanged();
            go(runPath(run.id, job.id));
          }}
        >
          {words.start}
        </ActionButton>
      </div>
    </section>
  );
}
