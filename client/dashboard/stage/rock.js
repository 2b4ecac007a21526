// Turning to and fro by itself, so that depth is seen without a hand: about where the viewer stands, or as near to it as stays
// within what the clip taught. It ends when anything else moves the viewer.

import { TAUGHT_DEG } from "./orbit.js";

const ROCK_DEG = 8;
const PERIOD_MS = 4000;
const STEPS = 20;

/** @param {import("./orbit.js").Orbit} orbit @returns {[number, number]} yaw and pitch about which it rocks, degrees */
function middleOf(orbit) {
  const { yaw, pitch } = orbit;
  const [toYaw, toPitch] = orbit.nearestTaught();
  for (let step = 0; step <= STEPS; step++) {
    const [y, p] = [yaw + (step / STEPS) * (toYaw - yaw), pitch + (step / STEPS) * (toPitch - pitch)];
    if (Math.max(orbit.awayDeg(y - ROCK_DEG, p), orbit.awayDeg(y + ROCK_DEG, p)) <= TAUGHT_DEG) return [y, p];
  }
  return [toYaw, toPitch];
}

export class Rock {
  /**
   * @param {import("./orbit.js").Orbit} orbit
   * @param {() => void} onTurn told of each step
   * @param {() => void} onChange told when it begins or ends
   */
  constructor(orbit, onTurn, onChange) {
    Object.assign(this, { orbit, onTurn, onChange, isOn: false });
  }

  /** Begin, or end and go back to where it began. */
  toggle() {
    if (!this.isOn) return this.#begin();
    const { began } = this;
    this.stop();
    this.orbit.stand(began);
    this.onTurn();
  }

  /** End where the viewer stands. */
  stop() {
    if (!this.isOn) return;
    this.isOn = false;
    this.onChange();
  }

  #begin() {
    this.began = this.orbit.place;
    this.orbit.leave();
    [this.yaw, this.orbit.pitch] = middleOf(this.orbit);
    this.isOn = true;
    this.place = this.orbit.place;
    const run = (this.run = {}); // a second start ends the first
    const began = performance.now();
    const step = (now) => {
      if (!this.isOn || this.run !== run) return;
      if (this.orbit.place !== this.place) return this.stop();
      this.orbit.yaw = this.yaw + ROCK_DEG * Math.sin((2 * Math.PI * Math.max(0, now - began)) / PERIOD_MS);
      this.place = this.orbit.place;
      this.onTurn();
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
    this.onChange();
  }
}
