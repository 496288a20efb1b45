// The surface in space: rerun's viewer for everything, or points for machines where that is too heavy.

import type { Job, Run } from "../api.ts";
import { lazy } from "../lazy.tsx";
import { View3d } from "./view3d.tsx";

const LightView = lazy(async () => (await import("../cloud/light_view.tsx")).LightView);

export function Space({ run, job, segments }: { run: Run; job: Job; segments: number }) {
  return (
    <>
      <View3d key={`${job.id} ${job.attempt}`} job={job} segments={segments} name={run.source.filename} />
      <LightView job={job} />
    </>
  );
}
