// The list of measurements: the name that can be changed, the figure now, and a button that deletes it.

import { button, element, setText } from "../base/element.js";
import { figure, words } from "../base/messages.js";
import { MAX_NAME, shapeAt } from "./measurements.js";

/** @typedef {import("./measurements.js").Measurement} Measurement */

/** @param {import("./measurements.js").Shape} shape @param {number} value @param {number} sigma @returns {string} */
export const figureOf = ({ unit }, value, sigma) => words(`measure.value_${unit}`, { value: figure(value, 1), sigma: figure(sigma, 1) });

/** @param {Measurement} measurement @param {number} t @returns {string} its figure at a time, or why there is none */
export function figureAt({ shape, why }, t) {
  if (!shape) return why || words("measure.asking");
  const now = shapeAt(shape, t);
  return now ? figureOf(shape, now.value, now.sigma) : words("measure.away");
}

/** Pieces of a line of several. @param {Measurement} measurement */
function piecesOf({ shape }) {
  const { pieces_mm: pieces = [], piece_uncertainties_mm: sigmas } = shape ?? {};
  if (pieces.length < 2) return "";
  return words("measure.pieces", { pieces: pieces.map((each, i) => figureOf(shape, each, sigmas[i])).join(" + ") });
}

export class MeasurementList {
  /**
   * @param {HTMLElement} list
   * @param {{onSelect: (each: Measurement) => void, onName: (each: Measurement, name: string) => void,
   *   onDelete: (each: Measurement) => void}} told
   */
  constructor(list, told) {
    Object.assign(this, { list, told });
    /** @type {Map<Measurement, HTMLElement>} */
    this.rows = new Map();
  }

  /** In another language every row is made anew. */
  forget() {
    this.rows.clear();
  }

  /** @param {Measurement[]} measurements @param {Measurement | null} selected @param {number} t of the view */
  show(measurements, selected, t) {
    for (const each of this.rows.keys()) if (!measurements.includes(each)) this.rows.delete(each);
    const rows = measurements.map((each) => this.#rowOf(each));
    if (rows.length !== this.list.children.length || rows.some((row, i) => row !== this.list.children[i])) this.list.replaceChildren(...rows);
    for (const each of measurements) {
      const row = this.rows.get(each);
      row.toggleAttribute("data-selected", each === selected);
      row.classList.toggle("refused", each.why !== "");
      row.classList.toggle("small", !each.shape || shapeAt(each.shape, t) === null);
      setText(row.querySelector(".figure"), figureAt(each, t));
      setText(row.querySelector(".pieces"), piecesOf(each));
    }
  }

  #rowOf(each) {
    const known = this.rows.get(each);
    if (known) return known;
    const name = element("input");
    Object.assign(name, { type: "text", value: each.name, maxLength: MAX_NAME });
    name.setAttribute("aria-label", words("measure.name"));
    name.addEventListener("change", () => {
      this.told.onName(each, name.value.trim());
      name.value = each.name;
    });
    name.addEventListener("focus", () => this.told.onSelect(each));
    const told = element("div", { class: "found" }, element("p", { class: "figure" }), element("p", { class: "pieces quiet" }));
    told.addEventListener("click", () => this.told.onSelect(each));
    const remove = button("×", () => this.told.onDelete(each), words("measure.delete", { name: each.name }));
    const row = element("li", {}, element("div", { class: "what" }, name, told), remove);
    this.rows.set(each, row);
    return row;
  }
}
