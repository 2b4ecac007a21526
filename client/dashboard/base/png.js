// Chunks of a PNG, and texts in it, which say what it shows wherever it is copied to (PNG specification, 5.3, 11.3.3.4).

const HEAD_BYTES = 33; // the signature, and IHDR, which must be first
const POLYNOMIAL = 0xedb88320;

const TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? (value >>> 1) ^ POLYNOMIAL : value >>> 1;
  return value;
});

/** @param {Uint8Array} bytes @returns {number} CRC-32 */
export function crcOf(bytes) {
  let crc = ~0;
  for (const byte of bytes) crc = TABLE[(crc ^ byte) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}

/** @param {string} type @param {Uint8Array} content @returns {Uint8Array} a chunk of a PNG */
export function chunkOf(type, content) {
  const chunk = new Uint8Array(12 + content.length);
  const view = new DataView(chunk.buffer);
  view.setUint32(0, content.length);
  chunk.set(new TextEncoder().encode(type), 4);
  chunk.set(content, 8);
  view.setUint32(8 + content.length, crcOf(chunk.subarray(4, 8 + content.length)));
  return chunk;
}

/** @param {string} keyword in ASCII @param {string} text @returns {Uint8Array} an uncompressed iTXt chunk */
const textChunkOf = (keyword, text) => chunkOf("iTXt", new TextEncoder().encode(`${keyword}\0\0\0\0\0${text}`));

/** @param {Blob} png @param {Record<string, string>} texts by keyword @returns {Blob} */
export function withTexts(png, texts) {
  const chunks = Object.entries(texts).map(([keyword, text]) => textChunkOf(keyword, text));
  return new Blob([png.slice(0, HEAD_BYTES), ...chunks, png.slice(HEAD_BYTES)], { type: png.type });
}
