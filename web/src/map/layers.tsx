// Which layer the map shows: depth in colours, the visible image, the relief; and any mixture of them.

import { mapTexts } from "../texts/map.ts";

/** How much of the image, and of the relief, is mixed in: 0 to 1. */
export interface Look {
  image: number;
  relief: number;
}

type Name = keyof typeof mapTexts.layer;
const LOOKS: Record<Name, Look> = {
  depth: { image: 0, relief: 0.35 },
  image: { image: 1, relief: 0.35 },
  relief: { image: 0, relief: 1 },
};

export const lookOf = (name: Name): Look => LOOKS[name];

type Props = { look: Look; onChange: (look: Look) => void; withImage: boolean };

export function Layers({ look, onChange, withImage }: Props) {
  const names = (Object.keys(LOOKS) as Name[]).filter((name) => withImage || name !== "image");
  const named = (Object.keys(LOOKS) as Name[]).find((name) => LOOKS[name].image === look.image && LOOKS[name].relief === look.relief);
  return (
    <div class="layers">
      <div class="segments" role="radiogroup" aria-label={mapTexts.layers}>
        {names.map((name) => (
          <label key={name} class={name === named ? "on" : ""}>
            <input type="radio" name="map-layer" class="unseen" checked={name === named} onChange={() => onChange(LOOKS[name])} onClick={() => onChange(LOOKS[name])} />
            {mapTexts.layer[name]}
          </label>
        ))}
      </div>
      {withImage && (
        <label class="slider">
          <span>{mapTexts.fadeImage}</span>
          <input type="range" min={0} max={1} step={0.05} value={look.image} onInput={(event) => onChange({ ...look, image: Number(event.currentTarget.value) })} />
        </label>
      )}
      <label class="slider">
        <span>{mapTexts.fadeRelief}</span>
        <input type="range" min={0} max={1} step={0.05} value={look.relief} onInput={(event) => onChange({ ...look, relief: Number(event.currentTarget.value) })} />
      </label>
    </div>
  );
}
