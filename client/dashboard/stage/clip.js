// What a scene tells of its clip, whoever draws it: where the endoscope was, its lens, and when frames were recorded. While a
// job works, that grows: its first picture knows one moment only.

import { getCameras } from "../base/api.js";
import { pause } from "../base/pause.js";
import { Cameras } from "../player/camera.js";

const AGAIN_MS = 1500;
const FIRST_PICTURE = "first_picture";

export class Clip {
  /** @param {(cameras: Cameras | null) => void} onKnown null: another scene is open, and nothing is known of it yet */
  constructor(onKnown) {
    this.onKnown = onKnown;
    this.#forget(null);
  }

  #forget(scene) {
    this.scene = scene;
    this.visit = {};
    this.isAsking = false;
    /** @type {Cameras | null} */
    this.cameras = null;
    /** @type {string | null} the kind of picture that is shown; null: none yet */
    this.kind = null;
    /** @type {string | null | undefined} what was shown when the scene answered last; undefined: it has not answered */
    this.asked = undefined;
    this.iteration = 0;
  }

  /** @param {string | null} scene */
  open(scene) {
    this.#forget(scene);
    this.onKnown(null);
    if (scene) this.#ask(scene, this.visit);
  }

  /** Ask the scene again where it may know more of its clip. @param {import("./stream.js").Picture} picture of the model */
  follow({ state, codes, iteration }) {
    this.kind = codes.includes(FIRST_PICTURE) ? FIRST_PICTURE : state;
    if (iteration < this.iteration) this.asked = undefined; // another attempt has begun
    this.iteration = iteration;
    if (!this.isAsking && this.#isOutdated) this.#ask(this.scene, this.visit);
  }

  get #isOutdated() {
    if (this.asked === null && this.cameras?.frameCount > 1) this.asked = this.kind; // it told all before its picture came
    return this.asked !== this.kind;
  }

  async #ask(scene, visit) {
    this.isAsking = true;
    while (this.visit === visit && this.#isOutdated) {
      const { kind } = this;
      try {
        const found = new Cameras(await getCameras(scene));
        if (this.visit !== visit) return;
        this.asked = kind;
        this.cameras = found;
        this.onKnown(found);
      } catch (error) {
        if (this.visit !== visit) return;
        if (error.mayPass) await pause(AGAIN_MS);
        else this.asked = kind; // the picture tells why there is nothing
      }
    }
    if (this.visit === visit) this.isAsking = false;
  }
}
