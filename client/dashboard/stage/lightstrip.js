// What light and smoke did over the clip: in words, and as a strip under the time line. A line is the exposure, an area the
// share of light that smoke takes.

import { draw, element } from "../base/element.js";
import { figure, words } from "../base/messages.js";
import { percent } from "../library/figures.js";

/** @typedef {import("../base/wire.js").LightChanges} LightChanges */

/** The strip's height stands for at least so much, so that little does not look like much. */
const MIN_STOPS = 1;
const MIN_SMOKE = 0.25;
const HEIGHT = 100;
/** Above and below the line, which has a width. */
const MARGIN = 10;

const isDrawn = ({ kind }) => kind === "stops" || kind === "smoke";
const range = (values) => ({ low: Math.min(...values), high: Math.max(...values) });
const inWords = (values, say) => Object.fromEntries(Object.entries(range(values)).map(([end, value]) => [end, say(value)]));
const mean = (values) => values.reduce((sum, each) => sum + each, 0) / values.length;

/**
 * @param {LightChanges | null | undefined} light of a report
 * @returns {{kind: "stops"|"red"|"blue"|"smoke"|"border", text: string}[]} a sentence on each change; none where there is none
 */
export function lightWords(light) {
  const { reference, stops, red, blue, smoke_share: smoke, vignetting } = light ?? {};
  const found = [];
  const tell = (kind, values) => found.push({ kind, text: words(`strip.${kind}`, values) });
  const against = (kind, values, digits) =>
    values && tell(kind, { ...inWords(values, (each) => figure(each, digits)), frame: reference + 1 });
  against("stops", stops, 1);
  against("red", red, 2);
  against("blue", blue, 2);
  if (smoke) tell("smoke", { ...inWords(smoke, percent), mean: percent(mean(smoke)) });
  if (Number.isFinite(vignetting)) tell("border", { share: percent(vignetting) });
  return found;
}

/**
 * The sentences, and the strip's legend.
 * @param {LightChanges | null | undefined} light
 * @returns {Node[]}
 */
export function lightList(light) {
  const found = lightWords(light);
  if (found.length === 0) return [];
  const mark = (kind) => element("span", { class: `mark ${kind}` });
  const lines = found.map(({ kind, text }) => element("li", {}, mark(kind), element("span", { text })));
  const legend = found.some(isDrawn) ? [element("p", { class: "quiet", text: words("strip.where") })] : [];
  return [element("h3", { text: words("strip.title") }), element("ul", { class: "lit" }, ...lines), ...legend];
}

/** @param {SVGSVGElement} svg as wide as the places of the time line @param {LightChanges | null | undefined} light */
export function drawStrip(svg, light) {
  const { stops, smoke_share: smoke } = light ?? {};
  svg.replaceChildren();
  svg.toggleAttribute("hidden", !stops && !smoke);
  if (!stops && !smoke) return;
  const last = Math.max(1, (stops ?? smoke).length - 1);
  svg.setAttribute("viewBox", `0 0 ${last} ${HEIGHT}`);
  const y = (share) => HEIGHT - MARGIN - share * (HEIGHT - 2 * MARGIN);
  const places = (values, low, span) => values.map((each, frame) => `${frame},${y((each - low) / span).toFixed(1)}`);
  if (smoke) {
    const corners = places(smoke, 0, Math.max(MIN_SMOKE, ...smoke));
    draw(svg, "polygon", { class: "smoke", points: [`0,${y(0)}`, ...corners, `${last},${y(0)}`].join(" ") });
  }
  if (stops) {
    const { low, high } = range(stops);
    const span = Math.max(MIN_STOPS, high - low);
    draw(svg, "polyline", { class: "stops", points: places(stops, (low + high - span) / 2, span).join(" ") });
  }
  const shown = lightWords(light).filter(isDrawn);
  svg.setAttribute("aria-label", [words("strip.name"), ...shown.map(({ text }) => text)].join(" "));
}
