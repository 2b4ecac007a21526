// Whether this browser draws fast enough to show scenes by itself.

import { EVERYWHERE } from "./shaders.js";

/** Names of renderers without a GPU. */
const SOFTWARE = /swiftshader|llvmpipe|softpipe|lavapipe|software|basic render/i;
/** Where no name is told: so many layers on so many pixels, 10 million fragments; a processor takes a second. */
const LAYERS = 40;
const SIDE = 512;
const SLOW_MS = 100;
const ONE = `#version 300 es
precision highp float;
out vec4 made;
void main() { made = vec4(exp(-fract(gl_FragCoord.x * 0.01)) * 0.01); }`;

/**
 * canDraw: at all. isFast: at a display's rate. why: a code, if it is not fast.
 * @typedef {{canDraw: boolean, isFast: boolean, name: string, why: "no_webgl"|"no_floats"|"software"|""}} Graphics
 */

/** @type {Graphics & {tookMs: number} | null} */
let found = null;

/** What this browser draws with, found out once, and how long that took. @returns {Graphics & {tookMs: number}} */
export function graphics() {
  const began = performance.now();
  return (found ??= { ...look(), tookMs: performance.now() - began });
}

/** @returns {Graphics} */
function look() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = SIDE;
  const gl = canvas.getContext("webgl2", { antialias: false, depth: false });
  if (!gl) return { canDraw: false, isFast: false, name: "", why: "no_webgl" };
  try {
    if (!gl.getExtension("EXT_color_buffer_float")) {
      return { canDraw: false, isFast: false, name: "", why: "no_floats" };
    }
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const name = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    const isSoftware = SOFTWARE.test(name) || (!info && fillMs(gl) > SLOW_MS);
    return { canDraw: true, isFast: !isSoftware, name, why: isSoftware ? "software" : "" };
  } finally {
    gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}

/** @param {WebGL2RenderingContext} gl @returns {number} ms that LAYERS take */
function fillMs(gl) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, EVERYWHERE], [gl.FRAGMENT_SHADER, ONE]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  gl.useProgram(program);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE);
  const filled = (layers) => {
    const began = performance.now();
    for (let i = 0; i < layers; i++) gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    return performance.now() - began;
  };
  filled(1); // the first compiles
  return filled(LAYERS);
}
