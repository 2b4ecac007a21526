// The line to the service: how fast it is, as its answers show, and how small and how many at a time pictures must be while
// the view moves, so that several a second come.

/** A moving view shows a picture this often, or the line is slow. */
const INTERVAL_MS = 200;
/** Share of that time in which a picture may be on its way; the rest is for what else goes over the line. */
const USED = 0.6;
/** Larger pictures come only where they take this share of it. */
const CAUTION = 0.6;
const MAX_UNDER_WAY = 4;
const MEMORY = 0.7; // weight of what came before
const RECENT = 12;
/** Pictures from the largest on. bytes: share of the full picture's, about, as JPEGs of tissue have. */
const LEVELS = [
  { width: 1, quality: undefined, bytes: 1 },
  { width: 1, quality: 60, bytes: 0.4 },
  { width: 0.7, quality: 55, bytes: 0.2 },
  { width: 0.5, quality: 50, bytes: 0.1 },
  { width: 0.35, quality: 45, bytes: 0.05 },
  { width: 0.25, quality: 40, bytes: 0.027 },
];

/** @returns {number} ms until the page itself began to come: the first idea of the latency */
function pageLatencyMs() {
  const [page] = performance.getEntriesByType("navigation");
  return page ? page.responseStart - page.requestStart : 0;
}

export class Line {
  constructor() {
    this.latencies = [pageLatencyMs()];
    this.bytes = this.ms = 0;
    this.fullBytes = 0;
    this.cameAt = 0;
    this.level = 0;
  }

  get latencyMs() {
    return Math.min(...this.latencies);
  }

  /**
   * A picture came.
   * @param {number} bytes its size
   * @param {number} tookMs since it was asked for
   * @param {number} servedMs of that, in the service
   * @param {number} level at which it was asked for
   */
  note(bytes, tookMs, servedMs, level) {
    const now = performance.now();
    const onWayMs = Math.max(0, tookMs - servedMs);
    this.latencies = [...this.latencies, onWayMs].slice(-RECENT);
    const sentMs = Math.min(onWayMs - this.latencyMs, now - this.cameAt); // pictures that follow at once wait for one another
    this.cameAt = now;
    this.bytes = MEMORY * this.bytes + bytes;
    this.ms = MEMORY * this.ms + Math.max(1, sentMs);
    this.fullBytes = bytes / LEVELS[level].bytes;
    const affordable = (this.bytes / this.ms) * INTERVAL_MS * USED;
    const fitting = (bytes) => LEVELS.findIndex((each) => this.fullBytes * each.bytes <= bytes);
    const [coarsest, finer] = [LEVELS.length - 1, fitting(affordable * CAUTION)];
    if (finer >= 0 && finer < this.level) this.level -= 1; // larger step by step
    else this.level = Math.max(this.level, fitting(affordable) < 0 ? coarsest : fitting(affordable));
  }

  /** How many pictures may be under way at a time while the view moves: the latency is then no pause. */
  get depth() {
    return Math.min(MAX_UNDER_WAY, Math.max(1, Math.ceil(this.latencyMs / INTERVAL_MS)));
  }

  /** Time between pictures that are asked for without waiting for the one before. */
  get spacingMs() {
    return this.depth > 1 ? INTERVAL_MS : 0;
  }

  /**
   * @param {number} level @param {number | undefined} width of the full picture, if it is known
   * @returns {{width?: number, quality?: number}} what to ask for
   */
  reduction(level, width) {
    const { width: share, quality } = LEVELS[level];
    if (level === 0) return {};
    return share < 1 && width ? { quality, width: Math.max(8, Math.round(width * share)) } : { quality };
  }
}
