// How far a job is, as a bar; of a stream nobody knows the end, so its bar only moves.

import type { Job } from "../api.ts";
import { count, percent } from "../format.ts";
import { texts } from "../texts.ts";

/** True where it can be told how far a job is: not while its source is still growing. */
function endKnown(job: Job): boolean {
  return (job.frames_total ?? 0) > 0 || job.progress > 0;
}

export function JobBar({ job }: { job: Job }) {
  return endKnown(job) ? <progress max={1} value={job.progress} aria-label={texts.progressBar} /> : <progress aria-label={texts.progressBar} />;
}

/** The same as a word: a share, or the frames so far. */
export function farInWords(job: Job): string {
  return endKnown(job) ? percent(job.progress) : texts.frames(count(job.frames));
}
