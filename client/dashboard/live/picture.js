// The endoscope's own picture, asked for again as soon as one has come, ten times a second at most: the newest wins, and
// nothing waits in a line.

import { pause } from "../base/pause.js";
import { getLivePicture } from "./feeds.js";

const PERIOD_MS = 100;
const AFTER_TROUBLE_MS = 400;
const HIDDEN_MS = 500;
const LOST = 0;

/** Tells "shown", and "answered" whenever the service has said anything. */
export class LivePicture extends EventTarget {
  /** @param {HTMLCanvasElement} canvas @param {import("./clock.js").FeedClock} clock */
  constructor(canvas, clock) {
    super();
    Object.assign(this, { canvas, clock, visit: 0 });
    this.clear();
  }

  /** Show none. */
  clear() {
    this.isBlank = true;
    /** @type {number | null} of what is on the screen */
    this.capturedAtS = null;
    /** @type {string | null} its ETag */
    this.tag = null;
    /** @type {Error | null} in place of the newest answer */
    this.problem = null;
    this.canvas.hidden = true;
    this.canvas.width = this.canvas.height = 0; // what it showed is no more
  }

  /** @param {string | null} id null: stop */
  open(id) {
    this.visit += 1;
    this.mayShow = true;
    this.clear();
    if (id !== null) this.#poll(id, this.visit);
  }

  /** @param {boolean} mayShow false: what comes is not to be seen, and nothing is asked for */
  allow(mayShow) {
    this.mayShow = mayShow;
    if (!mayShow) this.clear();
  }

  get ageS() {
    return this.capturedAtS === null ? null : Math.max(0, this.clock.nowS - this.capturedAtS);
  }

  async #poll(id, visit) {
    while (visit === this.visit) {
      const began = performance.now();
      let pauseMs = PERIOD_MS;
      if (document.hidden) pauseMs = HIDDEN_MS;
      else if (this.mayShow && !(await this.#once(id, visit))) pauseMs = AFTER_TROUBLE_MS;
      await pause(Math.max(0, began + pauseMs - performance.now()));
    }
  }

  /** @returns {Promise<boolean>} whether a picture has come */
  async #once(id, visit) {
    try {
      const image = await getLivePicture(id, this.tag);
      if (visit !== this.visit) return false;
      this.clock.note(image.capturedAtS + image.ageS, image.receivedMs, image.sentMs);
      this.dispatchEvent(new Event("answered"));
      this.problem = null;
      if (image.capturedAtS === this.capturedAtS || !this.mayShow) return true;
      if (image.blob) this.#show(await createImageBitmap(image.blob), image, visit);
      else if (image.tag === this.tag) this.#note(image);
      return true;
    } catch (error) {
      if (visit !== this.visit) return false;
      this.problem = error;
      if (error.status !== LOST) this.dispatchEvent(new Event("answered"));
      return false;
    }
  }

  #show(bitmap, image, visit) {
    if (visit === this.visit && this.mayShow) {
      const { canvas } = this;
      if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
        [canvas.width, canvas.height] = [bitmap.width, bitmap.height];
      }
      canvas.getContext("2d").drawImage(bitmap, 0, 0);
      canvas.hidden = false;
      this.isBlank = false;
      this.#note(image);
    }
    bitmap.close();
  }

  /** What is on the screen is this picture. */
  #note({ capturedAtS, tag }) {
    Object.assign(this, { capturedAtS, tag });
    this.dispatchEvent(new Event("shown"));
  }
}
