// A scene's report in plain words. Values that a report does not hold are left out.

import { exportScene, getMasks } from "./api.js";
import { button, element } from "./element.js";

const number = (value, digits, unit) => (Number.isFinite(value) ? `${value.toFixed(digits)} ${unit}`.trim() : null);
const share = (value) => (Number.isFinite(value) ? `${Math.round(value * 100)} %` : null);

/**
 * What copying neighbouring frames reaches, by name.
 * @param {import("./wire.js").Report} report
 * @returns {{name: string, db: number}[]}
 */
export function baselinesOf(report) {
  const baselines = [
    { name: "blending", db: report.baseline_blend_db },
    { name: "warping", db: report.baseline_flow_db },
  ];
  return baselines.filter(({ db }) => Number.isFinite(db));
}

function quality(report) {
  const model = number(report.psnr_tissue_db, 2, "dB");
  if (model === null) return "Not measured: no frames were held out.";
  const best = Math.max(...baselinesOf(report).map(({ db }) => db));
  if (!Number.isFinite(best)) return `${model} on frames it never saw.`;
  const verdict = report.psnr_tissue_db > best ? "better" : "no better";
  return `${model} on frames it never saw; ${verdict} than copying neighbouring frames (${best.toFixed(2)} dB).`;
}

/**
 * Likeness from beside: the right eye of a stereo clip. None for a clip of one eye.
 * @param {import("./wire.js").Report} report
 */
function rightEye({ psnr_right_db: right, baseline_warp_db: warped, psnr_clear_db: leftClear, psnr_right_clear_db: clear }) {
  if (!Number.isFinite(right)) return null;
  const sentences = [`${number(right, 2, "dB")} on frames it never saw, where the left eye sees the tissue, too`];
  if (Number.isFinite(warped)) {
    const verdict = right > warped ? "better" : "no better";
    sentences[0] += `; ${verdict} than shifting the left eye's own picture by its depth (${number(warped, 2, "dB")})`;
  }
  if (Number.isFinite(clear) && Number.isFinite(leftClear)) {
    sentences.push(`Without wet highlights ${number(clear, 2, "dB")}, left eye ${number(leftClear, 2, "dB")}`);
  }
  return sentences.map((sentence) => `${sentence}.`).join(" ");
}

/** The one sentence to read first. */
function verdict(report) {
  const best = Math.max(...baselinesOf(report).map(({ db }) => db));
  if (report.scored === false) return "It can be viewed. How good it is, is still being measured.";
  if (!Number.isFinite(report.psnr_tissue_db)) return "Its quality could not be measured: do not rely on it.";
  if (report.psnr_tissue_db <= best) return "Between the frames it is not better than copying them.";
  const count = report.warnings.filter(isWarning).length;
  if (count === 0) return "Measured; nothing to distrust was found.";
  return `Measured, with ${count === 1 ? "a warning" : `${count} warnings`}; read on.`;
}

function clip({ frame_count: frames, width, height, held_out: heldOut }) {
  if (!Number.isFinite(frames)) return null;
  return `${frames} frames of ${width} × ${height}, ${heldOut?.length ?? 0} held out to judge by`;
}

const SOURCES = {
  given: "Masked as given with the clip",
  found: "Found by their colour and depth",
  segmenter: "Found by this installation's network",
};
/** As the service's own warning has it (masks_unsure). */
const MIN_SURE = 0.7;

/** @param {import("./wire.js").Masks | null} masks */
const areFound = (masks) => masks?.source === "found" || masks?.source === "segmenter";

/**
 * What is masked, and how sure that is. Reports of version 0.2 do not tell.
 * @param {import("./wire.js").Report} report
 */
function instruments({ masks }) {
  if (!masks) return null;
  if (masks.source === "none") return "None masked: every pixel counts as tissue.";
  const masked = `${SOURCES[masks.source]}; ${(masks.share * 100).toFixed(1)} % of the picture.`;
  if (!Number.isFinite(masks.sure)) return masked;
  const clear = `of what looks like an instrument, ${share(masks.sure)} is told clearly from tissue`;
  return masks.sure < MIN_SURE ? `${masked} Not sure: ${clear}.` : `${masked} Sure: ${clear}.`;
}

function rows(report) {
  return [
    ["Likeness", quality(report)],
    ["Likeness from the right eye", rightEye(report)],
    ["Depth against stereo", number(report.depth_agreement_mm, 2, "mm (median difference)")],
    ["Tissue covered", share(report.coverage)],
    ["Instruments", instruments(report)],
    ["Clip", clip(report)],
    ["Size", Number.isFinite(report.gaussians) ? `${report.gaussians.toLocaleString("en")} Gaussians` : null],
    ["Training", number(report.seconds?.t_train_s, 1, "s")],
  ].filter(([, text]) => text !== null);
}

/** @param {import("./wire.js").Notice} notice */
const isWarning = (notice) => notice.severity === "warning";

function list(title, notices, kind) {
  if (notices.length === 0) return [];
  const items = notices.map(({ text }) => element("li", { text }));
  return [element("dt", { text: title }), element("dd", {}, element("ul", { class: kind }, ...items))];
}

/** Not a link: a link sends no key. */
async function download(name, load, message) {
  message.textContent = "";
  try {
    const link = element("a");
    link.href = URL.createObjectURL(await load());
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  } catch (error) {
    message.textContent = error.message;
  }
}

/** How to send better masks. */
function correction(id, { masks }, message, onMasks) {
  if (!masks) return [];
  const send = button(masks.source === "none" ? "Send masks" : "Send better masks", () => onMasks(id));
  if (!areFound(masks) || !masks.share) return [send];
  const save = button("Save the masks (.zip)", () => download(`${id}-masks.zip`, () => getMasks(id), message));
  const text = "To correct them: save them, paint instruments white and tissue black, and send them. The clip itself need not be sent again.";
  return [save, send, element("p", { class: "quiet", text })];
}

/**
 * @param {HTMLElement} target
 * @param {string} id
 * @param {import("./wire.js").Report} report
 * @param {(id: string) => void} onMasks better masks are to be sent for this scene's clip
 */
export function showReport(target, id, report, onMasks) {
  const lines = element("dl");
  lines.append(element("dt", { text: "How far to trust it" }));
  lines.append(element("dd", { class: "verdict", text: verdict(report) }));
  lines.append(...list("Warnings", report.warnings.filter(isWarning), "warning"));
  lines.append(...list("Good to know", report.warnings.filter((notice) => !isWarning(notice)), ""));
  for (const [title, text] of rows(report)) lines.append(element("dt", { text: title }), element("dd", { text }));
  lines.append(...list("Assumed", report.assumptions, ""));
  const message = element("p", { class: "message bad" });
  const save = button("Save the first frame's Gaussians (.ply)", () =>
    download(`${id}.ply`, () => exportScene(id, 0), message),
  );
  target.replaceChildren(lines, save, ...correction(id, report, message, onMasks), message);
}
