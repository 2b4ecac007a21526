// Between places in the tissue, points of a picture and points of the screen.

import { placeInPicture } from "./pointer.js";

/** @typedef {import("../stage/stream.js").Camera} Camera */
/** @typedef {[number, number]} Point in pixels */

/** @param {HTMLElement} canvas @param {Camera} camera @returns {number} pixels of the screen for one of the picture */
export const screenScale = (canvas, camera) => placeInPicture(canvas, camera, 0, 0).scale;

/**
 * @param {HTMLElement} canvas
 * @param {Camera} camera
 * @param {Point} place on the screen
 * @returns {Point | null} of the picture; null beside it
 */
export function toPicture(canvas, camera, [x, y]) {
  const { u, v } = placeInPicture(canvas, camera, x, y);
  return u >= 0 && v >= 0 && u < camera.width && v < camera.height ? [u, v] : null;
}

/**
 * @param {HTMLElement} canvas
 * @param {Camera} camera
 * @param {Point} point of the picture
 * @returns {Point} on the screen
 */
export function toScreen(canvas, camera, [x, y]) {
  const { u, v, scale } = placeInPicture(canvas, camera, 0, 0);
  return [scale * (x - u), scale * (y - v)];
}

/**
 * @param {Camera} camera
 * @param {number[]} place in the world, mm
 * @returns {Point | null} of the picture, also beyond its borders; null behind the camera
 */
export function project({ fx, fy, cx, cy, world_from_camera: pose }, place) {
  const from = [0, 1, 2].map((i) => place[i] - pose[4 * i + 3]);
  const [x, y, z] = [0, 1, 2].map((j) => from[0] * pose[j] + from[1] * pose[4 + j] + from[2] * pose[8 + j]);
  return z > 0 ? [(fx * x) / z + cx, (fy * y) / z + cy] : null;
}

/**
 * The query of GET /scenes/{id}/measure for points of a picture in view.
 * @param {import("../stage/viewer.js").Shown} shown
 * @param {Point[]} points
 * @returns {Record<string, string | number>}
 */
export function queryOf({ t, pose, eye = "left", camera }, points) {
  const { width, height, fx, fy, cx, cy, world_from_camera: rows } = camera;
  const query = { points: points.map((each) => each.join(",")).join(";"), t, width, height, fx, fy, cx, cy };
  const stands = pose ?? (eye === "left" ? null : rows.join(","));
  return stands === null ? query : { ...query, pose: stands };
}

/** Whether two views show the same places at the same points. */
export const sameView = (a, b) =>
  a !== null && b !== null && a.scene === b.scene && a.t === b.t && a.pose === b.pose && a.eye === b.eye &&
  a.camera?.width === b.camera?.width && a.camera?.height === b.camera?.height;

/** Whether the service can measure in what is shown: a finished scene, drawn by the model. */
export const isMeasurable = (shown) =>
  shown !== null && shown.state === "done" && shown.layer !== "recorded" && shown.camera !== null;
