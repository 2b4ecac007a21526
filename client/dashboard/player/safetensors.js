// A safetensors file: a header in JSON, then the tensors' bytes.

const ARRAYS = { U8: Uint8Array, F32: Float32Array, I64: BigInt64Array };
const LENGTH_BYTES = 8;

/**
 * @param {ArrayBuffer} file
 * @returns {Record<string, {shape: number[], data: Uint8Array | Float32Array | BigInt64Array}>} copies, by name
 */
export function tensorsOf(file) {
  const length = Number(new DataView(file).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(file, LENGTH_BYTES, length)));
  const start = LENGTH_BYTES + length;
  const named = Object.entries(header).filter(([name]) => name !== "__metadata__");
  return Object.fromEntries(named.map(([name, { dtype, shape, data_offsets: [first, end] }]) => {
    return [name, { shape, data: new ARRAYS[dtype](file.slice(start + first, start + end)) }];
  }));
}
