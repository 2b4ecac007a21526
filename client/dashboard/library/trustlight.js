// The traffic light of a scene: one judgement from its report's notices and scores, by code. It has a shape and a word
// beside its colour.

import { element } from "../base/element.js";
import { noticeWords, words } from "../base/messages.js";

/** What a warning of each code does to the light. A code that is not here, of a newer service, asks for care. */
const WEIGHTS = {
  "bad": [
    "depth_disagrees", "depth_inverted", "eyes_disagree", "field_of_view_unusual", "held_out_score_low",
    "held_out_without_tissue", "little_stereo_depth", "little_tissue", "nothing_held_out", "scores_failed",
    "training_score_low"
  ],
  "care": [
    "alignment_unknown", "blood", "blurred_frames", "brightness_changes", "calibration_scaled", "camera_or_tissue", "colour_changes",
    "damaged_frames", "depth_jumps", "depth_not_compared", "depth_out_of_range", "depth_unusual", "detail_lost",
    "detail_missing", "enlarged", "eyes_out_of_step", "eyes_unlike", "few_frames", "first_picture", "frames_show_nothing",
    "frames_without_tissue",
    "generalisation_gap", "hardly_seen", "hidden_at_first", "holes", "light_flickers", "little_depth", "mask_gaps",
    "mask_levels", "masks_mark_nothing", "masks_unsure", "motion_guessed", "no_instrument_masked", "no_texture",
    "out_of_focus", "outlier_frames", "pose_far", "pose_jitter", "poses_contradict", "poses_unsure", "repeated_frames",
    "right_eye_low", "sharpness_changes", "stereo_unsure", "time_in_gap", "time_outside_clip", "time_too_short",
    "training_goes_on", "unclassified", "unseen", "veiled"
  ],
  "fine": [
    "colours_unknown", "eyes_coloured_apart", "frame_count_unknown", "gpu_idle",
    "held_out_repeated", "magnified", "rows_misaligned"
  ]
};
const WEIGHT_OF = new Map(Object.entries(WEIGHTS).flatMap(([weight, codes]) => codes.map((code) => [code, weight])));
const SHAPES = { good: "●", care: "▲", bad: "■", pending: "◌" };

/** @typedef {"good"|"care"|"bad"|"pending"} Light */
/**
 * @typedef {{light: Light, reasons: import("../base/wire.js").Notice[]}} Trust reasons for care, the worst first
 */

/** Whether scores are still to come. @param {{scored: boolean}} report */
export const isPending = ({ scored }) => scored === false;

/** @param {import("../base/wire.js").Notice} notice @returns {"bad"|"care"|"fine"} */
const weightOf = ({ code, severity }) => (severity === "warning" ? (WEIGHT_OF.get(code) ?? "care") : "fine");

/**
 * @param {Pick<import("../base/wire.js").Report, "scored"|"psnr_tissue_db"|"warnings">} report
 * @returns {Trust}
 */
export function trustOf({ scored, psnr_tissue_db: db, warnings }) {
  const of = (weight) => warnings.filter((notice) => weightOf(notice) === weight);
  const [worst, some] = [of("bad"), of("care")];
  const reasons = [...worst, ...some];
  if (worst.length > 0) return { light: "bad", reasons };
  if (scored === false) return { light: "pending", reasons };
  if (!Number.isFinite(db)) return { light: "bad", reasons };
  return { light: some.length > 0 ? "care" : "good", reasons };
}

/**
 * @param {Trust} trust
 * @param {(notice: import("../base/wire.js").Notice) => string} wordsOf a reason
 * @returns {{code: string, text: string}[]} why, in plain words; codes may share a sentence
 */
export function reasonsOf({ light, reasons }, wordsOf = noticeWords) {
  if (light === "bad" && reasons.length === 0) return [{ code: "not_measured", text: words("light.not_measured") }];
  return reasons.map((notice) => ({ code: notice.code, text: wordsOf(notice) }));
}

/** @param {Light} light @returns {HTMLElement} shape and word */
export function lightMark(light) {
  const shape = element("span", { class: "shape", text: SHAPES[light] });
  shape.setAttribute("aria-hidden", "true");
  return element("span", { class: `light ${light}` }, shape, element("span", { text: words(`light.${light}`) }));
}
