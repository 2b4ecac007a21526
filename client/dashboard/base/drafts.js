// The strokes over a scene's masks that were not sent yet, in this tab: a draft for each scene.

import { readTabStorage, writeTabStorage } from "./storage.js";

/** @typedef {import("../masks/strokes.js").Stroke} Stroke */

/** @param {string} scene */
const nameOf = (scene) => `intrasplat-strokes-${scene}`;

/** @param {string} scene @returns {Stroke[]} */
export const readStrokes = (scene) => readTabStorage(nameOf(scene)) ?? [];

/** @param {string} scene @param {Stroke[]} strokes none forgets the draft */
export const storeStrokes = (scene, strokes) => writeTabStorage(nameOf(scene), strokes.length > 0 ? strokes : null);
