// How bad a defect is, and what people decided, as words with a colour; the words alone say it all.

import type { DefectState } from "../api.ts";
import { defectTexts as words } from "../texts/defects.ts";

export function Severity({ kind, severity }: { kind: string; severity: string }) {
  return (
    <span class={`severity ${severity}`}>
      {words.kind(kind)} <span class="faint">{words.severities[severity] ?? severity}</span>
    </span>
  );
}

export function Decision({ state }: { state: DefectState }) {
  return <span class={`state ${state}`}>{words.states[state]}</span>;
}
