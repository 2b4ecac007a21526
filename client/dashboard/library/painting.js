// Opens the brush, whose modules are loaded when it is wanted first.

import { connectionLost } from "../base/problem.js";

export class Painting {
  /** @type {typeof import("../masks/brush.js") | null} */
  #brush = null;

  /**
   * @param {import("../stage/viewer.js").Viewer} viewer stands still while masks are painted
   * @param {(text: string) => void} onFailure told when the modules cannot be loaded
   * @param {(id: string, masks: File) => void} onMasks given the masks of a scene
   */
  constructor(viewer, onFailure, onMasks) {
    this.viewer = viewer;
    this.onFailure = onFailure;
    this.onMasks = onMasks;
  }

  /** @param {string} id a scene @param {import("../base/wire.js").Report} found its report */
  async open(id, found) {
    this.viewer.timeline.play(false);
    try {
      this.#brush ??= await import("../masks/brush.js");
      await this.#brush.styled();
    } catch {
      return this.onFailure(connectionLost().message);
    }
    this.#brush.openBrush(id, found, (masks) => this.onMasks(id, masks));
  }

  /** Forget the strokes, which were sent. */
  forget() {
    this.#brush?.forgetStrokes();
  }
}
