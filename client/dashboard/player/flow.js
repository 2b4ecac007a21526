// Optical flow between two grey pictures: dense inverse search (Kroeger and others, 2016) as OpenCV computes it in its
// fastest setting, which intrasplat/view/residual.py uses. Symbols: h w pixels of a level, m n patches of it.

const FINEST = 2; // a level's pixels are 2 ** level of the picture's along a side
const [PATCH, STRIDE, STRIPES] = [8, 4, 8];
const STEPS = 6;
const BORDER = 16;
const LEAST = 1e-3;
const VERY_LARGE = 1e10;
/** Of intrasplat/view/residual.py: side of a cell of the picture, what unseen cells are divided by. */
export const CELL_PX = 8;
const UNSEEN = 0.1;

/** @typedef {{w: number, h: number, first: Uint8Array, second: Uint8Array}} Level */
/** A flow of w x h places. @typedef {{w: number, h: number, u: Float32Array, v: Float32Array}} Flow */

/** Which of `size` numbers each of `count` parts covers, at most `most` of them, and with which shares of the part. */
function areas(size, count) {
  const most = Math.min(Math.ceil(size / count) + 1, size);
  const [first, shares] = [new Int32Array(count), new Float32Array(count * most)];
  for (let part = 0; part < count; part++) {
    const [from, to] = [part, part + 1].map((each) => (each * size) / count);
    first[part] = Math.min(Math.floor(from + 1e-9), size - most);
    for (let k = 0; k < most; k++) {
      const at = first[part] + k;
      shares[part * most + k] = Math.max(0, Math.min(to, at + 1) - Math.max(from, at)) / (to - from);
    }
  }
  return { most, first, shares };
}

/** Means of a picture's areas. @param {Uint8Array | Float32Array} from [h, w] @returns {Float32Array} [down, across] */
function meansOf(from, w, h, across, down) {
  if (w === across && h === down) return Float32Array.from(from);
  const [columns, rows] = [areas(w, across), areas(h, down)];
  const small = new Float32Array(across * down);
  const row = new Float32Array(w);
  for (let i = 0; i < down; i++) {
    row.fill(0);
    for (let k = 0; k < rows.most; k++) {
      const share = rows.shares[i * rows.most + k];
      const start = (rows.first[i] + k) * w;
      if (share > 0) for (let j = 0; j < w; j++) row[j] += share * from[start + j];
    }
    for (let j = 0; j < across; j++) {
      let sum = 0;
      for (let k = 0; k < columns.most; k++) sum += columns.shares[j * columns.most + k] * row[columns.first[j] + k];
      small[i * across + j] = sum;
    }
  }
  return small;
}

/** Numbers in more places, times a factor. @param {Float32Array} from [h, w] @returns {Float32Array} [down, across] */
function enlarged(from, w, h, across, down, factor) {
  const place = (i, size, count) => Math.min(Math.max(((i + 0.5) * count) / size - 0.5, 0), count - 1);
  const columns = Float32Array.from({ length: across }, (_, j) => place(j, across, w));
  const found = new Float32Array(across * down);
  const row = new Float32Array(w + 1);
  for (let i = 0; i < down; i++) {
    const at = place(i, down, h);
    const above = Math.floor(at);
    const below = Math.min(above + 1, h - 1);
    for (let j = 0; j < w; j++) {
      row[j] = factor * (from[above * w + j] + (at - above) * (from[below * w + j] - from[above * w + j]));
    }
    row[w] = row[w - 1];
    for (let j = 0; j < across; j++) {
      const before = columns[j] | 0;
      found[i * across + j] = row[before] + (columns[j] - before) * (row[before + 1] - row[before]);
    }
  }
  return found;
}

/** A flow in more places, in their pixels. @param {Flow} flow @returns {Flow} */
function finer({ w, h, u, v }, across, down, factor) {
  const [us, vs] = [u, v].map((each) => enlarged(each, w, h, across, down, factor));
  return { w: across, h: down, u: us, v: vs };
}

