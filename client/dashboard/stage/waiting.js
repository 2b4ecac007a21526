// What is seen while a clip becomes a scene: the first frame of the user's own file until there is a picture of the
// service's, and above either one bar, with what is being done and how long it still takes.

import { setText } from "../base/element.js";
import { words } from "../base/messages.js";

/** Wider than this, or narrower, a frame shows both eyes side by side, or one above the other. */
const MAX_ASPECT = 2.2;
const MIN_ASPECT = 0.9;

export class Waiting {
  /**
   * @param {import("./screen.js").Screen} screen
   * @param {{box: HTMLElement, preview: HTMLCanvasElement}} parts
   */
  constructor(screen, { box, preview }) {
    Object.assign(this, { screen, box, preview });
    [this.text, this.bar] = box.children;
    /** @type {string | null} the job that was sent, once there is one */
    this.job = null;
    this.visit = 0; // counts clips: the frame of an earlier one is not shown
  }

  /** A clip is being sent. @param {File | undefined} clip @param {boolean} isExample the page's own */
  async begin(clip, isExample = false) {
    const visit = (this.visit += 1);
    this.job = null;
    this.tell(0, words("waiting.sending"));
    const hasFrame = clip !== undefined && (await drawFirstFrame(clip, this.preview));
    if (visit === this.visit && hasFrame) this.#cover(true, isExample);
  }

  /** @param {number | null} share of all that is to be done; null: nothing is under way @param {string} text what is done */
  tell(share, text = "") {
    this.box.hidden = share === null;
    if (share === null) return;
    this.bar.value = share;
    setText(this.text, text);
  }

  /** Whether the user's own clip stands in place of a picture. */
  get isOn() {
    return this.screen.isCovered === true;
  }

  /** There is a picture, or something else is looked at; what is under way goes on. */
  end() {
    this.visit += 1;
    this.job = null;
    this.#cover(false);
    this.tell(null);
  }

  #cover(isCovered, isExample = false) {
    this.preview.hidden = !isCovered;
    this.screen.cover(isCovered, isExample);
  }
}

/** Draw the first frame of a video, of its left or upper eye. @param {File} file @returns {Promise<boolean>} whether there is one */
async function drawFirstFrame(file, canvas) {
  const video = document.createElement("video");
  const isLoaded = new Promise((resolve) => {
    video.addEventListener("loadeddata", () => resolve(true));
    video.addEventListener("error", () => resolve(false));
  });
  Object.assign(video, { muted: true, preload: "auto", src: URL.createObjectURL(file) });
  try {
    if (!(await isLoaded) || video.videoWidth === 0) return false;
    const { videoWidth: width, videoHeight: height } = video;
    canvas.width = width / height > MAX_ASPECT ? width >> 1 : width;
    canvas.height = width / height < MIN_ASPECT ? height >> 1 : height;
    const { width: w, height: h } = canvas;
    canvas.getContext("2d").drawImage(video, 0, 0, w, h, 0, 0, w, h);
    return true;
  } finally {
    URL.revokeObjectURL(video.src);
    video.removeAttribute("src");
  }
}
