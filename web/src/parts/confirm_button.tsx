// A button for what cannot be undone: asks first, in a dialog, and says what went wrong in it.

import { useId, useRef, useState } from "preact/hooks";
import { problemOf, type Problem } from "../api.ts";
import { ProblemBox } from "./problem.tsx";

type Props = { label: string; heading: string; body: string; yes: string; no: string; action: () => Promise<void> };

export function ConfirmButton({ label, heading, body, yes, no, action }: Props) {
  const dialog = useRef<HTMLDialogElement>(null);
  const id = useId();
  const [problem, setProblem] = useState<Problem | null>(null);
  const confirm = () => {
    setProblem(null);
    action().catch((error: unknown) => setProblem(problemOf(error)));
  };
  return (
    <>
      <button type="button" class="harm" onClick={() => dialog.current?.showModal()}>
        {label}
      </button>
      <dialog ref={dialog} aria-labelledby={id}>
        <h2 id={id} class="words">
          {heading}
        </h2>
        <p>{body}</p>
        {problem && <ProblemBox problem={problem} />}
        <p class="actions">
          <button type="button" onClick={() => dialog.current?.close()}>
            {no}
          </button>
          <button type="button" class="harm" onClick={confirm}>
            {yes}
          </button>
        </p>
      </dialog>
    </>
  );
}