/** The finest and the coarsest level of pictures of a size. */
function rangeOf(width, height) {
  const most = Math.trunc(Math.log2(Math.max(width, height) / (4 * PATCH)) + 0.5);
  const coarsest = Math.min(most, Math.trunc(Math.log2(Math.trunc(Math.min(width, height) / PATCH))));
  if (coarsest >= FINEST) return [FINEST, coarsest];
  const few = Math.max(0, Math.floor(Math.log2((2 * width) / (5 * PATCH)))); // of a small picture
  return [Math.max(few - 2, 0), few];
}

/** The levels of two pictures [h, w], finest first. @returns {Level[]} */
function levelsOf(first, second, width, height, [finest, coarsest]) {
  const smaller = (from, w, h, across, down) => Uint8Array.from(meansOf(from, w, h, across, down), Math.round);
  const levels = [];
  let [w, h] = [width, height];
  for (let level = finest; level <= coarsest; level++) {
    const step = level === finest ? 2 ** finest : 2;
    const [across, down] = [Math.trunc(w / step), Math.trunc(h / step)];
    if (Math.min(across, down) < PATCH) break;
    const last = levels.at(-1) ?? { first, second };
    const [one, other] = [last.first, last.second].map((each) => smaller(each, w, h, across, down));
    levels.push({ w: across, h: down, first: one, second: other });
    [w, h] = [across, down];
  }
  return levels;
}

/** Sobel's derivatives; borders are mirrored. @returns {[Int16Array, Int16Array]} across and down */
function derivatives({ w, h, first }) {
  const [x, y] = [new Int16Array(w * h), new Int16Array(w * h)];
  const mirrored = (i, count) => (i < 0 ? Math.min(1, count - 1) : i >= count ? Math.max(count - 2, 0) : i);
  for (let i = 0; i < h; i++) {
    const [a, b, c] = [-1, 0, 1].map((step) => mirrored(i + step, h) * w);
    for (let j = 0; j < w; j++) {
      const [l, r] = [mirrored(j - 1, w), mirrored(j + 1, w)];
      x[i * w + j] = first[a + r] - first[a + l] + 2 * (first[b + r] - first[b + l]) + first[c + r] - first[c + l];
      y[i * w + j] = first[c + l] - first[a + l] + 2 * (first[c + j] - first[a + j]) + first[c + r] - first[a + r];
    }
  }
  return [x, y];
}

/** A picture with its borders repeated. */
function widened(from, w, h) {
  const wide = new Uint8Array((w + 2 * BORDER) * (h + 2 * BORDER));
  for (let i = 0, at = 0; i < h + 2 * BORDER; i++) {
    const row = Math.min(Math.max(i - BORDER, 0), h - 1) * w;
    for (let j = 0; j < w + 2 * BORDER; j++) wide[at++] = from[row + Math.min(Math.max(j - BORDER, 0), w - 1)];
  }
  return wide;
}

/** The search for the patches of a level. */
class Search {
  /** @param {Level} level @param {Flow} flow where to begin */
  constructor({ w, h, first, second }, flow) {
    Object.assign(this, { w, h, first, flow, second: widened(second, w, h) });
    [this.x, this.y] = derivatives({ w, h, first });
    this.across = 1 + Math.trunc((w - PATCH) / STRIDE);
    this.down = 1 + Math.trunc((h - PATCH) / STRIDE);
    this.u = new Float32Array(this.across * this.down);
    this.v = new Float32Array(this.across * this.down);
    [this.du, this.dv] = [0, 0]; // of the patch that was compared last
  }

