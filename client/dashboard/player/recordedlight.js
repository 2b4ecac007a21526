// The light and the smoke in which the frames of a scene were recorded (intrasplat/view/recorded_light.py, smoky.py), as
// uniforms of MISSED.

import { inverse, times } from "./camera.js";
import { matrix, texture } from "./gpu.js";

/** A stored step of the smoke's thickness (intrasplat/motion/veil.py). */
const STEP = 1 / 64;

export class RecordedLight {
  /** @param {import("./camera.js").Cameras} cameras @param {Record<string, any>} settings of the scene's manifest */
  constructor(cameras, settings) {
    this.cameras = cameras;
    this.gains = settings.log_gains?.map((each) => each.map(Math.exp)) ?? null;
    const [power, level] = settings.vignetting ?? [0, 1];
    this.vignetting = [power, Math.log(level)];
    this.veil = settings.veil ?? null;
    this.thickness = null;
  }

  /** Unpack the smoke. */
  async open() {
    if (this.veil === null) return;
    const packed = Uint8Array.from(atob(this.veil.thickness), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    this.thickness = new Uint8Array(await new Response(stream).arrayBuffer());
  }

  /** The smoke's thickness at a frame; null: there is none. @returns {WebGLTexture | null} */
  smoke(gl, frame) {
    if (this.thickness === null) return null;
    const [, h, w] = this.veil.shape;
    const steps = this.thickness.subarray(frame * h * w, (frame + 1) * h * w);
    return texture(gl, gl.R32F, w, h, gl.RED, gl.FLOAT, Float32Array.from(steps, (each) => each * STEP));
  }

  /** @param {number} frame @param {number[][]} pose world_from_eye, mm */
  uniforms(frame, pose) {
    const { cameras, veil } = this;
    const t = frame / cameras.frameCount;
    const [left, right] = [cameras.endoscope(t), cameras.rightEye(t)];
    const far = (eye) => Math.hypot(...[0, 1, 2].map((i) => eye[i][3] - pose[i][3]));
    const lamp = far(left) <= far(right) ? left : right;
    const fromEye = (eye) => matrix(cameras.inUnits(times(inverse(eye), pose)));
    const { fx, fy, cx, cy, width, height } = cameras.intrinsics;
    return {
      own: ["4f", fx, fy, cx, cy],
      ownSize: ["2f", width, height],
      endoscopeFromEye: fromEye(left),
      lampFromEye: fromEye(lamp),
      gains: ["3f", ...(this.gains?.[frame] ?? [1, 1, 1])],
      vignetting: ["2f", ...this.vignetting],
      airlight: ["4f", ...(veil?.airlight ?? [0, 0, 0]), (veil?.depth_mm ?? 1) * cameras.unitsPerMm],
      isSmoky: ["1i", veil === null ? 0 : 1],
    };
  }
}
