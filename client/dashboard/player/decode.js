// The table of whole numbers in a compact scene: what intrasplat/scene/compact.py reads, bit for bit. docs/scene-file.md
// has the equations. Symbols: N Gaussians, K columns, cut into PARTS runs that are coded by themselves.

export const PARTS = 4;
/** The last columns: powers of place, shape and colour, and what training saw. */
export const PLAIN_COLUMNS = 4;
const MIN_POWER = -3;
const MAX_POWER = 4;
const SEEN_LEVELS = 63;
const MAX_STORED = 2 ** 28;

const BUCKETS = 10;
const MODELS = 126;
const SECOND = 33;
const THIRD = 64;
const AVERAGE = 64;
const MAX_ACTIVITY = 6 * AVERAGE;
const THRESHOLDS = [14, 21, 31, 46, 69, 103, 154, 231, 346];
const TOP = 2 ** 24;
/** Where the models of an activity begin, within a column's. */
const BUCKET_AT = Int32Array.from({ length: MAX_ACTIVITY + 1 }, (_, activity) => {
  return THRESHOLDS.filter((threshold) => threshold <= activity).length * MODELS;
});

/** A file that no version of intrasplat has written. */
export class DamagedError extends Error {}

/** @param {number} columns K @returns {number[][]} first column and number of columns of each part */
export function partsOf(columns) {
  let first = 0;
  return Array.from({ length: PARTS }, (_, part) => {
    const count = Math.floor(columns / PARTS) + (part < columns % PARTS ? 1 : 0);
    first += count;
    return [first - count, count];
  });
}

/** @param {number} count N @returns {Int32Array} Gaussians in the order in which they are coded */
export function codingOrder(count) {
  const order = new Int32Array(count);
  let place = 1;
  for (let step = 2 ** Math.ceil(Math.log2(Math.max(count, 1))) / 2; step >= 1; step /= 2) {
    for (let i = step; i < count; i += 2 * step) order[place++] = i;
  }
  return order;
}

/**
 * Undo the range coder.
 * @param {Uint8Array} code of one part
 * @param {Int32Array} order of coding
 * @param {number} columns of the part
 * @returns {Int32Array} [N, columns], in the order of the Gaussians
 */
export function decodePart(code, order, columns) {
  const table = new Int32Array(order.length * columns);
  // Both estimates of a probability lie side by side.
  const models = new Uint16Array(2 * columns * BUCKETS * MODELS).fill(32768);
  const average = new Float64Array(columns).fill(256);
  const nearby = new Int32Array(columns).fill(AVERAGE);
  let low = 0;
  let width = 0xffffffff;
  let place = 0;
  for (; place < 5; place++) low = ((low << 8) | code[place]) >>> 0;
  for (let n = 0; n < order.length; n++) {
    const row = order[n] * columns;
    let here = AVERAGE;
    for (let k = 0; k < columns; k++) {
      const set = 2 * (k * BUCKETS * MODELS + BUCKET_AT[(3 * here + nearby[k]) >> 2]);
      let digits = 0;
      for (; digits < 31; digits++) {
        const at = set + 2 * digits;
        const quick = models[at];
        const slow = models[at + 1];
        const bound = Math.imul(width >>> 16, (quick + slow) >>> 1) >>> 0;
        const bit = low >= bound;
        if (bit) {
          low = (low - bound) >>> 0;
          width = (width - bound) >>> 0;
          models[at] = quick - (quick >> 4);
          models[at + 1] = slow - (slow >> 7);
        } else {
          width = bound;
          models[at] = quick + ((65536 - quick) >> 4);
          models[at + 1] = slow + ((65536 - slow) >> 7);
        }
        while (width < TOP) {
          width = (width << 8) >>> 0;
          low = ((low << 8) | code[place++]) >>> 0;
        }
        if (!bit) break;
      }
      if (digits > 30 || place > code.length) throw new DamagedError("A code of the scene is damaged.");
      let magnitude = 0;
      let isNegative = false;
      if (digits) {
        magnitude = 1;
        let half = width >>> 1;
        isNegative = low >= half;
        if (isNegative) {
          low = (low - half) >>> 0;
          width = (width - half) >>> 0;
        } else width = half;
        while (width < TOP) {
          width = (width << 8) >>> 0;
          low = ((low << 8) | code[place++]) >>> 0;
        }
        for (let digit = digits - 2; digit >= 0; digit--) {
          let model = 0;
          if (digit === digits - 2) model = SECOND + digits;
          else if (digit === digits - 3) model = THIRD + 2 * digits + (magnitude & 1);
          const at = set + 2 * model;
          if (model) half = Math.imul(width >>> 16, (models[at] + models[at + 1]) >>> 1) >>> 0;
          else half = width >>> 1;
          const bit = low >= half;
          if (bit) {
            low = (low - half) >>> 0;
            width = (width - half) >>> 0;
          } else width = half;
          if (model) {
            const goal = bit ? 0 : 65536;
            models[at] += bit ? -(models[at] >> 4) : (goal - models[at]) >> 4;
            models[at + 1] += bit ? -(models[at + 1] >> 7) : (goal - models[at + 1]) >> 7;
          }
          while (width < TOP) {
            width = (width << 8) >>> 0;
            low = ((low << 8) | code[place++]) >>> 0;
          }
          magnitude = 2 * magnitude + (bit ? 1 : 0);
        }
        table[row + k] = isNegative ? -magnitude : magnitude;
      }
      const mean = average[k] + Math.floor((magnitude * 256 - average[k]) / 128);
      average[k] = mean;
      let activity = 0;
      if (magnitude) {
        const ratio = (magnitude * 16384) / (mean + AVERAGE);
        activity = ratio >= MAX_ACTIVITY ? MAX_ACTIVITY : ratio | 0;
      }
      nearby[k] += (activity - nearby[k]) >> 3;
      here += (activity - here) >> 3;
    }
  }
  if (place !== code.length) throw new DamagedError("A code of the scene does not end where its numbers do.");
  return table;
}

