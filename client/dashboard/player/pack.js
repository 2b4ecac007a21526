// A decoded table as what the GPU and the sorter read. Symbols: N Gaussians, C channels of R patterns.

import { DamagedError, partsOf, PLAIN_COLUMNS } from "./decode.js";

/** Floats of a Gaussian: mean and the opacity's logit; quaternion; log-scale and what training saw of it; colour and
 * gloss; what one motion number counts in place, shape and colour. */
export const STATE = 20;
const SEEN_LEVELS = 63;
const MAX_INT16 = 32767;
const OPPONENT = [[1, 1, 1], [1, 0, -1], [1, -2, 1]].map((row, o) => row.map((each) => each / Math.sqrt([3, 2, 6][o])));
/** First and last channel, and power, of place, shape and colour. */
const GROUPS = [[0, 3], [3, 10], [10, 14]];

/**
 * coefficients: [N, C, stride] whole numbers, R of each channel in use. place: [N, 3 R] of place, in units.
 * @typedef {{state: Float32Array, coefficients: Int16Array, stride: number, place: Float32Array}} Packed
 */

/** @param {import("./table.js").Table} table @returns {Packed} */
export function pack(table) {
  const { count, atRest, channels, patterns, tables } = table;
  const parts = partsOf(atRest + channels * patterns + PLAIN_COLUMNS);
  const stride = 4 * Math.ceil(patterns / 4);
  const state = stateOf(table, parts);
  const coefficients = new Int16Array(count * channels * stride);
  const place = new Float32Array(count * 3 * patterns);
  const tooLarge = new Set();
  parts.forEach(([first, width], part) => {
    const from = tables[part];
    // of each column: where its number goes among a Gaussian's, and among its numbers of place
    const columns = Array.from({ length: width }, (_, at) => first + at - atRest);
    const own = columns.filter((k) => k >= 0 && k < channels * patterns);
    const start = own.length > 0 ? own[0] + atRest - first : 0;
    const goals = Int32Array.from(own, (k) => Math.floor(k / patterns) * stride + (k % patterns));
    const placed = own.filter((k) => k < 3 * patterns).length;
    for (let n = 0; n < count; n++) {
      if (most(from, n * width + start, goals, coefficients, n * channels * stride) > MAX_INT16) tooLarge.add(n);
      const scale = state[n * STATE + 16];
      const goal = n * 3 * patterns + own[0];
      for (let i = 0; i < placed; i++) place[goal + i] = from[n * width + start + i] * scale;
    }
  });
  const number = (n, k) => {
    const part = parts.findIndex(([first, width]) => atRest + k < first + width);
    return tables[part][n * parts[part][1] + atRest + k - parts[part][0]];
  };
  for (const n of tooLarge) shrink(n, state, coefficients, number, { channels, patterns, stride });
  return { state, coefficients, stride, place };
}

/** Copy a Gaussian's numbers of motion. @returns {number} the largest magnitude */
function most(from, first, goals, to, start) {
  let found = 0;
  for (let i = 0; i < goals.length; i++) {
    const number = from[first + i];
    to[start + goals[i]] = number;
    found = Math.max(found, Math.abs(number));
  }
  return found;
}

/** [N, STATE] numbers at rest. */
function stateOf({ count, atRest, step, tables }, parts) {
  const state = new Float32Array(count * STATE);
  const [width, last] = [parts[3][1], tables[3]];
  for (let n = 0; n < count; n++) {
    const plain = (n + 1) * width - PLAIN_COLUMNS;
    for (let g = 0; g < 3; g++) state[n * STATE + 16 + g] = 2 ** -last[plain + g];
    state[n * STATE + 11] = last[plain + 3] / SEEN_LEVELS;
  }
  // mean, quaternion, log-scale, colour, gloss if it is there, opacity: where each goes, and its power
  const goals = [0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 12, 13, 14, ...(atRest === 15 ? [15] : []), 3];
  goals.forEach((goal, column) => {
    const part = parts.findIndex(([first, columns]) => column < first + columns);
    const [from, columns, at] = [tables[part], parts[part][1], column - parts[part][0]];
    const power = 16 + GROUPS.findIndex(([first, end]) => column >= first && (column < end || end === 14));
    for (let n = 0; n < count; n++) {
      const scale = Math.fround(state[n * STATE + power] * step[column]);
      state[n * STATE + goal] = from[n * columns + at] * scale;
    }
  });
  for (let n = 0; n < count; n++) {
    const at = n * STATE;
    if (state[at + 4] === 0 && state[at + 5] === 0 && state[at + 6] === 0 && state[at + 7] === 0) {
      throw new DamagedError("A quaternion of the scene is 0.");
    }
    const brightness = state[at + 12];
    const redBlue = state[at + 13];
    const magentaGreen = state[at + 14];
    for (let i = 0; i < 3; i++) {
      state[at + 12 + i] = OPPONENT[0][i] * brightness + OPPONENT[1][i] * redBlue + OPPONENT[2][i] * magentaGreen;
    }
  }
  return state;
}

/** Numbers that do not fit into 16 bits are counted in larger units: 15 digits are left of the largest. */
function shrink(n, state, coefficients, number, { channels, patterns, stride }) {
  GROUPS.forEach(([first, end], g) => {
    let largest = 0;
    const each = (work) => {
      for (let c = first; c < Math.min(end, channels); c++) for (let r = 0; r < patterns; r++) work(c, r);
    };
    each((c, r) => (largest = Math.max(largest, Math.abs(number(n, c * patterns + r)))));
    const unit = 2 ** Math.max(0, Math.ceil(Math.log2(largest / MAX_INT16)));
    if (largest === 0 || unit === 1) return;
    each((c, r) => (coefficients[(n * channels + c) * stride + r] = Math.round(number(n, c * patterns + r) / unit)));
    state[n * STATE + 16 + g] *= unit;
  });
}
