// The picture and what it is worth. A picture is live only while the service keeps answering: whatever goes wrong, the
// badge says so by itself after STALE_AFTER_MS, because it depends on what comes, not on somebody noticing. What this
// browser draws from memory goes on without the service, and then says that nobody confirms it.

import { clockTime, setText } from "../base/element.js";
import { words } from "../base/messages.js";

/** @typedef {import("./stream.js").Picture} Picture */

const STALE_AFTER_MS = 5000;
/** A scene from memory is drawn here, so the service is asked less often. */
const UNCONFIRMED_AFTER_MS = 10000;
const LOOK_MS = 250;
const FIRST_PICTURE = "first_picture";

export class Screen {
  /**
   * @param {{stage: HTMLElement, canvas: HTMLCanvasElement, status: HTMLElement, badge: HTMLElement,
   *   statusText: HTMLElement, message: HTMLElement, sceneId: HTMLElement}} parts
   */
  constructor(parts) {
    Object.assign(this, parts);
    this.clear(null, words("page.choose"));
    setInterval(() => this.#look(), LOOK_MS);
    document.addEventListener("visibilitychange", () => this.#look()); // timers sleep in hidden tabs
  }

  get isStale() {
    return this.status.dataset.state === "stale";
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
    this.confirmedAt = this.aliveAt = 0;
    this.awaitedUntil = 0;
    this.trouble = "";
    this.work = "";
    this.words = words;
    this.canvas.width = this.canvas.height = 0; // its pixels are gone, not only hidden
    this.sceneId.dataset.scene = scene ?? "";
    this.#look();
  }

  /**
   * @param {Picture} picture
   * @param {ImageBitmap | HTMLCanvasElement} image of it; a bitmap is closed here
   * @param {string} name what it shows
   * @param {string} moment of the clip
   */
  show(picture, image, name, moment) {
    const { canvas } = this;
    if (canvas.width !== image.width) canvas.width = image.width; // setting it clears and allocates anew
    if (canvas.height !== image.height) canvas.height = image.height;
    canvas.getContext("2d").drawImage(image, 0, 0);
    this.stage.style.setProperty("--aspect", String(canvas.width / canvas.height)); // where it is within the stage: style/page.css
    image.close?.();
    const label = [name, moment].filter(Boolean).join(", ");
    canvas.setAttribute("aria-label", label);
    this.about = picture.isRecorded ? moment : label; // the badge says what recorded frames are
    this.shown = picture;
    this.awaitedUntil = 0;
    if (picture.way === "memory") this.#look(); // that it could be drawn says nothing of whether it may
    else this.confirm();
  }

  /** @param {boolean} isCovered a clip that is sent lies over whatever picture there is @param {boolean} isExample the page's own */
  cover(isCovered, isExample = false) {
    Object.assign(this, { isCovered, isExample });
    this.#look();
  }

  /** @param {""|"storing"|"scoring"} work on the scene after its training, while its last snapshot is in view */
  tellWork(work) {
    if (this.work === work) return;
    this.work = work;
    this.#look();
  }

  /** The service has just said that what is shown is there. */
  confirm() {
    this.confirmedAt = Date.now();
    this.trouble = "";
    this.#look();
  }

  /** The service has just said that it is well and knows what is shown: a picture that takes long is no silence. */
  keepAlive() {
    this.aliveAt = Date.now();
    this.#look();
  }

  /** @param {number} seconds until the service shows the next picture: it lives, and serves others first */
  waitFor(seconds) {
    this.awaitedUntil = Date.now() + seconds * 1000 + STALE_AFTER_MS;
    this.trouble = "";
    this.#look();
  }

  /** @param {string} reason why the picture, if there is one, is not confirmed any more */
  fail(reason) {
    this.trouble = this.words = reason;
    this.#look();
  }

  #look() {
    const [state, badge, message] = this.#state();
    this.stage.dataset.state = this.status.dataset.state = state;
    this.stage.toggleAttribute("data-empty", this.scene === null);
    this.stage.toggleAttribute("data-failed", this.trouble !== "");
    this.status.toggleAttribute("data-recorded", this.shown?.isRecorded === true);
    this.canvas.hidden = this.shown === null || this.isCovered === true;
    setText(this.badge, badge);
    this.badge.hidden = badge === "";
    setText(this.statusText, this.#text(state));
    this.#fitText();
    setText(this.message, message);
    this.message.hidden = message === "";
  }

  /** Two lines of smaller letters for a text that is longer than the line. */
  #fitText() {
    const { status, statusText } = this;
    const line = statusText.parentElement;
    const size = () => [statusText.textContent.length, statusText.offsetLeft, line.clientWidth].join();
    if (this.fitted === size()) return;
    status.toggleAttribute("data-long", false);
    status.toggleAttribute("data-long", line.scrollWidth > line.clientWidth);
    this.fitted = size();
  }

  /** @returns {[string, string, string]} state, badge, message over the picture */
  #state() {
    if (this.isCovered) return ["waiting", words(this.isExample ? "screen.example_clip" : "screen.own_clip"), ""];
    if (this.scene === null) return ["none", "", this.words];
    if (this.shown === null) return ["waiting", words("screen.nothing"), this.words];
    const isOfMemory = this.shown.way === "memory";
    const limit = isOfMemory ? this.confirmedAt + UNCONFIRMED_AFTER_MS : Math.max(this.confirmedAt, this.aliveAt) + STALE_AFTER_MS;
    if (this.trouble || Date.now() > Math.max(limit, this.awaitedUntil)) {
      if (isOfMemory) return ["unconfirmed", words("screen.unconfirmed"), ""];
      const reason = this.trouble || words("screen.silent");
      return ["stale", words("screen.stale"), words("screen.stale_why", { time: clockTime(this.confirmedAt), reason })];
    }
    if (this.shown.isRecorded) return ["live", words("screen.recorded"), ""];
    if (this.shown.codes?.includes(FIRST_PICTURE)) return ["training", words("screen.first_picture"), ""];
    if (this.shown.state === "running") return ["training", words(`screen.${this.work || "training"}`), ""];
    return this.shown.isExtrapolated ? ["extrapolated", words("screen.extrapolated"), ""] : ["live", words("screen.current"), ""];
  }

  /** @param {string} state @returns {string} beside the badge */
  #text(state) {
    if (state === "unconfirmed") return words("screen.unconfirmed_why", { time: clockTime(this.confirmedAt) });
    return this.shown && state !== "stale" ? this.about : "";
  }
}