  /** The squared differences of a patch from where it may have moved to, but for their mean. Steps towards less, if asked for. */
  #apart(i, j, u, v, withSteps) {
    const { w, h, first, second, x, y } = this;
    const row = Math.min(Math.max(i + v + BORDER, BORDER - PATCH + 1), BORDER + h - 1);
    const column = Math.min(Math.max(j + u + BORDER, BORDER - PATCH + 1), BORDER + w - 1);
    const [a, b] = [Math.floor(row), Math.floor(column)];
    const [f, g] = [row - a, column - b];
    const [w00, w01, w10, w11] = [(1 - f) * (1 - g), (1 - f) * g, f * (1 - g), f * g];
    const wide = w + 2 * BORDER;
    let [sum, squares, du, dv] = [0, 0, 0, 0];
    for (let k = 0; k < PATCH; k++) {
      let at = (i + k) * w + j;
      let to = (a + k) * wide + b;
      for (let l = 0; l < PATCH; l++, at++, to++) {
        const apart = w00 * second[to] + w01 * second[to + 1] + w10 * second[to + wide] + w11 * second[to + wide + 1] - first[at];
        sum += apart;
        squares += apart * apart;
        if (!withSteps) continue;
        du += apart * x[at];
        dv += apart * y[at];
      }
    }
    this.sum = sum;
    this.du = du;
    this.dv = dv;
    return squares - (sum * sum) / PATCH ** 2;
  }

  #refine(i, j, at) {
    const { w, x, y, u, v } = this;
    let [xx, yy, xy, xs, ys] = [0, 0, 0, 0, 0];
    for (let k = 0; k < PATCH; k++) {
      for (let l = 0, from = (i + k) * w + j; l < PATCH; l++, from++) {
        xx += x[from] * x[from];
        yy += y[from] * y[from];
        xy += x[from] * y[from];
        xs += x[from];
        ys += y[from];
      }
    }
    const found = xx * yy - xy * xy;
    const determinant = Math.abs(found) < LEAST ? LEAST : found;
    let [across, down, before] = [u[at], v[at], VERY_LARGE];
    for (let step = 0; step < STEPS; step++) {
      const apart = this.#apart(i, j, across, down, true);
      const [du, dv] = [this.du - (this.sum * xs) / PATCH ** 2, this.dv - (this.sum * ys) / PATCH ** 2];
      across -= (yy * du - xy * dv) / determinant;
      down -= (xx * dv - xy * du) / determinant;
      if (apart >= before) break;
      before = apart;
    }
    if (Math.hypot(across - u[at], down - v[at]) <= PATCH) [u[at], v[at]] = [across, down];
  }

  #patch(is, js, nearby, isFirst) {
    const { w, across, u, v, flow } = this;
    const [i, j, at] = [is * STRIDE, js * STRIDE, is * across + js];
    const middle = (i + PATCH / 2) * w + j + PATCH / 2;
    if (isFirst) [u[at], v[at]] = [flow.u[middle], flow.v[middle]];
    let best = this.#apart(i, j, u[at], v[at], false);
    for (const each of [null, ...nearby]) {
      const [du, dv] = each === null ? [0, 0] : [u[each], v[each]];
      const apart = this.#apart(i, j, du, dv, false);
      if (apart < best) [best, u[at], v[at]] = [apart, du, dv];
    }
    this.#refine(i, j, at);
  }

  /** Stripe by stripe, there and back: what a patch finds is tried by the next ones. */
  run() {
    const { across, down } = this;
    const height = Math.ceil(down / STRIPES);
    for (let from = 0; from < down; from += height) {
      const to = Math.min(from + height, down);
      for (let is = from; is < to; is++) {
        for (let js = 0; js < across; js++) {
          const at = is * across + js;
          this.#patch(is, js, [...(js > 0 ? [at - 1] : []), ...(is > from ? [at - across] : [])], true);
        }
      }
      for (let is = to - 1; is >= from; is--) {
        for (let js = across - 1; js >= 0; js--) {
          const at = is * across + js;
          this.#patch(is, js, [...(js < across - 1 ? [at + 1] : []), ...(is < to - 1 ? [at + across] : [])], false);
        }
      }
    }
    return this;
  }
}

