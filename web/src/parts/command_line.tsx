// A command to copy.

import { useState } from "preact/hooks";
import { texts } from "../texts.ts";

export function CommandLine({ command }: { command: string }) {
  const [copied, setCopied] = useState(false);
  // Browsers offer the clipboard only under HTTPS and on localhost; elsewhere the text is selected by hand.
  const copy = () => void navigator.clipboard.writeText(command).then(() => setCopied(true));
  return (
    <div class="command">
      <code>{command}</code>
      {"clipboard" in navigator && (
        <button type="button" class="quiet" onClick={copy} aria-live="polite">
          {copied ? texts.runs.copied : texts.runs.copy}
        </button>
      )}
    </div>
  );
}
