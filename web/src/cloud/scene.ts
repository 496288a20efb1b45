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
  private readonly program: WebGLProgram;
  private readonly count: number;

  /** Throws where WebGL is not to be had. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly points: Points,
  ) {
    const gl = canvas.getContext("webgl", { antialias: false, preserveDrawingBuffer: true });
    if (gl === null) throw new Error("no WebGL");
    this.gl = gl;
    this.count = points.count;
    this.program = programOf(gl);
    gl.useProgram(this.program);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, points.positions, gl.STATIC_DRAW);
    const place = gl.getAttribLocation(this.program, "place");
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
  }

  draw(camera: Camera): void {
    const { gl, canvas, points } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const at = (name: string) => gl.getUniformLocation(this.program, name);
    gl.uniform3f(at("middle"), ...points.middle);
    gl.uniform1f(at("radius"), points.radius);
    gl.uniform1f(at("exaggeration"), camera.exaggeration);
    gl.uniform1f(at("turn"), camera.turn);
    gl.uniform1f(at("tilt"), camera.tilt);
    gl.uniform1f(at("distance"), camera.distance);
    gl.uniform1f(at("aspect"), width / Math.max(height, 1));
    // Points as large as their distance to each other, so that the surface closes.
    gl.uniform1f(at("size"), (height * 2.4) / Math.sqrt(this.count));
    gl.uniform2f(at("shift"), ...camera.shift);
    gl.uniform2f(at("range"), ...points.range);
    gl.drawArrays(gl.POINTS, 0, this.count);
  }

  close(): void {
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
    if (shader === null) throw new Error("no shader");
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) ?? "a shader does not compile");
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? "the shaders do not link");
  return program;
}
