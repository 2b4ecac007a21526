// Where the viewer stands: at one of the endoscope's eyes, or turned about a point. Beyond what the clip taught, turning
// takes more and more movement, and ends at MAX_AWAY_DEG.

import { RIGHT_EYE } from "../base/spelling.js";
import { words } from "../base/messages.js";

/** @typedef {import("../player/camera.js").Cameras} Cameras */

const DEGREES_A_PIXEL = 0.15;
const MIN_ZOOM = 0.3;
const MAX_ZOOM = 8;
const MAX_MM = 10_000;
const MAX_PITCH_DEG = 89;
/** So far from the nearest pose that taught, tissue holds together: seen on scenes of fixed stereo endoscopes. */
export const TAUGHT_DEG = 20;
const MAX_AWAY_DEG = 60;
const LEAST_GIVE = 0.15;
const AHEAD = [[0, 0, 1]];
const DEGREES = 180 / Math.PI;

const STEP_PIXELS = 5;
/** Degrees: addresses have two digits after the point. */
const ROUNDING = 0.02;

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
const wrapped = (degrees) => ((((degrees + 180) % 360) + 360) % 360) - 180;
const dot = (a, b) => a.reduce((sum, each, i) => sum + each * b[i], 0);
const numbersOf = (place) => place.replace("orbit:", "").trim().split(/[,\s]+/).map(Number);
const column = (pose, j) => [0, 1, 2].map((i) => pose[i][j]);

