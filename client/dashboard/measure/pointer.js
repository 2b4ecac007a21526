// What lies under the pointer: where in the picture it is, how deep the model is there, and which point of the world that is.

import { request } from "../base/api.js";

/** @typedef {import("../stage/stream.js").Camera} Camera */
/** @typedef {import("../stage/viewer.js").Shown} Shown */

/** Pixels of a side of the little depth picture, whose middle is asked for. */
const SIDE = 9;

/**
 * Where a place on the screen lies in the picture, which is shown whole.
 * @param {HTMLElement} canvas
 * @param {Camera} camera of the picture
 * @param {number} x of the window @param {number} y
 * @returns {{u: number, v: number, scale: number, isInside: boolean}} u, v: pixels of the picture, 0.5 is the middle of
 *   the first; scale: CSS pixels of one
 */
export function placeInPicture(canvas, camera, x, y) {
  const box = canvas.getBoundingClientRect();
  const scale = Math.min(box.width / camera.width, box.height / camera.height);
  const u = (x - box.left - (box.width - scale * camera.width) / 2) / scale;
  const v = (y - box.top - (box.height - scale * camera.height) / 2) / scale;
  return { u, v, scale, isInside: u >= 0 && v >= 0 && u <= camera.width && v <= camera.height };
}

/**
 * Depth of what is shown at a place of the picture, along the camera's z. The service draws a few pixels for it, also
 * where the browser draws the picture. /measure tells more, and only of finished scenes.
 * @param {Shown} shown
 * @param {number} u @param {number} v pixels of the picture
 * @returns {Promise<number>} mm; NaN where nothing solid is, or no frame saw it
 */
export async function depthAt({ scene, t, pose, eye, unseen, camera }, u, v) {
  const { fx, fy, cx, cy } = camera;
  const query = { scene, t, layer: "depth", format: "npy", unseen, width: SIDE, height: SIDE, fx, fy };
  const asked = new URLSearchParams({ ...query, cx: cx - u + SIDE / 2, cy: cy - v + SIDE / 2 });
  if (pose !== null) asked.set("pose", pose);
  if (eye === "right") asked.set("eye", eye);
  const file = await (await request(`/render?${asked}`)).arrayBuffer();
  return middleOf(file) || NaN;
}

/** @param {ArrayBuffer} npy of SIDE x SIDE float32 @returns {number} the middle pixel's */
function middleOf(npy) {
  const pixels = new Float32Array(npy.slice(npy.byteLength - 4 * SIDE * SIDE));
  return pixels[(SIDE * SIDE - 1) / 2];
}

/** @returns {number[]} x, y, z in the world, mm @param {Camera} camera */
export function worldPoint({ fx, fy, cx, cy, world_from_camera: rows }, u, v, depthMm) {
  const inCamera = [((u - cx) / fx) * depthMm, ((v - cy) / fy) * depthMm, depthMm, 1];
  return [0, 1, 2].map((i) => inCamera.reduce((sum, each, j) => sum + rows[4 * i + j] * each, 0));
}
