// A job's state as a word with a colour; the word alone says it all.

import type { JobState } from "../api.ts";
import { texts } from "../texts.ts";

export function State({ state }: { state: JobState }) {
  return <span class={`state ${state}`}>{texts.state[state]}</span>;
}
