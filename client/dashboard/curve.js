// The curve: likeness to frames that training never sees, over iterations; dashed, what copying neighbours reaches.

const WIDTH = 300;
const HEIGHT = 120;
const LEFT = 30;
const RIGHT = 6;
const TOP = 8;
const BOTTOM = 18;
/** The axis spans at least so much, so that noise does not look like progress. */
const MIN_SPAN_DB = 4;

/** @typedef {{iteration: number, db: number}} Point */

/**
 * @param {string} csv curve.csv
 * @returns {Point[]}
 */
export function pointsOfCsv(csv) {
  const [header, ...rows] = csv.trim().split(/\r?\n/).map((line) => line.split(","));
  const iteration = header.indexOf("iteration");
  const db = header.indexOf("psnr_tissue_db");
  const points = rows.map((row) => ({ iteration: Number(row[iteration]), db: Number(row[db]) }));
  return points.filter((point) => Number.isFinite(point.iteration) && Number.isFinite(point.db));
}

/** Draw one thing. */
function draw(svg, tag, attributes, text = "") {
  const made = document.createElementNS(svg.namespaceURI, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, String(value));
  made.textContent = text;
  svg.append(made);
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
  const values = [...points, ...baselines].map((each) => each.db);
  const middle = (Math.min(...values) + Math.max(...values)) / 2;
  const half = Math.max(MIN_SPAN_DB, Math.max(...values) - Math.min(...values)) / 2 + 0.5;
  const last = Math.max(1, points.at(-1).iteration);
  const x = (iteration) => LEFT + (iteration / last) * (WIDTH - LEFT - RIGHT);
  const y = (db) => TOP + ((middle + half - db) / (2 * half)) * (HEIGHT - TOP - BOTTOM);
  for (const db of [Math.ceil(middle - half), Math.floor(middle + half)]) {
    draw(svg, "line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: y(db), y2: y(db) });
    draw(svg, "text", { class: "tick right", x: LEFT - 4, y: y(db) + 3 }, String(db));
  }
  for (const { name, db } of baselines) {
    draw(svg, "line", { class: "baseline", x1: LEFT, x2: WIDTH - RIGHT, y1: y(db), y2: y(db) });
    draw(svg, "text", { class: "tick right", x: WIDTH - RIGHT, y: y(db) - 3 }, `${name} ${db.toFixed(1)}`);
  }
  const corners = points.map((each) => `${x(each.iteration).toFixed(1)},${y(each.db).toFixed(1)}`);
  draw(svg, "polyline", { points: corners.join(" ") });
  draw(svg, "circle", { cx: x(last), cy: y(points.at(-1).db), r: 2.5 });
  draw(svg, "text", { class: "tick", x: LEFT, y: HEIGHT - 4 }, "dB on unseen frames, over iterations");
  draw(svg, "text", { class: "tick right", x: WIDTH - RIGHT, y: HEIGHT - 4 }, String(last));
  svg.setAttribute("aria-label", `Likeness over training: ${points.at(-1).db.toFixed(1)} dB after ${last} iterations`);
}
