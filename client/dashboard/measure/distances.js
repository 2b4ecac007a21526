// The curve of a measurement over the clip, with its uncertainty as a band.

import { draw } from "../base/element.js";
import { figure, language, words } from "../base/messages.js";

const WIDTH = 300;
const HEIGHT = 90;
const LEFT = 40;
const RIGHT = 6;
const TOP = 8;
const BOTTOM = 18;
/** The axis spans at least so much, so that noise does not look like movement. */
const MIN_SPAN = { mm: 1, mm2: 10, deg: 2 };
const NOTHING = { time_s: [], values: [], uncertainties: [], unit: "mm" };
/** What each picture shows, and in which language. */
const drawn = new WeakMap();

/**
 * Draw it, unless it is there.
 * @param {SVGSVGElement} svg
 * @param {import("../base/wire.js").MeasuredShape | null} found null, or known at no frame: nothing is drawn
 */
export function drawOverTime(svg, found) {
  const [shape, of] = drawn.get(svg) ?? [];
  if (shape === found && of === language()) return;
  drawn.set(svg, [found, language()]);
  svg.replaceChildren();
  const { time_s: times, values: lengths, uncertainties: sigmas, unit } = found ?? NOTHING;
  const known = times.map((_, i) => i).filter((i) => lengths[i] !== null);
  svg.toggleAttribute("hidden", known.length === 0);
  if (known.length === 0) return;
  svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  const [low, high] = spanOf(known.flatMap((i) => [lengths[i] - sigmas[i], lengths[i] + sigmas[i]]), MIN_SPAN[unit]);
  const last = times.at(-1) || 1;
  const x = (seconds) => LEFT + (seconds / last) * (WIDTH - LEFT - RIGHT);
  const y = (mm) => TOP + ((high - mm) / (high - low)) * (HEIGHT - TOP - BOTTOM);
  for (const mm of [low, high]) {
    draw(svg, "line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: y(mm), y2: y(mm) });
    draw(svg, "text", { class: "tick right", x: LEFT - 4, y: y(mm) + 4 }, figure(mm, 1));
  }
  for (const run of runsOf(known)) {
    const upper = run.map((i) => `${x(times[i]).toFixed(1)},${y(lengths[i] + sigmas[i]).toFixed(1)}`);
    const lower = run.map((i) => `${x(times[i]).toFixed(1)},${y(lengths[i] - sigmas[i]).toFixed(1)}`);
    draw(svg, "polygon", { class: "band", points: [...upper, ...lower.reverse()].join(" ") });
    const middle = run.map((i) => `${x(times[i]).toFixed(1)},${y(lengths[i]).toFixed(1)}`);
    draw(svg, "polyline", { class: "score", points: middle.join(" ") });
  }
  draw(svg, "line", { class: "now", x1: x(0), x2: x(0), y1: TOP, y2: HEIGHT - BOTTOM });
  draw(svg, "text", { class: "tick", x: LEFT, y: HEIGHT - 4 }, words(`measure.axes_${unit}`));
  draw(svg, "text", { class: "tick right", x: WIDTH - RIGHT, y: HEIGHT - 4 }, `${figure(last, 1)} s`);
  const told = known.map((i) => lengths[i]);
  const range = { low: figure(Math.min(...told), 1), high: figure(Math.max(...told), 1), unit: words(`measure.unit_${unit}`) };
  svg.setAttribute("aria-label", words("measure.over_time", range));
}

/**
 * Move the line of the time in view.
 * @param {SVGSVGElement} svg as drawOverTime left it
 * @param {import("../base/wire.js").MeasuredShape} found
 * @param {number} t
 */
export function markTime(svg, { time_s: times }, t) {
  const line = svg.querySelector(".now");
  if (!line) return; // nothing is drawn
  const place = Math.min(Math.max(t * times.length, 0), times.length - 1);
  const before = times[Math.floor(place)];
  const seconds = before + (place % 1) * (times[Math.ceil(place)] - before);
  const x = LEFT + (seconds / (times.at(-1) || 1)) * (WIDTH - LEFT - RIGHT);
  for (const end of ["x1", "x2"]) line.setAttribute(end, x.toFixed(1));
}

/** Least and greatest of the axis. */
function spanOf(values, least) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const more = Math.max(0, least - (high - low)) / 2;
  return [Math.max(0, low - more), high + more];
}

/** Neighbouring frames together. */
function runsOf(frames) {
  const runs = [];
  for (const frame of frames) {
    if (runs.at(-1)?.at(-1) === frame - 1) runs.at(-1).push(frame);
    else runs.push([frame]);
  }
  return runs;
}
