// Texts inside a PNG, which say what it shows wherever it is copied to (PNG specification, 11.3.3.4).

const HEAD_BYTES = 33; // the signature, and IHDR, which must be first
const POLYNOMIAL = 0xedb88320;

const TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? (value >>> 1) ^ POLYNOMIAL : value >>> 1;
  return value;
});

/** @param {Uint8Array} bytes @returns {number} CRC-32 */
const crcOf = (bytes) => ~bytes.reduce((crc, byte) => TABLE[(crc ^ byte) & 255] ^ (crc >>> 8), ~0) >>> 0;

/** @param {string} keyword in ASCII @param {string} text @returns {Uint8Array} an uncompressed iTXt chunk */
function chunkOf(keyword, text) {
  const body = new TextEncoder().encode(`iTXt${keyword}\0\0\0\0\0${text}`);
  const chunk = new Uint8Array(body.length + 8);
  const view = new DataView(chunk.buffer);
  view.setUint32(0, body.length - 4); // without its type
  chunk.set(body, 4);
  view.setUint32(body.length + 4, crcOf(body));
  return chunk;
}

/** @param {Blob} png @param {Record<string, string>} texts by keyword @returns {Blob} */
export function withTexts(png, texts) {
  const chunks = Object.entries(texts).map(([keyword, text]) => chunkOf(keyword, text));
  return new Blob([png.slice(0, HEAD_BYTES), ...chunks, png.slice(HEAD_BYTES)], { type: png.type });
}
