// Depth and trust near the pointer, where it rests on the picture while the picture rests, too.

import { getMeasurement } from "../base/api.js";
import { element } from "../base/element.js";
import { figure, words } from "../base/messages.js";
import { isMeasurable, queryOf, sameView, toPicture } from "./places.js";

const RESTS_AFTER_MS = 200;
const BESIDE_PX = 18;

/** @param {import("../base/wire.js").MeasuredPoint} point @returns {string} */
export function readingOf({ depth_mm: depth, uncertainty_mm: sigma, confidence, refusal }) {
  if (refusal) return words(`measure.${refusal.code}`);
  return words("measure.depth", {
    depth: figure(depth, 1),
    sigma: figure(sigma, 1),
    trust: figure(100 * confidence),
  });
}

export class Probe {
  /**
   * @param {import("../stage/viewer.js").Viewer} viewer
   * @param {{stage: HTMLElement, canvas: HTMLElement, over: HTMLElement}} parts
   */
  constructor(viewer, parts) {
    this.viewer = viewer;
    this.parts = parts;
    this.label = parts.over.appendChild(element("p", { class: "probe" }));
    this.label.hidden = true;
    this.at = null; // where the pointer is, on the screen
    this.asked = null; // the view that the label is of
    this.timer = 0;
    this.isBusy = false;
    parts.stage.addEventListener("pointermove", (event) => this.#move(event));
    parts.stage.addEventListener("pointerleave", () => this.#leave());
    viewer.addEventListener("shown", ({ detail }) => !sameView(detail, this.asked) && this.#again());
    viewer.addEventListener("gone", () => this.#leave());
    new ResizeObserver(() => this.#again()).observe(parts.canvas); // another place comes under the pointer
  }

  /** Nothing is known of the place in view. */
  hide() {
    this.asked = null;
    this.label.hidden = true;
    this.label.textContent = "";
  }

  #move({ pointerType, buttons, clientX, clientY }) {
    if (pointerType === "touch" || buttons !== 0) return this.#leave();
    this.at = [clientX, clientY];
    this.#again();
  }

  #leave() {
    this.at = null;
    clearTimeout(this.timer);
    this.hide();
  }

  #again() {
    this.hide();
    clearTimeout(this.timer);
    if (this.at !== null) this.timer = setTimeout(() => this.#ask(), RESTS_AFTER_MS);
  }

  async #ask() {
    const { shown } = this.viewer;
    const point = this.at && isMeasurable(shown) ? toPicture(this.parts.canvas, shown.camera, this.at) : null;
    if (point === null) return;
    if (this.isBusy) return this.#again();
    this.isBusy = true;
    const at = this.at;
    try {
      const { points } = await getMeasurement(shown.scene, queryOf(shown, [point]));
      if (at !== this.at || !sameView(shown, this.viewer.shown)) return;
      this.asked = shown;
      this.#show(readingOf(points[0]), points[0].refusal !== null, at);
    } catch {
      this.hide(); // the picture's own state says what is wrong
    } finally {
      this.isBusy = false;
    }
  }

  #show(text, isRefused, [clientX, clientY]) {
    const box = this.parts.over.getBoundingClientRect();
    const { label } = this;
    label.textContent = text;
    label.classList.toggle("refused", isRefused);
    label.hidden = false;
    const isRight = clientX - box.left > box.width / 2;
    label.style.left = isRight ? "" : `${clientX - box.left + BESIDE_PX}px`;
    label.style.right = isRight ? `${box.right - clientX + BESIDE_PX}px` : "";
    label.style.top = `${Math.min(clientY - box.top + BESIDE_PX, box.height - 2 * BESIDE_PX)}px`;
  }
}
