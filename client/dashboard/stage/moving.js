// A scene that plays and rocks as it opens.

/**
 * Let the scene in view play and rock, as its address says; not for whoever wants less motion.
 * @param {import("./viewer.js").Viewer} viewer @param {{plays: boolean, rocks: boolean}} place
 */
export function setMoving(viewer, { plays, rocks }) {
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
  if (plays) viewer.timeline.play(true);
  if (rocks) viewer.swing();
}
