// How a scene moves: its patterns at a time, from bases that all Gaussians share (intrasplat/splat/deformation/shared.py).

/** A basis below this at a time is left out, as the service does (intrasplat/splat/cpu/motion.py). */
const NEGLIGIBLE = 1e-3;

/** @typedef {{channels: number, patterns: number, bases: number, pattern: Float32Array, centre: Float32Array,
 *   width: Float32Array}} Motion */

/** @param {Motion} motion @param {number} t model time @returns {Float64Array} [bases], summing to about 1 */
function basesAt({ centre, width }, t) {
  const exponent = Float64Array.from(centre, (c, j) => -((t - c) ** 2) / (2 * width[j] ** 2));
  const most = exponent.reduce((a, b) => Math.max(a, b), -Infinity);
  const value = exponent.map((each) => Math.exp(each - most));
  const sum = value.reduce((a, b) => a + b, 0);
  const share = value.map((each) => each / sum);
  const first = share.findIndex((each) => each >= NEGLIGIBLE);
  const last = share.findLastIndex((each) => each >= NEGLIGIBLE);
  return share.map((each, j) => (j >= first && j <= last && first >= 0 ? each : 0));
}

/**
 * What one unit of a motion number adds to its channel at a time.
 * @param {Motion} motion
 * @param {number} t
 * @returns {Float32Array} [channels, patterns]
 */
export function patternsAt(motion, t) {
  const share = basesAt(motion, t);
  return Float32Array.from({ length: motion.channels * motion.patterns }, (_, at) => {
    let sum = 0;
    for (let j = 0; j < motion.bases; j++) sum += motion.pattern[at * motion.bases + j] * share[j];
    return sum;
  });
}
