// What the page reads of Matroska: the videos that intrasplat/scene/training_pictures.py writes.

import { DamagedError } from "./decode.js";

const [SEGMENT, SEEK_HEAD, SEEK, SEEK_ID, SEEK_POSITION] = [0x18538067, 0x114d9b74, 0x4dbb, 0x53ab, 0x53ac];
const [INFO, SCALE, TRACKS, TRACK, NUMBER, CODEC, PRIVATE] = [0x1549a966, 0x2ad7b1, 0x1654ae6b, 0xae, 0xd7, 0x86, 0x63a2];
const [VIDEO, WIDTH, HEIGHT] = [0xe0, 0xb0, 0xba];
const [TAGS, TAG, SIMPLE_TAG, TAG_NAME, TAG_TEXT] = [0x1254c367, 0x7373, 0x67c8, 0x45a3, 0x4487];
const [CUES, CUE, CUE_TIME, CUE_TRACK, CUE_NUMBER, CUE_CLUSTER] = [0x1c53bb6b, 0xbb, 0xb3, 0xb7, 0xf7, 0xf1];
const [CLUSTER, CLUSTER_TIME, GROUP, BLOCK, SIMPLE_BLOCK] = [0x1f43b675, 0xe7, 0xa0, 0xa1, 0xa3];
const SCALE_NS = 1e6;

/** @typedef {{id: number, at: number, end: number}} Element its content's first and last byte, in the file's part */
/** @typedef {{number: number, codec: string, description: Uint8Array | null, width: number, height: number}} Track */
/** time: seconds. at: of its cluster, in the file. @typedef {{time: number, number: number, at: number}} Key */
/** @typedef {{number: number, time: number, data: Uint8Array}} Block */

/** A number of variable length. @returns {[number, number]} it, and where it ends; with its marker if asked for */
function variable(bytes, at, withMarker) {
  const length = Math.clz32(bytes[at]) - 23;
  if (length > 8 || at + length > bytes.length) throw new DamagedError("The recorded frames' file is damaged.");
  let value = withMarker ? bytes[at] : bytes[at] & (0xff >> length);
  for (let i = 1; i < length; i++) value = value * 256 + bytes[at + i];
  return [value, at + length];
}

/** The elements in a run of bytes; the last one may be cut off. @returns {Generator<Element>} */
function* elements(bytes, { at, end }) {
  while (at < end) {
    const [id, afterId] = variable(bytes, at, true);
    const [size, start] = variable(bytes, afterId, false);
    yield { id, at: start, end: start + size };
    at = start + size;
  }
}

function* inside(bytes, parent, ...ids) {
  const [id, ...deeper] = ids;
  for (const each of elements(bytes, parent)) {
    if (each.id !== id) continue;
    if (each.end > bytes.length) throw new DamagedError("A part of the recorded frames' file is missing.");
    if (deeper.length === 0) yield each;
    else yield* inside(bytes, each, ...deeper);
  }
}

const first = (bytes, parent, ...ids) => inside(bytes, parent, ...ids).next().value ?? null;
const number = (bytes, { at, end }) => bytes.subarray(at, end).reduce((sum, each) => 256 * sum + each, 0);
const text = (bytes, { at, end }) => new TextDecoder().decode(bytes.subarray(at, end));

function numberIn(bytes, parent, ...ids) {
  const found = first(bytes, parent, ...ids);
  return found === null ? 0 : number(bytes, found);
}

/**
 * What a file begins with.
 * @param {Uint8Array} bytes its beginning
 * @param {string} tag
 * @returns {{start: number, cuesAt: number, scaleS: number, tracks: Track[], tag: string}} start: the place that cues count
 *   from; tag: its text
 */
export function headOf(bytes, tag) {
  const segment = [...elements(bytes, { at: 0, end: Math.min(bytes.length, 256) })].find(({ id }) => id === SEGMENT);
  if (!segment) throw new DamagedError("The recorded frames are no Matroska file.");
  const start = segment.at;
  const whole = { at: start, end: Math.min(segment.end, bytes.length) };
  const seeks = [...inside(bytes, whole, SEEK_HEAD, SEEK)];
  const cues = seeks.find((each) => numberIn(bytes, each, SEEK_ID) === CUES);
  const tags = [...inside(bytes, whole, TAGS, TAG, SIMPLE_TAG)];
  const own = tags.find((each) => text(bytes, first(bytes, each, TAG_NAME)) === tag);
  const tracks = [...inside(bytes, whole, TRACKS, TRACK)].map((each) => {
    const extra = first(bytes, each, PRIVATE);
    return {
      number: numberIn(bytes, each, NUMBER),
      codec: text(bytes, first(bytes, each, CODEC)),
      description: extra && bytes.slice(extra.at, extra.end),
      width: numberIn(bytes, each, VIDEO, WIDTH),
      height: numberIn(bytes, each, VIDEO, HEIGHT),
    };
  });
  if (!cues || !own) throw new DamagedError("The recorded frames' file has no index.");
  const scaleS = (numberIn(bytes, whole, INFO, SCALE) || SCALE_NS) / 1e9;
  return { start, cuesAt: start + numberIn(bytes, cues, SEEK_POSITION), scaleS, tracks, tag: text(bytes, first(bytes, own, TAG_TEXT)) };
}

/** @param {Uint8Array} bytes from the cues on @param {ReturnType<headOf>} head @returns {Key[]} */
export function keysOf(bytes, { start, scaleS }) {
  return [...inside(bytes, { at: 0, end: bytes.length }, CUES, CUE)].flatMap((cue) => {
    const time = numberIn(bytes, cue, CUE_TIME) * scaleS;
    return [...inside(bytes, cue, CUE_TRACK)].map((each) => {
      return { time, number: numberIn(bytes, each, CUE_NUMBER), at: start + numberIn(bytes, each, CUE_CLUSTER) };
    });
  });
}

/** @param {Uint8Array} bytes whole clusters @param {number} scaleS @returns {Block[]} in the order of coding */
export function blocksOf(bytes, scaleS) {
  return [...inside(bytes, { at: 0, end: bytes.length }, CLUSTER)].flatMap((cluster) => {
    const began = numberIn(bytes, cluster, CLUSTER_TIME);
    const blocks = [...elements(bytes, cluster)].flatMap((each) => {
      if (each.id === GROUP) return [first(bytes, each, BLOCK)];
      return each.id === SIMPLE_BLOCK ? [each] : [];
    });
    return blocks.map(({ at, end }) => {
      const [track, after] = variable(bytes, at, false);
      const ticks = ((bytes[after] << 24) | (bytes[after + 1] << 16)) >> 16; // signed
      return { number: track, time: (began + ticks) * scaleS, data: bytes.subarray(after + 3, end) };
    });
  });
}
