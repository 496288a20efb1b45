// Parts of the page that are loaded when somebody asks for them.

import type { ComponentType, JSX } from "preact";
import { useEffect, useState } from "preact/hooks";
import { problemOf, UNREACHABLE, type Problem } from "./api.ts";
import { ProblemBox } from "./parts/problem.tsx";
import { texts } from "./texts.ts";

/** A component whose code comes when it is first shown. */
export function lazy<P extends object>(load: () => Promise<ComponentType<P>>): (props: P) => JSX.Element {
  let loaded: ComponentType<P> | null = null;
  return function Lazy(props: P) {
    const [, setTurn] = useState(0);
    const [problem, setProblem] = useState<Problem | null>(null);
    const ask = () => {
      setProblem(null);
      load().then(
        (component) => {
          loaded = component;
          setTurn((turn) => turn + 1);
        },
        // A module that does not come says nothing about why: mostly the link is down.
        (error: unknown) => setProblem(error instanceof TypeError ? UNREACHABLE : problemOf(error)),
      );
    };
    useEffect(() => {
      if (loaded === null) ask();
    }, []);
    if (loaded !== null) {
      const Component = loaded;
      return <Component {...props} />;
    }
    return problem === null ? (
      <p role="status" class="faint">
        {texts.waiting.part}
      </p>
    ) : (
      <ProblemBox problem={problem} onRetry={ask} />
    );
  };
}
