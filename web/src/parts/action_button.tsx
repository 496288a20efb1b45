// A button that asks the server for something: rests while it waits, shows the refusal beside itself.

import type { ComponentChildren } from "preact";
import { useState } from "preact/hooks";
import { problemOf, type Problem } from "../api.ts";
import { ProblemBox } from "./problem.tsx";

type Props = { class?: string; disabled?: boolean; label?: string; action: () => Promise<unknown>; children: ComponentChildren };

export function ActionButton({ action, disabled, label, children, ...rest }: Props) {
  const [waiting, setWaiting] = useState(false);
  const [problem, setProblem] = useState<Problem | null>(null);
  const press = async () => {
    setWaiting(true);
    setProblem(null);
    try {
      await action();
    } catch (error) {
      setProblem(problemOf(error));
    }
    setWaiting(false);
  };
  return (
    <>
      <button type="button" aria-label={label} disabled={waiting || disabled} onClick={() => void press()} {...rest}>
        {children}
      </button>
      {problem && <ProblemBox problem={problem} onDismiss={() => setProblem(null)} />}
    </>
  );
}
