// Measurements that stay: what each was asked with, so that an address can hold it, and what was found. No elements.

/**
 * query: of GET /scenes/{id}/measure, without the shape: the points in the view in which they were chosen. shape: what
 * was found; null: not yet, or why says why not.
 * @typedef {import("../base/wire.js").MeasuredShape} Shape
 * @typedef {"distance"|"line"|"area"|"angle"} Kind
 * @typedef {{name: string, kind: Kind, query: Record<string, string | number>, shape: Shape | null, why: string}} Measurement
 */

/** Of each kind, the shape that the service knows, and how many points it takes. */
export const KINDS = {
  distance: { shape: "line", fewest: 2, most: 2 },
  line: { shape: "line", fewest: 2, most: 16 },
  area: { shape: "area", fewest: 3, most: 16 },
  angle: { shape: "angle", fewest: 3, most: 3 },
};
/** As much as an address should hold. */
export const MOST = 26;
export const MAX_NAME = 30;
const BETWEEN = "~";
const LENS = ["width", "height", "fx", "fy", "cx", "cy"];
const NUMBER = /^-?\d+(\.\d+)?(e-?\d+)?$/;
const POINT = /^-?\d+(\.\d+)?,-?\d+(\.\d+)?$/;
const POSE = /^(orbit:)?-?[\d.e]+(,-?[\d.e+-]+)*$/;
const HEAD = ["scene", "name", "kind", "unit", "seconds", "value", "low", "high", "trust"];

const short = (value) => String(Number(Number(value).toFixed(4)));

/** @param {{name: string}[]} taken @returns {string} the first free one of A, B, ... */
export function freeName(taken) {
  const letters = Array.from({ length: MOST }, (_, i) => String.fromCharCode(65 + i));
  return letters.find((letter) => taken.every(({ name }) => name !== letter)) ?? letters[0];
}

/** @param {string} name @returns {string} one that an address can hold */
export const safeName = (name) => name.replaceAll(BETWEEN, " ").trim();

/** @param {Measurement} measurement @returns {string} as an address holds it */
export function textOf({ name, kind, query }) {
  const lens = LENS.map((each) => short(query[each])).join(",");
  const points = query.points.split(";").map((each) => each.split(",").map(short).join(",")).join(";");
  return [safeName(name), kind, short(query.t), lens, query.pose ?? "", points].join(BETWEEN);
}

/** @param {string} text as textOf() writes it @returns {Measurement | null} null: it cannot be read */
export function measurementOf(text) {
  const parts = text.split(BETWEEN);
  if (parts.length !== 6) return null;
  const [name, kind, t, lens, pose, points] = parts;
  const numbers = lens.split(",");
  const places = points.split(";");
  const limits = Object.hasOwn(KINDS, kind) ? KINDS[kind] : null;
  const isGood = limits && name.trim() && name.length <= MAX_NAME && NUMBER.test(t) && numbers.length === LENS.length &&
    numbers.every((each) => NUMBER.test(each)) && places.every((each) => POINT.test(each)) &&
    places.length >= limits.fewest && places.length <= limits.most && (pose === "" || POSE.test(pose));
  if (!isGood) return null;
  const query = { points, t: Number(t), ...Object.fromEntries(LENS.map((each, i) => [each, Number(numbers[i])])) };
  return { name, kind, query: pose ? { ...query, pose } : query, shape: null, why: "" };
}

/**
 * A shape at a time, between two frames as far as both are known.
 * @param {Shape} shape @param {number} t
 * @returns {{value: number, sigma: number, places: number[][]} | null} null: not known then
 */
export function shapeAt({ t: times, values, uncertainties, places_mm: paths }, t) {
  const place = Math.min(Math.max(t * times.length, 0), times.length - 1);
  const [before, after] = [Math.floor(place), Math.ceil(place)];
  if (values[before] === null || values[after] === null) return null;
  const mixed = (a, b) => a + (place - before) * (b - a);
  return {
    value: mixed(values[before], values[after]),
    sigma: mixed(uncertainties[before], uncertainties[after]),
    places: paths.map((path) => path[before].map((each, i) => mixed(each, path[after][i]))),
  };
}

/**
 * All measurements at all frames as CSV. Numbers have a point, whatever the language.
 * @param {string} scene its name @param {Measurement[]} measurements
 */
export function csvOf(scene, measurements) {
  const rows = measurements.filter(({ shape }) => shape).flatMap(({ name, kind, shape }) =>
    shape.time_s.map((seconds, i) => {
      const [value, sigma] = [shape.values[i], shape.uncertainties[i]];
      const found = value === null ? ["", "", ""] : [value, Math.max(0, value - sigma), value + sigma].map(short);
      return [scene, name, kind, shape.unit, short(seconds - shape.time_s[0]), ...found, short(shape.trust[i])];
    }));
  return [HEAD, ...rows].map((row) => `${row.map(cell).join(",")}\r\n`).join("");
}

/** A spreadsheet takes no name for a formula. */
function cell(text) {
  const safe = /^[=+@\t\r]|^-(?![\d.])/.test(text) ? `'${text}` : text;
  return /[",\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}
