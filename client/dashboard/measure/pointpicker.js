// Points of a picture: chosen by clicks, or by Enter at a cross that the arrow keys move; Escape ends.

import { toPicture } from "./places.js";

const STEP_PX = 10;
const FINE_STEP_PX = 1;
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/**
 * Who picks points. clickPx: a pointer that moves less between down and up has clicked, and turns nothing.
 * isOn: whether points are picked now. camera: that of the picture in view; null: none is.
 * @typedef {{clickPx: number, isOn: () => boolean, camera: () => {width: number, height: number} | null,
 *   isPicture?: (target: EventTarget) => boolean, onPoint: (point: [number, number]) => void, onOutside?: () => void,
 *   onCross: () => void, onEnd: () => void}} Picking
 */

export class PointPicker {
  /**
   * @param {{stage: HTMLElement, canvas: HTMLElement}} parts
   * @param {Picking} picking
   */
  constructor({ stage, canvas }, picking) {
    Object.assign(this, { stage, canvas, picking });
    this.forget();
    this.#listenToPointer();
    document.addEventListener("keydown", (event) => this.#key(event), { capture: true });
  }

  /** Where the keys' cross is in a picture; null: no key has moved it. @returns {[number, number] | null} */
  crossIn(camera) {
    return this.cross && this.#placeIn(camera);
  }

  forget() {
    this.cross = null; // in shares of the picture, whose size may change
  }

  /** Clicks choose; what moves farther goes on to whoever turns the view. */
  #listenToPointer() {
    const { stage, canvas } = this;
    const { clickPx, isOn, camera, isPicture = () => true, onPoint, onOutside = () => {} } = this.picking;
    let began = null;
    const isNear = ({ clientX, clientY }) => began && Math.hypot(clientX - began[0], clientY - began[1]) < clickPx;
    const first = { capture: true };
    stage.addEventListener("pointerdown", (event) => {
      const isOurs = isOn() && event.isPrimary && event.button === 0 && isPicture(event.target);
      began = isOurs ? [event.clientX, event.clientY] : null;
    }, first);
    stage.addEventListener("pointermove", (event) => {
      if (isNear(event)) event.stopImmediatePropagation();
      else if (event.buttons !== 0) began = null;
    }, first);
    stage.addEventListener("pointerup", (event) => {
      const isClick = isOn() && isNear(event);
      began = null;
      if (!isClick) return;
      const point = camera() && toPicture(canvas, camera(), [event.clientX, event.clientY]);
      if (point) onPoint(point);
      else onOutside();
    }, first);
  }

  #key(event) {
    const { isOn, camera, onPoint, onCross, onEnd } = this.picking;
    if (!isOn() || event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (event.key === "Escape" && document.querySelector(".drawers > .drawer:not([hidden])")) return; // it closes first
    if (event.key === "Escape") onEnd();
    else if (event.target !== this.stage || !camera()) return;
    else if (event.key === "Enter") onPoint(this.#placeIn(camera()));
    else if (STEPS[event.key]) {
      this.#move(camera(), STEPS[event.key], event.shiftKey ? FINE_STEP_PX : STEP_PX);
      onCross();
    } else return;
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  #placeIn({ width, height }) {
    const [x, y] = (this.cross ??= [0.5, 0.5]);
    return [x * width, y * height];
  }

  #move(camera, [right, down], step) {
    const [x, y] = this.#placeIn(camera);
    const within = (value, size) => Math.min(Math.max(value, 0.5), size - 0.5) / size;
    this.cross = [within(x + right * step, camera.width), within(y + down * step, camera.height)];
  }
}
