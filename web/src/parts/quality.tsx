// How well the run was measured, in plain words.

import { getManifest, type Job, type Manifest } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { runTexts } from "../texts/run.ts";
import { ProblemBox } from "./problem.tsx";
import { Warnings } from "./warnings.tsx";

const GAPS_SHOWN = 10;
const words = runTexts.quality;

export function Quality({ job }: { job: Job }) {
  const manifest = useLoaded(`manifest ${job.id}`, () => getManifest(job.id), once);
  return (
    <section>
      <h2>{words.heading}</h2>
      {manifest.problem && <ProblemBox problem={manifest.problem} onRetry={manifest.reload} />}
      <Warnings warnings={job.warnings} />
      {manifest.value && <Sentences manifest={manifest.value} />}
      {manifest.value && manifest.value.gaps.length > 0 && <Gaps gaps={manifest.value.gaps} />}
      {manifest.value && manifest.value.gaps.length + job.warnings.length === 0 && <p class="notice good">{words.good}</p>}
    </section>
  );
}

function Sentences({ manifest: { quality, resolution } }: { manifest: Manifest }) {
  const steps = Math.max(quality.frames - 1, 0);
  const sentences =
    quality.points === 0
      ? [words.none]
      : [
          words.rows(quality.rows_found, quality.frames),
          words.travel(quality.travel_mm, quality.duration_s),
          quality.frames_tracked >= steps ? words.trackedAll : words.tracked(quality.frames_tracked, steps),
          ...(quality.breaks ? [words.breaks(quality.breaks)] : []),
          ...(quality.frames_3_dof ? [words.onlyPosition(quality.frames_3_dof)] : []),
          ...(quality.residual_px == null ? [] : [words.fit(quality.residual_px)]),
          ...(quality.drift ? [words.drift(quality.drift.x_mm, quality.drift.y_mm, quality.drift.z_mm)] : []),
          words.coverage(quality.coverage),
          words.points(quality.points),
          ...(resolution ? [words.resolution(resolution.r_depth_mm, resolution.distance_mm)] : []),
        ];
  return (
    <ul>
      {sentences.map((sentence) => (
        <li key={sentence}>{sentence}</li>
      ))}
    </ul>
  );
}

function Gaps({ gaps }: { gaps: Manifest["gaps"] }) {
  return (
    <>
      <h3>{words.gaps}</h3>
      <ul>
        {gaps.slice(0, GAPS_SHOWN).map((gap) => (
          <li key={`${gap.first_frame} ${gap.reason}`}>{words.gap(gap.first_frame, gap.last_frame, gap.reason)}</li>
        ))}
        {gaps.length > GAPS_SHOWN && <li>{words.gapsMore(gaps.length - GAPS_SHOWN)}</li>}
      </ul>
    </>
  );
}
