// What the false colours of the layers depth, confidence and error mean. The range of depth can be set.

import { setText } from "../base/element.js";
import { figure, languageEvents, words } from "../base/messages.js";
import { BRIGHTEST_ERROR } from "../base/wire.js";
import { errorGradient, gradient } from "./colours.js";

export class Legend {
  /**
   * @param {import("./viewer.js").Viewer} viewer
   * @param {HTMLElement} box with .what, .low, .colours, .high and .range with .near, .far and .auto
   * @param {() => void} onRange another range was chosen
   */
  constructor(viewer, box, onRange) {
    this.box = box;
    this.viewer = viewer;
    this.shown = null;
    viewer.addEventListener("shown", ({ detail }) => this.#show(detail));
    viewer.addEventListener("gone", () => this.#show(null));
    languageEvents.addEventListener("changed", () => this.#show(this.shown));
    const [near, far] = (this.ends = [".near", ".far"].map((each) => box.querySelector(each)));
    const choose = (range) => {
      viewer.look({ range });
      onRange();
    };
    for (const end of this.ends) {
      end.addEventListener("change", () => {
        const range = [near, far].map((each) => Number(each.value)).sort((one, other) => one - other);
        const isRange = this.ends.every((each) => each.validity.valid && each.value) && range[0] < range[1];
        if (isRange) choose(range);
        else this.#fill(true);
      });
    }
    box.querySelector(".auto").addEventListener("click", () => choose(null));
  }

  #show(shown) {
    this.shown = shown;
    const legend = shown && this.#legendOf(shown);
    this.box.hidden = !legend;
    this.box.querySelector(".range").hidden = shown?.layer !== "depth";
    if (!legend) return;
    this.#say(".what", words(`legend.${shown.layer}`));
    this.#say(".low", legend.low);
    this.#say(".high", legend.high);
    const isError = shown.layer === "error";
    const colours = isError ? errorGradient() : gradient(shown.layer === "depth" ? "to left" : "to right");
    this.box.querySelector(".colours").style.backgroundImage = colours;
    if (shown.layer === "depth") this.#fill(false);
  }

  /** @returns {{low: string, high: string} | null} what its ends mean; null: the picture has no false colours */
  #legendOf({ layer, depthRangeMm }) {
    if (layer === "confidence") return { low: words("legend.unsure"), high: words("legend.sure") };
    if (layer === "error") {
      const most = { levels: BRIGHTEST_ERROR };
      return { low: words("legend.darker", most), high: words("legend.brighter", most) };
    }
    if (layer !== "depth" || !depthRangeMm) return null;
    const [near, far] = depthRangeMm.map((each) => ({ mm: figure(each) }));
    return { low: words("legend.nearest", near), high: words("legend.farthest", far) }; // what lies beyond has the colours of the ends
  }

  /** Show the range in its fields, but for one that somebody writes in. */
  #fill(isForced) {
    const range = this.shown?.depthRangeMm ?? [];
    for (const [i, end] of this.ends.entries()) {
      if (isForced || end !== document.activeElement) end.value = String(range[i] ?? "");
    }
    this.box.querySelector(".auto").disabled = this.viewer.range === null;
  }

  #say(part, text) {
    setText(this.box.querySelector(part), text);
  }
}
