// The frame that is painted on: the recorded picture, its mask coloured over it, and the brush in the hand.

import { element } from "../base/element.js";
import { words } from "../base/messages.js";
import { paint, recordedPlace } from "./strokes.js";

/** Red, green, blue and opacity of what is masked, as in the service's own pictures: no tissue has it. */
const MARK = [0, 220, 255, 115];
const TENTHS = 10;

/** @param {number} value @returns {number} in tenths of a pixel, as strokes have it */
const rounded = (value) => Math.round(value * TENTHS) / TENTHS;
const clamped = (value, high) => Math.max(0, Math.min(high, value));

export class Paper {
  /**
   * @param {import("../base/wire.js").RecordedPixels} pixels
   * @param {(stroke: import("./strokes.js").Stroke) => void} onStroke
   */
  constructor(pixels, onStroke) {
    const { width, height } = pixels;
    Object.assign(this, { width, height, onStroke, place: recordedPlace(pixels) });
    /** @type {import("./files.js").Mask | null} of the frame in view, once it is there */
    this.mask = null;
    /** @type {import("./strokes.js").Stroke | null} under way */
    this.stroke = null;
    this.isResting = false; // it takes no stroke
    this.cursor = { x: width / 2, y: height / 2 };
    this.recorded = Object.assign(element("canvas"), { width, height });
    this.over = Object.assign(element("canvas"), { width, height });
    this.ring = element("div", { class: "ring" });
    this.stage = element("div", { class: "paper" }, this.recorded, this.over, this.ring);
    Object.assign(this.stage, { tabIndex: 0, role: "application", ariaLabel: words("brush.picture") });
    this.stage.addEventListener("pointerdown", (event) => this.#begin(event));
    this.stage.addEventListener("pointermove", (event) => this.#move(event));
    for (const end of ["pointerup", "pointercancel"]) this.stage.addEventListener(end, (event) => this.#lift(event));
    this.stage.addEventListener("contextmenu", (event) => event.preventDefault());
    this.sizes = new ResizeObserver(() => this.#showRing());
    this.sizes.observe(this.stage);
  }

  get isPainting() {
    return this.stroke !== null;
  }

  close() {
    this.sizes.disconnect();
  }

  /** @param {{isTool: boolean, isForAll: boolean, size: number}} brush size: its diameter in pixels of the frame */
  take(brush) {
    this.brush = brush;
    this.ring.classList.toggle("tissue", !brush.isTool);
    this.#showRing();
  }

  /** Another frame is asked for: the one in view goes. */
  clear() {
    this.mask = this.stroke = null;
    this.stage.classList.add("stale");
  }

  /** @param {number} frame @param {ImageBitmap} picture @param {import("./files.js").Mask} mask painted into */
  show(frame, picture, mask) {
    Object.assign(this, { frame, mask });
    this.recorded.getContext("2d").drawImage(picture, 0, 0, this.width, this.height);
    this.#draw();
    this.stage.classList.remove("stale");
  }

  /**
   * What keys do while the frame has the focus: the arrows lead the brush, finely with Shift, and Enter or Space dabs.
   * @param {KeyboardEvent} event
   * @returns {Record<string, () => void>}
   */
  keys({ target, shiftKey }) {
    if (target !== this.stage) return {};
    const step = shiftKey ? 1 : Math.max(1, this.brush.size / 2);
    const by = (x, y) => () => {
      this.cursor = { x: clamped(this.cursor.x + x * step, this.width - 1), y: clamped(this.cursor.y + y * step, this.height - 1) };
      this.#showRing();
    };
    const dab = () => {
      if (!this.mask) return;
      this.#startStroke();
      this.#endStroke();
    };
    return { ArrowLeft: by(-1, 0), ArrowRight: by(1, 0), ArrowUp: by(0, -1), ArrowDown: by(0, 1), Enter: dab, " ": dab };
  }

  #begin(event) {
    if (event.button !== 0 || this.stroke || !this.mask || this.isResting) return;
    event.preventDefault();
    this.stage.focus();
    this.stage.setPointerCapture(event.pointerId);
    this.pointer = event.pointerId;
    this.cursor = this.#pointOf(event);
    this.#startStroke();
    this.#showRing();
  }

  #move(event) {
    if (this.stroke && event.pointerId !== this.pointer) return;
    const between = this.stroke ? (event.getCoalescedEvents?.() ?? []) : [];
    for (const each of between.length > 0 ? between : [event]) {
      this.cursor = this.#pointOf(each);
      if (this.stroke) this.#continueStroke();
    }
    this.#showRing();
  }

  #lift(event) {
    if (this.stroke && event.pointerId === this.pointer) this.#endStroke();
  }

  #startStroke() {
    const { x, y } = this.cursor;
    const [here, beside] = [this.place(x, y), this.place(x + 1, y)];
    const { isTool, isForAll, size } = this.brush;
    const radius = rounded((size / 2) * Math.hypot(beside[0] - here[0], beside[1] - here[1]));
    this.stroke = { isTool, isForAll, frame: this.frame, radius, points: [] };
    this.#continueStroke();
  }

