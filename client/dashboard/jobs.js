// The jobs as the page knows them: asked for every other second, and told by their events the moment they change.

import { getJob, listJobs, trouble } from "./api.js";
import { JobEvents } from "./events.js";
import { keyEvents } from "./key.js";
import { words } from "./messages.js";

/** @typedef {import("./api.js").Job} Job */

const POLL_MS = 2000;
/** Browsers open six connections to a place, and uploads and pictures need some. */
const MAX_FOLLOWED = 3;
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
   * @param {(text: string, kind: "good"|"bad") => void} onConnection how the service is
   */
  constructor(onChange, onConnection) {
    this.onChange = onChange;
    this.onConnection = onConnection;
    /** @type {Map<string, Job>} newest first */
    this.byId = new Map();
    /** @type {Map<string, Scores>} */
    this.scores = new Map();
    /** @type {Map<string, JobEvents>} */
    this.followed = new Map();
    this.told = new Map(); // when the last event of a job came
    this.round = 0;
    keyEvents.addEventListener("changed", () => this.#startAnew());
    setInterval(() => this.poll(), POLL_MS);
    this.poll();
  }

  /** @param {string} id the points of its curve so far */
  pointsOf(id) {
    return this.scores.get(id)?.points ?? [];
  }

  /** @param {string} id of a job that was purged */
  forget(id) {
    this.byId.delete(id);
    this.scores.delete(id);
    this.told.delete(id);
    this.onChange();
  }

  /** Ask for all jobs now. */
  async poll() {
    const round = ++this.round;
    const askedAt = performance.now();
    try {
      const jobs = await listJobs();
      if (round !== this.round) return; // a newer answer is there, or comes
      this.#replace(jobs, askedAt);
      await this.#askForPosition();
      const wrong = await trouble();
      if (round === this.round) this.onConnection(wrong || words("page.ready"), wrong ? "bad" : "good");
    } catch (error) {
      if (round === this.round) this.onConnection(error.status ? error.message : words("page.no_connection"), "bad");
    }
  }

  #startAnew() {
    for (const events of this.followed.values()) events.stop();
    this.followed.clear();
    this.byId.clear();
    this.scores.clear();
    this.told.clear();
    this.onChange();
    this.poll();
  }

  #replace(jobs, askedAt) {
    const before = this.byId;
    this.byId = new Map();
    for (const job of jobs) {
      const known = before.get(job.id);
      const isOlder = known && (this.told.get(job.id) ?? 0) > askedAt;
      this.byId.set(job.id, isOlder ? known : { ...job, ...positionIn(known, job) });
      this.#note(job);
    }
    for (const known of [this.scores, this.told]) for (const id of known.keys()) if (!this.byId.has(id)) known.delete(id);
    this.#follow();
    this.onChange();
  }

  #follow() {
    const active = [...this.byId.values()].filter(isActive).reverse();
    const chosen = active.sort((a, b) => (b.state === "running") - (a.state === "running")).slice(0, MAX_FOLLOWED);
    const wanted = new Set(chosen.map((job) => job.id));
    for (const [id, events] of this.followed) {
      if (wanted.has(id)) continue;
      events.stop();
      this.followed.delete(id);
    }
    for (const id of wanted) {
      if (!this.followed.has(id)) this.followed.set(id, new JobEvents(id, (job) => this.#take(job)));
    }
  }

  /** @param {Job} job as an event told it */
  #take(job) {
    if (!this.byId.has(job.id)) return;
    this.told.set(job.id, performance.now());
    this.byId.set(job.id, { ...job, ...positionIn(this.byId.get(job.id), job) });
    this.#note(job);
    this.onChange();
  }

  /** The list tells no positions; one job after the other of those that no events tell of is asked for its own. */
  async #askForPosition() {
    const queued = [...this.byId.values()].filter((job) => job.state === "queued" && !this.followed.has(job.id));
    if (queued.length === 0) return;
    const job = await getJob(queued[this.round % queued.length].id);
    if (this.byId.has(job.id)) this.byId.set(job.id, job);
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
