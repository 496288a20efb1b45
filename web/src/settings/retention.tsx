// What is kept: the rules that hold and who made them, what they or others would delete, others to be stored, and a pin for what
// shall stay.

import { useEffect, useState } from "preact/hooks";
import { CHANGED_MEANWHILE, forgetRetention, getRetention, previewRetention, problemOf, setPinned, storeRetention, type KeepingRules, type RetentionPreview, type RetentionRules } from "../api.ts";
import { localTime, size } from "../format.ts";
import { once, useLoaded } from "../hooks.ts";
import { ActionButton } from "../parts/action_button.tsx";
import { ConfirmButton } from "../parts/confirm_button.tsx";
import { Field } from "../parts/field.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { Time } from "../parts/time.tsx";
import { Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { doorTexts } from "../texts/doors.ts";

const words = doorTexts.retention;

export function RetentionSettings() {
  const held = useLoaded("retention", getRetention, once);
  // What was shown stays while it is asked for anew, so that a form half filled in stays too.
  const [shown, setShown] = useState<RetentionPreview | null>(null);
  useEffect(() => {
    if (held.value) setShown(held.value);
  }, [held.value]);
  return (
    <>
      <p class="faint">{words.about}</p>
      {held.problem && <ProblemBox problem={held.problem} onRetry={held.reload} />}
      {shown === null && !held.problem && <p role="status">{texts.waiting.list}</p>}
      {shown && (
        <>
          <section class="card" aria-label={words.rules}>
            <h2>{words.rules}</h2>
            <Rules rules={shown.rules} />
            <Origin rules={shown.rules} />
            <p>{words.stored(shown.stored_bytes)}</p>
            <Doomed preview={shown} onPinned={held.reload} />
            {shown.rules.origin === "stored" && (
              <p class="actions">
                <UseOwn key={shown.rules.version} rules={shown.rules} onChanged={held.reload} />
              </p>
            )}
          </section>
          <OtherRules held={shown.rules} onChanged={held.reload} />
        </>
      )}
    </>
  );
}

function Rules({ rules: { keep_days, quota_gb } }: { rules: { keep_days?: number | null; quota_gb?: number | null } }) {
  return (
    <ul>
      {keep_days != null && <li>{words.days(keep_days)}</li>}
      {quota_gb != null && <li>{words.quota(quota_gb)}</li>}
      {keep_days == null && quota_gb == null && <li>{words.keepsAll}</li>}
    </ul>
  );
}

/** Which rules these are: since when, by whom. */
function Origin({ rules: { origin, changed_at, changed_by } }: { rules: RetentionRules }) {
  if (!changed_at) return <p class="faint">{words.fromServer}</p>;
  const who = changed_by ?? "";
  return (
    <p class="faint">
      {origin === "stored" ? words.fromPeople(who) : words.again(who)} <Time at={changed_at} />.
    </p>
  );
}

const rulesOf = (keep_days?: number | null, quota_gb?: number | null): KeepingRules => ({ ...(keep_days == null ? {} : { keep_days }), ...(quota_gb == null ? {} : { quota_gb }) });

function UseOwn({ rules, onChanged }: { rules: RetentionRules; onChanged: () => void }) {
  const own = rulesOf(rules.own_keep_days, rules.own_quota_gb);
  const preview = useLoaded(`retention ${JSON.stringify(own)}`, () => previewRetention(own), once);
  return (
    <ConfirmButton
      class={preview.value?.runs === 0 ? "" : "harm"}
      label={words.own}
      heading={words.ownHeading}
      body={words.ownBody}
      yes={words.ownYes}
      no={words.leave}
      disabled={preview.value === null}
      action={() => forgetRetention(rules.version).then(onChanged)}
    >
      <Rules rules={own} />
      {preview.value && <Verdict preview={preview.value} />}
    </ConfirmButton>
  );
}

/** A number of 0 or more; null where it is none, undefined where nothing was said. */
function amount(text: string): number | null | undefined {
  if (text.trim() === "") return undefined;
  const value = Number(text);
  return Number.isFinite(value) && value >= 0 ? value : null;
}

function OtherRules({ held, onChanged }: { held: RetentionRules; onChanged: () => void }) {
  const [days, setDays] = useState(`${held.keep_days ?? ""}`);
  const [gb, setGb] = useState(`${held.quota_gb ?? ""}`);
  const [tried, setTried] = useState<{ rules: KeepingRules; preview: RetentionPreview } | null>(null);
  const [saved, setSaved] = useState(false);
  const [keep_days, quota_gb] = [amount(days), amount(gb)];
  const problem = (value: number | null | undefined) => (value === null ? words.bad : null);
  const ask = async (rules: KeepingRules) => setTried({ rules, preview: await previewRetention(rules) });
  // What was looked at is not what stands in the fields any more.
  const edit = (set: (text: string) => void) => (event: { currentTarget: HTMLInputElement }) => {
    set(event.currentTarget.value);
    setTried(null);
    setSaved(false);
  };
  const save = async (rules: KeepingRules) => {
    try {
      await storeRetention(rules, held.version);
    } catch (error) {
      // The rules above become those of now; whoever still wants others says so again.
      if (problemOf(error).status === CHANGED_MEANWHILE) onChanged();
      throw error;
    }
    setTried(null);
    setSaved(true);
    onChanged();
  };
  const keepsNothing = tried !== null && (tried.rules.keep_days === 0 || tried.rules.quota_gb === 0);
  return (
    <section class="card" aria-label={words.other}>
      <h2>{words.other}</h2>
      <p class="faint">{words.otherAbout}</p>
      <div class="fields">
        <Field label={words.keepDays} hint={words.keepDaysHint} problem={problem(keep_days)}>
          {(id, aria) => <input id={id} {...aria} inputMode="decimal" autoComplete="off" value={days} onInput={edit(setDays)} />}
        </Field>
        <Field label={words.quotaGb} hint={words.quotaGbHint} problem={problem(quota_gb)}>
          {(id, aria) => <input id={id} {...aria} inputMode="decimal" autoComplete="off" value={gb} onInput={edit(setGb)} />}
        </Field>
      </div>
      <p class="actions">
        <ActionButton class="primary" disabled={keep_days === null || quota_gb === null} action={() => ask(rulesOf(keep_days, quota_gb))}>
          {words.show}
        </ActionButton>
        <span role="status" class="faint">
          {saved && words.saved}
        </span>
      </p>
      {tried !== null && (
        <>
          <Rules rules={tried.rules} />
          <Doomed preview={tried.preview} onPinned={() => void ask(tried.rules)} />
          {keepsNothing && <p class="faint">{words.keepsNothing}</p>}
          <p class="actions">
            <ConfirmButton
              class={tried.preview.runs === 0 ? "primary" : "harm"}
              label={words.save}
              heading={words.saveHeading(tried.preview.runs, tried.preview.freed_bytes)}
              body={words.saveBody}
              yes={words.saveYes}
              no={words.leave}
              disabled={keepsNothing}
              action={() => save(tried.rules)}
            >
              <Rules rules={tried.rules} />
            </ConfirmButton>
          </p>
        </>
      )}
    </section>
  );
}

function Verdict({ preview }: { preview: RetentionPreview }) {
  if (preview.runs === 0) return <p class="notice good">{words.nothing}</p>;
  return (
    <p class="notice warn">
      <strong>{words.doomed(preview.runs, preview.freed_bytes)}</strong> {preview.items.length < preview.runs && words.first(preview.items.length)}
    </p>
  );
}

function Doomed({ preview, onPinned }: { preview: RetentionPreview; onPinned: () => void }) {
  if (preview.runs === 0) return <Verdict preview={preview} />;
  return (
    <>
      <Verdict preview={preview} />
      <div class="table-box doomed" tabIndex={0} role="region" aria-label={words.doomed(preview.runs, preview.freed_bytes)}>
        <table class="plain-table">
          <thead>
            <tr>
              {[words.run, words.came, words.size, words.why, words.pin].map((head) => (
                <th key={head} scope="col">
                  {head}
                </th>
              ))}
            </tr>
          </thead>
          <tbody>
            {preview.items.map(({ run, asset, created_at, bytes, reason }) => (
              <tr key={run}>
                <th scope="row" class="words">
                  <Link to={runPath(run)}>{asset}</Link>
                </th>
                <td>
                  <Time at={created_at} />
                </td>
                <td>{size(bytes)}</td>
                <td>{words.reasons[reason] ?? reason}</td>
                <td>
                  <ActionButton class="small" label={words.pinOf(asset, localTime(created_at))} action={() => setPinned(run, true).then(onPinned)}>
                    {words.pin}
                  </ActionButton>
                </td>
              </tr>
            ))}
          </tbody>
        </table>
      </div>
    </>
  );
}
