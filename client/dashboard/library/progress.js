// What a job is doing, in one line, and how much of everything is done.

import { figure, words } from "../base/messages.js";

/** Shares of a bar that never falls: sending, then the stages as they follow one another, by the time that they usually take. */
const SENDING = 10;
const STAGES = {
  fetch: 1, decode: 6, stereo: 13, masks: 5, poses: 5, motion: 5, fusion: 3, start: 2, calibrate: 3, compile: 3, train: 38,
  finish: 3, publish: 3,
};
/** @type {Map<string, number>} the largest share that was said of a job under way */
const most = new Map();

/** @param {number} sent share of a clip @returns {number} of all there is to do */
export const shareOfSending = (sent) => (sent * SENDING) / 100;

/** @param {import("../base/api.js").Job} job @returns {number} share of all there is to do, which only grows until the job ends */
export function shareOf({ id, state, stage, fraction }) {
  if (state !== "running" && state !== "queued") {
    most.delete(id);
    return state === "done" ? 1 : 0;
  }
  let share = SENDING;
  const names = Object.keys(STAGES);
  const place = state === "running" ? names.indexOf(stage ?? "") : -1;
  for (const name of names.slice(0, Math.max(0, place))) share += STAGES[name];
  if (place >= 0) share += STAGES[names[place]] * (fraction ?? 0);
  most.set(id, Math.max(share / 100, most.get(id) ?? 0));
  return most.get(id);
}

/** @param {import("../base/api.js").Job} job @param {import("./timeleft.js").TimesLeft} times @returns {string} */
export function progressOf(job, times) {
  const left = times.of(job);
  if (job.state === "queued") {
    const before = job.position == null ? "" : words(job.position === 0 ? "job.next" : "job.before", { count: job.position });
    return [words("state.queued"), before, left].filter(Boolean).join(" · ");
  }
  if (job.state !== "running") return words(`state.${job.state}`);
  const stage = job.cancel_requested ? words("job.cancelling") : words(`stage.${job.stage ?? "start"}`);
  const db = job.psnr_db != null && `${figure(job.psnr_db, 1)} dB`;
  return [stage, db, left].filter(Boolean).join(" · ");
}

/** @param {import("../base/api.js").Job} [job] @returns {""|"storing"|"scoring"} what is done to its scene after training */
export function workOn(job) {
  if (job?.state === "done") return "scoring";
  return job?.state === "running" && ["finish", "publish"].includes(job.stage) ? "storing" : "";
}
