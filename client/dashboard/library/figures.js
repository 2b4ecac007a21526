// The second layer of a report: its figures, for those who know what they mean. What a report does not hold is left out.

import { element } from "../base/element.js";
import { figure, words } from "../base/messages.js";
import { isPending } from "./trustlight.js";

/** @typedef {import("../base/wire.js").Report} Report */

/** As the service's own warning has it (masks_unsure). */
const MIN_SURE = 0.7;

const number = (value, digits, unit) => (Number.isFinite(value) ? `${figure(value, digits)} ${unit}` : null);
export const percent = (value, digits = 0) => (Number.isFinite(value) ? `${figure(value * 100, digits)} %` : null);
const joined = (sentences) => sentences.filter(Boolean).join(" ") || null;

/**
 * What copying neighbouring frames reaches, by name.
 * @param {Report} report
 * @returns {{name: string, db: number}[]}
 */
export function baselinesOf(report) {
  const baselines = [
    { name: words("figure.blending"), db: report.baseline_blend_db },
    { name: words("figure.warping"), db: report.baseline_flow_db },
  ];
  return baselines.filter(({ db }) => Number.isFinite(db));
}

/**
 * Of the views that are shown, and of the model alone.
 * @param {Pick<Report, "scored"|"psnr_tissue_db"|"detail"|"baseline_blend_db"|"baseline_flow_db">} report
 * @param {boolean} [hasDetail] whether views are shown with detail from recorded frames, where the scene has scores of it
 */
export function likenessOf({ psnr_tissue_db: alone, detail, ...report }, hasDetail = true) {
  if (!Number.isFinite(alone)) return words(isPending(report) ? "figure.pending" : "figure.not_measured");
  if (detail && !hasDetail) return words("figure.without_detail", { db: number(alone, 2, "dB") });
  const db = number(detail?.psnr_tissue_db ?? alone, 2, "dB");
  const best = Math.max(...baselinesOf(report).map((each) => each.db));
  return joined([
    Number.isFinite(best)
      ? words("figure.likeness_beside_copies", { db, best: number(best, 2, "dB") })
      : words("figure.likeness", { db }),
    detail && words("figure.without_detail", { db: number(alone, 2, "dB") }),
  ]);
}

/** Likeness from beside: the right eye of a stereo clip. @param {Report} report */
function rightEye({ psnr_right_db: right, detail, baseline_warp_db: warped, ...report }) {
  if (!Number.isFinite(right)) return null;
  const { psnr_clear_db: left, psnr_right_clear_db: clear } = report;
  const db = (value) => number(value, 2, "dB");
  return joined([
    words("figure.right_eye", { db: db(detail?.psnr_right_db ?? right) }),
    Number.isFinite(warped) && words("figure.right_eye_warped", { db: db(warped) }),
    Number.isFinite(detail?.psnr_right_db) && words("figure.without_detail", { db: db(right) }),
    Number.isFinite(clear) && Number.isFinite(left) && words("figure.right_eye_clear", { db: db(clear), left: db(left) }),
  ]);
}

/** @param {Report} report */
function instruments({ masks }) {
  if (!masks) return null;
  const share = percent(masks.share, 1);
  const where = words(`figure.masks_${masks.source}`, { share });
  if (!Number.isFinite(masks.sure)) return where;
  const sure = words(masks.sure < MIN_SURE ? "figure.masks_not_sure" : "figure.masks_sure", { share: percent(masks.sure) });
  return joined([where, sure]);
}

/** @param {Report} report */
function clip({ frame_count: frames, train_count: trained, held_out: heldOut }) {
  return words("figure.frames_used", { frames: figure(frames), trained: figure(trained), held: heldOut?.length ?? 0 });
}

/** @param {Report} report @returns {[string, string][]} */
function rows(report) {
  return [
    ["likeness_title", likenessOf(report)],
    ["right_eye_title", rightEye(report)],
    ["depth_title", number(report.depth_agreement_mm, 2, "mm")],
    ["covered_title", percent(report.coverage)],
    ["instruments_title", instruments(report)],
    ["frames_title", Number.isFinite(report.frame_count) ? clip(report) : null],
    ["size_title", Number.isFinite(report.gaussians) ? words("figure.gaussians", { count: figure(report.gaussians) }) : null],
    ["training_title", number(report.seconds?.t_train_s, 1, "s")],
    ["preset_title", report.preset],
  ].filter(([, text]) => text !== null);
}

/** A notice as the service has it: its code and its text. @param {import("../base/wire.js").Notice} notice */
function raw({ code, text }) {
  const said = element("span", { text });
  said.lang = "en";
  return element("li", {}, element("code", { text: code }), " ", said);
}

/** @param {string} title @param {import("../base/wire.js").Notice[]} notices */
function list(title, notices) {
  if (notices.length === 0) return [];
  return [element("dt", { text: words(title) }), element("dd", {}, element("ul", {}, ...notices.map(raw)))];
}

/**
 * Every number and word of a report by its name in the API; lists by their length.
 * @param {Record<string, any>} values
 * @param {string} [within] the name of what holds them
 * @returns {[string, string][]}
 */
function rawFigures(values, within = "") {
  return Object.entries(values).flatMap(([name, value]) => {
    if (value === null || value === undefined) return [];
    if (Array.isArray(value)) return [[`${within}${name}`, `[${value.length}]`]];
    return typeof value === "object" ? rawFigures(value, `${within}${name}.`) : [[`${within}${name}`, String(value)]];
  });
}

/** @param {Report} report @returns {HTMLElement} for programs and those who write them */
function everything(report) {
  const lines = rawFigures(report).map(([name, value]) =>
    element("tr", {}, element("th", { text: name }), element("td", { text: value })));
  const table = element("table", { class: "everything" }, element("tbody", {}, ...lines));
  table.lang = "en";
  return element("details", {}, element("summary", { text: words("figure.everything") }), table);
}

/** @param {Report} report @returns {HTMLElement} closed until somebody opens it */
export function figuresOf(report) {
  const lines = element("dl");
  for (const [title, text] of rows(report)) {
    lines.append(element("dt", { text: words(`figure.${title}`) }), element("dd", { text }));
  }
  const of = (severity) => report.warnings.filter((notice) => notice.severity === severity);
  lines.append(
    ...list("figure.warnings_title", of("warning")),
    ...list("figure.notes_title", of("info")),
    ...list("figure.assumed_title", report.assumptions),
  );
  return element("details", { class: "figures" }, element("summary", { text: words("report.details") }), lines, everything(report));
}
