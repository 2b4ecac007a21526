// The past that can be looked at, now at its right edge: drag back, and the model shows that moment.

import { clockTime, draw, setText } from "../base/element.js";
import { figure, words } from "../base/messages.js";

/** Lengths of the tape, s: the shortest that holds the past. */
const SPANS_S = [30, 60, 120, 300, 600, 1200, 1800, 3600];
const TICKS = 5;
/** A thumb so near to a mark goes to it, in shares of the tape. */
const SNAP = 0.012;
const MAX_MARKS = 50;
/** Of the drawing, which is stretched over the tape. */
const WIDTH = 1000;

/** @typedef {{atS: number, kind: "frozen"|"kept", fromS?: number}} Mark */

export class Tape {
  /**
   * @param {{slider: HTMLInputElement, svg: SVGSVGElement, ticks: HTMLElement}} parts
   * @param {import("./look.js").Look} look
   * @param {import("./clock.js").FeedClock} clock
   */
  constructor({ slider, svg, ticks }, look, clock) {
    Object.assign(this, { slider, svg, ticks, look, clock, isDragged: false });
    this.forget();
    slider.addEventListener("pointerdown", () => (this.isDragged = true));
    for (const end of ["pointerup", "pointercancel", "change"]) {
      slider.addEventListener(end, () => (this.isDragged = false));
    }
    slider.addEventListener("input", () => look.lookBack(this.#snapped(-Number(slider.value))));
  }

  forget() {
    /** @type {Mark[]} */
    this.marks = [];
    this.drawn = "";
  }

  /** @param {Mark} mark */
  mark(mark) {
    this.marks = [...this.marks, mark].slice(-MAX_MARKS);
  }

  #snapped(backS) {
    const nowS = this.clock.nowS;
    const near = this.marks.find(({ atS }) => Math.abs(nowS - atS - backS) < SNAP * this.spanS);
    return near && backS > 0 ? nowS - near.atS : backS;
  }

  /** @param {import("./feeds.js").Feed | null} feed */
  refresh(feed) {
    const nowS = this.clock.nowS;
    const pastS = feed?.begins_s == null ? 0 : Math.max(0, nowS - feed.begins_s);
    this.spanS = SPANS_S.find((each) => each >= pastS) ?? SPANS_S.at(-1);
    this.slider.disabled = pastS === 0;
    this.slider.min = String(-this.spanS);
    const { behindS } = this.look;
    if (!this.isDragged) this.slider.value = String(-behindS);
    const at = { s: figure(behindS), time: clockTime(1000 * (nowS - behindS)) };
    this.slider.setAttribute("aria-valuetext", behindS > 0 ? words("live.tape_at", at) : words("live.tape_now"));
    this.#draw(nowS, pastS, feed?.ends_s ?? nowS);
    this.#label();
  }

  #draw(nowS, pastS, endsS) {
    const { svg } = this;
    const place = (atS) => WIDTH * (1 - (nowS - atS) / this.spanS);
    svg.replaceChildren();
    const known = { x: Math.max(0, WIDTH * (1 - pastS / this.spanS)), y: 22, height: 20 };
    draw(svg, "rect", { class: "known", ...known, width: Math.max(0, Math.min(WIDTH, place(endsS)) - known.x) });
    for (const { atS, kind, fromS = atS } of this.marks) {
      if (place(atS) < 0) continue;
      const x = Math.max(0, place(fromS));
      const rows = kind === "kept" ? { y: 44, height: 8 } : { y: 8, height: 14 };
      draw(svg, "rect", { class: kind, x, ...rows, width: Math.max(3, place(atS) - x) });
    }
    const { behindS } = this.look;
    const gap = { x: place(nowS - behindS), y: 22, width: (WIDTH * behindS) / this.spanS, height: 20 };
    if (behindS > 0) draw(svg, "rect", { class: "gap", ...gap });
    draw(svg, "rect", { class: "now", x: WIDTH - 4, y: 8, width: 4, height: 48 });
  }

  #label() {
    const texts = Array.from({ length: TICKS }, (_, i) => (this.spanS * (TICKS - 1 - i)) / (TICKS - 1));
    const key = texts.join() + words("live.tape_now");
    if (this.drawn === key) return;
    this.drawn = key;
    const isMinutes = this.spanS >= 120;
    const minutes = (s) => [Math.floor(s / 60), ...(s % 60 ? [String(Math.round(s % 60)).padStart(2, "0")] : [])].join(":");
    for (const [i, each] of [...this.ticks.children].entries()) {
      const text = isMinutes
        ? words("live.minutes_ago", { min: minutes(texts[i]) })
        : words("live.seconds_ago", { s: figure(texts[i], texts[i] % 1 ? 1 : 0) });
      setText(each, texts[i] === 0 ? words("live.tape_now") : text);
    }
  }
}
