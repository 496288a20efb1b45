// What is kept: the server's rules, what they or others would delete now, and a pin for what shall stay.

import { useState } from "preact/hooks";
import { previewRetention, setPinned, type RetentionPreview } from "../api.ts";
import { localTime, size } from "../format.ts";
import { once, useLoaded } from "../hooks.ts";
import { ActionButton } from "../parts/action_button.tsx";
import { CommandLine } from "../parts/command_line.tsx";
import { Field } from "../parts/field.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { Time } from "../parts/time.tsx";
import { Link, runPath } from "../router.tsx";
import { texts } from "../texts.ts";
import { doorTexts } from "../texts/doors.ts";

const words = doorTexts.retention;
type Rules = { keep_days?: number; quota_gb?: number };

export function RetentionSettings() {
  const own = useLoaded("retention", () => previewRetention({}), once);
  return (
    <>
      <p class="faint">{words.about}</p>
      {own.problem && <ProblemBox problem={own.problem} onRetry={own.reload} />}
      {own.value === null && !own.problem && <p role="status">{texts.waiting.list}</p>}
      {own.value && (
        <section class="card" aria-label={words.rules}>
          <h2>{words.rules}</h2>
          <p>{words.stored(own.value.stored_bytes)}</p>
          <ul>
            {own.value.keep_days != null && <li>{words.days(own.value.keep_days)}</li>}
            {own.value.quota_gb != null && <li>{words.quota(own.value.quota_gb)}</li>}
            {own.value.keep_days == null && own.value.quota_gb == null && <li>{words.keepsAll}</li>}
          </ul>
          <Doomed preview={own.value} onPinned={own.reload} />
        </section>
      )}
      <TryRules />
    </>
  );
}

/** A number of 0 or more; null where it is none, undefined where nothing was said. */
function amount(text: string): number | null | undefined {
  if (text.trim() === "") return undefined;
  const value = Number(text);
  return Number.isFinite(value) && value >= 0 ? value : null;
}

function TryRules() {
  const [days, setDays] = useState("");
  const [gb, setGb] = useState("");
  const [tried, setTried] = useState<{ rules: Rules; preview: RetentionPreview } | null>(null);
  const [keep_days, quota_gb] = [amount(days), amount(gb)];
  const problem = (value: number | null | undefined) => (value === null ? words.bad : null);
  const ask = async (rules: Rules) => setTried({ rules, preview: await previewRetention(rules) });
  const wanted = (): Rules => ({ ...(keep_days == null ? {} : { keep_days }), ...(quota_gb == null ? {} : { quota_gb }) });
  return (
    <section class="card" aria-label={words.try}>
      <h2>{words.try}</h2>
      <p class="faint">{words.tryAbout}</p>
      <div class="fields">
        <Field label={words.keepDays} hint={words.keepDaysHint} problem={problem(keep_days)}>
          {(id, aria) => <input id={id} {...aria} inputMode="decimal" value={days} onInput={(event) => setDays(event.currentTarget.value)} />}
        </Field>
        <Field label={words.quotaGb} hint={words.quotaGbHint} problem={problem(quota_gb)}>
          {(id, aria) => <input id={id} {...aria} inputMode="decimal" value={gb} onInput={(event) => setGb(event.currentTarget.value)} />}
        </Field>
      </div>
      <p class="actions">
        <ActionButton class="primary" disabled={keep_days === null || quota_gb === null || keep_days === quota_gb} action={() => ask(wanted())}>
          {words.show}
        </ActionButton>
      </p>
      {tried !== null && (
        <>
          <Doomed preview={tried.preview} onPinned={() => void ask(tried.rules)} />
          <p>{words.make}</p>
          <CommandLine command={commandOf(tried.preview)} />
        </>
      )}
    </section>
  );
}

const commandOf = ({ keep_days, quota_gb }: RetentionPreview): string => `stria serve${keep_days == null ? "" : ` --keep-days ${keep_days}`}${quota_gb == null ? "" : ` --quota-gb ${quota_gb}`}`;

function Doomed({ preview, onPinned }: { preview: RetentionPreview; onPinned: () => void }) {
  if (preview.runs === 0) return <p class="notice good">{words.nothing}</p>;
  return (
    <>
      <p class="notice warn">
        <strong>{words.doomed(preview.runs, preview.freed_bytes)}</strong> {preview.items.length < preview.runs && words.first(preview.items.length)}
      </p>
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
