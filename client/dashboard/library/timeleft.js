// How long a job still takes, as far as that is known: never to the second, and honest when a promise is broken.

import { words } from "../base/messages.js";

const SOON_S = 6;
const STEP_S = 5;
const IN_MINUTES_S = 90;
/** How long "almost ready" is said at most. */
const MAX_SOON_MS = 12_000;

/** What each job was told: remembers since when it is almost ready. */
export class TimesLeft {
  constructor() {
    /** @type {Map<string, number>} */
    this.soonSince = new Map();
  }

  /**
   * @param {{id: string, seconds_left?: number | null, eta_s?: number | null}} job
   * @returns {string} "" if nothing is known
   */
  of(job) {
    const seconds = job.seconds_left ?? job.eta_s;
    if (seconds == null) return "";
    if (seconds > SOON_S) {
      this.soonSince.delete(job.id);
      return inWords(seconds);
    }
    if (!this.soonSince.has(job.id)) this.soonSince.set(job.id, Date.now());
    return words(Date.now() - this.soonSince.get(job.id) > MAX_SOON_MS ? "left.overdue" : "left.soon");
  }

  /** @param {Iterable<string>} ids of the jobs that are still listed */
  keepOnly(ids) {
    const here = new Set(ids);
    for (const id of this.soonSince.keys()) if (!here.has(id)) this.soonSince.delete(id);
  }
}

function inWords(seconds) {
  if (seconds < IN_MINUTES_S) return words("left.seconds", { count: Math.ceil(seconds / STEP_S) * STEP_S });
  return words("left.minutes", { count: Math.ceil(seconds / 60) });
}
