// A scene's report in two layers: first what everybody understands, then codes and figures under "details".

import { getMasks } from "./api.js";
import { download } from "./downloads.js";
import { button, element } from "./element.js";
import { figuresOf, percent } from "./figures.js";
import { lightMark, reasonsOf, trustOf } from "./light.js";
import { figure, words } from "./messages.js";

/** @typedef {import("./wire.js").Report} Report */

/** @param {Report["masks"]} masks */
const areFound = (masks) => masks?.source === "found" || masks?.source === "segmenter";

/** What the clip showed, a sentence each. @param {Report} report */
function seen({ frame_count: frames, frame_times_s: times, width, height, eyes, poses, masks, coverage }) {
  const seconds = figure((times.at(-1) ?? 0) - (times[0] ?? 0), 1);
  const sentences = [words("report.clip", { frames: figure(frames), seconds, width, height })];
  if (eyes) sentences.push(words(`report.eyes_${eyes}`));
  if (poses) sentences.push(words(`report.camera_${poses.source}`, { path: figure(poses.path_mm ?? 0, 0) }));
  if (masks) sentences.push(words(masks.source === "none" ? "report.no_masks" : "report.masks", { share: percent(masks.share) }));
  if (Number.isFinite(coverage)) sentences.push(words("report.covered", { share: percent(coverage) }));
  return sentences;
}

const listOf = (sentences, name) => element("ul", { class: name }, ...sentences.map((text) => element("li", { text })));

/** How to send better masks. */
function correction(id, { masks }, message, onMasks) {
  if (!masks) return [];
  const send = button(words(masks.source === "none" ? "report.send_masks" : "report.send_better_masks"), () => onMasks(id));
  if (!areFound(masks) || !masks.share) return [send];
  const save = button(words("report.save_masks"), () => download(`${id}-masks.zip`, () => getMasks(id), message));
  return [save, send, element("p", { class: "quiet", text: words("report.how_to_correct") })];
}

/**
 * @param {HTMLElement} target
 * @param {string} id
 * @param {Report} report
 * @param {(id: string) => void} onMasks better masks are to be sent for this scene's clip
 */
export function showReport(target, id, report, onMasks) {
  const trust = trustOf(report);
  const reasons = reasonsOf(trust);
  const message = element("div", { class: "message bad" });
  const isOpen = target.querySelector("details.figures")?.open ?? false;
  const figures = figuresOf(report);
  figures.open = isOpen;
  target.replaceChildren(
    element("div", { class: "verdict" }, lightMark(trust.light), element("p", { text: words(`light.${trust.light}_why`) })),
    ...(reasons.length > 0 ? [element("h3", { text: words("report.careful") }), listOf(reasons, "reasons")] : []),
    element("h3", { text: words("report.seen") }),
    listOf(seen(report), "seen"),
    figures,
    ...correction(id, report, message, onMasks),
    message,
  );
}
