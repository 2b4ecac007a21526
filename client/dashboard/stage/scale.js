// A scale bar in mm at the depth of the picture's middle. It says which depth that is, and goes where none is known.

import { getMeasurement } from "../base/api.js";
import { figure, languageEvents, words } from "../base/messages.js";
import { isMeasurable, queryOf, sameView, screenScale } from "../measure/places.js";

/** Asked for at most so often, also while playing. */
const EVERY_MS = 1000;
const MAX_SHARE = 0.25;
const LENGTHS_MM = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200];

/** Whether two views are of the same scene from the same place; the times may differ. */
const isSamePlace = (a, b) => a.scene === b.scene && a.pose === b.pose && a.eye === b.eye;

export class Scale {
  /**
   * @param {import("./viewer.js").Viewer} viewer
   * @param {{canvas: HTMLElement, box: HTMLElement}} parts box: with .bar and .about
   */
  constructor(viewer, { canvas, box }) {
    Object.assign(this, { viewer, canvas, box });
    this.bar = box.querySelector(".bar");
    this.about = box.querySelector(".about");
    this.known = null; // the view, and its middle point as it was measured
    this.wanted = 0;
    this.askedAt = -Infinity;
    viewer.addEventListener("shown", ({ detail }) => this.#follow(detail));
    viewer.addEventListener("gone", () => this.#forget());
    languageEvents.addEventListener("changed", () => this.#draw());
    new ResizeObserver(() => this.#draw()).observe(canvas);
  }

  #forget() {
    clearTimeout(this.wanted);
    this.wanted = 0;
    this.known = null;
    this.#draw();
  }

  #follow(shown) {
    if (!isMeasurable(shown)) return this.#forget();
    const { known } = this;
    if (known && !isSamePlace(known.shown, shown)) this.known = null;
    this.#draw();
    if (this.wanted || sameView(shown, this.known?.shown ?? null)) return;
    this.wanted = setTimeout(() => this.#ask(), Math.max(0, this.askedAt + EVERY_MS - performance.now()));
  }

  async #ask() {
    const { shown } = this.viewer;
    this.askedAt = performance.now();
    try {
      if (!isMeasurable(shown)) return;
      const { width, height } = shown.camera;
      const { points } = await getMeasurement(shown.scene, queryOf(shown, [[width / 2, height / 2]]));
      const now = this.viewer.shown;
      if (now && isSamePlace(now, shown)) this.known = { shown, point: points[0] };
    } catch {
      this.known = null; // the picture's own state says what is wrong
    } finally {
      this.wanted = 0;
      this.#draw();
      const now = this.viewer.shown;
      if (now && this.known && !sameView(now, this.known.shown)) this.#follow(now);
    }
  }

  #draw() {
    const point = this.known?.point;
    this.box.hidden = !point || point.refusal !== null;
    if (this.box.hidden) return;
    const { camera } = this.known.shown;
    const scale = screenScale(this.canvas, camera);
    const pxPerMm = scale / point.mm_per_px;
    const longest = MAX_SHARE * scale * camera.width;
    const length = LENGTHS_MM.findLast((each) => each * pxPerMm <= longest) ?? LENGTHS_MM[0];
    this.bar.style.width = `${(length * pxPerMm).toFixed(1)}px`;
    this.about.textContent = words("measure.scale", {
      length: figure(length, length < 1 ? 1 : 0),
      depth: figure(point.depth_mm, 0),
    });
  }
}
