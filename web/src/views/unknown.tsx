// An address that is none of ours.

import { useTitle } from "../hooks.ts";
import { Link } from "../router.tsx";
import { texts } from "../texts.ts";

export function UnknownView({ path }: { path: string }) {
  useTitle(texts.unknownPage.heading);
  return (
    <>
      <h1>{texts.unknownPage.heading}</h1>
      <p>{texts.unknownPage.body(path)}</p>
      <p>
        <Link to="/">{texts.unknownPage.back}</Link>
      </p>
    </>
  );
}