/** The flow of all pixels of a level: the mean of the patches about each, by how well they fit there. @returns {Flow} */
function dense({ w, h, first, second }, { u, v, across, down }) {
  const found = { w, h, u: new Float32Array(w * h), v: new Float32Array(w * h) };
  const about = (i, count) => {
    const last = Math.min(Math.trunc(i / STRIDE), count - 1);
    return [Math.min(Math.max(0, Math.trunc(i / STRIDE) - 1), last), last];
  };
  for (let i = 0; i < h; i++) {
    const [top, bottom] = about(i, down);
    for (let j = 0; j < w; j++) {
      const [left, right] = about(j, across);
      let [total, us, vs] = [0, 0, 0];
      for (let is = top; is <= bottom; is++) {
        for (let js = left; js <= right; js++) {
          const at = is * across + js;
          const column = Math.min(Math.max(j + u[at], 0), w - 1 - LEAST);
          const row = Math.min(Math.max(i + v[at], 0), h - 1 - LEAST);
          const [a, b] = [Math.trunc(row), Math.trunc(column)];
          const [f, g] = [row - a, column - b];
          const to = a * w + b;
          const upper = (1 - g) * second[to] + g * second[to + 1];
          const lower = (1 - g) * second[to + w] + g * second[to + w + 1];
          const weight = 1 / Math.max(1, Math.abs((1 - f) * upper + f * lower - first[i * w + j]));
          us += weight * u[at];
          vs += weight * v[at];
          total += weight;
        }
      }
      found.u[i * w + j] = us / total;
      found.v[i * w + j] = vs / total;
    }
  }
  return found;
}

/**
 * Where what a picture shows lies in another one, in pixels from where it lies in the first.
 * @param {Uint8Array} first [h, w] grey
 * @param {Uint8Array} second
 * @returns {Flow} [h, w]; 0 where the pictures are too small
 */
export function opticalFlow(first, second, width, height) {
  const range = rangeOf(width, height);
  const levels = levelsOf(first, second, width, height, range);
  const none = (w, h) => ({ w, h, u: new Float32Array(w * h), v: new Float32Array(w * h) });
  if (levels.length === 0) return none(width, height);
  let flow = none(levels.at(-1).w, levels.at(-1).h);
  levels.reverse().forEach((level, i) => {
    if (i > 0) flow = finer(flow, level.w, level.h, 2);
    flow = dense(level, new Search(level, flow).run());
  });
  return finer(flow, width, height, 2 ** range[0]);
}

const WEIGHTS = [-4, -3, -2, -1, 0, 1, 2, 3, 4].map((i) => Math.exp(-(i * i) / 2)).map((each, _, all) => {
  return each / all.reduce((sum, weight) => sum + weight, 0);
});

/** Blur with a standard deviation of one; borders are mirrored. @param {Float32Array} from [h, w], in place */
function blur(from, w, h) {
  for (const [count, lines, step, next] of [[w, h, 1, w], [h, w, w, 1]]) {
    const line = new Float32Array(count + 8);
    const period = Math.max(2 * (count - 1), 1);
    for (let n = 0; n < lines; n++) {
      for (let k = 0; k < count + 8; k++) {
        const at = Math.abs(k - 4) % period;
        line[k] = from[n * next + (at >= count ? period - at : at) * step];
      }
      for (let k = 0; k < count; k++) {
        let sum = 0;
        for (let l = 0; l < 9; l++) sum += WEIGHTS[l] * line[k + l];
        from[n * next + k * step] = sum;
      }
    }
  }
  return from;
}

/**
 * The flow between two pictures in cells of the first, as flow_between() of intrasplat/view/residual.py smooths it.
 * @param {Uint8Array} pictures [h, w, 4]: both grey values, and whether the place is seen in both
 * @returns {{w: number, h: number, flow: Float32Array}} flow: [h, w, 2] px
 */
export function flowInCells(pictures, width, height) {
  const count = width * height;
  const [first, second, isSeen] = [new Uint8Array(count), new Uint8Array(count), new Float32Array(count)];
  for (let at = 0; at < count; at++) {
    first[at] = pictures[4 * at];
    second[at] = pictures[4 * at + 1];
    isSeen[at] = pictures[4 * at + 2] > 0 ? 1 : 0;
  }
  const { u, v } = opticalFlow(first, second, width, height);
  for (let at = 0; at < count; at++) {
    u[at] *= isSeen[at];
    v[at] *= isSeen[at];
  }
  const [w, h] = [width, height].map((side) => Math.ceil(side / CELL_PX));
  const [us, vs, shares] = [u, v, isSeen].map((each) => blur(meansOf(each, width, height, w, h), w, h));
  const flow = new Float32Array(2 * w * h);
  shares.forEach((share, at) => flow.set([us[at] / (share + UNSEEN), vs[at] / (share + UNSEEN)], 2 * at));
  return { w, h, flow };
}
