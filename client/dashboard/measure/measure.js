// The tool "Measure": distances, lines, areas and angles of points of the tissue, with their uncertainty, followed in
// time. They stay until they are deleted, or the scene leaves the screen. For research alone, as it says.

import { getMeasurement } from "../base/api.js";
import { languageEvents, words } from "../base/messages.js";
import { drawOverTime, markTime } from "./distances.js";
import { prepareFold } from "./fold.js";
import { figureOf, MeasurementList } from "./list.js";
import { freeName, KINDS, measurementOf, MOST, safeName, shapeAt, textOf } from "./measurements.js";
import { Overlay } from "./overlay.js";
import { isMeasurable, queryOf, sameView } from "./places.js";
import { PointPicker } from "./pointpicker.js";
import { readingOf } from "./probe.js";

/** @typedef {import("./measurements.js").Measurement} Measurement */

/** A pointer that moves less between down and up has clicked, and turns nothing. */
const CLICK_PX = 6;

export class Measure {
  /**
   * @param {import("../stage/viewer.js").Viewer} viewer
   * @param {{stage: HTMLElement, canvas: HTMLElement, over: HTMLElement, button: HTMLButtonElement,
   *   panel: HTMLElement}} parts panel: with .kind, .fold, .told, .list, .again, .csv, .end and svg
   * @param {{onChange: () => void, onSave: (measurements: Measurement[]) => void}} told onChange: others are there now
   */
  constructor(viewer, parts, told) {
    Object.assign(this, { viewer, parts, onChange: told.onChange });
    this.overlay = new Overlay(parts.over, parts.canvas);
    this.isOn = false;
    /** @type {Measurement[]} */
    this.measurements = [];
    /** @type {Measurement | null} whose curve is drawn */
    this.selected = null;
    this.list = new MeasurementList(parts.panel.querySelector(".list"), {
      onSelect: (each) => this.#select(each),
      onName: (each, name) => this.#rename(each, name),
      onDelete: (each) => this.#delete(each),
    });
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
    prepareFold(parts.panel);
    this.#begin();
    viewer.addEventListener("shown", ({ detail }) => this.#follow(detail));
    viewer.addEventListener("gone", () => this.#forget());
    languageEvents.addEventListener("changed", () => {
      this.list.forget();
      if (this.isOn) this.#say();
    });
    new ResizeObserver(() => this.#draw()).observe(parts.canvas);
    parts.button.addEventListener("click", () => this.toggle());
    const { panel } = parts;
    panel.querySelector(".kind").addEventListener("change", () => this.start());
    panel.querySelector(".again").addEventListener("click", () => this.start());
    panel.querySelector(".csv").addEventListener("click", () => told.onSave(this.measurements));
    panel.querySelector(".end").addEventListener("click", () => this.end());
    const notTwice = (event) => this.isOn && event.stopImmediatePropagation();
    parts.stage.addEventListener("dblclick", notTwice, { capture: true });
  }

  /** @returns {string[]} the measurements, as an address holds them */
  get texts() {
    return this.measurements.map(textOf);
  }

  /** Have these measurements, found once more. @param {string[]} texts of an address */
  restore(texts) {
    if (texts.join() === this.texts.join()) return;
    this.measurements = texts.map(measurementOf).filter((each) => each !== null).slice(0, MOST);
    this.selected = this.measurements.at(-1) ?? null;
    if (this.measurements.length > 0) this.#open();
    this.#say();
    this.#findAll(this.viewer.scene);
  }

  toggle() {
    if (this.isOn) this.end();
    else this.start();
  }

  /** Choose the points of another measurement. */
  start() {
    this.viewer.timeline.play(false);
    this.viewer.rock.stop();
    this.#open();
    this.parts.stage.focus();
  }

  #open() {
    this.isOn = true;
    this.picker.forget();
    this.#begin();
    this.parts.panel.hidden = false;
    this.parts.button.setAttribute("aria-pressed", "true");
    this.parts.stage.toggleAttribute("data-measuring", true);
    const { shown } = this.viewer;
    this.#tell(shown === null || isMeasurable(shown) ? "measure.first" : "measure.not_here");
    this.#draw();
  }

  /** Put the tool away; the measurements come back with it. */
  end() {
    const hadFocus = this.parts.panel.contains(document.activeElement);
    this.isOn = false;
    this.#begin();
    this.parts.panel.hidden = true;
    this.parts.button.setAttribute("aria-pressed", "false");
    this.parts.stage.removeAttribute("data-measuring");
    this.overlay.clear();
    if (hadFocus) this.parts.button.focus();
  }

  /** The scene leaves the screen. */
  #forget() {
    this.measurements = [];
    this.selected = null;
    this.end();
    this.#say();
  }

  #begin() {
    this.chosen = []; // points of the picture of this.view
    this.view = null; // in which they were chosen
    this.current = null; // the measurement that these points make, and more points will
    this.asked = {}; // replaced by each question: earlier answers are for nobody
  }