/** @returns {number[]} the direction in which such an orbit looks */
function axisOf(yawDeg, pitchDeg) {
  const [yaw, pitch] = [-yawDeg / DEGREES, -pitchDeg / DEGREES];
  return [Math.sin(yaw) * Math.cos(pitch), -Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
}

/** @param {number[]} axis @returns {[number, number]} yaw and pitch of an orbit that looks along it, degrees */
const anglesOf = (axis) => [-Math.atan2(axis[0], axis[2]) * DEGREES, Math.asin(clamp(axis[1], -1, 1)) * DEGREES];

export class Orbit {
  /** @param {() => number} now the time that is shown, t */
  constructor(now) {
    this.now = now;
    this.goHome();
    this.know(null);
  }

  /**
   * @param {Cameras | null} cameras of the scene; null while they are not known
   * @returns {boolean} false: nobody may stand where the viewer stood, who is at the endoscope now
   */
  know(cameras) {
    this.cameras = cameras;
    this.taught = cameras ? cameras.trainedFrames.map((frame) => column(cameras.poses[frame], 2)) : AHEAD;
    if (this.taught.length === 0) this.taught = AHEAD;
    if (cameras === null) return true;
    const isAllowed = this.isRight ? this.hasRightEye : this.given !== null || this.awayDeg() <= MAX_AWAY_DEG + ROUNDING;
    if (!isAllowed) this.goHome();
    return isAllowed;
  }

  /** Back to the endoscope's own pose, which moves with t. */
  goHome() {
    this.isHome = true;
    this.isRight = false;
    this.yaw = 0;
    this.pitch = 0;
    this.zoom = 1;
    /** @type {number[] | null} the point looked at, mm; null: at the median depth before frame 0 */
    this.about = null;
    /** @type {string | null} world_from_camera as the service spells it, in place of all that, until somebody moves */
    this.given = null;
  }

  get hasRightEye() {
    return this.cameras?.rightEyeMm != null;
  }

  /** @param {boolean} isRight see through the endoscope's right eye instead of its left one */
  seeRight(isRight) {
    this.goHome();
    this.isRight = isRight;
  }

  /** Leave the endoscope, from where it is. */
  leave() {
    if (!this.isHome && !this.given) return;
    const pose = this.#stood();
    this.isHome = this.isRight = false;
    this.given = null;
    if (!pose || !this.cameras) return;
    const axis = column(pose, 2);
    [this.yaw, this.pitch] = anglesOf(axis);
    this.about = axis.map((each, i) => pose[i][3] + each * this.cameras.depthMm);
  }

  /** @returns {number[][] | null} world_from_camera before the viewer leaves; null: where frame 0 was */
  #stood() {
    if (this.given) {
      const numbers = numbersOf(this.given);
      return [0, 4, 8].map((i) => numbers.slice(i, i + 4));
    }
    if (this.isRight && this.hasRightEye) return this.cameras.rightEye(this.now());
    return this.cameras?.moves ? this.cameras.endoscope(this.now()) : null;
  }

  /** @returns {number} degrees from the nearest pose that taught */
  awayDeg(yaw = this.yaw, pitch = this.pitch) {
    if (this.isHome) return 0;
    const axis = this.given ? column(this.#stood(), 2) : axisOf(yaw, pitch);
    return Math.acos(clamp(Math.max(...this.taught.map((each) => dot(each, axis))), -1, 1)) * DEGREES;
  }

  /** @returns {[number, number]} yaw and pitch of the pose that taught and is nearest, degrees */
  nearestTaught() {
    const axis = axisOf(this.yaw, this.pitch);
    const nearest = this.taught.reduce((a, b) => (dot(b, axis) > dot(a, axis) ? b : a));
    return anglesOf(nearest);
  }

  /** Whether this is farther from the clip's poses than what they taught. */
  get isBeyond() {
    return this.awayDeg() > TAUGHT_DEG;
  }

  /** @param {number} dx pixels to the right @param {number} dy pixels down */
  turn(dx, dy) {
    this.leave();
    const steps = Math.ceil(Math.max(Math.abs(dx), Math.abs(dy)) / STEP_PIXELS);
    for (let i = 0; i < steps; i++) this.#turnStep((dx / steps) * DEGREES_A_PIXEL, (dy / steps) * DEGREES_A_PIXEL);
  }

  #turnStep(right, down) {
    const away = this.awayDeg();
    const turned = (give) => [wrapped(this.yaw - right * give), clamp(this.pitch + down * give, -MAX_PITCH_DEG, MAX_PITCH_DEG)];
    let place = turned(1);
    const wanted = this.awayDeg(...place);
    if (wanted > away && wanted > TAUGHT_DEG) {
      place = turned(clamp((MAX_AWAY_DEG - away) / (MAX_AWAY_DEG - TAUGHT_DEG), LEAST_GIVE, 1));
      if (this.awayDeg(...place) > MAX_AWAY_DEG) return;
    }
    [this.yaw, this.pitch] = place;
  }

  /** @param {number} factor above 1: nearer */
  approach(factor) {
    this.leave();
    this.zoom = clamp(this.zoom * factor, MIN_ZOOM, MAX_ZOOM);
  }

  /**
   * Move what is looked at parallel to the picture, which follows the pointer.
   * @param {number} dx pixels of the clip's camera to the right @param {number} dy down
   */
  pan(dx, dy) {
    if (!this.cameras) return;
    this.leave();
    const { depthMm, intrinsics } = this.cameras;
    const pose = this.cameras.orbit(this.yaw, this.pitch, this.zoom);
    const [right, down] = [column(pose, 0), column(pose, 1)];
    const [x, y] = [dx / intrinsics.fx, dy / intrinsics.fy].map((each) => (each * depthMm) / this.zoom);
    this.#lookAt((this.about ?? [0, 0, depthMm]).map((each, i) => each - right[i] * x - down[i] * y));
  }

  /** Look at a point, from the same side and as near as the zoom says. @param {number[]} point x, y, z, mm */
  focus(point) {
    this.leave();
    this.#lookAt(point);
  }

  #lookAt(point) {
    this.about = point.map((each) => clamp(each, -MAX_MM, MAX_MM));
  }

  /** @returns {string | null} as an address spells it; null is the endoscope's own, left */
  get place() {
    if (this.isHome) return this.isRight ? RIGHT_EYE : null;
    if (this.given) return this.given;
    const about = this.about ? `,${this.about.map((each) => each.toFixed(2)).join(",")}` : "";
    return `orbit:${this.yaw.toFixed(2)},${this.pitch.toFixed(2)},${this.zoom.toFixed(3)}${about}`;
  }

  /** @returns {string | null} as the service spells a pose; null is the endoscope's own, of the eye */
  get pose() {
    return this.isHome ? null : this.place;
  }

  /** @returns {"left"|"right"} the eye of the endoscope that the viewer looks through, at home */
  get eye() {
    return this.isRight && this.hasRightEye ? "right" : "left";
  }

  /**
   * Stand at a place.
   * @param {string | null} place as an address or the service spells it; null is the endoscope's own
   * @returns {boolean} false: nobody may stand there; the viewer is at the endoscope
   */
  stand(place) {
    this.seeRight(place === RIGHT_EYE);
    if (place === null || this.isRight) return this.know(this.cameras);
    const numbers = numbersOf(place);
    if (!numbers.every(Number.isFinite)) return false;
    if (!place.startsWith("orbit:")) {
      Object.assign(this, { isHome: false, given: place });
      return true;
    }
    const [yaw, pitch, zoom, ...about] = numbers;
    if (Math.abs(pitch) > MAX_PITCH_DEG || zoom < MIN_ZOOM || zoom > MAX_ZOOM) return false;
    Object.assign(this, { isHome: false, yaw: wrapped(yaw), pitch, zoom, about: about.length === 3 ? about : null });
    return this.know(this.cameras);
  }

  /** @returns {string} */
  get words() {
    if (this.isHome) return words(this.isRight ? "view.right_eye" : "view.endoscope");
    if (this.given) return words("view.elsewhere");
    const signed = (degrees) => `${degrees > 0 ? "+" : ""}${degrees.toFixed(0)}°`;
    const turned = words("view.turned", { yaw: signed(this.yaw), pitch: signed(this.pitch), zoom: this.zoom.toFixed(2) });
    return this.isBeyond ? `${turned} · ${words("view.beyond")}` : turned;
  }
}
