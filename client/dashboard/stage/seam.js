// The seam between two pictures of one moment, moved by mouse, finger or keys (style/seam.css).

import { words } from "../base/messages.js";

const STEPS = { ArrowLeft: -2, ArrowDown: -2, ArrowRight: 2, ArrowUp: 2, PageDown: -10, PageUp: 10 };
const ENDS = { Home: 0, End: 100 };
export const MIDDLE = 50;

/**
 * The elements of a comparison, by the ids that every page gives them.
 * @param {(id: string) => HTMLElement} get
 */
export const comparisonParts = (get) => ({
  stage: get("stage"),
  box: get("compare-box"),
  canvas: get("recorded"),
  seam: get("seam"),
  ofRecorded: get("of-recorded"),
  ofModel: get("of-model"),
});

export class Seam {
  /** @param {HTMLElement} handle a slider @param {HTMLElement} box the pictures, which take the place from --seam */
  constructor(handle, box) {
    Object.assign(this, { handle, box });
    this.percent = MIDDLE;
    this.#listen();
  }

  /** @param {number} percent of the width that shows the left picture */
  move(percent) {
    this.percent = Math.min(100, Math.max(0, percent));
    const { handle, box } = this;
    box.style.setProperty("--seam", `${this.percent}%`);
    handle.setAttribute("aria-valuenow", String(Math.round(this.percent)));
    handle.setAttribute("aria-valuetext", words("compare.seam_at", { percent: Math.round(this.percent) }));
  }

  #listen() {
    const { handle, box } = this;
    const follow = ({ clientX }) => {
      const { left, width } = box.getBoundingClientRect();
      this.move(((clientX - left) / width) * 100);
    };
    handle.addEventListener("pointerdown", (event) => {
      event.stopPropagation(); // the stage would turn the model
      handle.setPointerCapture(event.pointerId);
    });
    handle.addEventListener("pointermove", (event) => {
      event.stopPropagation();
      if (handle.hasPointerCapture(event.pointerId)) follow(event);
    });
    handle.addEventListener("dblclick", (event) => event.stopPropagation());
    handle.addEventListener("keydown", (event) => {
      const { key } = event;
      if (key in STEPS) this.move(this.percent + STEPS[key]);
      else if (key in ENDS) this.move(ENDS[key]);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }
}