  /** @param {string} place of the words to show @param {Record<string, string>} [values] */
  #tell(place, values = {}) {
    this.told = { place, values };
    this.#say();
  }

  #say() {
    const { panel } = this.parts;
    const { place, values } = this.told ?? { place: "measure.first", values: {} };
    panel.toggleAttribute("data-first", place === "measure.first");
    panel.querySelector(".told").textContent = words(place, values);
    panel.querySelector(".csv").hidden = !this.measurements.some(({ shape }) => shape);
    this.#sayNow();
  }

  /** What changes with the time in view. */
  #sayNow() {
    const t = this.viewer.shown?.t ?? 0;
    const svg = this.parts.panel.querySelector("svg");
    this.list.show(this.measurements, this.selected, t);
    drawOverTime(svg, this.selected?.shape ?? null);
    if (this.selected?.shape) markTime(svg, this.selected.shape, t);
  }

  get #kind() {
    return this.parts.panel.querySelector(".kind").value;
  }

  /** @param {[number, number]} point of the picture in view */
  async choose(point) {
    const { shown } = this.viewer;
    const kind = this.#kind;
    const { shape, fewest, most } = KINDS[kind];
    if (!isMeasurable(shown)) return this.#tell("measure.not_here");
    if (this.chosen.length >= most || !sameView(shown, this.view)) this.#begin();
    if (!this.current && this.measurements.length >= MOST) return this.#tell("measure.too_many");
    this.view = shown;
    const points = [...this.chosen, point];
    const query = queryOf(shown, points);
    const asked = (this.asked = {});
    this.#tell("measure.asking");
    try {
      const found = await getMeasurement(shown.scene, points.length < fewest ? query : { ...query, shape });
      if (asked === this.asked && this.isOn) this.#take(points, query, kind, found);
    } catch (error) {
      if (asked === this.asked && this.isOn) this.#tell("measure.failed", { why: error.message });
    }
    this.#draw();
  }

  #take(points, query, kind, { points: readings, shape }) {
    const reading = readingOf(readings.at(-1));
    const isFirst = this.chosen.length === 0;
    if (readings.at(-1).refusal) return this.#tell(isFirst ? "measure.refused_first" : "measure.refused_next", { why: reading });
    this.chosen = points;
    if (!shape) return this.#tell("measure.next", { count: points.length, reading });
    if (this.current) Object.assign(this.current, { query, shape });
    else {
      this.current = { name: freeName(this.measurements), kind, query, shape, why: "" };
      this.measurements.push(this.current);
    }
    this.selected = this.current;
    const mayGrow = points.length < KINDS[kind].most;
    this.#tell(mayGrow ? "measure.more" : "measure.done", { count: points.length, reading });
    this.onChange();
  }

  async #findAll(scene) {
    for (const each of [...this.measurements]) {
      if (this.viewer.scene !== scene) return;
      try {
        const { shape } = await getMeasurement(scene, { ...each.query, shape: KINDS[each.kind].shape });
        Object.assign(each, { shape, why: shape ? "" : words("measure.refused_again") });
      } catch (error) {
        each.why = words("measure.failed", { why: error.message });
      }
      this.#say();
      this.#draw();
    }
  }

  #select(each) {
    this.selected = each;
    this.#say();
    this.#draw();
  }

  #rename(each, name) {
    const safe = safeName(name);
    if (!safe) return this.#tell("measure.unnamed", { name: each.name });
    each.name = safe;
    this.onChange();
    this.#draw();
  }

  #delete(each) {
    this.measurements = this.measurements.filter((other) => other !== each);
    if (each === this.current) this.#begin();
    if (each === this.selected) this.selected = this.measurements.at(-1) ?? null;
    this.onChange();
    this.#tell("measure.first");
    this.#draw();
    this.parts.stage.focus();
  }

  /** The points chosen hold for the view in which they were; what they make, for every view of their scene. */
  #follow(shown) {
    if (!this.isOn) return;
    const isElsewhere = this.chosen.length > 0 && !sameView(shown, this.view);
    if (isElsewhere && !this.current) this.#tell("measure.moved");
    if (isElsewhere) this.#begin();
    this.#sayNow();
    this.#draw();
  }

  #draw() {
    if (!this.isOn) return;
    const { shown } = this.viewer;
    this.overlay.clear();
    if (!shown?.camera) return;
    for (const { name, kind, shape } of this.measurements) {
      const now = shape && shapeAt(shape, shown.t);
      const text = now && `${name}  ${figureOf(shape, now.value, now.sigma)}`;
      if (now) this.overlay.line(shown.camera, now.places, text, { isClosed: kind === "area" });
    }
    this.overlay.spread(shown.camera);
    if (!this.current && sameView(shown, this.view)) this.overlay.points(shown.camera, this.chosen);
    const cross = this.picker.crossIn(shown.camera);
    if (cross) this.overlay.cross(shown.camera, cross);
  }
}
