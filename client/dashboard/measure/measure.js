// The tool "Measure": two points of the tissue, their distance in mm with its uncertainty, followed in time. For
// research alone, as it says.

import { getMeasurement } from "../base/api.js";
import { figure, language, languageEvents, words } from "../base/messages.js";
import { drawDistances, markTime } from "./distances.js";
import { Overlay } from "./overlay.js";
import { isMeasurable, queryOf, sameView } from "./places.js";
import { PointPicker } from "./pointpicker.js";
import { readingOf } from "./probe.js";

/** A pointer that moves less between down and up has clicked, and turns nothing. */
const CLICK_PX = 6;

export class Measure {
  /**
   * @param {import("../stage/viewer.js").Viewer} viewer
   * @param {{stage: HTMLElement, canvas: HTMLElement, over: HTMLElement, button: HTMLButtonElement,
   *   panel: HTMLElement}} parts panel: with .told, .distance, .again, .end and svg
   */
  constructor(viewer, parts) {
    this.viewer = viewer;
    this.parts = parts;
    this.overlay = new Overlay(parts.over, parts.canvas);
    this.isOn = false;
    this.picker = new PointPicker(parts, {
      clickPx: CLICK_PX,
      isOn: () => this.isOn,
      camera: () => this.viewer.shown?.camera ?? null,
      isPicture: (target) => target === parts.stage || target.tagName === "CANVAS",
      onPoint: (point) => this.choose(point),
      onOutside: () => this.#tell("measure.outside"),
      onCross: () => this.#draw(),
      onEnd: () => this.end(),
    });
    this.#clear();
    viewer.addEventListener("shown", ({ detail }) => this.#follow(detail));
    viewer.addEventListener("gone", () => this.end());
    languageEvents.addEventListener("changed", () => this.isOn && this.#say());
    new ResizeObserver(() => this.#draw()).observe(parts.canvas);
    parts.button.addEventListener("click", () => this.toggle());
    parts.panel.querySelector(".again").addEventListener("click", () => this.start());
    parts.panel.querySelector(".end").addEventListener("click", () => this.end());
    const notTwice = (event) => this.isOn && event.stopImmediatePropagation();
    parts.stage.addEventListener("dblclick", notTwice, { capture: true });
  }

  toggle() {
    if (this.isOn) this.end();
    else this.start();
  }

  /** Choose two points. */
  start() {
    this.isOn = true;
    this.#clear();
    this.viewer.timeline.play(false);
    this.viewer.rock.stop();
    this.parts.panel.hidden = false;
    this.parts.button.setAttribute("aria-pressed", "true");
    this.parts.stage.toggleAttribute("data-measuring", true);
    this.#tell(isMeasurable(this.viewer.shown) ? "measure.first" : "measure.not_here");
    this.parts.stage.focus();
  }

  end() {
    const hadFocus = this.parts.panel.contains(document.activeElement);
    this.isOn = false;
    this.#clear();
    this.parts.panel.hidden = true;
    this.parts.button.setAttribute("aria-pressed", "false");
    this.parts.stage.removeAttribute("data-measuring");
    this.overlay.clear();
    if (hadFocus) this.parts.button.focus();
  }

  #clear() {
    this.chosen = []; // points of the picture of this.view
    this.view = null; // in which they were chosen
    this.found = null; // the distance of both
    this.picker.forget();
    this.asked = {}; // replaced by each question: earlier answers are for nobody
    this.#say();
  }

  /** @param {string} place of the words to show @param {Record<string, string>} [values] */
  #tell(place, values = {}) {
    this.told = { place, values };
    this.#say();
  }

  #say() {
    const { panel } = this.parts;
    const { place, values } = this.told ?? { place: "measure.first", values: {} };
    panel.querySelector(".told").textContent = words(place, values);
    const now = this.found && this.#now();
    panel.querySelector(".distance").textContent = !this.found
      ? ""
      : now === null
        ? words("measure.away")
        : words("measure.distance", { mm: figure(now.mm, 1), sigma: figure(now.sigma, 1) });
    this.#drawCurve();
  }

  /** Anew only when it is another's, or in another language. */
  #drawCurve() {
    const svg = this.parts.panel.querySelector("svg");
    if (this.drawn !== this.found || this.drawnIn !== language()) drawDistances(svg, this.found);
    [this.drawn, this.drawnIn] = [this.found, language()];
    if (this.found) markTime(svg, this.found, this.viewer.shown?.t ?? 0);
  }

  /** @param {[number, number]} point of the picture in view */
  async choose(point) {
    const { shown } = this.viewer;
    if (!isMeasurable(shown)) return this.#tell("measure.not_here");
    if (this.found || !sameView(shown, this.view)) this.chosen = [];
    this.found = null;
    this.view = shown;
    const points = [...this.chosen, point];
    const asked = (this.asked = {});
    this.#tell("measure.asking");
    try {
      const { points: readings, distance } = await getMeasurement(shown.scene, queryOf(shown, points));
      if (asked !== this.asked || !this.isOn) return;
      this.#take(points, readings, distance);
    } catch (error) {
      if (asked === this.asked && this.isOn) this.#tell("measure.failed", { why: error.message });
    }
    this.#draw();
  }

  #take(points, readings, distance) {
    const last = readings.at(-1);
    if (last.refusal) {
      this.#tell(this.chosen.length ? "measure.refused_second" : "measure.refused_first", { why: readingOf(last) });
      return;
    }
    this.chosen = points;
    this.found = distance;
    this.#tell(distance ? "measure.done" : "measure.second", { reading: readingOf(last) });
  }

  /** The points chosen hold for the view in which they were; both together, for every view of their scene. */
  #follow(shown) {
    if (!this.isOn) return;
    if (shown.scene !== (this.view?.scene ?? shown.scene)) return this.end();
    if (!this.found && this.chosen.length > 0 && !sameView(shown, this.view)) {
      this.#clear();
      this.#tell("measure.moved");
    }
    if (this.found) this.#say();
    this.#draw();
  }

  /** @returns {{mm: number, sigma: number, places: number[][]} | null} at the time in view; null: not known then */
  #now() {
    const { shown } = this.viewer;
    const { t: times, distances_mm: lengths, uncertainties_mm: sigmas, first_mm: first, second_mm: second } = this.found;
    const place = Math.min(Math.max((shown?.t ?? 0) * times.length, 0), times.length - 1);
    const [before, after] = [Math.floor(place), Math.ceil(place)];
    if (lengths[before] === null || lengths[after] === null) return null;
    const mixed = (a, b) => a + (place - before) * (b - a);
    const at = (path) => path[before].map((each, i) => mixed(each, path[after][i]));
    return {
      mm: mixed(lengths[before], lengths[after]),
      sigma: mixed(sigmas[before], sigmas[after]),
      places: [at(first), at(second)],
    };
  }

  #draw() {
    if (!this.isOn) return;
    const { shown } = this.viewer;
    const now = this.found && shown?.camera ? this.#now() : null;
    if (now) this.overlay.line(shown.camera, now.places, words("measure.distance", { mm: figure(now.mm, 1), sigma: figure(now.sigma, 1) }));
    else if (!this.found && shown?.camera && sameView(shown, this.view)) this.overlay.points(shown.camera, this.chosen);
    else this.overlay.clear();
    const cross = shown?.camera && this.picker.crossIn(shown.camera);
    if (cross) this.overlay.cross(shown.camera, cross);
  }
}
