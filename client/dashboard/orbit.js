// Where the viewer stands: at the endoscope, or turned about what it looks at.

const DEGREES_A_PIXEL = 0.15;
const MAX_DEGREES = 60;
const MIN_ZOOM = 0.3;
const MAX_ZOOM = 4;

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

export class Orbit {
  constructor() {
    this.goHome();
  }

  /** Back to the endoscope's own pose, which moves with t. */
  goHome() {
    this.isHome = true;
    this.yaw = 0;
    this.pitch = 0;
    this.zoom = 1;
    /** @type {string | null} a pose of another form, until somebody turns or approaches */
    this.given = null;
  }

  /** @param {string | null} pose as the service spells it; null is the endoscope's own */
  stand(pose) {
    this.goHome();
    if (pose === null) return;
    this.isHome = false;
    if (pose.startsWith("orbit:")) [this.yaw, this.pitch, this.zoom] = pose.slice(6).split(/[,\s]+/).map(Number);
    else this.given = pose;
  }

  /** @param {number} dx pixels to the right @param {number} dy pixels down */
  turn(dx, dy) {
    this.isHome = false;
    this.given = null;
    this.yaw = clamp(this.yaw - dx * DEGREES_A_PIXEL, -MAX_DEGREES, MAX_DEGREES);
    this.pitch = clamp(this.pitch + dy * DEGREES_A_PIXEL, -MAX_DEGREES, MAX_DEGREES);
  }

  /** @param {number} factor above 1: nearer */
  approach(factor) {
    this.isHome = false;
    this.given = null;
    this.zoom = clamp(this.zoom * factor, MIN_ZOOM, MAX_ZOOM);
  }

  /** @returns {string | null} as the service spells a pose; null is the endoscope's own */
  get pose() {
    if (this.given !== null) return this.given;
    return this.isHome ? null : `orbit:${this.yaw.toFixed(2)},${this.pitch.toFixed(2)},${this.zoom.toFixed(3)}`;
  }

  /** @returns {string} */
  get words() {
    if (this.isHome) return "endoscope's view";
    const signed = (degrees) => `${degrees > 0 ? "+" : ""}${degrees.toFixed(0)}°`;
    return `turned ${signed(this.yaw)}, ${signed(this.pitch)} · ${this.zoom.toFixed(2)}×`;
  }
}
