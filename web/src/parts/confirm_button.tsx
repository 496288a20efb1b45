// A button that asks first, in a dialog, and says what went wrong in it: for what cannot be undone, or needs one more answer.

import type { ComponentChildren } from "preact";
import { useId, useRef, useState } from "preact/hooks";
import { problemOf, type Problem } from "../api.ts";
import { ProblemBox } from "./problem.tsx";

type Props = {
  label: string;
  /** What a screen reader calls the button, where its label alone does not tell which one it is. */
  name?: string;
  heading: string;
  body: string;
  yes: string;
  no: string;
  class?: string;
  disabled?: boolean;
  action: () => Promise<unknown>;
  /** More to be answered. */
  children?: ComponentChildren;
};

export function ConfirmButton({ label, name, heading, body, yes, no, action, disabled, children, class: kind = "harm" }: Props) {
  const dialog = useRef<HTMLDialogElement>(null);
  const id = useId();
  const [problem, setProblem] = useState<Problem | null>(null);
  const [waiting, setWaiting] = useState(false);
  const open = () => {
    setProblem(null);
    dialog.current?.showModal();
  };
  const confirm = () => {
    setProblem(null);
    setWaiting(true);
    action()
      .then(() => dialog.current?.close())
      .catch((error: unknown) => setProblem(problemOf(error)))
      .finally(() => setWaiting(false));
  };
  return (
    <>
      <button type="button" class={kind} aria-label={name} disabled={disabled} onClick={open}>
        {label}
      </button>
      <dialog ref={dialog} aria-labelledby={id}>
        <h2 id={id} class="words">
          {heading}
        </h2>
        <p>{body}</p>
        {children}
        {problem && <ProblemBox problem={problem} />}
        <p class="actions">
          <button type="button" onClick={() => dialog.current?.close()}>
            {no}
          </button>
          <button type="button" class={kind} disabled={waiting} onClick={confirm}>
            {yes}
          </button>
        </p>
      </dialog>
    </>
  );
}
