// What the false colours of the layers depth and confidence mean.

import { setText } from "../base/element.js";
import { figure, languageEvents, words } from "../base/messages.js";
import { gradient } from "./colours.js";

export class Legend {
  /**
   * @param {import("./viewer.js").Viewer} viewer
   * @param {HTMLElement} box with .what, .low, .colours and .high
   */
  constructor(viewer, box) {
    this.box = box;
    this.shown = null;
    viewer.addEventListener("shown", ({ detail }) => this.#show(detail));
    viewer.addEventListener("gone", () => this.#show(null));
    languageEvents.addEventListener("changed", () => this.#show(this.shown));
  }

  #show(shown) {
    this.shown = shown;
    const range = shown?.layer === "depth" ? (shown.depthRangeMm ?? null) : null;
    const isConfidence = shown?.layer === "confidence";
    this.box.hidden = !isConfidence && range === null;
    if (this.box.hidden) return;
    const [low, high] = isConfidence
      ? [words("legend.unsure"), words("legend.sure")]
      : range.map((each) => words("legend.mm", { mm: figure(each) }));
    this.#say(".what", words(isConfidence ? "legend.confidence" : "legend.depth"));
    this.#say(".low", low);
    this.#say(".high", high);
    this.box.querySelector(".colours").style.backgroundImage = gradient(isConfidence ? "to right" : "to left");
  }

  #say(part, text) {
    setText(this.box.querySelector(part), text);
  }
}
