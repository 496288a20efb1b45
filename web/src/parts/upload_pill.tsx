// Sending, from any page: the way to it, and how far it is.

import { percent } from "../format.ts";
import { Link } from "../router.tsx";
import { texts } from "../texts.ts";
import { useUploads } from "../uploads.ts";

export function UploadPill({ current }: { current: boolean }) {
  const active = useUploads().filter(({ state }) => state === "sending" || state === "waiting" || state === "cut" || state === "paused");
  const bytes = active.reduce((sum, item) => sum + item.bytes, 0);
  const sent = active.reduce((sum, item) => sum + item.sent, 0);
  return (
    <Link to="/send" class="button send" current={current}>
      {active.length === 0 ? texts.nav.send : texts.sending(active.length, percent(bytes === 0 ? 0 : sent / bytes))}
    </Link>
  );
}
