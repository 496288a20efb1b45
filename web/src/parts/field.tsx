// A labelled form field with a hint and, where it is wrong, what is wrong.

import type { JSX } from "preact";
import { useId } from "preact/hooks";

type Aria = { "aria-describedby": string; "aria-invalid": boolean };
type Props = { label: string; hint: string; problem: string | null; children: (id: string, aria: Aria) => JSX.Element };

export function Field({ label, hint, problem, children }: Props) {
  const id = useId();
  return (
    <div class="field">
      <label for={id}>{label}</label>
      {children(id, { "aria-describedby": `${id}-hint`, "aria-invalid": problem !== null })}
      <p id={`${id}-hint`} class={problem === null ? "faint" : "field-problem"}>
        {problem ?? hint}
      </p>
    </div>
  );
}
