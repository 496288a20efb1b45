// Who this browser is to the server, and the way out.

import { getSession, logOut } from "../api.ts";
import { once, useLoaded } from "../hooks.ts";
import { ActionButton } from "../parts/action_button.tsx";
import { Time } from "../parts/time.tsx";
import { doorTexts } from "../texts/doors.ts";

const words = doorTexts.who;

export function Who() {
  const session = useLoaded("session", getSession, once);
  if (session.value === null) return null;
  const { name, scopes, expires_at, locked } = session.value;
  if (!locked) return <p class="notice warn">{words.open}</p>;
  return (
    <p class="who faint">
      <span>
        {words.is(name)} ({scopes.join(", ")})
        {expires_at && (
          <>
            {" "}
            {words.until} <Time at={expires_at} />
          </>
        )}
      </span>
      <ActionButton class="small" action={() => logOut().then(() => location.assign("/login"))}>
        {words.out}
      </ActionButton>
    </p>
  );
}
