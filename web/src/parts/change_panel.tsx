// What changed on the wall between two measurements: a table, and the numbers on both maps.

import { differenceFile, getChange, type ChangeReport } from "../api.ts";
import { useLoaded, type Loaded } from "../hooks.ts";
import type { Marker } from "../map/painter.ts";
import type { Place } from "../map/pyramid.ts";
import { defectTexts } from "../texts/defects.ts";
import { ProblemBox } from "./problem.tsx";

const words = defectTexts.change;
/** A comparison that takes longer is asked for again after this, ms. */
const AGAIN_MS = 1500;

/** The comparison of two jobs, asked for until it is there. */
export function useChange(before: string, after: string): Loaded<{ report: ChangeReport | null }> {
  return useLoaded(`change ${before} ${after}`, async () => ({ report: await getChange(before, after) }), ({ report }) => (report === null ? AGAIN_MS : null));
}

/** Where the changes are on a map that lies shifted to the earlier one, and with `turned` half about. */
export function changeMarkers(report: ChangeReport, shift: Place, turned: boolean): Marker[] {
  const sign = turned ? -1 : 1;
  return report.changes.map(({ id, x_mm, y_mm, state }) => ({ number: id, x_mm: sign * (x_mm + shift.x_mm), y_mm: sign * (y_mm + shift.y_mm), colour: state === "shrunk" || state === "vanished" ? "--minor" : "--severe", chosen: false }));
}

export function ChangePanel({ change }: { change: Loaded<{ report: ChangeReport | null }> }) {
  const report = change.value?.report ?? null;
  return (
    <section class="card">
      <h2>{words.heading}</h2>
      {change.problem && <ProblemBox problem={change.problem} {...(change.problem.retryable ? { onRetry: change.reload } : {})} />}
      {report === null && !change.problem && <p role="status">{words.working}</p>}
      {report !== null && <Report report={report} />}
    </section>
  );
}

function Report({ report }: { report: ChangeReport }) {
  const { registration: laid, changes, unchanged, unsure_before, unsure_after } = report;
  const known = (number: number | null | undefined, depth_mm: number | null | undefined) => (number == null || depth_mm == null ? "–" : words.no(number, defectTexts.depth(depth_mm)));
  return (
    <>
      <p class="faint">
        {words.about(report.level_of_detection_mm, report.claimed_from_mm)} {words.registration(laid.windows_agreeing, laid.windows, Math.hypot(laid.sd_x_mm, laid.sd_y_mm))}
      </p>
      {changes.length === 0 && (
        <p>
          <strong>{words.none}</strong>
        </p>
      )}
      {changes.length + unchanged.length > 0 && (
        <div class="table-box" tabIndex={0} role="region" aria-label={words.heading}>
          <table class="plain-table">
            <thead>
              <tr>
                {["", words.state, words.delta, words.before, words.after, words.place, words.area].map((name) => (
                  <th key={name} scope="col">
                    {name}
                  </th>
                ))}
              </tr>
            </thead>
            <tbody>
              {changes.map((each) => (
                <tr key={each.id}>
                  <td>{each.id}</td>
                  <th scope="row">{words.states[each.state] ?? each.state}</th>
                  <td>{defectTexts.depth(each.delta_depth_mm)}</td>
                  <td>{known(each.before_number, each.before_depth_mm)}</td>
                  <td>{known(each.after_number, each.after_depth_mm)}</td>
                  <td>
                    {[defectTexts.chainage(each.chainage_mm), defectTexts.place(each.clock_h, each.height_mm)].filter((part) => part !== "").join(", ")}
                  </td>
                  <td>{defectTexts.area(each.area_mm2)}</td>
                </tr>
              ))}
              {unchanged.map((same) => (
                <tr key={`same ${same.before_number}`} class="faint">
                  <td />
                  <th scope="row">{words.states["unchanged"]}</th>
                  <td>–</td>
                  <td>{defectTexts.number(same.before_number)}</td>
                  <td>{defectTexts.number(same.after_number)}</td>
                  <td />
                  <td />
                </tr>
              ))}
            </tbody>
          </table>
        </div>
      )}
      <p>
        <a class="button small" href={differenceFile(report.before, report.after)} download="difference.tif" title={words.differenceHint}>
          {words.difference}
        </a>
      </p>
      {unsure_before.length + unsure_after.length > 0 && <p class="faint">{words.unsure(unsure_before.length, unsure_after.length)}</p>}
    </>
  );
}
