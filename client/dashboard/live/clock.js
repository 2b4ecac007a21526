// The clock of the machine that receives a feed, as far as its answers tell it. This browser's own clock may be wrong,
// and an age is of no use if it is.

const WINDOW_MS = 30_000;

export class FeedClock {
  /** @param {() => number} now this browser's steady clock, ms */
  constructor(now = () => performance.now()) {
    this.now = now;
    this.forget();
  }

  forget() {
    /** @type {{atMs: number, low: number, high: number}[]} bounds of the difference of both clocks, s */
    this.bounds = [];
    this.offsetS = null;
  }

  /**
   * An answer has come.
   * @param {number} feedS what the feed's clock showed when it was made
   * @param {number} receivedMs
   * @param {number} [sentMs] when it was asked for; left out, nobody asked
   */
  note(feedS, receivedMs, sentMs = -Infinity) {
    if (!Number.isFinite(feedS)) return;
    const made = { atMs: receivedMs, low: feedS - receivedMs / 1000, high: feedS - sentMs / 1000 };
    this.bounds = [...this.bounds.filter(({ atMs }) => receivedMs - atMs < WINDOW_MS), made];
    const low = Math.max(...this.bounds.map((each) => each.low));
    const high = Math.min(...this.bounds.map((each) => each.high));
    if (low > high + 0.001) {
      this.bounds = [made]; // one of the clocks was set
      return this.note(feedS, receivedMs, sentMs);
    }
    this.offsetS = Number.isFinite(high) ? (low + high) / 2 : low;
  }

  /** @returns {number} UNIX time, s */
  get nowS() {
    return this.offsetS === null ? Date.now() / 1000 : this.now() / 1000 + this.offsetS;
  }
}
