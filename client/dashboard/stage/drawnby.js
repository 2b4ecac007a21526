// Who draws, why, and how fast: in words, with a choice and figures below.

import { element, setText } from "../base/element.js";
import { figure, languageEvents, words } from "../base/messages.js";
import { graphics } from "../player/support.js";
import { CHOICES } from "./memory.js";

export class DrawnBy {
  /**
   * @param {HTMLDetailsElement} target
   * @param {import("./memory.js").Memory} memory
   * @param {() => void} onOpen the figures are wanted
   */
  constructor(target, memory, onOpen) {
    Object.assign(this, { target, memory });
    this.begin();
    this.summary = element("summary");
    this.reason = element("p");
    this.choice = element("select");
    this.label = element("span");
    this.figures = element("output", { class: "quiet" });
    target.replaceChildren(
      this.summary,
      element("div", { class: "panel" }, this.reason, element("label", {}, this.label, this.choice), this.figures),
    );
    this.choice.addEventListener("change", () => memory.choose(this.choice.value));
    target.addEventListener("toggle", () => target.open && onOpen());
    languageEvents.addEventListener("changed", () => this.#word());
    this.#word();
  }

  /** Whether somebody reads the figures. */
  get isOpen() {
    return this.target.open;
  }

  /** Another scene was chosen: who draws it is decided anew, and how soon is kept beside the answer (data-decided-ms). */
  begin() {
    this.begunAt = performance.now();
    delete this.target.dataset.decidedMs;
  }

  /** @param {string | null} why the service draws, a code; null: this browser does */
  tell(why) {
    const { step, share } = this.memory;
    const { dataset } = this.target;
    const isNew = dataset.decidedMs === undefined || dataset.why !== (why ?? "");
    if (isNew) dataset.decidedMs = (performance.now() - this.begunAt).toFixed(1);
    this.target.dataset.way = why === null ? "memory" : "service";
    this.target.dataset.why = why ?? "";
    const title = why === null ? "way.here" : "way.there";
    setText(this.summary, step ? words(`way.${step}`, { share: figure(100 * share) }) : words(title));
    setText(this.reason, why === null ? words("way.here_why") : words(`way.why_${why}`));
    if (why !== null) setText(this.figures, "");
  }

  /** @param {string[]} pace how fast pictures come, while they do @param {import("./stream.js").Camera} camera of the last */
  tellFigures(pace, camera) {
    const { player } = this.memory;
    if (!player || !this.isOpen) return;
    const ms = (value) => (value === undefined ? "–" : figure(value, value < 10 ? 1 : 0));
    const { decodeMs, packMs, deformMs, sortMs, drawMs } = player.times;
    const times = { decode: ms(decodeMs + packMs), deform: ms(deformMs), sort: ms(sortMs), draw: ms(drawMs) };
    const size = { width: camera.width, height: camera.height, gpu: graphics().name };
    setText(this.figures, [...pace, words("way.figures", { ...times, ...size })].join("; "));
  }

  #word() {
    setText(this.label, words("way.choice"));
    const options = CHOICES.map((value) => new Option(words(`way.${value}`), value));
    this.choice.replaceChildren(...options);
    this.choice.value = this.memory.choice;
  }
}
