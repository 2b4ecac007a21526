// Waiting, and trying again.

import { Problem } from "./problem.js";

const FIRST_PAUSE_MS = 500;
const MAX_PAUSE_MS = 8000;

/**
 * @param {number} ms
 * @param {AbortSignal} [signal] ends the pause early, as an error
 * @returns {Promise<void>}
 */
export function pause(ms, signal) {
  return new Promise((resolve, reject) => {
    const giveUp = () => {
      clearTimeout(timer);
      reject(signal.reason);
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener("abort", giveUp); // else they pile up while a signal lives
      resolve();
    }, ms);
    if (signal?.aborted) giveUp();
    else signal?.addEventListener("abort", giveUp, { once: true });
  });
}

/**
 * Do the work, again after ever longer pauses while what stops it may pass.
 * @template T
 * @param {() => Promise<T>} work
 * @param {(problem: Problem) => void} onTrouble told of every failure that is waited out
 * @param {AbortSignal} [signal]
 * @returns {Promise<T>}
 */
export async function insist(work, onTrouble, signal) {
  for (let pauseMs = FIRST_PAUSE_MS; ; pauseMs = Math.min(MAX_PAUSE_MS, pauseMs * 2)) {
    try {
      return await work();
    } catch (error) {
      if (!(error instanceof Problem) || !error.mayPass) throw error;
      onTrouble(error);
      await pause(Math.max(pauseMs, error.retryAfterS * 1000), signal);
    }
  }
}
