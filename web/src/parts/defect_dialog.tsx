// One defect: its figures, what people decide about it, the same place in other runs.

import { useEffect, useId, useRef, useState } from "preact/hooks";
import { CHANGED_MEANWHILE, changeDefect, getDefect, getDefectHistory, problemOf, type Defect, type DefectChange, type DefectHistory, type DefectState } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { defectPath, Link } from "../router.tsx";
import { texts } from "../texts.ts";
import { defectTexts as words } from "../texts/defects.ts";
import { ActionButton } from "./action_button.tsx";
import { ProblemBox } from "./problem.tsx";
import { Severity } from "./severity.tsx";
import { Time } from "./time.tsx";

type Props = { defect: Defect; onChanged: (defect: Defect) => void; onClose: () => void };

export function DefectDialog({ defect, onChanged, onClose }: Props) {
  const dialog = useRef<HTMLDialogElement>(null);
  const id = useId();
  useEffect(() => dialog.current?.showModal(), []);
  return (
    <dialog ref={dialog} class="defect" aria-labelledby={id} onClose={onClose}>
      <h2 id={id}>
        {words.one(defect.number, words.kind(defect.kind))}
      </h2>
      <p>
        <Severity kind={defect.kind} severity={defect.severity} />
      </p>
      <Facts defect={defect} />
      <Judge key={defect.id} defect={defect} onChanged={onChanged} />
      <History defect={defect} />
      <p class="actions">
        <Link to={defectPath(defect)} class="button">
          {words.onMap}
        </Link>
        <button type="button" onClick={() => dialog.current?.close()}>
          {words.close}
        </button>
      </p>
    </dialog>
  );
}

function Facts({ defect }: { defect: Defect }) {
  const names = words.facts;
  const place = words.place(defect.clock_h, defect.height_mm);
  const facts: [string, string][] = [
    [names.asset, defect.asset],
    [names.place, `${words.chainage(defect.chainage_mm)}${place === "" ? "" : `, ${place}`}`],
    [names.depth, words.depth(defect.depth_mm)],
    [names.size, words.size(defect.length_mm, defect.width_mm)],
    [names.area, words.area(defect.area_mm2)],
    [names.volume, words.volume(defect.volume_mm3)],
    [names.slope, words.slope(defect.steepest_slope_deg)],
    [names.sure, words.sure(defect.confidence, defect.at_edge)],
    ...(defect.code ? ([[names.code, defect.code]] as [string, string][]) : []),
  ];
  return (
    <dl class="facts">
      {facts.map(([name, value]) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd class="words">{value}</dd>
        </div>
      ))}
    </dl>
  );
}

/** State and comment. The version that was seen goes with a change, so that nobody overwrites what somebody else just wrote. */
function Judge({ defect, onChanged }: Omit<Props, "onClose">) {
  const id = useId();
  const [state, setState] = useState<DefectState>(defect.state);
  const [comment, setComment] = useState(defect.comment);
  const [saved, setSaved] = useState(false);
  const changed = state !== defect.state || comment !== defect.comment;
  const save = async (change: DefectChange) => {
    try {
      const now = await changeDefect(defect, change);
      setState(now.state);
      setSaved(true);
      onChanged(now);
    } catch (error) {
      if (problemOf(error).status === CHANGED_MEANWHILE) {
        // What somebody else said stands in the form now: whoever still wants something else says it again.
        const theirs = await getDefect(defect.id);
        setState(theirs.state);
        setComment(theirs.comment);
        onChanged(theirs);
      }
      throw error;
    }
  };
  return (
    <section>
      <h3>{words.decision}</h3>
      {defect.carried_from && <p class="faint">{words.carried}</p>}
      <div class="field">
        <label for={`${id}-state`}>{words.stateLabel}</label>
        <select id={`${id}-state`} value={state} onChange={(event) => setState(event.currentTarget.value as DefectState)}>
          {Object.entries(words.states).map(([name, text]) => (
            <option key={name} value={name}>
              {text}
            </option>
          ))}
        </select>
      </div>
      <div class="field">
        <label for={`${id}-comment`}>{words.comment}</label>
        <textarea id={`${id}-comment`} rows={3} maxLength={4000} value={comment} onInput={(event) => setComment(event.currentTarget.value)} />
      </div>
      <p class="actions">
        <ActionButton class="primary" disabled={!changed} action={() => save({ state, comment })}>
          {words.save}
        </ActionButton>
        {defect.state === "open" && state === "open" && <ActionButton action={() => save({ state: "acknowledged", comment })}>{words.acknowledge}</ActionButton>}
        <span class="faint" role="status">
          {saved && !changed && words.saved}{" "}
          {defect.changed_at && (
            <>
              <Time at={defect.changed_at} /> {defect.changed_by && words.by(defect.changed_by)}
            </>
          )}
        </span>
      </p>
    </section>
  );
}

function History({ defect }: { defect: Defect }) {
  const history = useLoaded<DefectHistory>(`history ${defect.id}`, () => getDefectHistory(defect.id), once);
  const items = history.value?.items ?? [];
  return (
    <section>
      <h3>{words.history}</h3>
      {history.problem && <ProblemBox problem={history.problem} onRetry={history.reload} />}
      {history.value === null && !history.problem && <p role="status">{texts.waiting.list}</p>}
      {history.value !== null && items.length < 2 && <p class="faint">{words.historyAlone}</p>}
      {items.length > 1 && (
        <div class="table-box" tabIndex={0} role="region" aria-label={words.history}>
          <table class="plain-table">
            <thead>
              <tr>
                <th scope="col">{words.historyRun}</th>
                <th scope="col">{words.historyDepth}</th>
                <th scope="col">{words.facts.size}</th>
              </tr>
            </thead>
            <tbody>
              {items.map(({ run, recorded_at, detection_limit_mm, defect: there }) => (
                <tr key={run}>
                  <th scope="row">
                    <Time at={recorded_at} />
                  </th>
                  <td>
                    {!there && words.historyNothing(detection_limit_mm)}
                    {there && there.id === defect.id && `${words.depth(there.depth_mm)} (${words.historyThis})`}
                    {there && there.id !== defect.id && (
                      <Link to={defectPath(there)} label={words.onMapOf(words.depth(there.depth_mm))}>
                        {words.depth(there.depth_mm)}
                      </Link>
                    )}
                  </td>
                  <td>{there && words.size(there.length_mm, there.width_mm)}</td>
                </tr>
              ))}
            </tbody>
          </table>
        </div>
      )}
    </section>
  );
}
