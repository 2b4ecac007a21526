// The recorded frames of one eye of a scene: loaded ahead of the moment in view, and decoded shortly before it comes.

import { request } from "../base/api.js";
import { pause } from "../base/pause.js";
import { nearestPlace } from "./recordedpicture.js";

const AT_ONCE = 3;
/** Frames that are decoded; a second of a film of 25 a second would take 40 MB of an eye of 640 x 512. */
const DECODED = 8;
const MAX_LOADED_BYTES = 64e6;
const AFTER_TROUBLE_MS = 1000;
const FINAL = [401, 403, 404, 409, 422];

/** @typedef {import("../base/wire.js").Recorded} Recorded */
/**
 * frame: its number in the clip, from 0.
 * @typedef {{frame: number, picture: ImageBitmap, mask: ImageBitmap | null}} Frame
 */

export class RecordedFrames {
  /**
   * @param {string} scene
   * @param {Recorded} kept what the scene keeps
   * @param {number} frameCount of the clip
   * @param {"left"|"right"} eye
   * @param {{onReady: () => void, onFail: (error: Error) => void}} told onReady: the frame that was sought last is
   *   decoded; onFail: no frame comes any more
   */
  constructor(scene, kept, frameCount, eye, told) {
    Object.assign(this, { scene, kept, frameCount, eye, told });
    this.place = 0; // of the frame in view, among those that are kept
    /** @type {Map<number, {picture: Blob, mask: Blob | null}>} */
    this.files = new Map();
    /** @type {Map<number, Frame | null>} null while it is being decoded */
    this.frames = new Map();
    this.underWay = new Set();
    this.controller = new AbortController();
    const each = kept.size_bytes / (kept.frames.length * kept.eyes.length);
    this.reach = Math.min(kept.frames.length, Math.max(DECODED, Math.floor(MAX_LOADED_BYTES / Math.max(1, each))));
  }

  /** Let go of all pictures, and of what is on its way. */
  close() {
    this.controller.abort();
    for (const place of [...this.frames.keys()]) this.#forget(place);
    this.files.clear();
  }

  /** The number of the kept frame nearest to t. @param {number} t */
  frameAt(t) {
    return this.kept.frames[nearestPlace(this.kept.frames, this.frameCount, t)];
  }

  /** @param {number} t @returns {Frame | null} the frame nearest to t; null: onReady is told when it is there */
  seek(t) {
    this.place = nearestPlace(this.kept.frames, this.frameCount, t);
    for (const place of [...this.files.keys()]) if (this.#ahead(place) >= this.reach) this.files.delete(place);
    for (const place of [...this.frames.keys()]) if (this.#ahead(place) >= DECODED) this.#forget(place);
    this.#decodeAhead();
    while (this.underWay.size < AT_ONCE && this.#loadNext());
    return this.frames.get(this.place) ?? null;
  }

  /** How many frames after the one in view, in a loop. */
  #ahead(place) {
    const { length } = this.kept.frames;
    return (place - this.place + length) % length;
  }

  #forget(place) {
    const frame = this.frames.get(place);
    frame?.picture.close();
    frame?.mask?.close();
    this.frames.delete(place);
  }

  /** @returns {boolean} whether there was one to load */
  #loadNext() {
    if (this.controller.signal.aborted) return false;
    const { length } = this.kept.frames;
    for (let ahead = 0; ahead < this.reach; ahead++) {
      const place = (this.place + ahead) % length;
      if (this.files.has(place) || this.underWay.has(place)) continue;
      this.#load(place);
      return true;
    }
    return false;
  }

  async #load(place) {
    this.underWay.add(place);
    try {
      const t = this.kept.frames[place] / this.frameCount;
      const asked = ["off", ...(this.kept.masks ? ["only"] : [])].map((masks) => this.#fetch(t, masks));
      const [picture, mask = null] = await Promise.all(asked);
      if (this.controller.signal.aborted) return;
      this.files.set(place, { picture, mask });
      this.#decodeAhead();
    } catch (error) {
      if (this.controller.signal.aborted) return;
      if (FINAL.includes(error.status)) {
        this.close();
        this.told.onFail(error);
        return;
      }
      await pause(AFTER_TROUBLE_MS);
    } finally {
      this.underWay.delete(place);
    }
    this.#loadNext();
  }

  async #fetch(t, masks) {
    const query = new URLSearchParams({ t: String(t), eye: this.eye, masks });
    return (await request(`/scenes/${this.scene}/recorded?${query}`, { signal: this.controller.signal })).blob();
  }

  #decodeAhead() {
    for (const [place, files] of this.files) {
      if (this.#ahead(place) < DECODED && !this.frames.has(place)) this.#decode(place, files);
    }
  }

  async #decode(place, { picture, mask }) {
    this.frames.set(place, null);
    try {
      const [shown, masked] = await Promise.all([createImageBitmap(picture), mask && createImageBitmap(mask)]);
      const frame = { frame: this.kept.frames[place], picture: shown, mask: masked };
      if (this.frames.get(place) !== null) { // it is out of reach by now
        shown.close();
        masked?.close();
        return;
      }
      this.frames.set(place, frame);
      if (place === this.place) this.told.onReady();
    } catch (error) {
      if (this.controller.signal.aborted) return;
      this.close();
      this.told.onFail(error);
    }
  }
}
