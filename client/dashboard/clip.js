// What a scene tells of its clip, whoever draws it: where the endoscope was, its lens, and when frames were recorded.

import { getCameras } from "./api.js";
import { pause } from "./pause.js";
import { Cameras } from "./player/camera.js";

const AGAIN_MS = 1500;

export class Clip {
  /** @param {(cameras: Cameras | null) => void} onKnown null: another scene is open, and nothing is known of it yet */
  constructor(onKnown) {
    this.onKnown = onKnown;
    this.scene = null;
    /** @type {Cameras | null} */
    this.cameras = null;
  }

  /** @param {string | null} scene */
  async open(scene) {
    this.scene = scene;
    this.cameras = null;
    this.onKnown(null);
    const visit = (this.visit = {});
    while (scene && this.visit === visit) {
      try {
        const found = new Cameras(await getCameras(scene));
        if (this.visit !== visit) return;
        this.cameras = found;
        return this.onKnown(found);
      } catch (error) {
        if (this.visit !== visit || !error.mayPass) return; // the picture tells why there is nothing
        await pause(AGAIN_MS);
      }
    }
  }
}