  #continueStroke() {
    const { points } = this.stroke;
    const [x, y] = this.place(this.cursor.x, this.cursor.y).map(rounded);
    if (points.at(-2) === x && points.at(-1) === y) return;
    points.push(x, y);
    paint(this.mask, this.stroke, points.length / 2 - 1);
    this.drawing ??= requestAnimationFrame(() => this.#draw());
  }

  #endStroke() {
    const { stroke } = this;
    this.stroke = null;
    this.onStroke(stroke);
  }

  /** Colour what is masked, as the frame shows it. */
  #draw() {
    this.drawing = null;
    if (!this.mask) return;
    this.seenAt ??= this.#places();
    const image = new ImageData(this.width, this.height);
    const shown = new Uint32Array(image.data.buffer);
    const [mark] = new Uint32Array(Uint8Array.from(MARK).buffer);
    for (let i = 0; i < shown.length; i++) if (this.mask.pixels[this.seenAt[i]]) shown[i] = mark;
    this.over.getContext("2d").putImageData(image, 0, 0);
  }

  /** The recorded pixel that each pixel of a frame shows; -1 where it shows none. */
  #places() {
    const { width, height } = this;
    const places = new Int32Array(width * height);
    for (let i = 0; i < places.length; i++) {
      const [x, y] = this.place(i % width, Math.floor(i / width)).map(Math.round);
      places[i] = x >= 0 && y >= 0 && x < width && y < height ? y * width + x : -1;
    }
    return places;
  }

  /** Pixels of the screen a pixel of the frame, and where its first one begins in the stage. */
  #fit() {
    const { clientWidth, clientHeight } = this.stage;
    const scale = Math.min(clientWidth / this.width, clientHeight / this.height);
    return { scale, left: (clientWidth - scale * this.width) / 2, top: (clientHeight - scale * this.height) / 2 };
  }

  /** @param {PointerEvent} event @returns {{x: number, y: number}} the nearest point of the frame, its pixels from the middle of the first */
  #pointOf(event) {
    const { scale, left, top } = this.#fit();
    const box = this.stage.getBoundingClientRect();
    const x = (event.clientX - box.left - left) / scale - 0.5;
    const y = (event.clientY - box.top - top) / scale - 0.5;
    return { x: clamped(x, this.width - 1), y: clamped(y, this.height - 1) };
  }

  #showRing() {
    if (!this.brush) return;
    const { scale, left, top } = this.#fit();
    const px = (value) => `${value}px`;
    const size = px(this.brush.size * scale);
    const place = { left: px(left + (this.cursor.x + 0.5) * scale), top: px(top + (this.cursor.y + 0.5) * scale) };
    Object.assign(this.ring.style, { ...place, width: size, height: size });
  }
}
