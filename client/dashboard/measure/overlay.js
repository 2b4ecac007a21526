// Points, lines, areas and cross over the picture, at places of the tissue or points of the picture.

import { draw } from "../base/element.js";
import { spread } from "./labels.js";
import { project, toScreen } from "./places.js";

const ARM_PX = 9;

export class Overlay {
  /** @param {HTMLElement} over an element that covers the stage, with an svg @param {HTMLElement} canvas of the picture */
  constructor(over, canvas) {
    this.over = over;
    this.canvas = canvas;
    this.svg = over.querySelector("svg");
  }

  clear() {
    this.svg.replaceChildren();
  }

  /** @param {import("../stage/stream.js").Camera} camera @param {number[][]} points of the picture */
  points(camera, points) {
    for (const point of points) this.#mark("point", this.#at(camera, point));
  }

  /**
   * @param {import("../stage/stream.js").Camera} camera
   * @param {number[][]} places two or more, in mm
   * @param {string} text
   * @param {{isClosed?: boolean}} [how] isClosed: it is an area
   */
  line(camera, places, text, { isClosed = false } = {}) {
    const ends = places.map((place) => project(camera, place)).map((each) => each && this.#at(camera, each));
    if (ends.includes(null)) return;
    const points = ends.map((end) => end.map((each) => each.toFixed(1)).join(",")).join(" ");
    for (const name of ["under", "line"]) draw(this.svg, isClosed ? "polygon" : "polyline", { class: name, points });
    for (const end of ends) this.#mark("point", end);
    const [x, y] = isClosed ? meanOf(ends) : meanOf(middleOf(ends));
    draw(this.svg, "text", { x, y: y - ARM_PX }, text);
  }

  /** Once all lines are there: their texts above them, within the picture and over no other text or point. @param {import("../stage/stream.js").Camera} camera */
  spread(camera) {
    const texts = [...this.svg.querySelectorAll("text")];
    this.svg.append(...texts);
    const [left, top] = this.#at(camera, [0, 0]);
    const [right, bottom] = this.#at(camera, [camera.width, camera.height]);
    const points = [...this.svg.querySelectorAll("path.point")];
    const [boxes, free] = [texts, points].map((all) => all.map((each) => each.getBBox()));
    const moves = spread(boxes, { left, top, right, bottom }, free);
    texts.forEach((text, i) => {
      for (const [j, name] of ["x", "y"].entries()) text.setAttribute(name, Number(text.getAttribute(name)) + moves[i][j]);
    });
  }

  /** @param {import("../stage/stream.js").Camera} camera @param {number[]} point of the picture, besides what is there */
  cross(camera, point) {
    this.#mark("cross", this.#at(camera, point));
  }

  #at(camera, point) {
    const [x, y] = toScreen(this.canvas, camera, point);
    const { left, top } = this.over.getBoundingClientRect();
    return [x - left, y - top];
  }

  #mark(name, [x, y]) {
    const arms = `M${x - ARM_PX} ${y}H${x + ARM_PX}M${x} ${y - ARM_PX}V${y + ARM_PX}`;
    for (const each of ["under", name]) draw(this.svg, "path", { class: each, "data-mark": name, d: arms });
  }
}

/** The ends of a line's middle piece. */
const middleOf = (ends) => ends.slice(Math.ceil(ends.length / 2) - 1, Math.ceil(ends.length / 2) + 1);

const meanOf = (ends) => [0, 1].map((i) => ends.reduce((sum, end) => sum + end[i], 0) / ends.length);
