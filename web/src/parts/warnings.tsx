// What a person should know about a result although it is there, or about a job while it goes on.

import { texts } from "../texts.ts";

export function Warnings({ warnings }: { warnings: string[] }) {
  if (warnings.length === 0) return null;
  return (
    <div class="notice warn">
      <p class="notice-title">{texts.quality.warnings}</p>
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
