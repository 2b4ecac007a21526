// The jobs as the page knows them: the newest, asked for every other second while somebody waits for news, the one in view,
// and those of other pages of the list. Their events tell the moment they change.

import { getJob, listJobs, trouble } from "../base/api.js";
import { storeStrokes } from "../base/drafts.js";
import { JobEvents } from "../base/events.js";
import { keyEvents } from "../base/key.js";
import { words } from "../base/messages.js";

/** @typedef {import("../base/api.js").Job} Job */

const POLL_MS = 2000;
/** While nobody looks at the list and nothing is under way, every so manieth time is enough. */
const IDLE_POLLS = 4;
/** While also the stream confirms that the service is there, the list is asked for every so manieth time. */
const HEARD_POLLS = 48;
/** And every so manieth time, whether clips would be trained. */
const READY_POLLS = 16;
/** Jobs in a page of the list. */
export const PAGE_SIZE = 30;
/** Browsers open six connections to a place, and uploads and pictures need some. */
const MAX_FOLLOWED = 3;
/** A worker that was not seen yet may be starting for so long. */
const STARTING_MS = 60_000;
const isActive = (job) => job.state === "queued" || job.state === "running";

/** A job's scores while it trains, by iteration. */
class Scores {
  constructor() {
    /** @type {Map<number, import("./curve.js").Point>} */
    this.byIteration = new Map();
    this.latest = null;
  }

  /** @param {Job} job */
  note({ iteration, psnr_db: db, psnr_right_db: rightDb }) {
    for (const each of this.byIteration.keys()) if (each > iteration) this.byIteration.delete(each); // it began again
    if (!iteration || db == null || (db === this.latest && this.byIteration.size > 0)) return;
    this.latest = db;
    this.byIteration.set(iteration, { iteration, db, rightDb: rightDb ?? NaN });
  }

  get points() {
    return [...this.byIteration.values()].sort((a, b) => a.iteration - b.iteration);
  }
}

export class Jobs {
  /**
   * @param {() => void} onChange after any change of the jobs
   * @param {(text: string, kind: "good"|"starting"|"bad") => void} onConnection how the service is
   * @param {() => boolean} isWatched whether somebody looks at the list, or waits for the service
   * @param {() => boolean} isHeard whether the service is known by another way to be there
   */
  constructor(onChange, onConnection, isWatched, isHeard = () => false) {
    this.isWatched = isWatched;
    this.isHeard = isHeard;
    this.onChange = onChange;
    this.onConnection = onConnection;
    /** @type {Map<string, Job>} */
    this.byId = new Map();
    /** @type {string[]} ids of the newest jobs, newest first, as many as a page of the list has */
    this.newest = [];
    /** @type {string | null} the cursor of the page after them */
    this.next = null;
    /** @type {Set<string>} ids of jobs that stay known though they are not among the newest */
    this.kept = new Set();
    /** @type {string[]} ids of jobs that somebody waits for, whatever the list holds */
    this.awaited = [];
    /** @type {Set<string>} ids of jobs that are no more, or not this key's */
    this.gone = new Set();
    /** @type {string | null} the job in view */
    this.viewed = null;
    /** @type {Map<string, Scores>} */
    this.scores = new Map();
    /** @type {Map<string, JobEvents>} */
    this.followed = new Map();
    this.told = new Map(); // when the last event of a job came
    this.round = 0;
    keyEvents.addEventListener("changed", () => this.#startAnew());
    this.polledAt = 0;
    /** Whether the service has listed its jobs. */
    this.isKnown = false;
    this.isWell = true;
    this.hasTrained = false; // whether a worker was there
    /** @type {number | null} when it was first missed */
    this.missedMs = null;
    setInterval(() => this.#tick(), POLL_MS);
    addEventListener("focus", () => this.#look());
    document.addEventListener("visibilitychange", () => this.#look());
    this.poll();
  }

  #tick() {
    const isBusy = this.isWatched() || !this.isWell || [...this.byId.values()].some(isActive);
    const isHeard = this.isHeard();
    if (isBusy || ++this.ticks >= (isHeard ? HEARD_POLLS : IDLE_POLLS)) this.poll();
    else if (isHeard && this.ticks % READY_POLLS === 0) this.#askIfReady();
  }

  /** Notice that nothing would be trained any more. */
  async #askIfReady() {
    const { round } = this;
    const wrong = await trouble().catch((error) => error);
    if (wrong !== null && round === this.round) this.#tellConnection(wrong);
  }

  /** Somebody comes back to the page. */
  #look() {
    if (!document.hidden && performance.now() - this.polledAt > POLL_MS) this.poll();
  }

  /** @param {string} id the points of its curve so far */
  pointsOf(id) {
    return this.scores.get(id)?.points ?? [];
  }

  /** Know these as well, in place of those that were kept before. @param {Job[]} jobs of other pages of the list */
  keep(jobs) {
    this.kept = new Set(jobs.map((job) => job.id));
    for (const job of jobs) if (!this.byId.has(job.id)) this.byId.set(job.id, job);
    this.#prune();
  }

  /** @param {string | null} id of the job that comes into view; it stays known */
  view(id) {
    this.viewed = id;
  }

  /** @param {string} id of a job that was purged */
  forget(id) {
    this.#lose(id);
    storeStrokes(id, []);
    this.kept.delete(id);
    this.newest = this.newest.filter((each) => each !== id);
    this.scores.delete(id);
    this.told.delete(id);
    this.onChange();
  }

  /** It is no more, or not this key's. */
  #lose(id) {
    this.gone.add(id);
    this.byId.delete(id);
  }

