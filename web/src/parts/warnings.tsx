// What a person should know about a result although it is there, or about a job while it goes on.

import { runTexts } from "../texts/run.ts";

export function Warnings({ warnings }: { warnings: string[] }) {
  if (warnings.length === 0) return null;
  return (
    <div class="notice warn">
      <p class="notice-title">{runTexts.quality.warnings}</p>
      <ul>
        {warnings.map((warning) => (
          <li key={warning} class="words">
            {warning}
          </li>
        ))}
      </ul>
    </div>
  );
}
