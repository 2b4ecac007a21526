// How addresses spell what is in view, where more than the address reads it.

/** Not a pose of the service's: the endoscope's right eye, wherever it is at t. */
export const RIGHT_EYE = "right";
/** The mode, then another scene; without one it is the recording. */
const COMPARISON = /^(wipe|side)(?:,([0-9a-f]{32}))?$/;

/** @param {string | null} text @returns {{mode: "wipe"|"side", scene: string} | null} scene: "" for the recording */
export function comparisonOf(text) {
  const [, mode, scene = ""] = COMPARISON.exec(text ?? "") ?? [];
  return mode ? { mode, scene } : null;
}
