// Opens the brush, whose modules are loaded when it is wanted first.

import { storeStrokes } from "../base/drafts.js";
import { connectionLost } from "../base/problem.js";

export class Painting {
  /** @type {typeof import("../masks/brush.js") | null} */
  #brush = null;

  /**
   * @param {import("../stage/viewer.js").Viewer} viewer stands still while masks are painted
   * @param {(text: string) => void} onFailure told when the modules cannot be loaded
   * @param {() => boolean} isSending whether a clip is being sent, so that no other can be
   * @param {(id: string, masks: File) => void} onMasks given the masks of a scene
   */
  constructor(viewer, onFailure, isSending, onMasks) {
    Object.assign(this, { viewer, onFailure, isSending, onMasks });
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
    this.#brush.openBrush(id, found, this.isSending, (masks) => this.onMasks(id, masks));
  }

  /** Forget the strokes that were sent: those of the scene whose clip got other masks. @param {import("../form/sending.js").Plan} plan */
  forget({ submission, files }) {
    if (submission.clip_of && files.some(({ part }) => part === "masks")) storeStrokes(submission.clip_of, []);
  }
}
