// The legend, and the depths at its ends.

import { useEffect, useRef } from "preact/hooks";
import { mapTexts } from "../texts/map.ts";
import { rampAt } from "./colours.ts";

type Props = {
  range: [number, number];
  auto: [number, number];
  chosen: boolean;
  /** Null: the automatic range. */
  onChange: (range: [number, number] | null) => void;
};

export function ColourRange({ range, auto, chosen, onChange }: Props) {
  const [near, far] = range;
  const set = (end: 0 | 1, text: string) => {
    const value = Number(text);
    if (text === "" || !Number.isFinite(value)) return;
    const next: [number, number] = end === 0 ? [value, far] : [near, value];
    if (next[0] < next[1]) onChange(next);
  };
  const step = stepFor(auto[1] - auto[0]);
  const field = (end: 0 | 1, label: string) => (
    <input
      type="number"
      aria-label={`${mapTexts.range}: ${label}`}
      title={label}
      step={step}
      value={Number(range[end].toFixed(2))}
      onChange={(event) => set(end, event.currentTarget.value)}
    />
  );
  return (
    <div class="colour-range">
      {field(0, mapTexts.near)}
      <Ramp />
      {field(1, mapTexts.far)}
      <span class="faint">mm</span>
      <button type="button" class="small" disabled={!chosen} title={mapTexts.autoHint} onClick={() => onChange(null)}>
        {mapTexts.auto}
      </button>
    </div>
  );
}

function Ramp() {
  const canvas = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    const context = canvas.current?.getContext("2d");
    if (!context) return;
    for (let x = 0; x < 256; x += 1) {
      context.fillStyle = `rgb(${rampAt(x / 255).join(" ")})`;
      context.fillRect(x, 0, 1, 1);
    }
  }, []);
  return <canvas ref={canvas} class="ramp" width={256} height={1} role="img" aria-label={mapTexts.legend} title={mapTexts.legend} />;
}

/** A round step of about a fiftieth of the range. */
function stepFor(span: number): number {
  const power = 10 ** Math.floor(Math.log10(Math.max(span, 0.01) / 20));
  return Math.max(power, 0.01);
}
