// The masks of a scene and the strokes over them. A frame's mask is the one it came with and, in their order, the strokes
// that reach it: so one is undone by leaving it out, and a mask is decoded only where it is looked at or sent.

import { bodyOf, getMasks, request } from "../base/api.js";
import { readStrokes, storeStrokes } from "../base/drafts.js";
import { maskOf, pngOf, unusable, unzipped, zipped } from "./files.js";

/**
 * isTool: it paints instrument, else tissue. frame: the one that it was painted on. isForAll: it reaches all frames.
 * points: x and y in turn, in pixels of the recording, from the middle of the first one.
 * @typedef {{isTool: boolean, isForAll: boolean, frame: number, radius: number, points: number[]}} Stroke
 */
/** @typedef {import("./files.js").Mask} Mask */

/**
 * The way from a stored frame, which may be rectified, to the recording.
 * @param {import("../base/wire.js").RecordedPixels} pixels
 * @returns {(column: number, row: number) => [number, number]} x and y in the recording of a pixel of a stored frame
 */
export function recordedPlace({ rays: r, distortion, camera: c }) {
  const [k1 = 0, k2 = 0, p1 = 0, p2 = 0, k3 = 0, k4 = 0, k5 = 0, k6 = 0, s1 = 0, s2 = 0, s3 = 0, s4 = 0] = distortion;
  return (column, row) => {
    const [X, Y, Z] = [0, 3, 6].map((i) => r[i] * column + r[i + 1] * row + r[i + 2]);
    const [x, y] = [X / Z, Y / Z];
    const r2 = x * x + y * y;
    const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
    const u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2);
    const v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2);
    return [c[0] * u + c[1] * v + c[2], c[4] * v + c[5]];
  };
}

/**
 * Paint a stroke into a mask: every pixel that is no farther from its line than its radius.
 * @param {Mask} mask
 * @param {Stroke} stroke
 * @param {number} [from] the first point whose line is painted
 */
export function paint({ width, height, pixels }, { isTool, radius, points }, from = 0) {
  const value = isTool ? 1 : 0;
  for (let i = Math.max(0, 2 * from - 2); i < points.length; i += 2) {
    const [x0, y0] = [points[i], points[i + 1]];
    const [x1, y1] = i + 3 < points.length ? [points[i + 2], points[i + 3]] : [x0, y0];
    const [dx, dy] = [x1 - x0, y1 - y0];
    const length2 = dx * dx + dy * dy;
    const last = { x: Math.min(width - 1, Math.floor(Math.max(x0, x1) + radius)), y: Math.min(height - 1, Math.floor(Math.max(y0, y1) + radius)) };
    for (let y = Math.max(0, Math.ceil(Math.min(y0, y1) - radius)); y <= last.y; y++) {
      for (let x = Math.max(0, Math.ceil(Math.min(x0, x1) - radius)); x <= last.x; x++) {
        const along = length2 > 0 ? Math.min(1, Math.max(0, ((x - x0) * dx + (y - y0) * dy) / length2)) : 0;
        const [offX, offY] = [x - x0 - along * dx, y - y0 - along * dy];
        if (offX * offX + offY * offY <= radius * radius) pixels[y * width + x] = value;
      }
    }
  }
}

export class PaintedMasks {
  /**
   * @param {string} scene
   * @param {import("../base/wire.js").Report} report with recorded frames
   */
  constructor(scene, report) {
    const { recorded, frame_count: count, masks } = report;
    Object.assign(this, { scene, count, storedFrames: recorded.frames, source: masks?.share ? masks.source : "none" });
    this.width = recorded.pixels.width;
    this.height = recorded.pixels.height;
    this.strokes = readStrokes(scene);
    /** @type {Map<string, Uint8Array> | null} PNGs of all frames by name, once they are loaded, where masks were found */
    this.found = null;
    /** @type {Promise<void> | null} */
    this.loading = null;
  }

  /** The stored frame that stands for a frame of the clip. @param {number} frame */
  nearestStored(frame) {
    return this.storedFrames.reduce((best, each) => (Math.abs(each - frame) < Math.abs(best - frame) ? each : best));
  }

  /** @param {number} frame stored @returns {boolean} whether a stroke reaches it */
  isChanged(frame) {
    return this.strokes.some((stroke) => stroke.isForAll || stroke.frame === frame);
  }

  /** @param {Stroke} stroke */
  add(stroke) {
    this.strokes.push(stroke);
    storeStrokes(this.scene, this.strokes);
  }

  /** Take the last stroke back. @returns {Stroke | undefined} */
  undo() {
    const last = this.strokes.pop();
    storeStrokes(this.scene, this.strokes);
    return last;
  }

  /** Forget all strokes. */
  discard() {
    this.strokes = [];
    storeStrokes(this.scene, []);
  }

  /** Load what all frames need, once. @returns {Promise<void>} */
  load() {
    this.loading ??= this.#load().catch((error) => {
      this.loading = null; // asked for again with the next look
      throw error;
    });
    return this.loading;
  }

  async #load() {
    if (this.source === "none" || this.source === "given") return;
    const { blob } = await getMasks(this.scene);
    const found = await unzipped(new Uint8Array(await blob.arrayBuffer()));
    if (found.size !== this.count) throw unusable();
    this.found = found;
  }

  /** @param {number} frame of the clip @returns {Promise<Mask>} with its strokes */
  async mask(frame) {
    const mask = await this.#mask(frame);
    const stored = this.nearestStored(frame);
    for (const stroke of this.strokes) if (stroke.isForAll || stroke.frame === stored) paint(mask, stroke);
    return mask;
  }

  /** @returns {Promise<Mask>} as it was */
  async #mask(frame) {
    const { width, height } = this;
    if (this.source === "none") return { width, height, pixels: new Uint8Array(width * height) };
    const png = this.found ? [...this.found.values()][frame] : await this.#recorded(frame);
    const mask = await maskOf(png);
    if (mask.width !== width || mask.height !== height) throw unusable();
    return mask;
  }

  async #recorded(frame) {
    const query = new URLSearchParams({ t: String(frame / this.count), masks: "only" });
    const png = await bodyOf(await request(`/scenes/${this.scene}/recorded?${query}`), "blob");
    return new Uint8Array(await png.arrayBuffer());
  }

  /**
   * All masks as they are now; those that were found and no stroke reaches keep their bytes.
   * @param {(share: number) => void} onShare
   * @returns {Promise<File>} a zip with a PNG for each frame of the clip
   */
  async file(onShare) {
    await this.load();
    const names = this.found ? [...this.found.keys()] : Array.from({ length: this.count }, (_, n) => `${String(n).padStart(6, "0")}.png`);
    const files = new Map();
    for (const [frame, name] of names.entries()) {
      const isAsFound = this.found && !this.isChanged(this.nearestStored(frame));
      files.set(name, isAsFound ? this.found.get(name) : await pngOf(await this.mask(frame)));
      onShare((frame + 1) / this.count);
    }
    return new File([zipped(files)], "masks.zip", { type: "application/zip" });
  }
}
