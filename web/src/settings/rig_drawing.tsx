// A rig seen from the side: what the camera sees and where the laser's plane crosses it.

import { workTexts } from "../texts/work.ts";
import { distanceAt, usualDistance, type Geometry } from "./rig_geometry.ts";

const words = workTexts.settings.rigs;
const WIDTH = 640;
const HEIGHT = 260;
const LEFT = 54;
const RIGHT = 24;

export function RigDrawing({ rig }: { rig: Geometry }) {
  const focal = rig.vertical ? rig.fx_px : rig.fy_px;
  const middle = rig.vertical ? rig.cx_px : rig.cy_px;
  const size = rig.vertical ? rig.width_px : rig.height_px;
  const depth = Math.max((usualDistance(rig) ?? 1000) * 1.7, 50);
  const [low, high] = [(0 - middle) / focal, (size - 1 - middle) / focal];
  const axis = rig.vertical ? 0 : 1;
  // Where the laser's plane crosses the drawing at the camera and at the far end: n·X = d.
  const laserAt = (z_mm: number) => (rig.offset_mm - rig.normal[2] * z_mm) / rig.normal[axis];
  const span = Math.max(Math.abs(low), Math.abs(high), Math.abs(laserAt(0)) / depth, 0.25) * depth * 1.12;
  const scale = Math.min((WIDTH - LEFT - RIGHT) / depth, HEIGHT / 2 / span);
  const x = (z_mm: number) => LEFT + z_mm * scale;
  const y = (across_mm: number) => HEIGHT / 2 + across_mm * scale;
  const reach = (WIDTH - LEFT - RIGHT) / scale;
  const crossing = crossingOf(rig, size, reach);
  const step = roundStep(reach / 5);
  const marks = Array.from({ length: Math.floor(reach / step) }, (_, index) => (index + 1) * step);
  return (
    <figure class="rig-drawing">
      <svg viewBox={`0 0 ${WIDTH} ${HEIGHT}`} role="img" aria-label={words.drawing}>
        <path class="view-cone" d={`M ${x(0)} ${y(0)} L ${x(reach)} ${y(low * reach)} L ${x(reach)} ${y(high * reach)} Z`} />
        {marks.map((z) => (
          <g key={z} class="mark">
            <line x1={x(z)} x2={x(z)} y1={HEIGHT - 22} y2={HEIGHT - 16} />
            <text x={x(z)} y={HEIGHT - 4} text-anchor="middle">
              {z >= 1000 ? `${z / 1000} m` : `${z} mm`}
            </text>
          </g>
        ))}
        <line class="axis" x1={x(0)} y1={y(0)} x2={x(reach)} y2={y(0)} />
        {Number.isFinite(laserAt(0)) && <line class={`laser ${rig.colour}`} x1={x(0)} y1={y(laserAt(0))} x2={x(reach)} y2={y(laserAt(reach))} />}
        {crossing !== null && <line class={`laser seen ${rig.colour}`} x1={x(crossing[0])} y1={y(laserAt(crossing[0]))} x2={x(crossing[1])} y2={y(laserAt(crossing[1]))} />}
        <rect class="camera" x={x(0) - 26} y={y(0) - 13} width="26" height="26" rx="4" />
        <text class="name" x={x(0) - 13} y={y(0) - 19} text-anchor="middle">
          {words.camera}
        </text>
      </svg>
      <figcaption class="faint">{words.drawing}</figcaption>
    </figure>
  );
}

/** The part of the laser's plane that the camera sees, up to a distance, mm. */
function crossingOf(rig: Geometry, size: number, reach: number): [number, number] | null {
  let [near, far] = [Infinity, 0];
  for (let at = 0; at < size; at += Math.max(size / 400, 1)) {
    const z_mm = distanceAt(rig, at);
    if (z_mm === null) continue;
    near = Math.min(near, z_mm);
    far = Math.max(far, z_mm);
  }
  return near < reach && far > 0 ? [near, Math.min(far, reach)] : null;
}

/** A round step, not below a value: no more marks than have room for their words. */
function roundStep(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5].map((digit) => digit * power).find((step) => step >= value) ?? 10 * power;
}
