// How far Gaussians are trusted: what training saw of them, less what has left a moving endoscope's view
// (intrasplat/view/unseen.py, intrasplat/view/out_of_view.py). Symbols: N Gaussians, S sampled frames.

/** What a Gaussian that no training frame saw counts in the blend. */
const NEVER_SEEN = -0.1;
const SAMPLED_FRAMES = 32;
const FADES_IN_S = 0.4;
const LEFT_TRUST = 0.4;

/** @param {Float32Array} seen [N] @returns {Float32Array | null} what is blended; null: nothing is known */
export function blendedValues(seen) {
  if (seen.every((each) => each === 0)) return null;
  return seen.map((each) => (each > 0 ? each : NEVER_SEEN));
}

/** @param {number[]} frames @returns {number[]} at most SAMPLED_FRAMES, evenly spread, with the first and the last */
function spread(frames) {
  const count = Math.min(SAMPLED_FRAMES, frames.length);
  const places = Array.from({ length: count }, (_, i) => halfEven((i * (frames.length - 1)) / Math.max(1, count - 1)));
  return [...new Set(places)].map((place) => frames[place]);
}

/** To the nearest whole number, halves to the even one, as NumPy rounds. @param {number} x */
export function halfEven(x) {
  const floor = Math.floor(x);
  if (x - floor !== 0.5) return Math.round(x);
  return floor % 2 === 0 ? floor : floor + 1;
}

/** When each Gaussian was in the endoscope's view; for a camera that moves. */
export class OutOfView {
  /**
   * @param {import("./camera.js").Recording} recording
   * @param {(frame: number) => Uint8Array} inView [N] whether each centre lies in the endoscope's view at a frame
   */
  constructor(recording, inView) {
    const frames = spread(recording.trainedFrames);
    this.seenS = frames.map((frame) => Math.fround(recording.frameTimesS[frame]));
    const seen = frames.map(inView);
    const [count, nothing] = [seen[0].length, frames.length];
    this.before = Array.from({ length: nothing + 1 }, () => new Float32Array(count).fill(-Infinity));
    this.after = Array.from({ length: nothing + 1 }, () => new Float32Array(count).fill(Infinity));
    for (let s = 0; s < nothing; s++) {
      for (let n = 0; n < count; n++) this.before[s + 1][n] = seen[s][n] ? this.seenS[s] : this.before[s][n];
    }
    for (let s = nothing - 1; s >= 0; s--) {
      for (let n = 0; n < count; n++) this.after[s][n] = seen[s][n] ? this.seenS[s] : this.after[s + 1][n];
    }
  }

  /** @param {Float32Array} values [N] of blendedValues @param {number} timeS @returns {Float32Array} [N] then */
  faded(values, timeS) {
    const later = this.seenS.findIndex((each) => each >= timeS);
    const interval = later < 0 ? this.seenS.length : later;
    const last = this.seenS.length - 1;
    const gapS = this.seenS[Math.min(interval, last)] - this.seenS[Math.max(interval - 1, 0)];
    const [before, after] = [this.before[interval], this.after[interval]];
    return values.map((value, n) => {
      if (value <= 0) return value;
      const awayS = Math.min(timeS - before[n], after[n] - timeS) - gapS;
      return value * (LEFT_TRUST + (1 - LEFT_TRUST) * Math.exp(-Math.max(awayS, 0) / FADES_IN_S));
    });
  }
}
