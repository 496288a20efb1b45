// The cross-section: asked of the server, shown as a plot and as numbers to copy.

import { useEffect, useState } from "preact/hooks";
import { getProfile, problemOf, profilePath, type CrossSection, type Cut, type Problem } from "../api.ts";
import { copyText } from "../clipboard.ts";
import { Plot } from "../parts/plot.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { mapTexts } from "../texts/map.ts";
import type { Place } from "./pyramid.ts";

const words = mapTexts.section;
/** So many rows of numbers are shown; copying and the file have all. */
const ROWS_SHOWN = 500;

type Props = { job: string; cut: Cut; onSpot: (spot: Place | null) => void; onClose: () => void };

export function SectionPanel({ job, cut, onSpot, onClose }: Props) {
  const [section, setSection] = useState<CrossSection | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const path = profilePath(job, cut);
  useEffect(() => {
    const stopped = new AbortController();
    setProblem(null);
    getProfile(job, cut, stopped.signal)
      .then(setSection)
      .catch((error: unknown) => !stopped.signal.aborted && setProblem(problemOf(error)));
    return () => {
      stopped.abort();
      onSpot(null);
    };
  }, [path]);
  return (
    <section class="section-panel" aria-label={words.heading}>
      <div class="panel-head">
        <h3>{words.heading}</h3>
        <button type="button" class="quiet small" onClick={onClose}>
          {mapTexts.clear}
        </button>
      </div>
      {problem && <ProblemBox problem={problem} />}
      {section === null && !problem && <p role="status">{words.working}</p>}
      {section !== null && <Numbers section={section} csv={profilePath(job, cut, "csv")} onSpot={onSpot} />}
    </section>
  );
}

function Numbers({ section, csv, onSpot }: { section: CrossSection; csv: string; onSpot: (spot: Place | null) => void }) {
  const [copied, setCopied] = useState(false);
  const [series, setSeries] = useState(() => seriesOf(section));
  useEffect(() => {
    setSeries(seriesOf(section));
    setCopied(false);
  }, [section]);
  const depths = section.z_mm.filter((z) => z !== null && z !== undefined) as number[];
  const length_mm = section.distance_mm.at(-1) ?? 0;
  let [near, far] = [Infinity, -Infinity];
  for (const z of depths) [near, far] = [Math.min(near, z), Math.max(far, z)];
  const copy = async () => {
    await copyText(numbersOf(section));
    setCopied(true);
  };
  return (
    <>
      <p class="faint">
        {words.summary(length_mm, section.z_mm.length, section.z_mm.length - depths.length)} {depths.length > 0 && words.range(near, far)}
      </p>
      {depths.length === 0 ? (
        <p>{words.empty}</p>
      ) : (
        <Plot
          x={section.distance_mm}
          series={series}
          xLabel={words.axis}
          yLabel={words.depthAxis}
          label={words.plot}
          flipped
          onCursor={(index) => {
            const [x_mm, y_mm] = [section.x_mm[index ?? -1], section.y_mm[index ?? -1]];
            onSpot(x_mm === undefined || y_mm === undefined ? null : { x_mm, y_mm });
          }}
        />
      )}
      <p class="actions">
        <button type="button" onClick={() => void copy()} aria-live="polite">
          {copied ? words.copied : words.copy}
        </button>
        <a class="button" href={csv} download="cross-section.csv">
          {words.download}
        </a>
      </p>
      <details>
        <summary class="small">{words.numbers}</summary>
        <div class="numbers" tabIndex={0} role="region" aria-label={words.numbers}>
          <table>
            <thead>
              <tr>
                <th scope="col">{words.columns.distance}</th>
                <th scope="col">{words.columns.chainage}</th>
                <th scope="col">{words.columns.y}</th>
                <th scope="col">{words.columns.depth}</th>
              </tr>
            </thead>
            <tbody>
              {section.z_mm.slice(0, ROWS_SHOWN).map((z, at) => (
                <tr key={at}>
                  <td>{section.distance_mm[at]?.toFixed(2)}</td>
                  <td>{section.chainage_mm[at]?.toFixed(2)}</td>
                  <td>{section.y_mm[at]?.toFixed(2)}</td>
                  <td>{z?.toFixed(3) ?? "–"}</td>
                </tr>
              ))}
            </tbody>
          </table>
        </div>
        {section.z_mm.length > ROWS_SHOWN && <p class="faint">{words.shown(ROWS_SHOWN, section.z_mm.length)}</p>}
      </details>
    </>
  );
}

function seriesOf(section: CrossSection) {
  return [{ label: words.depthAxis, values: section.z_mm.map((z) => z ?? null), colour: "--plot-1" }];
}

/** For a spreadsheet: tabs between columns, a line a value. */
export function numbersOf(section: CrossSection): string {
  const lines = section.z_mm.map((z, at) => [section.distance_mm[at], section.chainage_mm[at], section.x_mm[at], section.y_mm[at], z ?? ""].join("\t"));
  return ["distance_mm\tchainage_mm\tx_mm\ty_mm\tz_mm", ...lines].join("\n");
}
