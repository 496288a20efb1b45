// Points on a canvas by WebGL: turning, coming closer, colours by depth. Small on purpose.

import { rampAt } from "../map/colours.ts";
import type { Points } from "./points.ts";

const VERTEX = `
attribute vec3 place;
uniform vec3 middle;
uniform float radius, exaggeration, turn, tilt, distance, aspect, size;
uniform vec2 shift;
uniform vec2 range;
varying float share;
void main() {
  vec3 p = (place - middle) / radius;
  p.z *= exaggeration;
  // The wall as the robot sees it: x to the right, y down, z away.
  vec3 q = vec3(p.x * cos(turn) + p.z * sin(turn), -p.y, -p.x * sin(turn) + p.z * cos(turn));
  vec3 r = vec3(q.x, q.y * cos(tilt) + q.z * sin(tilt), -q.y * sin(tilt) + q.z * cos(tilt));
  float away = r.z + distance;
  gl_Position = vec4((r.x + shift.x) / aspect * 1.8, (r.y + shift.y) * 1.8, (away - distance) * 0.1 * away, away);
  gl_PointSize = clamp(size / away, 1.0, 12.0);
  share = clamp((place.z - range.x) / max(range.y - range.x, 0.001), 0.0, 1.0);
}`;
const FRAGMENT = `
precision mediump float;
uniform sampler2D ramp;
varying float share;
void main() { gl_FragColor = texture2D(ramp, vec2(share, 0.5)); }`;

/** How the points are looked at. */
export interface Camera {
  /** About the upright, radians. */
  turn: number;
  tilt: number;
  /** In halves of the longest side. */
  distance: number;
  shift: [number, number];
  exaggeration: number;
}

export const START: Camera = { turn: 0.35, tilt: 0.35, distance: 1.5, shift: [0, 0], exaggeration: 1 };

export class Scene {
  private readonly gl: WebGLRenderingContext;
  private program: WebGLProgram | null = null;
  private readonly stopped = new AbortController();

  /** `changed` is called when there is reason to draw again. Throws where WebGL is not to be had. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly points: Points,
    changed: () => void,
  ) {
    const gl = canvas.getContext("webgl", { antialias: false, preserveDrawingBuffer: true });
    if (gl === null) throw new Error("no WebGL");
    this.gl = gl;
    this.load();
    // A graphics driver that was reset, or a browser short of contexts, takes everything; it gives the context back when asked to.
    const { signal } = this.stopped;
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault(), { signal });
    canvas.addEventListener(
      "webglcontextrestored",
      () => {
        this.load();
        changed();
      },
      { signal },
    );
  }

  /** Hands shaders, points and colours to the graphics card; nothing while it has lost the context. */
  private load(): void {
    const { gl, points } = this;
    const program = programOf(gl);
    if (gl.isContextLost()) return;
    gl.useProgram(program);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, points.positions, gl.STATIC_DRAW);
    const place = gl.getAttribLocation(program, "place");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
    const ramp = new Uint8Array(256 * 4);
    for (let at = 0; at < 256; at += 1) ramp.set([...rampAt(at / 255), 255], 4 * at);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, ramp);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.enable(gl.DEPTH_TEST);
    this.program = program;
  }

  draw(camera: Camera): void {
    const { gl, canvas, points, program } = this;
    if (program === null || gl.isContextLost()) return;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const at = (name: string) => gl.getUniformLocation(program, name);
    gl.uniform3f(at("middle"), ...points.middle);
    gl.uniform1f(at("radius"), points.radius);
    gl.uniform1f(at("exaggeration"), camera.exaggeration);
    gl.uniform1f(at("turn"), camera.turn);
    gl.uniform1f(at("tilt"), camera.tilt);
    gl.uniform1f(at("distance"), camera.distance);
    gl.uniform1f(at("aspect"), width / Math.max(height, 1));
    // Points as large as their distance to each other, so that the surface closes.
    gl.uniform1f(at("size"), (height * 2.4) / Math.sqrt(points.count));
    gl.uniform2f(at("shift"), ...camera.shift);
    gl.uniform2f(at("range"), ...points.range);
    gl.drawArrays(gl.POINTS, 0, points.count);
  }

  close(): void {
    this.stopped.abort();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}

function programOf(gl: WebGLRenderingContext): WebGLProgram {
  const program = gl.createProgram();
  for (const [kind, source] of [
    [gl.VERTEX_SHADER, VERTEX],
    [gl.FRAGMENT_SHADER, FRAGMENT],
  ] as const) {
    const shader = gl.createShader(kind);
    // There is none where the context was lost meanwhile.
    if (shader === null) break;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(program) ?? "the shaders do not link");
  return program;
}
