// Masks as files: PNGs of one bit a pixel, and the zip that holds one a frame. Pixels do not go through a canvas, whose
// contents some browsers blur against tracking.

import { chunkOf, crcOf } from "../base/png.js";
import { Problem } from "../base/problem.js";

const LOCAL = 0x04034b50;
const ENTRY = 0x02014b50;
const END = 0x06054b50;
const LOCAL_BYTES = 30;
const ENTRY_BYTES = 46;
const END_BYTES = 22;
/** 1 January 1980, the first that a zip can say: the same masks give the same file. */
const NO_DATE = 0x21;
const PNG_HEAD = [137, 80, 78, 71, 13, 10, 26, 10];
/** IHDR after width and height: 1 bit, grey, no interlacing. */
const ONE_BIT_GREY = [1, 0, 0, 0, 0];

/** @param {Uint8Array} bytes @param {TransformStream} coder @returns {Promise<Uint8Array>} */
const through = async (bytes, coder) =>
  new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(coder)).arrayBuffer());

const viewOf = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
const UNUSABLE = 422;
/** @returns {Problem} that these are no masks of this clip */
export const unusable = () => new Problem(UNUSABLE, { field: "masks" });

/** @param {Uint8Array} bytes of a zip @returns {Promise<Map<string, Uint8Array>>} its files by name, in its order */
export async function unzipped(bytes) {
  const view = viewOf(bytes);
  let end = bytes.length - END_BYTES;
  while (end >= 0 && view.getUint32(end, true) !== END) end--;
  if (end < 0) throw unusable();
  const files = new Map();
  let at = view.getUint32(end + 16, true);
  for (let n = view.getUint16(end + 10, true); n > 0; n--) {
    if (view.getUint32(at, true) !== ENTRY) throw unusable();
    const [nameBytes, extraBytes, commentBytes] = [28, 30, 32].map((place) => view.getUint16(at + place, true));
    const name = new TextDecoder().decode(bytes.subarray(at + ENTRY_BYTES, at + ENTRY_BYTES + nameBytes));
    const local = view.getUint32(at + 42, true);
    const from = local + LOCAL_BYTES + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    const packed = bytes.subarray(from, from + view.getUint32(at + 20, true));
    files.set(name, view.getUint16(at + 10, true) ? await through(packed, new DecompressionStream("deflate-raw")) : packed);
    at += ENTRY_BYTES + nameBytes + extraBytes + commentBytes;
  }
  return files;
}

/** @param {Map<string, Uint8Array>} files by name, which is ASCII @returns {Blob} a zip that stores them as they are */
export function zipped(files) {
  const parts = [];
  const entries = [];
  let at = 0;
  for (const [name, content] of files) {
    const text = new TextEncoder().encode(name);
    // what both headers have: the needed version up to the length of the extra field
    const about = new DataView(new ArrayBuffer(26));
    about.setUint16(0, 20, true);
    about.setUint16(8, NO_DATE, true);
    about.setUint32(10, crcOf(content), true);
    for (const place of [14, 18]) about.setUint32(place, content.length, true);
    about.setUint16(22, text.length, true);
    const entry = new DataView(new ArrayBuffer(ENTRY_BYTES - 32));
    entry.setUint32(10, at, true);
    parts.push(number(LOCAL), about, text, content);
    entries.push(number(ENTRY), Uint8Array.of(20, 0), about, entry, text);
    at += LOCAL_BYTES + text.length + content.length;
  }
  const end = new DataView(new ArrayBuffer(END_BYTES));
  end.setUint32(0, END, true);
  for (const place of [8, 10]) end.setUint16(place, files.size, true);
  end.setUint32(12, entries.reduce((sum, each) => sum + each.byteLength, 0), true);
  end.setUint32(16, at, true);
  return new Blob([...parts, ...entries, end], { type: "application/zip" });
}

/** @param {number} value @returns {DataView} 4 bytes, the lowest first */
function number(value) {
  const made = new DataView(new ArrayBuffer(4));
  made.setUint32(0, value, true);
  return made;
}

/** @typedef {{width: number, height: number, pixels: Uint8Array}} Mask pixels: row by row, 1 on instruments, else 0 */

/** @param {Uint8Array} png of one bit a pixel, as the service writes them @returns {Promise<Mask>} */
export async function maskOf(png) {
  const view = viewOf(png);
  if (png.length < 33 || PNG_HEAD.some((byte, i) => png[i] !== byte)) throw unusable();
  if (ONE_BIT_GREY.some((byte, i) => png[24 + i] !== byte)) throw unusable();
  const [width, height] = [view.getUint32(16), view.getUint32(20)];
  const packed = [];
  for (let at = 8; at + 12 <= png.length; at += 12 + view.getUint32(at)) {
    if (view.getUint32(at + 4) === 0x49444154) packed.push(png.subarray(at + 8, at + 8 + view.getUint32(at))); // IDAT
  }
  const rows = await through(new Uint8Array(await new Blob(packed).arrayBuffer()), new DecompressionStream("deflate"));
  const stride = Math.ceil(width / 8);
  if (rows.length !== (stride + 1) * height) throw unusable();
  const pixels = new Uint8Array(width * height);
  let above = new Uint8Array(stride);
  for (let y = 0; y < height; y++) {
    const filter = rows[y * (stride + 1)];
    const row = rows.subarray(y * (stride + 1) + 1, (y + 1) * (stride + 1));
    for (let i = 0; i < stride; i++) row[i] += predicted(filter, i > 0 ? row[i - 1] : 0, above[i], i > 0 ? above[i - 1] : 0);
    for (let x = 0; x < width; x++) pixels[y * width + x] = (row[x >> 3] >> (7 - (x & 7))) & 1;
    above = row;
  }
  return { width, height, pixels };
}

/** What a row's filter adds to a byte. @param {number} filter @param {number} left @param {number} up @param {number} corner */
function predicted(filter, left, up, corner) {
  if (filter < 4) return [0, left, up, (left + up) >> 1][filter];
  const [a, b, c] = [up - corner, left - corner, left + up - 2 * corner].map(Math.abs);
  if (a <= b && a <= c) return left;
  return b <= c ? up : corner;
}

/** @param {Mask} mask @returns {Promise<Uint8Array>} a PNG of one bit a pixel, white on instruments */
export async function pngOf({ width, height, pixels }) {
  const stride = Math.ceil(width / 8) + 1; // a row begins with its filter, 0
  const rows = new Uint8Array(stride * height);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) if (pixels[y * width + x]) rows[y * stride + 1 + (x >> 3)] |= 128 >> (x & 7);
  }
  const head = new DataView(new ArrayBuffer(13));
  head.setUint32(0, width);
  head.setUint32(4, height);
  ONE_BIT_GREY.forEach((value, i) => head.setUint8(8 + i, value));
  const packed = await through(rows, new CompressionStream("deflate"));
  const chunks = [chunkOf("IHDR", new Uint8Array(head.buffer)), chunkOf("IDAT", packed), chunkOf("IEND", new Uint8Array())];
  return new Uint8Array(await new Blob([Uint8Array.from(PNG_HEAD), ...chunks]).arrayBuffer());
}
