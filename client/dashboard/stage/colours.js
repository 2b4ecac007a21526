// The false colours of depth, confidence and error: those of the service's pictures. Depth is bright where it is near,
// confidence where it is high.

import { COLOUR_TABLE, ERROR_COLOURS } from "../base/wire.js";

const STOPS = 32;

/** 256 colours, R G B, from dark to bright, as a texture takes them. */
export const COLOURS = Uint8Array.from(COLOUR_TABLE.match(/../g), (byte) => parseInt(byte, 16));

/** @param {number} share from 0, dark, to 1, bright; beyond, the nearer end @returns {string} a CSS colour */
export function colourOf(share) {
  const place = 3 * Math.round(255 * Math.min(1, Math.max(0, share)));
  return `rgb(${COLOURS.slice(place, place + 3).join(" ")})`;
}

/** @param {string} direction of CSS, such as "to right" @returns {string} a CSS gradient from dark to bright */
export const gradient = (direction) =>
  `linear-gradient(${direction}, ${Array.from({ length: STOPS + 1 }, (_, i) => colourOf(i / STOPS)).join(", ")})`;

/** @returns {string} a CSS gradient from where the model is darker than the recording to where it is brighter */
export const errorGradient = () => `linear-gradient(to right, ${ERROR_COLOURS.join(", ")})`;
