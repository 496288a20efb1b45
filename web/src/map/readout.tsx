// What is under the pointer, in millimetres.

import { mapTexts } from "../texts/map.ts";
import type { Hover } from "./controller.ts";
import type { Chainage } from "./painter.ts";

const words = mapTexts.cursor;

export function Readout({ hover, chainage, value }: { hover: Hover | null; chainage: Chainage; value: string }) {
  if (hover === null) return <p class="readout faint">{words.none}</p>;
  const { place, z_mm, exact } = hover;
  const depth = z_mm === null ? (exact ? words.hole : "…") : exact ? words.exact(z_mm) : words.about(z_mm);
  return (
    <dl class="readout">
      <div>
        <dt>{words.chainage}</dt>
        <dd>{words.chainageMm(chainage.start_mm + chainage.sign * place.x_mm)}</dd>
      </div>
      <div>
        <dt>{words.height}</dt>
        <dd>{words.heightMm(place.y_mm)}</dd>
      </div>
      <div class="depth">
        <dt>{value}</dt>
        <dd data-z={exact && z_mm !== null ? z_mm : undefined} data-x={place.x_mm} data-y={place.y_mm}>
          {depth}
        </dd>
      </div>
    </dl>
  );
}
