// What a job is doing, in one line.

import { figure, words } from "./messages.js";

/** @param {import("./api.js").Job} job @param {import("./left.js").TimesLeft} times @returns {string} */
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