  /** Ask for all jobs now. */
  async poll() {
    const round = ++this.round;
    const askedAt = (this.polledAt = performance.now());
    this.ticks = 0;
    try {
      const { jobs, next } = await listJobs({ limit: PAGE_SIZE });
      if (round !== this.round) return; // a newer answer is there, or comes
      this.next = next;
      this.#replace(jobs, askedAt);
      await this.#askForOne();
      const wrong = await trouble();
      if (round === this.round) this.#tellConnection(wrong);
    } catch (error) {
      if (round === this.round) this.#tellConnection(error);
    }
  }

  /** @param {Error | null} wrong what is */
  #tellConnection(wrong) {
    this.isWell = wrong === null;
    this.hasTrained ||= this.isWell;
    if (this.isWell) this.onConnection(words("page.ready"), "good");
    else if (this.#isStarting(wrong)) this.onConnection(words("page.starting"), "starting");
    else this.onConnection(wrong.status ? wrong.message : words("page.no_connection"), "bad");
  }

  /** Whether the worker that is missing was never there, and may come yet. */
  #isStarting({ status, document }) {
    if (status !== 503 || document.field !== "worker" || this.hasTrained) return false;
    this.missedMs ??= performance.now();
    return performance.now() - this.missedMs < STARTING_MS;
  }

  #startAnew() {
    this.isKnown = false;
    for (const events of this.followed.values()) events.stop();
    this.followed.clear();
    this.byId.clear();
    this.kept.clear();
    this.gone.clear();
    this.newest = [];
    this.next = null;
    this.scores.clear();
    this.told.clear();
    this.onChange();
    this.poll();
  }

  #replace(jobs, askedAt) {
    this.newest = jobs.map((job) => job.id);
    this.isKnown = true;
    for (const job of jobs) {
      this.gone.delete(job.id);
      const known = this.byId.get(job.id);
      const isOlder = known && (this.told.get(job.id) ?? 0) > askedAt;
      if (!isOlder) this.byId.set(job.id, { ...job, ...positionIn(known, job) });
      this.#note(job);
    }
    this.#prune();
    this.#follow();
    this.onChange();
  }

  /** Forget what is neither among the newest, nor kept, nor awaited, nor in view. */
  #prune() {
    const wanted = new Set([...this.newest, ...this.kept, ...this.awaited, this.viewed]);
    for (const known of [this.byId, this.scores, this.told]) {
      for (const id of known.keys()) if (!wanted.has(id)) known.delete(id);
    }
  }

  #follow() {
    const active = [...this.byId.values()].filter(isActive).sort((a, b) => a.created_at_s - b.created_at_s);
    const chosen = active.sort((a, b) => (b.state === "running") - (a.state === "running")).slice(0, MAX_FOLLOWED);
    const wanted = new Set(chosen.map((job) => job.id));
    for (const [id, events] of this.followed) {
      if (wanted.has(id)) continue;
      events.stop();
      this.followed.delete(id);
    }
    for (const id of wanted) {
      if (!this.followed.has(id)) this.followed.set(id, new JobEvents(id, (job) => this.take(job)));
    }
  }

  /** @param {Job} job as the service has just told it */
  take(job) {
    if (!this.byId.has(job.id)) return;
    this.told.set(job.id, performance.now());
    this.byId.set(job.id, { ...job, ...positionIn(this.byId.get(job.id), job) });
    this.#note(job);
    this.onChange();
  }

  /**
   * One job a round is asked for by itself: the one in view or one that is awaited if nothing is known of it, or one of
   * those that neither events nor the list tell of. (The list tells no positions.)
   */
  async #askForOne() {
    const isUntold = (job) => job.state === "queued" || (job.state === "running" && !this.newest.includes(job.id));
    const untold = [...this.byId.values()].filter((job) => isUntold(job) && !this.followed.has(job.id)).map((job) => job.id);
    const isUnknown = (id) => id !== null && !this.byId.has(id) && !this.gone.has(id);
    untold.unshift(...new Set([this.viewed, ...this.awaited].filter(isUnknown)));
    if (untold.length === 0) return;
    const id = untold[this.round % untold.length];
    const wasThere = this.byId.has(id); // for this key
    try {
      const job = await getJob(id);
      if (this.byId.has(id) || id === this.viewed || this.awaited.includes(id)) this.byId.set(id, job);
    } catch (error) {
      if (error.status !== 404) throw error;
      this.#lose(id);
      if (wasThere) storeStrokes(id, []);
    }
    this.onChange();
  }

  #note(job) {
    if (!this.scores.has(job.id)) this.scores.set(job.id, new Scores());
    this.scores.get(job.id).note(job);
  }
}

/** The position that is known already, where this answer tells none. */
function positionIn(known, job) {
  if (job.state !== "queued" || known?.state !== "queued" || job.position != null) return {};
  return { position: known.position, eta_s: known.eta_s };
}
