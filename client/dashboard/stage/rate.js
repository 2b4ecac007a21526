// How fast pictures come.

const WINDOW_MS = 2000;

export class Pace {
  constructor() {
    this.times = [];
  }

  /** A picture came. */
  note() {
    const now = performance.now();
    this.times = [...this.times.filter((time) => now - time < WINDOW_MS), now];
  }

  /** @returns {number} pictures a second, of late */
  get rate() {
    if (this.times.length < 2) return 0;
    return ((this.times.length - 1) * 1000) / Math.max(1, this.times.at(-1) - this.times[0]);
  }
}
