// The recorded frame that belongs to a moment, and its picture on a canvas.

import { Hatch } from "./hatch.js";

/** @param {number[]} frames @param {number} frameCount of the clip @param {number} t @returns {number} the nearest one's place */
export function nearestPlace(frames, frameCount, t) {
  const wanted = Math.min(t, 1) * frameCount;
  return frames.reduce((best, each, i) => (Math.abs(each - wanted) < Math.abs(frames[best] - wanted) ? i : best), 0);
}

export class RecordedPicture {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.hatch = new Hatch();
  }

  /**
   * @param {{picture: ImageBitmap, mask: ImageBitmap | null}} frame
   * @param {boolean} hasTools whether masked parts are shown; else they are hatched
   */
  draw({ picture, mask }, hasTools) {
    const { canvas } = this;
    const { width, height } = picture;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    const context = canvas.getContext("2d");
    context.drawImage(picture, 0, 0);
    if (mask && !hasTools) context.drawImage(this.hatch.over(mask), 0, 0);
  }
}
