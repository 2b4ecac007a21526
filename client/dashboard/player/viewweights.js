// How much a view gets of what each eye misses alone, and of what both miss, by the angles between their rays
// (intrasplat/view/detail.py). Lengths are in units.

import { inverse, times } from "./camera.js";
import { CELL_PX } from "./flow.js";

const [SHARED_DEG, LONE_DEG, OWN] = [12, 6, 0.5];
const NEGLIGIBLE = 0.02;
const LEAST_SQUARED_ANGLE = 1e-7;

const squaredRad = (degrees) => ((degrees * Math.PI) / 180) ** 2;
const mean = (values) => values.reduce((sum, each) => sum + each, 0) / values.length;

/**
 * eyes: those that count at all. nearest: the one whose residuals tell most. isOwn: that one alone is shown.
 * isDimmed: nothing brighter that one eye misses alone is added.
 * weights: of each cell, first row first: what the first and the last eye miss alone, what both miss, and depth.
 * @typedef {{eyes: number[], nearest: number, isOwn: boolean, isDimmed: boolean, weights: Float32Array}} Weights
 */

/**
 * @param {import("./camera.js").Cameras} cameras
 * @param {import("./camera.js").Matrix[]} poses world_from_eye, mm, of all eyes
 * @param {{pose: import("./camera.js").Matrix, lens: import("./camera.js").Intrinsics}} view
 * @param {Float32Array} depth in the middles of the view's cells; 0 where nothing is solid
 * @param {[number, number]} cells across and down
 * @param {boolean} highlights whether to add light that one of two eyes misses alone
 * @returns {Weights}
 */
export function weightsOf(cameras, poses, { pose, lens }, depth, [across], highlights) {
  const solid = depth.filter((each) => each > 0).sort();
  const median = solid.length === 0 ? 1 : (solid[(solid.length - 1) >> 1] + solid[solid.length >> 1]) / 2;
  const filled = depth.map((each) => (each > 0 ? each : median));
  const places = new Float64Array(3 * depth.length);
  filled.forEach((d, at) => {
    const x = Math.min(CELL_PX * (at % across) + CELL_PX / 2, lens.width - 1) + 0.5;
    const y = Math.min(CELL_PX * Math.floor(at / across) + CELL_PX / 2, lens.height - 1) + 0.5;
    places.set([(d * (x - lens.cx)) / lens.fx, (d * (y - lens.cy)) / lens.fy, d], 3 * at);
  });
  const angles = poses.map((each) => squaredAngles(cameras, places, pose, each, pose));
  const apart = poses.length === 1 ? null : squaredAngles(cameras, places, pose, poses[0], poses[1]);
  const between = filled.map((_, at) => {
    return Math.max(apart === null ? squaredRad(LONE_DEG) : OWN ** 2 * apart[at], LEAST_SQUARED_ANGLE);
  });
  const own = angles.map((each) => each.map((angle, at) => Math.exp(angle / (-2 * between[at]))));
  const shared = filled.map((_, at) => {
    return Math.exp(Math.min(angles[0][at], angles.at(-1)[at]) / (-2 * squaredRad(SHARED_DEG)));
  });
  const means = own.map(mean);
  const nearest = means.indexOf(Math.max(...means));
  const isDimmed = !highlights && poses.length > 1;
  const isNearest = own[nearest].every((each) => each > 1 - NEGLIGIBLE);
  const isOwn = isNearest && !isDimmed;
  if (isNearest && isDimmed) own[1 - nearest].fill(0); // the other eye tells only what both miss
  const all = shared.some((each) => each > NEGLIGIBLE) ? poses.map((_, eye) => eye) : [];
  const weights = new Float32Array(4 * filled.length);
  filled.forEach((d, at) => weights.set([own[0][at], own.at(-1)[at], shared[at], d], 4 * at));
  return { eyes: isOwn ? [nearest] : all, nearest, isOwn, isDimmed, weights };
}

/** Squared angles, radians, at places of a view between the rays to an eye and to another one. @returns {Float64Array} */
function squaredAngles(cameras, places, pose, eye, other) {
  const [r, s, u] = cameras.inUnits(times(inverse(eye), pose));
  const [a, b, c] = cameras.inUnits(times(inverse(eye), other)).map((row) => row[3]);
  const seen = (row, x, y, z) => row[0] * x + row[1] * y + row[2] * z + row[3];
  return Float64Array.from({ length: places.length / 3 }, (_, at) => {
    const [i, j, k] = places.subarray(3 * at, 3 * at + 3);
    const [x, y, z] = [seen(r, i, j, k), seen(s, i, j, k), seen(u, i, j, k)];
    const lengths = Math.hypot(x, y, z) * Math.hypot(x - a, y - b, z - c);
    return Math.max(0, 2 - (2 * (x * (x - a) + y * (y - b) + z * (z - c))) / Math.max(lengths, 1e-6));
  });
}
