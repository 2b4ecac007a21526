// Which Gaussians a camera sees, nearest first. Symbols: N Gaussians, R patterns.

import { STATE } from "./pack.js";

/** Of intrasplat/splat/constants.py. */
const NEAR = 0.2;
const MIN_ALPHA = 1 / 255;
const RADIX_BITS = 11;
const RADIX = 1 << RADIX_BITS;

export class Sorter {
  /** @param {import("./pack.js").Packed} packed @param {number} patterns R */
  constructor({ state, place }, patterns) {
    const count = state.length / STATE;
    this.patterns = patterns;
    this.place = place;
    this.rest = new Float64Array(3 * count);
    this.isSolid = new Uint8Array(count);
    for (let n = 0; n < count; n++) {
      for (let c = 0; c < 3; c++) this.rest[3 * n + c] = state[n * STATE + c];
      this.isSolid[n] = 1 / (1 + Math.exp(-state[n * STATE + 3])) >= MIN_ALPHA ? 1 : 0;
    }
    this.depth = new Float32Array(count);
    this.bits = new Uint32Array(this.depth.buffer);
    this.order = new Uint32Array(count);
    this.other = new Uint32Array(count);
    this.counts = new Uint32Array(3 * RADIX);
  }

  /** @param {number} n @param {Float32Array} patterns at a time @param {number} c x, y, z @returns {number} units */
  centre(n, patterns, c) {
    let sum = this.rest[3 * n + c];
    const [at, R] = [(3 * n + c) * this.patterns, this.patterns];
    for (let r = 0; r < R; r++) sum += patterns[c * R + r] * this.place[at + r];
    return sum;
  }

  /**
   * @param {Float32Array} patterns [channels, R] at the time
   * @param {number[]} row of camera_from_world: what turns a place into depth, in units
   * @returns {Uint32Array} Gaussians in front of the camera that are not too faint, by depth, then by number; a copy
   */
  sort(patterns, [x, y, z, offset]) {
    const { rest, place, isSolid, depth, order } = this;
    const length = 3 * this.patterns;
    const weight = Float64Array.from({ length }, (_, k) => patterns[k] * [x, y, z][Math.floor(k / this.patterns)]);
    let visible = 0;
    for (let n = 0; n < isSolid.length; n++) {
      let sum = x * rest[3 * n] + y * rest[3 * n + 1] + z * rest[3 * n + 2] + offset;
      for (let k = 0, at = n * length; k < length; k++, at++) sum += weight[k] * place[at];
      depth[n] = sum;
      if (sum > NEAR && isSolid[n]) order[visible++] = n;
    }
    return this.#sorted(visible);
  }

  /** By the bits of depth, which rise as positive depths do: three passes, each of which keeps the order of equals. */
  #sorted(visible) {
    const { bits, counts } = this;
    counts.fill(0);
    for (let i = 0; i < visible; i++) {
      const key = bits[this.order[i]];
      counts[key & (RADIX - 1)]++;
      counts[RADIX + ((key >>> RADIX_BITS) & (RADIX - 1))]++;
      counts[2 * RADIX + (key >>> (2 * RADIX_BITS))]++;
    }
    for (let pass = 0; pass < 3; pass++) {
      let sum = 0;
      for (let i = pass * RADIX; i < (pass + 1) * RADIX; i++) [counts[i], sum] = [sum, sum + counts[i]];
      const shift = pass * RADIX_BITS;
      for (let i = 0; i < visible; i++) {
        const n = this.order[i];
        this.other[counts[pass * RADIX + ((bits[n] >>> shift) & (RADIX - 1))]++] = n;
      }
      [this.order, this.other] = [this.other, this.order];
    }
    return this.order.slice(0, visible);
  }
}
