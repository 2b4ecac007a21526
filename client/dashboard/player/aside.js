// How far a view lies aside from what the endoscope recorded: the twin of intrasplat/view/aside.py.

import { inverse, times } from "./camera.js";

const RAYS_A_SIDE = 5;
const BEHIND = 1e-6;
const DEGREES = 180 / Math.PI;
const LEFT_EYE = [0, 0, 0];

const median = (values) => values.sort((a, b) => a - b)[values.length >> 1];

export class Aside {
  /** @param {import("./camera.js").Cameras} cameras */
  constructor({ poses, trainedFrames, rightEyeMm, depthMm, intrinsics }) {
    this.depthMm = depthMm;
    this.framesFromWorld = trainedFrames.map((frame) => inverse(poses[frame]));
    this.eyes = rightEyeMm === null ? [LEFT_EYE] : [LEFT_EYE, rightEyeMm];
    this.rays = raysOf(intrinsics);
  }

  /** @param {number[][]} pose world_from_camera, mm @returns {{angleDeg: number, enlargement: number}} */
  of(pose) {
    const best = this.rays.map(() => ({ cosine: -1, enlargement: 1 }));
    for (const eye of this.eyes) for (const from of this.framesFromWorld) this.#compare(times(from, pose), eye, best);
    const angles = best.map(({ cosine }) => Math.acos(Math.min(1, cosine)) * DEGREES);
    return { angleDeg: median(angles), enlargement: median(best.map(({ enlargement }) => enlargement)) };
  }

  /** Note the rays that a frame's eye sees from nearer. @param {number[][]} view the view's pose in the frame's axes */
  #compare([r0, r1, r2], [ex, ey, ez], best) {
    this.rays.forEach(([x, y, z], k) => {
      const along = r2[0] * x + r2[1] * y + r2[2] * z;
      const reach = (this.depthMm - r2[3]) / along;
      if (!(along > BEHIND) || !(reach > 0)) return;
      const ray = [r0[0] * x + r0[1] * y + r0[2] * z, r1[0] * x + r1[1] * y + r1[2] * z, along];
      const toEye = [ex - r0[3] - reach * ray[0], ey - r1[3] - reach * ray[1], ez - r2[3] - reach * ray[2]];
      const length = Math.hypot(...toEye);
      const cosine = -(ray[0] * toEye[0] + ray[1] * toEye[1] + ray[2] * toEye[2]) / length;
      if (cosine > best[k].cosine) best[k] = { cosine, enlargement: length / reach };
    });
  }
}

/** @returns {number[][]} unit directions of a grid of rays in a camera's axes */
function raysOf({ width, height, fx, fy, cx, cy }) {
  const shares = Array.from({ length: RAYS_A_SIDE }, (_, i) => (i + 0.5) / RAYS_A_SIDE);
  const all = shares.flatMap((down) => shares.map((right) => [(right * width - cx) / fx, (down * height - cy) / fy, 1]));
  return all.map((ray) => ray.map((each) => each / Math.hypot(...ray)));
}
