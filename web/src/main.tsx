// The page around the views: header, the view that the address asks for, focus and title on every change of view.

import "./style.css";
import { render } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { Link, useRoute } from "./router.tsx";
import { texts } from "./texts.ts";
import { RunView } from "./views/run.tsx";
import { RunsView } from "./views/runs.tsx";
import { UnknownView } from "./views/unknown.tsx";

function App() {
  const route = useRoute();
  const main = useRef<HTMLElement>(null);
  const address = route.view === "run" ? `run ${route.run}` : route.view;
  const shown = useRef(address);

  // A new view: whoever reads with the keyboard or by ear starts at its top.
  useEffect(() => {
    if (shown.current !== address) main.current?.focus();
    shown.current = address;
  }, [address]);

  return (
    <>
      <a class="skip" href="#main">
        {texts.skip}
      </a>
      <header class="bar">
        <nav aria-label={texts.menu}>
          <Link to="/" class="brand" label={texts.product}>
            <img src="/favicon.svg" alt="" width="28" height="28" />
            <span>{texts.product}</span>
          </Link>
          <Link to="/" current={route.view === "runs"}>
            {texts.runs.title}
          </Link>
        </nav>
      </header>
      <main id="main" ref={main} tabIndex={-1}>
        {route.view === "runs" && <RunsView />}
        {route.view === "run" && <RunView key={route.run} run={route.run} job={route.job} />}
        {route.view === "unknown" && <UnknownView path={route.path} />}
      </main>
    </>
  );
}

const root = document.getElementById("app");
if (root !== null) render(<App />, root);
