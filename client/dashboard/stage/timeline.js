// The clip's time in seconds and frames: a slider with one place a frame, steps, speeds, and a loop over all or a part.

import { figure, languageEvents, words } from "../base/messages.js";

/** @typedef {import("../player/camera.js").Cameras} Cameras */

/** While a scene has not told its times. */
const PLACES = 200;
const LOOP_S = 5;
/** Times as fast as the clip. */
export const SPEEDS = [0.25, 0.5, 1, 2];

export class Timeline {
  /**
   * @param {{time: HTMLInputElement, timeValue: HTMLElement, play: HTMLButtonElement, speed: HTMLSelectElement,
   *   loop: HTMLElement, loopStart: HTMLButtonElement, loopEnd: HTMLButtonElement, loopAll: HTMLButtonElement}} parts
   * @param {() => void} onChange
   * @param {() => boolean} isBusy whether another picture would only have to wait
   * @param {() => boolean} [isStale] whether the picture stands for want of the service: time stands with it
   */
  constructor(parts, onChange, isBusy, isStale = () => false) {
    Object.assign(this, { parts, onChange, isBusy, isStale });
    this.t = 0;
    this.isPlaying = false;
    this.playEvents = new EventTarget();
    this.know(null);
    parts.time.addEventListener("input", () => this.goTo(Number(parts.time.value)));
    parts.play.addEventListener("click", () => this.play(!this.isPlaying));
    parts.loopStart.addEventListener("click", () => this.startLoop());
    parts.loopEnd.addEventListener("click", () => this.endLoop());
    parts.loopAll.addEventListener("click", () => this.loopAll());
    languageEvents.addEventListener("changed", () => this.#show());
  }

  /** @param {Cameras | null} cameras of the scene, which know its times; null while they are not known */
  know(cameras) {
    const { count } = this;
    this.cameras = cameras;
    this.parts.time.max = String(this.count - 1);
    if (cameras && this.count === count) this.#show(); // told once more: the loop stays
    else this.loopAll();
  }

  /** Frames; while they are not known, places. */
  get count() {
    return this.cameras?.frameCount ?? PLACES;
  }

  /** Seconds from the first frame to the last. */
  get durationS() {
    return this.cameras ? this.cameras.seconds(1) - this.cameras.seconds(0) : LOOP_S;
  }

  /** The frame nearest to t, from 0. */
  get frame() {
    return this.#frameAt(this.t);
  }

  #frameAt(t) {
    return Math.min(this.count - 1, Math.round(t * this.count));
  }

  #seconds(t) {
    return this.cameras ? this.cameras.seconds(t) - this.cameras.seconds(0) : t * LOOP_S;
  }

  /** @param {number} t from 0, the first frame, to 1, the end */
  set(t) {
    this.t = t;
    this.#show();
    this.onChange();
  }

  /** Stop at a frame. @param {number} frame from 0 */
  goTo(frame) {
    this.play(false);
    this.set(Math.min(this.count - 1, Math.max(0, frame)) / this.count);
  }

  /** @param {number} frames on, or back */
  step(frames) {
    this.goTo(this.frame + frames);
  }

  /** @param {number} steps among SPEEDS */
  changeSpeed(steps) {
    const { speed } = this.parts;
    speed.selectedIndex = Math.min(SPEEDS.length - 1, Math.max(0, speed.selectedIndex + steps));
  }

  /** Let the loop begin here; end here, if it is to end before. After a loop that ends before, a new one begins. */
  startLoop() {
    const { frame, first, last } = this;
    if (frame === last) return; // a loop of one frame is none
    if (frame < last) this.#loop(frame, last);
    else if (first === 0) this.#loop(last, frame);
    else this.#loop(frame, this.count - 1);
  }

  /** Let the loop end here; begin here, if it is to begin later. Before a loop that begins later, a new one ends. */
  endLoop() {
    const { frame, first, last } = this;
    if (frame === first) return;
    if (frame > first) this.#loop(first, frame);
    else if (last === this.count - 1) this.#loop(frame, first);
    else this.#loop(0, frame);
  }

  /** Let the loop be the whole clip. */
  loopAll() {
    this.#loop(0, this.count - 1);
  }

  #loop(first, last) {
    if (first >= last) [first, last] = [0, this.count - 1]; // a loop of one frame is none
    [this.first, this.last] = [first, last];
    const { loop, loopAll } = this.parts;
    loop.hidden = loopAll.hidden = first === 0 && last === this.count - 1;
    const share = (frame) => frame / Math.max(1, this.count - 1);
    loop.style.setProperty("--first", String(share(first)));
    loop.style.setProperty("--last", String(share(last)));
    this.#show();
  }

  /** @param {boolean} isPlaying */
  play(isPlaying) {
    const { play } = this.parts;
    const isNew = this.isPlaying !== isPlaying;
    this.isPlaying = isPlaying;
    this.#show();
    play.setAttribute("aria-pressed", String(isPlaying));
    if (isPlaying) this.#run();
    if (isNew) this.playEvents.dispatchEvent(new Event("changed"));
  }

  /** In the clip's own time: a loop takes as long as it took, times the speed. */
  #run() {
    let before = performance.now();
    const run = (this.run = {}); // a second start ends the first
    const step = (now) => {
      if (!this.isPlaying || this.run !== run) return;
      if (this.isStale()) before = now;
      else if (!this.isBusy()) {
        const elapsedS = (Math.max(0, now - before) / 1000) * Number(this.parts.speed.value);
        before = now;
        this.set(this.#after(elapsedS));
      }
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  /** @returns {number} t, so many seconds later in the loop */
  #after(elapsedS) {
    const [from, to] = [this.first, this.last].map((frame) => this.#seconds(frame / this.count));
    if (to <= from) return this.t;
    const at = this.#seconds(this.t) - from + elapsedS;
    const seconds = from + (at < 0 ? 0 : at % (to - from));
    return this.cameras ? this.cameras.timeAt(seconds) : seconds / LOOP_S;
  }

  #show() {
    const { time, timeValue, play } = this.parts;
    play.textContent = words(this.isPlaying ? "time.pause" : "time.play");
    time.value = String(this.frame);
    const text = this.#placeOf(this.t);
    timeValue.textContent = text;
    time.setAttribute("aria-valuetext", text);
  }

  /** @param {number} t @returns {string} the moment, in seconds; empty while they are not known */
  momentOf(t) {
    return this.cameras ? words("time.moment", { seconds: figure(this.#seconds(t), 2) }) : "";
  }

  /** @param {number} t @returns {string} where in the clip that is */
  #placeOf(t) {
    if (!this.cameras) return this.momentOf(t);
    const [seconds, duration] = [this.#seconds(t), this.durationS].map((each) => figure(each, 2));
    return words("time.place", { seconds, duration, frame: this.#frameAt(t) + 1, frames: this.count });
  }
}
