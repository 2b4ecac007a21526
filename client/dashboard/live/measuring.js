// Two points of the frozen moment, and their distance in mm.

import { getMeasurement } from "../base/api.js";
import { setText } from "../base/element.js";
import { figure, languageEvents, words } from "../base/messages.js";
import { Overlay } from "../measure/overlay.js";
import { queryOf } from "../measure/places.js";
import { PointPicker } from "../measure/pointpicker.js";
import { readingOf } from "../measure/probe.js";

/** A pointer that moves less between down and up has clicked, and turns nothing. */
const CLICK_PX = 8;

export class LiveMeasure {
  /**
   * @param {{stage: HTMLElement, canvas: HTMLElement, over: HTMLElement, told: HTMLElement, button: HTMLElement}} parts
   * @param {import("./look.js").Look} look
   * @param {import("./model.js").ModelPicture} model
   */
  constructor(parts, look, model) {
    Object.assign(this, { parts, look, model, isOn: false });
    this.overlay = new Overlay(parts.over, parts.canvas);
    this.picker = new PointPicker(parts, {
      clickPx: CLICK_PX,
      isOn: () => this.isOn,
      camera: () => this.model.shown?.camera ?? null,
      onPoint: (point) => this.#choose(point),
      onCross: () => this.#draw(),
      onEnd: () => this.end(),
    });
    this.#clear();
    look.addEventListener("changed", () => look.mode !== "frozen" && this.end());
    model.addEventListener("shown", () => this.#follow());
    languageEvents.addEventListener("changed", () => this.#say());
    window.addEventListener("resize", () => this.#draw());
  }

  toggle() {
    if (this.isOn) this.end();
    else this.start();
  }

  /** Choose two points of the moment in view, which stands still meanwhile. */
  start() {
    if (!this.look.freeze()) return;
    if (this.look.rock.isOn) this.look.rock.toggle();
    this.isOn = true;
    this.#clear();
    this.#tell("live.measure_first");
    this.parts.button.setAttribute("aria-pressed", "true");
    this.parts.stage.focus();
  }

  end() {
    this.isOn = false;
    this.#clear();
    this.overlay.clear();
    this.parts.button.setAttribute("aria-pressed", "false");
  }

  #clear() {
    this.chosen = [];
    this.found = null; // {mm, sigma, places}
    this.of = null; // the view in which they were chosen
    this.picker.forget();
    this.asked = {}; // replaced by each question: earlier answers are for nobody
    this.told = null;
    this.#say();
  }

  /** @param {string} place of the words @param {Record<string, string>} [values] */
  #tell(place, values = {}) {
    this.told = { place, values };
    this.#say();
  }

  #say() {
    const { told } = this.parts;
    told.hidden = !this.isOn || this.told === null;
    if (told.hidden) return;
    const text = words(this.told.place, this.told.values);
    const sum = this.found && words("live.measured", { mm: figure(this.found.mm, 1), sigma: figure(this.found.sigma, 1) });
    told.classList.toggle("sum", this.found !== null);
    setText(told, sum ?? text);
  }

  /** @param {[number, number]} point of the picture in view */
  async #choose(point) {
    const { shown } = this.model;
    if (!shown?.camera) return;
    if (this.found || !this.#isOf(shown)) this.chosen = [];
    [this.found, this.of] = [null, shown];
    const points = [...this.chosen, point];
    const asked = (this.asked = {});
    this.#tell("live.measure_asking");
    try {
      const { asked: wish, camera } = shown;
      const t = new Date(Math.round(shown.capturedAtS * 1000)).toISOString();
      const query = queryOf({ t, pose: wish.pose ?? null, camera }, points);
      const { points: readings, distance } = await getMeasurement(wish.scene, query);
      if (asked !== this.asked || !this.isOn) return;
      this.#take(points, readings, distance);
    } catch (error) {
      if (asked === this.asked && this.isOn) this.#tell("measure.failed", { why: error.message });
    }
    this.#draw();
  }

  #take(points, readings, distance) {
    const last = readings.at(-1);
    const second = this.chosen.length > 0;
    const why = { why: readingOf(last) };
    if (last.refusal) return this.#tell(second ? "measure.refused_next" : "measure.refused_first", why);
    this.chosen = points;
    const places = readings.map((each) => each.point_mm);
    this.found = distance && { mm: distance.distance_mm, sigma: distance.uncertainty_mm, places };
    this.#tell("live.measure_second");
  }

  #isOf(shown) {
    const { of } = this;
    return of !== null && of.capturedAtS === shown.capturedAtS && of.asked.pose === shown.asked.pose;
  }

  /** Both points together stay where they are in the tissue; one alone holds for the view in which it was chosen. */
  #follow() {
    const { shown } = this.model;
    if (!this.isOn) return;
    if (this.of && this.of.capturedAtS !== shown.capturedAtS) this.#clear();
    else if (this.chosen.length > 0 && !this.found && !this.#isOf(shown)) this.#clear();
    if (this.told === null) this.#tell("live.measure_first");
    this.#draw();
  }

  #draw() {
    const { shown } = this.model;
    if (!this.isOn) return;
    this.overlay.clear();
    if (!shown?.camera) return;
    if (this.found) this.overlay.line(shown.camera, this.found.places, `${figure(this.found.mm, 1)} mm`);
    else this.overlay.points(shown.camera, this.chosen);
    const cross = this.picker.crossIn(shown.camera);
    if (cross) this.overlay.cross(shown.camera, cross);
  }
}
