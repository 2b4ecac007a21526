// A scene's report in two layers: first what everybody understands, then codes and figures under "details".

import { getMasks } from "../base/api.js";
import { button, element } from "../base/element.js";
import { figure, noticeWords, words } from "../base/messages.js";
import { lightList } from "../stage/lightstrip.js";
import { download } from "./downloads.js";
import { figuresOf, percent } from "./figures.js";
import { isPending, lightMark, reasonsOf, trustOf } from "./trustlight.js";

/** @typedef {import("../base/wire.js").Report} Report */

/** @param {Report["masks"]} masks */
const areFound = (masks) => masks?.source === "found" || masks?.source === "segmenter";

/** Coefficients of distortion that the brush computes with; any after them stand for a tilted sensor. */
const MAX_DISTORTION = 12;
/** More reasons for care than these are under "details". */
const MAX_REASONS = 3;

/** Whether a notice doubts what the report says of the endoscope's movement. @param {Report} report */
const doubtsCamera = ({ poses }) => ({ code }) =>
  (code === "camera_or_tissue" && poses?.source !== "given") || (code === "poses_unsure" && poses?.source === "fixed");

/** Whether and how far the endoscope moved. @param {NonNullable<Report["poses"]>} poses @param {boolean} isDoubted */
const cameraWords = ({ source, path_mm: mm }, isDoubted) =>
  words(`report.camera_${source}${isDoubted ? "_or_tissue" : ""}`, { mm: figure(mm ?? 0) });

/** What can be trusted, a sentence each, in mm, seconds and shares of the picture. @param {Report} report */
function trusted(report) {
  const { frame_count: frames, frame_times_s: times, eyes, poses, masks, coverage, depth_agreement_mm: depth_mm } = report;
  const { field_of_view: field } = report;
  const seconds = figure((times.at(-1) ?? 0) - (times[0] ?? 0), 1);
  const sentences = [words(`report.clip${eyes ? `_${eyes}` : ""}`, { frames: figure(frames), seconds })];
  const isMeasured = Number.isFinite(depth_mm);
  const unmeasured = isPending(report) ? "report.depth_pending" : "report.no_depth";
  sentences.push(words(isMeasured ? "report.depth" : unmeasured, { mm: figure(depth_mm ?? 0, 1) }));
  if (Number.isFinite(coverage)) sentences.push(words(coverage < 0.995 ? "report.covered" : "report.covered_all", { share: percent(coverage) }));
  const fieldWords = field?.source === "given" ? "report.field_of_view_given" : "report.field_of_view";
  if (field && field.share < 1) sentences.push(words(fieldWords, { share: percent(field.share) }));
  if (masks) sentences.push(words(masks.source === "none" ? "report.no_masks" : "report.masks", { share: percent(masks.share) }));
  if (poses && !report.warnings.some(doubtsCamera(report))) sentences.push(cameraWords(poses, false));
  return sentences;
}

/**
 * Why to be careful, the worst first.
 * @param {Report} report
 * @param {import("./trustlight.js").Trust} trust
 * @returns {{code: string, text: string}[]}
 */
export function reasonsIn(report, trust) {
  const isDoubt = doubtsCamera(report);
  return reasonsOf(trust, (notice) => (report.poses && isDoubt(notice) ? cameraWords(report.poses, true) : noticeWords(notice)));
}

/** @param {Report} report @param {import("./trustlight.js").Trust} trust @returns {Node[]} */
function careful(report, trust) {
  const reasons = [...new Set(reasonsIn(report, trust).map(({ text }) => text))];
  const more = reasons.length - MAX_REASONS;
  const shown = reasons.length > 0 ? [listOf(reasons.slice(0, MAX_REASONS), "reasons")] : [];
  if (more > 0) shown.push(element("p", { class: "quiet", text: words("report.more_reasons", { count: more }) }));
  const sides = Number.isFinite(report.psnr_right_db) ? "report.tested_beside" : "report.tested_here";
  return [element("h3", { text: words("report.careful") }), ...shown, element("p", { class: "quiet", text: words(sides) })];
}

const listOf = (sentences, name) => element("ul", { class: name }, ...sentences.map((text) => element("li", { text })));

/**
 * Whether the masks can be painted in the page: there are frames to paint on, and masks in the pixels of the recording. Given
 * masks are known only as the frames have them, so these must be all frames, as they were recorded.
 * @param {Report} report
 */
function canPaint({ masks, recorded, frame_count: count }) {
  const pixels = recorded?.pixels;
  if (!masks || !pixels || pixels.distortion.slice(MAX_DISTORTION).some(Boolean)) return false;
  if (areFound(masks) || !masks.share) return true;
  const isAsRecorded = pixels.distortion.length === 0 && pixels.rays.every((each, i) => each === (i % 4 === 0 ? 1 : 0));
  return recorded.frames.length === count && recorded.width === pixels.width && isAsRecorded;
}

/** How to save the masks, and to send better ones. */
function correction(id, report, message, { maySend, onMasks, onPaint }) {
  const { masks } = report;
  if (!masks) return [];
  const save = areFound(masks) && masks.share ? [button(words("report.save_masks"), () => download(() => getMasks(id), message))] : [];
  if (!maySend) return save;
  const paint = canPaint(report) ? [button(words("brush.title"), () => onPaint(id, report))] : [];
  const send = button(words(masks.source === "none" ? "report.send_masks" : "report.send_better_masks"), () => onMasks(id));
  const how = save.map(() => element("p", { class: "quiet", text: words("report.how_to_correct") }));
  return [...paint, ...save, send, ...how];
}

/**
 * @param {HTMLElement} target
 * @param {string} id
 * @param {Report} report
 * @param {{maySend: boolean, onMasks: (id: string) => void, onPaint: (id: string, report: Report) => void}} sending whether
 *   the key may send clips; better masks are to be sent for this scene's clip, or to be painted
 */
export function showReport(target, id, report, sending) {
  const trust = trustOf(report);
  const message = element("div", { class: "message bad" });
  const isOpen = target.querySelector("details.figures")?.open ?? false;
  const figures = figuresOf(report);
  figures.open = isOpen;
  target.replaceChildren(
    element("div", { class: "verdict" }, lightMark(trust.light), element("p", { text: words(`light.${trust.light}_why`) })),
    element("h3", { text: words("report.trusted") }),
    listOf(trusted(report), "trusted"),
    ...careful(report, trust),
    ...lightList(report.light),
    figures,
    ...correction(id, report, message, sending),
    message,
  );
}
