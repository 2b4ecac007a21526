// The picture and what it is worth. A picture is live only while the service keeps confirming it: whatever goes wrong,
// the badge says so by itself after STALE_AFTER_MS, because it depends on what comes, not on somebody noticing.

import { clockTime } from "./element.js";

/** @typedef {import("./stream.js").Picture} Picture */

const STALE_AFTER_MS = 5000;
const LOOK_MS = 250;
const FIRST_PICTURE = "first_picture";

export class Screen {
  /**
   * @param {{stage: HTMLElement, canvas: HTMLCanvasElement, status: HTMLElement, badge: HTMLElement,
   *   statusText: HTMLElement, message: HTMLElement, warning: HTMLElement, sceneId: HTMLElement}} parts
   */
  constructor(parts) {
    Object.assign(this, parts);
    this.clear(null, "Choose a job.");
    setInterval(() => this.#look(), LOOK_MS);
    document.addEventListener("visibilitychange", () => this.#look()); // timers sleep in hidden tabs
  }

  get hasPicture() {
    return this.shown !== null;
  }

  /**
   * No picture, of a scene that is to come or of none.
   * @param {string | null} scene
   * @param {string} words why there is none
   */
  clear(scene, words) {
    this.scene = scene;
    this.shown = null;
    this.shownAt = 0;
    this.awaitedUntil = 0;
    this.trouble = "";
    this.words = words;
    this.canvas.width = this.canvas.height = 0; // its pixels are gone, not only hidden
    this.sceneId.dataset.scene = scene ?? "";
    this.#look();
  }

  /** @param {Picture} picture @param {ImageBitmap} bitmap of it, closed here @param {string} name what it shows */
  show(picture, bitmap, name) {
    const { canvas } = this;
    if (canvas.width !== bitmap.width) canvas.width = bitmap.width; // setting it clears and allocates anew
    if (canvas.height !== bitmap.height) canvas.height = bitmap.height;
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
    canvas.setAttribute("aria-label", name);
    this.name = name;
    this.shown = picture;
    this.shownAt = Date.now();
    this.awaitedUntil = 0;
    this.trouble = "";
    this.#look();
  }

  /** @param {number} seconds until the service shows the next picture: it lives, and serves others first */
  waitFor(seconds) {
    this.awaitedUntil = Date.now() + seconds * 1000 + STALE_AFTER_MS;
    this.trouble = "";
    this.#look();
  }

  /** @param {string} words why the picture, if there is one, is not live any more */
  fail(words) {
    this.trouble = this.words = words;
    this.#look();
  }

  #look() {
    const [state, badge, message] = this.#state();
    this.stage.dataset.state = this.status.dataset.state = state;
    this.canvas.hidden = this.shown === null;
    setText(this.badge, badge);
    this.badge.hidden = badge === "";
    setText(this.statusText, this.shown && state !== "stale" ? this.name : "");
    setText(this.message, message);
    this.message.hidden = message === "";
    setText(this.warning, state === "stale" ? "" : (this.shown?.warning ?? ""));
  }

  /** @returns {[string, string, string]} state, badge, message over the picture */
  #state() {
    if (this.scene === null) return ["none", "", this.words];
    if (this.shown === null) return ["waiting", "NO PICTURE", this.words];
    if (this.trouble || Date.now() > Math.max(this.shownAt + STALE_AFTER_MS, this.awaitedUntil)) {
      const reason = this.trouble || "The service does not answer.";
      return ["stale", "STALE", `Last picture ${clockTime(this.shownAt)}. ${reason} Reconnecting.`];
    }
    if (this.shown.isRecorded) return ["live", "RECORDED, what is coloured is masked", ""];
    if (this.shown.codes?.includes(FIRST_PICTURE)) return ["training", "FIRST PICTURE, not yet a model", ""];
    if (this.shown.state === "running") return ["training", `TRAINING, iteration ${this.shown.iteration}`, ""];
    return this.shown.isExtrapolated ? ["extrapolated", "EXTRAPOLATED", ""] : ["live", "CURRENT", ""];
  }
}

/** Only where it changes, so that screen readers are told once. */
function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}
