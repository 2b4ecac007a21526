// The curve: likeness to frames that training never sees, over iterations; the right eye's is thinner. Dashed is what
// copying neighbours reaches.

import { draw } from "../base/element.js";
import { figure, words } from "../base/messages.js";

const WIDTH = 300;
const HEIGHT = 160;
const LEFT = 30;
const RIGHT = 6;
const TOP = 14;
const BOTTOM = 36;
/** Between the feet of two lines of text. */
const LINE = 14;
/** The axis spans at least so much, so that noise does not look like progress. */
const MIN_SPAN_DB = 4;

/** @typedef {{iteration: number, db: number, rightDb: number}} Point a clip of one eye has no rightDb: NaN */

/**
 * @param {string} csv curve.csv
 * @returns {Point[]}
 */
export function pointsOfCsv(csv) {
  const [header, ...rows] = csv.trim().split(/\r?\n/).map((line) => line.split(","));
  const iteration = header.indexOf("iteration");
  const db = header.indexOf("psnr_tissue_db");
  const rightDb = header.indexOf("psnr_right_db");
  const points = rows.map((row) => ({
    iteration: Number(row[iteration]),
    db: Number.parseFloat(row[db]),
    rightDb: Number.parseFloat(row[rightDb]), // empty where there is no right eye
  }));
  return points.filter((point) => Number.isFinite(point.iteration) && Number.isFinite(point.db));
}

/**
 * Dashed lines with their names, from the top downwards; names that would overlap make room for each other.
 * @param {SVGSVGElement} svg
 * @param {{name: string, db: number}[]} baselines
 * @param {(db: number) => number} y
 */
function drawBaselines(svg, baselines, y) {
  const fromTop = [...baselines].sort((a, b) => b.db - a.db);
  let foot = TOP - LINE; // of the name before
  for (const { name, db } of fromTop) {
    foot = Math.max(y(db) - 3, foot + LINE);
    draw(svg, "line", { class: "baseline", x1: LEFT, x2: WIDTH - RIGHT, y1: y(db), y2: y(db) });
    draw(svg, "text", { class: "tick right", x: WIDTH - RIGHT, y: foot }, `${name} ${figure(db, 1)}`);
  }
}

/**
 * @param {SVGSVGElement} svg
 * @param {Point[]} points
 * @param {{name: string, db: number}[]} baselines
 */
export function drawCurve(svg, points, baselines) {
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  svg.toggleAttribute("hidden", points.length === 0);
  if (points.length === 0) return;
  const right = points.filter(({ rightDb }) => Number.isFinite(rightDb));
  const values = [...[...points, ...baselines].map((each) => each.db), ...right.map((each) => each.rightDb)];
  const middle = (Math.min(...values) + Math.max(...values)) / 2;
  const half = Math.max(MIN_SPAN_DB, Math.max(...values) - Math.min(...values)) / 2 + 0.5;
  const last = Math.max(1, points.at(-1).iteration);
  const x = (iteration) => LEFT + (iteration / last) * (WIDTH - LEFT - RIGHT);
  const y = (db) => TOP + ((middle + half - db) / (2 * half)) * (HEIGHT - TOP - BOTTOM);
  for (const db of [Math.ceil(middle - half), Math.floor(middle + half)]) {
    draw(svg, "line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: y(db), y2: y(db) });
    draw(svg, "text", { class: "tick right", x: LEFT - 4, y: y(db) + 3 }, String(db));
  }
  const line = (name, corners, radius) => {
    const places = corners.map(([iteration, db]) => [x(iteration).toFixed(1), y(db).toFixed(1)]);
    draw(svg, "polyline", { class: name, points: places.join(" ") });
    draw(svg, "circle", { class: name, cx: places.at(-1)[0], cy: places.at(-1)[1], r: radius });
  };
  if (right.length > 0) line("beside", right.map((each) => [each.iteration, each.rightDb]), 1.8);
  line("score", points.map((each) => [each.iteration, each.db]), 2.5);
  drawBaselines(svg, baselines, y); // over the lines, so that they can be read
  draw(svg, "text", { class: "tick right", x: WIDTH - RIGHT, y: HEIGHT - 4 - LINE }, words("curve.steps", { count: figure(last) }));
  draw(svg, "text", { class: "tick", x: LEFT, y: HEIGHT - 4 }, words(right.length > 0 ? "curve.axes_both" : "curve.axes"));
  const beside = right.length > 0 ? words("curve.beside", { db: figure(right.at(-1).rightDb, 1) }) : "";
  const score = `${figure(points.at(-1).db, 1)} dB${beside}`;
  svg.setAttribute("aria-label", words("curve.name", { score, last }));
}
