// Small pictures of scenes, loaded when they come into view and let go of when they leave it: the browser's own store
// keeps them meanwhile, so memory does not grow with the list.

import { getThumbnail } from "../base/api.js";
import { pause } from "../base/pause.js";

/** Begun a little before they are seen. */
const MARGIN = "300px";
/** Browsers open six connections to a place; uploads, events and the picture need theirs. */
const MAX_LOADING = 2;
const AFTER_TROUBLE_MS = 3000;
const MAX_TRIES = 5;

export class Thumbnails {
  /** @param {Element} root scrolls: a margin counts only around what is named as the root */
  constructor(root) {
    /** @type {Set<HTMLImageElement>} in view and not loaded yet */
    this.waiting = new Set();
    this.loading = 0;
    this.observer = new IntersectionObserver((entries) => this.#see(entries), { root, rootMargin: MARGIN });
  }

  /** @param {string} id of a scene @returns {HTMLImageElement} that loads itself while it can be seen */
  of(id) {
    const image = document.createElement("img");
    image.className = "thumbnail";
    image.alt = "";
    image.dataset.scene = id;
    this.observer.observe(image);
    return image;
  }

  /** @param {ParentNode} root with pictures that are not shown any more */
  letGo(root) {
    for (const image of root.querySelectorAll("img.thumbnail")) {
      this.observer.unobserve(image);
      this.#clear(image);
    }
  }

  #see(entries) {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) this.#clear(target);
      else if (!target.src) this.waiting.add(target);
    }
    this.#work();
  }

  #clear(image) {
    this.waiting.delete(image);
    delete image.dataset.loading;
    if (!image.src) return;
    URL.revokeObjectURL(image.src);
    image.removeAttribute("src");
  }

  #work() {
    for (const image of this.waiting) {
      if (this.loading >= MAX_LOADING) return;
      this.waiting.delete(image);
      this.#load(image);
    }
  }

  async #load(image) {
    this.loading += 1;
    image.dataset.loading = "";
    const isWanted = () => image.isConnected && "loading" in image.dataset;
    try {
      for (let tries = 0; tries < MAX_TRIES && isWanted(); tries++) {
        const blob = await getThumbnail(image.dataset.scene).catch((error) => error);
        if (!isWanted()) return;
        if (blob instanceof Blob) {
          image.src = URL.createObjectURL(blob);
          return;
        }
        if (!blob.mayPass) return;
        await pause(Math.max(AFTER_TROUBLE_MS, (blob.turnInS ?? 0) * 1000));
      }
    } finally {
      this.loading -= 1;
      this.#work();
    }
  }
}
