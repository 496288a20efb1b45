// A refusal or failure in words: what happened, what was expected, what to do.

import type { ComponentChildren } from "preact";
import type { Problem } from "../api.ts";
import { texts } from "../texts.ts";

type Props = { problem: Problem; heading?: string; onRetry?: () => void; onDismiss?: () => void; children?: ComponentChildren };

export function ProblemBox({ problem, heading, onRetry, onDismiss, children }: Props) {
  return (
    <div class="notice bad" role="alert">
      <p class="notice-title">{heading ?? problem.title}</p>
      {heading !== undefined && problem.title !== heading && <p>{problem.title}</p>}
      {problem.detail === "" ? <p>{texts.problem.unreachable}</p> : <p class="words">{problem.detail}</p>}
      {/* Some details say already what was expected. */}
      {problem.expected && !problem.detail.includes(problem.expected) && (
        <p class="words">
          <strong>{texts.problem.expected}:</strong> {problem.expected}
        </p>
      )}
      {children}
      {(onRetry ?? onDismiss) && (
        <p class="actions">
          {onRetry && (
            <button type="button" onClick={onRetry}>
              {texts.problem.tryAgain}
            </button>
          )}
          {onDismiss && (
            <button type="button" class="quiet" onClick={onDismiss}>
              {texts.problem.dismiss}
            </button>
          )}
        </p>
      )}
    </div>
  );
}
