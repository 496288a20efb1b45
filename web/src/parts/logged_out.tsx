// Says that the session is over, and leads to the log-in; goes away by itself when somebody has logged in elsewhere.

import { useEffect, useState } from "preact/hooks";
import { getSession } from "../api.ts";
import { loginPath, onSession } from "../session.ts";
import { texts } from "../texts.ts";

const words = texts.loggedOut;
const LOOK_MS = 4000;

export function LoggedOut() {
  const [out, setOut] = useState(false);
  useEffect(() => onSession((loggedIn) => setOut(!loggedIn)), []);
  useEffect(() => {
    if (!out) return undefined;
    // Whoever asks in vain hears it as everybody does.
    const look = () => document.hidden || void getSession().catch(() => undefined);
    const timer = setInterval(look, LOOK_MS);
    document.addEventListener("visibilitychange", look);
    addEventListener("focus", look);
    return () => {
      clearInterval(timer);
      document.removeEventListener("visibilitychange", look);
      removeEventListener("focus", look);
    };
  }, [out]);
  if (!out) return null;
  return (
    <div class="notice bad logged-out" role="alert">
      <p class="notice-title">{words.heading}</p>
      <p>{words.body}</p>
      <p class="actions">
        <a class="button primary" href={loginPath()}>
          {words.logIn}
        </a>
        <span>{words.elsewhere}</span>
      </p>
    </div>
  );
}
