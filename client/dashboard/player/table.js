// The table of a scene, decoded by several workers at a time.

import { DamagedError, groupsOf, partsOf, PARTS } from "./decode.js";
import { CannotDrawError } from "./gpu.js";
import { tensorsOf } from "./safetensors.js";

/** Channels that move: place, shape; with colour; with gloss. */
const CHANNELS = [10, 13, 14];
/** As intrasplat/scene/compact.py; a small file must not fill the memory. */
const MAX_NUMBERS = 7 * 2 ** 25;

/**
 * What a scene's file says. tables: the columns of each part, [N, columns].
 * @typedef {{count: number, atRest: number, channels: number, patterns: number, bases: number, step: Float32Array,
 *   pattern: Float32Array, centre: Float32Array, width: Float32Array, tables: Int32Array[], partMs: number[]}} Table
 */

/**
 * @param {ArrayBuffer} file scene.safetensors, compact
 * @param {(share: number) => void} [onProgress]
 * @param {AbortSignal} [signal] ends it early, as an error
 * @returns {Promise<Table>}
 */
export async function readTable(file, onProgress = () => {}, signal = undefined) {
  const tensors = tensorsOf(file);
  const [channels, patterns, bases] = tensors.pattern.shape;
  const count = Number(tensors.count.data[0]);
  const atRest = tensors.step.shape[0];
  const group = groupsOf(atRest, channels, patterns);
  const shared = tensors.shared.data;
  const gloss = channels === 14 ? 15 : 14;
  const isWhole = CHANNELS.includes(channels) && atRest === gloss && shared.length === group.length && patterns < bases;
  if (!isWhole || count < 1 || count * group.length > MAX_NUMBERS) {
    throw new DamagedError("The parts of the scene do not fit together.");
  }
  const parts = partsOf(group.length);
  const workers = parts.map(() => new Worker(new URL("./part.worker.js", import.meta.url), { type: "module" }));
  try {
    workers.forEach((worker, part) => {
      const [first, columns] = parts[part];
      const own = [first, first + columns];
      const code = tensors[`code.${part}`].data;
      const columnsOf = { group: group.slice(...own), shared: shared.slice(...own) };
      worker.postMessage({ code, count, ...columnsOf, isLast: part === PARTS - 1 }, [code.buffer]);
    });
    let done = 0;
    const answers = workers.map((worker) => answerOf(worker, ({ powers }) => {
      if (powers) for (const each of workers) each.postMessage({ powers });
    }).then((answer) => {
      done += 1;
      onProgress(done / PARTS);
      return answer;
    }));
    const all = await unlessAborted(Promise.all(answers), signal);
    return {
      count,
      atRest,
      channels,
      patterns,
      bases,
      step: tensors.step.data,
      pattern: tensors.pattern.data,
      centre: tensors.centre.data,
      width: tensors.width.data,
      tables: all.map(({ table }) => table),
      partMs: all.map(({ ms }) => ms),
    };
  } finally {
    for (const worker of workers) worker.terminate();
  }
}

/** @template T @param {Promise<T>} work @param {AbortSignal} [signal] @returns {Promise<T>} */
function unlessAborted(work, signal) {
  if (!signal) return work;
  return new Promise((resolve, reject) => {
    const giveUp = () => reject(signal.reason);
    if (signal.aborted) giveUp();
    signal.addEventListener("abort", giveUp, { once: true });
    work.then(resolve, reject).finally(() => signal.removeEventListener("abort", giveUp));
  });
}

/**
 * @param {Worker} worker
 * @param {(message: any) => void} onMessage told of what comes before
 * @returns {Promise<{table: Int32Array, ms: number}>}
 */
function answerOf(worker, onMessage) {
  return new Promise((resolve, reject) => {
    worker.addEventListener("error", () => reject(new CannotDrawError("A worker of the page could not start.", "no_worker")));
    worker.addEventListener("message", ({ data }) => {
      if (data.error) reject(new DamagedError(data.error));
      else if (data.table) resolve(data);
      else onMessage(data);
    });
  });
}