/**
 * Which power belongs to each column: 0 of place, 1 of shape, 2 of colour, 3 of none.
 * @param {number} atRest numbers of a Gaussian at rest, S
 * @param {number} channels that move, C
 * @param {number} patterns of each, R
 * @returns {Uint8Array} [K]
 */
export function groupsOf(atRest, channels, patterns) {
  const groupOf = (row) => (row < 3 ? 0 : row < 10 ? 1 : 2);
  const group = new Uint8Array(atRest + channels * patterns + PLAIN_COLUMNS).fill(3);
  for (let k = 0; k < atRest; k++) group[k] = groupOf(k);
  for (let k = 0; k < channels * patterns; k++) group[atRest + k] = groupOf(Math.floor(k / patterns));
  return group;
}

/**
 * Add the means of neighbours back, in place.
 * @param {Int32Array} table [N, columns] of one part
 * @param {Int32Array} order of coding
 * @param {number[]} shared the columns that hold differences, all of one kind: with powers or without
 * @param {Uint8Array} group of each column of the part
 * @param {Int8Array | null} powers [N, 3]; null for the plain columns
 */
export function addDifferences(table, order, shared, group, powers) {
  const [count, columns] = [order.length, table.length / order.length];
  for (let j = 1; j < count; j++) {
    const i = order[j];
    const step = i & -i;
    const left = i - step;
    const right = i + step < count ? i + step : left;
    const [row, leftRow, rightRow] = [i * columns, left * columns, right * columns];
    let known = -1;
    let [ofLeft, ofRight, half, scale] = [16, 16, 16, 1 / 32];
    for (const k of shared) {
      const g = group[k];
      if (powers !== null && g !== known) {
        known = g;
        const here = 2 ** (MAX_POWER + 1 - powers[3 * i + g]);
        [ofLeft, ofRight] = [2 ** (MAX_POWER - powers[3 * left + g]), 2 ** (MAX_POWER - powers[3 * right + g])];
        [half, scale] = [here / 2, 1 / here];
      }
      // numbers beyond 32 bits, which doubles hold exactly
      const sum = table[leftRow + k] * ofLeft + table[rightRow + k] * ofRight + half;
      const number = table[row + k] + Math.floor(sum * scale);
      if (number > MAX_STORED || number < -MAX_STORED) throw new DamagedError("A number of the scene is too large.");
      table[row + k] = number;
    }
  }
}

/**
 * @param {Int32Array} table [N, columns] of the last part, whose plain columns hold numbers
 * @param {number} count N
 * @returns {Int8Array} [N, 3] powers of place, shape and colour
 */
export function powersOf(table, count) {
  const columns = table.length / count;
  const powers = new Int8Array(3 * count);
  for (let n = 0; n < count; n++) {
    const plain = (n + 1) * columns - PLAIN_COLUMNS;
    for (let g = 0; g < 3; g++) {
      const power = table[plain + g];
      if (power < MIN_POWER || power > MAX_POWER) throw new DamagedError("A power of the scene is out of range.");
      powers[3 * n + g] = power;
    }
    const seen = table[plain + 3];
    if (seen < 0 || seen > SEEN_LEVELS) throw new DamagedError("A share of the scene is out of range.");
  }
  return powers;
}
