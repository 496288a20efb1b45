// Depth to colour and shade, a tile at a time: what the worker paints.

/** How depths are painted. */
export interface Style {
  /** Depths at the ends of the colours, mm: near, far. */
  near_mm: number;
  far_mm: number;
  /** 0: flat colours; 0.5: colours with the relief's shadows; 1: the relief alone, in gray. */
  relief: number;
}

/** From near to far in OKLCh, the same ramp as the preview's: lightness falls steadily, so it also works in gray. */
const RAMP: [number, number, number][] = [
  [0.91, 0.105, 96],
  [0.83, 0.14, 84],
  [0.74, 0.135, 135],
  [0.62, 0.105, 190],
  [0.5, 0.11, 245],
  [0.38, 0.13, 285],
];
const STEPS = 1024;

/** Red, green, blue of a place on the ramp, 0 to 255: 0 is nearest, 1 farthest. */
export function rampAt(share: number): [number, number, number] {
  const place = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
  const index = Math.min(Math.floor(place), RAMP.length - 2);
  const part = place - index;
  const [from, to] = [RAMP[index]!, RAMP[index + 1]!]; // index is at most the last but one
  const [lightness, chroma, hue] = [0, 1, 2].map((i) => from[i]! + (to[i]! - from[i]!) * part) as [number, number, number];
  const angle = (hue * Math.PI) / 180;
  return srgb(lightness, chroma * Math.cos(angle), chroma * Math.sin(angle));
}

/** Ottosson, "A perceptual color space for image processing" (2020): his matrices. */
function srgb(lightness: number, a: number, b: number): [number, number, number] {
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  const encode = (linear: number) => {
    const value = linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055;
    return Math.round(255 * Math.min(Math.max(value, 0), 1));
  };
  return [
    encode(4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s),
    encode(-1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s),
    encode(-0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s),
  ];
}

let table: Uint8Array | null = null;

function rampTable(): Uint8Array {
  if (table !== null) return table;
  table = new Uint8Array(3 * STEPS);
  for (let step = 0; step < STEPS; step += 1) table.set(rampAt(step / (STEPS - 1)), 3 * step);
  return table;
}

/** Contrast of the relief: how much a slope of 1 darkens. */
const CONTRAST = 1.4;
/** Share of the light that shadows may take from the colours. */
const SHADOW = 0.6;
const GRAY = 168;

/** Paints a square of depths (mm, NaN where there is none) whose pixels are `mm_per_px` wide; what is not measured stays clear. */
export function paint(depth_mm: Float32Array, side: number, mm_per_px: number, style: Style): ImageData {
  const colours = rampTable();
  const image = new ImageData(side, side);
  const pixels = image.data;
  const span = Math.max(style.far_mm - style.near_mm, 1e-6);
  const shadow = Math.min(style.relief * 2, 1) * SHADOW;
  const gray = Math.max(style.relief * 2 - 1, 0);
  for (let row = 0; row < side; row += 1) {
    const above = (row > 0 ? row - 1 : row) * side;
    const here = row * side;
    const below = (row < side - 1 ? row + 1 : row) * side;
    const down = row > 0 && row < side - 1 ? 2 : 1;
    for (let column = 0; column < side; column += 1) {
      const z = depth_mm[here + column]!;
      if (z !== z) continue; // NaN
      const step = Math.min(Math.max(Math.round(((z - style.near_mm) / span) * (STEPS - 1)), 0), STEPS - 1) * 3;
      let light = 0;
      if (shadow > 0) {
        const left = column > 0 ? column - 1 : column;
        const right = column < side - 1 ? column + 1 : column;
        const across = column > 0 && column < side - 1 ? 2 : 1;
        const at = (index: number) => {
          const value = depth_mm[index]!;
          return value === value ? value : z;
        };
        // Sobel: the slope, and the mean of three lines at once.
        const [a, c, g, k] = [at(above + left), at(above + right), at(below + left), at(below + right)];
        const slopeX = (c + 2 * at(here + right) + k - a - 2 * at(here + left) - g) / (4 * across * mm_per_px);
        const slopeY = (g + 2 * at(below + column) + k - a - 2 * at(above + column) - c) / (4 * down * mm_per_px);
        // Depth grows away from the eye; the light comes from the upper left.
        light = -Math.tanh(CONTRAST * (slopeX + slopeY));
      }
      const factor = 1 + shadow * light;
      const plain = GRAY * (1 + SHADOW * light);
      const to = 4 * (here + column);
      pixels[to] = colours[step]! * factor * (1 - gray) + plain * gray;
      pixels[to + 1] = colours[step + 1]! * factor * (1 - gray) + plain * gray;
      pixels[to + 2] = colours[step + 2]! * factor * (1 - gray) + plain * gray;
      pixels[to + 3] = 255;
    }
  }
  return image;
}
