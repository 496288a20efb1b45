// The page around the views: header, the view that the address asks for, focus and title on every change of view.

import "./style.css";
import { render } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { lazy } from "./lazy.tsx";
import { LoggedOut } from "./parts/logged_out.tsx";
import { UploadPill } from "./parts/upload_pill.tsx";
import { useDroppedFiles } from "./parts/dropped.ts";
import { go, Link, useRoute, type Route } from "./router.tsx";
import { texts } from "./texts.ts";
import { keepFiles } from "./uploads_inbox.ts";
import { RunsView } from "./views/runs.tsx";
import { UnknownView } from "./views/unknown.tsx";

const RunView = lazy(async () => (await import("./views/run.tsx")).RunView);
const CompareView = lazy(async () => (await import("./views/compare.tsx")).CompareView);
const SendView = lazy(async () => (await import("./views/send.tsx")).SendView);
const LiveView = lazy(async () => (await import("./views/live.tsx")).LiveView);
const QueueView = lazy(async () => (await import("./views/queue.tsx")).QueueView);
const BatchView = lazy(async () => (await import("./views/batch.tsx")).BatchView);
const DefectsView = lazy(async () => (await import("./views/defects.tsx")).DefectsView);
const SettingsView = lazy(async () => (await import("./views/settings.tsx")).SettingsView);

/** What changes when another view begins: then the reading starts at its top. */
function addressOf(route: Route): string {
  return "run" in route ? `${route.view} ${route.run}` : "batch" in route ? `${route.view} ${route.batch}` : route.view;
}

function App() {
  const route = useRoute();
  const main = useRef<HTMLElement>(null);
  const address = addressOf(route);
  const shown = useRef(address);

  // A new view: whoever reads with the keyboard or by ear starts at its top.
  useEffect(() => {
    if (shown.current !== address) main.current?.focus();
    shown.current = address;
  }, [address]);

  // Files may be let go anywhere: the page for sending takes them.
  const dragging = useDroppedFiles((files) => {
    keepFiles(files);
    if (route.view !== "send") go("/send");
  });

  return (
    <>
      <a class="skip" href="#main">
        {texts.skip}
      </a>
      <header class="bar">
        <nav aria-label={texts.menu}>
          <Link to="/" class="brand" label={texts.product}>
            <img src="/favicon.svg" alt="" width="26" height="26" />
            <span>{texts.product}</span>
          </Link>
          <div class="menu">
            <Link to="/" current={route.view === "runs" || route.view === "run" || route.view === "compare"}>
              {texts.nav.runs}
            </Link>
            <Link to="/defects" current={route.view === "defects"}>
              {texts.nav.defects}
            </Link>
            <Link to="/live" current={route.view === "live"}>
              {texts.nav.live}
            </Link>
            <Link to="/queue" current={route.view === "queue" || route.view === "batch"}>
              {texts.nav.queue}
            </Link>
            <Link to="/settings" current={route.view === "settings"}>
              {texts.nav.settings}
            </Link>
          </div>
          <UploadPill current={route.view === "send"} />
        </nav>
      </header>
      <LoggedOut />
      <main id="main" ref={main} tabIndex={-1} class={dragging ? "dragging" : ""}>
        <View route={route} />
      </main>
      {dragging && <p class="drop-veil">{texts.dropAnywhere}</p>}
    </>
  );
}

function View({ route }: { route: Route }) {
  switch (route.view) {
    case "runs":
      return <RunsView />;
    case "run":
      return <RunView key={route.run} run={route.run} job={route.job} tab={route.tab} />;
    case "compare":
      return <CompareView key={`${route.run} ${route.left} ${route.right}`} run={route.run} left={route.left} right={route.right} />;
    case "send":
      return <SendView />;
    case "live":
      return <LiveView />;
    case "queue":
      return <QueueView />;
    case "batch":
      return <BatchView key={route.batch} batch={route.batch} />;
    case "defects":
      return <DefectsView />;
    case "settings":
      return <SettingsView section={route.section} />;
    case "unknown":
      return <UnknownView path={route.path} />;
  }
}

const root = document.getElementById("app");
if (root !== null) render(<App />, root);
