// Tokens: make one, seen once; renew it while the old one still opens; shut it out.

import { useState } from "preact/hooks";
import { createToken, listTokens, revokeToken, rotateToken, type Scope, type Token, type TokenWithSecret } from "../api.ts";
import { copyText } from "../clipboard.ts";
import { once, useLoaded } from "../hooks.ts";
import { ActionButton } from "../parts/action_button.tsx";
import { ConfirmButton } from "../parts/confirm_button.tsx";
import { Field } from "../parts/field.tsx";
import { ProblemBox } from "../parts/problem.tsx";
import { Time } from "../parts/time.tsx";
import { texts } from "../texts.ts";
import { doorTexts } from "../texts/doors.ts";

const words = doorTexts.tokens;
const DAY_MS = 86_400_000;
const EXPIRY_DAYS = "365";
const OVERLAP_S = 86_400;

export function TokensSettings() {
  const tokens = useLoaded("tokens", listTokens, once);
  const [shown, setShown] = useState<TokenWithSecret | null>(null);
  const made = (token: TokenWithSecret) => {
    setShown(token);
    tokens.reload();
  };
  const [valid, former] = [true, false].map((wanted) => tokens.value?.filter((token) => token.valid === wanted) ?? []);
  return (
    <>
      <p class="faint">{words.about}</p>
      {shown !== null && <Secret key={shown.id} token={shown} onKept={() => setShown(null)} />}
      <MakeToken onMade={made} />
      {tokens.problem && <ProblemBox problem={tokens.problem} onRetry={tokens.reload} />}
      {tokens.value === null && !tokens.problem && <p role="status">{texts.waiting.list}</p>}
      {tokens.value?.length === 0 && <p class="empty">{words.none}</p>}
      {valid!.length > 0 && (
        <section class="card" aria-label={words.list}>
          <List tokens={valid!} onRenewed={made} onRevoked={tokens.reload} />
        </section>
      )}
      {former!.length > 0 && (
        <details class="card">
          <summary>{words.former(former!.length)}</summary>
          <List tokens={former!} onRenewed={made} onRevoked={tokens.reload} />
        </details>
      )}
    </>
  );
}

/** The secret, this once. */
function Secret({ token, onKept }: { token: TokenWithSecret; onKept: () => void }) {
  const [copied, setCopied] = useState(false);
  return (
    <section class="notice good" role="status" aria-label={token.name}>
      <p class="notice-title">{words.once(token.name)}</p>
      <p>
        <code class="secret words">{token.secret}</code>
      </p>
      <p class="actions">
        <button type="button" class="primary" aria-live="polite" onClick={() => void copyText(token.secret).then(() => setCopied(true))}>
          {copied ? words.copied : words.copy}
        </button>
        <button type="button" onClick={onKept}>
          {words.kept}
        </button>
      </p>
    </section>
  );
}

function MakeToken({ onMade }: { onMade: (token: TokenWithSecret) => void }) {
  const [name, setName] = useState("");
  const [scopes, setScopes] = useState<Scope[]>(["ingest", "read"]);
  const [days, setDays] = useState(EXPIRY_DAYS);
  const toggle = (scope: Scope) => setScopes((before) => (before.includes(scope) ? before.filter((each) => each !== scope) : [...before, scope]));
  const make = async () => {
    const expires = days === "" ? {} : { expires_at: new Date(Date.now() + Number(days) * DAY_MS).toISOString() };
    const token = await createToken({ name: name.trim(), scopes, ...expires });
    setName("");
    onMade(token);
  };
  return (
    <section class="card" aria-label={words.make}>
      <h2>{words.make}</h2>
      <div class="fields">
        <Field label={words.name} hint={words.nameHint} problem={null}>
          {(id, aria) => <input id={id} {...aria} value={name} autoComplete="off" onInput={(event) => setName(event.currentTarget.value)} />}
        </Field>
        <label class="field">
          {words.expiry}
          <select value={days} onChange={(event) => setDays(event.currentTarget.value)}>
            {Object.entries(words.expiries).map(([value, text]) => (
              <option key={value} value={value}>
                {text}
              </option>
            ))}
          </select>
        </label>
      </div>
      <fieldset class="checks">
        <legend>{words.scopes}</legend>
        {(Object.entries(doorTexts.scopes) as [Scope, string][]).map(([scope, text]) => (
          <label key={scope} class="check">
            <input type="checkbox" checked={scopes.includes(scope)} onChange={() => toggle(scope)} />
            <span>
              <code>{scope}</code> {text}
            </span>
          </label>
        ))}
      </fieldset>
      <p class="actions">
        <ActionButton class="primary" disabled={name.trim() === "" || scopes.length === 0} action={make}>
          {words.create}
        </ActionButton>
      </p>
    </section>
  );
}

type ListProps = { tokens: Token[]; onRenewed: (token: TokenWithSecret) => void; onRevoked: () => void };

function List({ tokens, onRenewed, onRevoked }: ListProps) {
  return (
    <ul class="queue tokens" aria-label={words.list}>
      {tokens.map((token) => (
        <li key={token.id}>
          <span class="queue-name words">
            <strong>{token.name}</strong>
            <span class="faint">{token.scopes.join(", ")}</span>
          </span>
          <span class="queue-tell faint">
            <span>
              {words.created} <Time at={token.created_at} />, {token.used_at ? <>{words.used} <Time at={token.used_at} /></> : words.never}
            </span>
            <span>{endOf(token)}</span>
          </span>
          {token.valid && (
            <span class="actions">
              <Renew token={token} onRenewed={onRenewed} />
              <ConfirmButton
                class="small harm"
                label={words.revoke}
                name={words.revokeOf(token.name)}
                heading={words.revokeHeading(token.name)}
                body={words.revokeBody}
                yes={words.revokeYes}
                no={words.keep}
                action={() => revokeToken(token.id).then(onRevoked)}
              />
            </span>
          )}
        </li>
      ))}
    </ul>
  );
}

function endOf({ revoked_at, expires_at, valid }: Token) {
  if (revoked_at) return <>{words.revoked} <Time at={revoked_at} /></>;
  if (!expires_at) return words.endless;
  return <>{valid ? words.expires : words.over} <Time at={expires_at} /></>;
}

function Renew({ token, onRenewed }: { token: Token; onRenewed: (token: TokenWithSecret) => void }) {
  const [overlap_s, setOverlap] = useState(OVERLAP_S);
  return (
    <ConfirmButton
      class="small"
      label={words.rotate}
      name={words.rotateOf(token.name)}
      heading={words.rotateHeading(token.name)}
      body={words.rotateBody}
      yes={words.rotateYes}
      no={words.keep}
      action={() => rotateToken(token.id, overlap_s).then(onRenewed)}
    >
      <label class="field">
        {words.overlap}
        <select value={overlap_s} onChange={(event) => setOverlap(Number(event.currentTarget.value))}>
          {words.overlaps.map((seconds) => (
            <option key={seconds} value={seconds}>
              {words.overlapWords(seconds)}
            </option>
          ))}
        </select>
      </label>
    </ConfirmButton>
  );
}
