// "Keep last 30 s", or as many as a clip has frames for: a part of the recording becomes a clip, and a scene in the
// background. A line says how far it is.

import { getInfo, getJob } from "../base/api.js";
import { clockTime, element, setText } from "../base/element.js";
import { figure, languageEvents, words } from "../base/messages.js";
import { pause } from "../base/pause.js";
import { failureOf } from "../base/problem.js";
import { progressOf } from "../library/progress.js";
import { TimesLeft } from "../library/timeleft.js";
import { cutFeed } from "./feeds.js";

const KEPT_S = 30;
const LOOK_MS = 1000;
/** A part may be so much longer than asked for: it begins and ends at key frames, and "live" may be some seconds later. */
const LONGER_S = 3;
const MIN_S = 1;

const capitalised = (sentence) => sentence[0].toUpperCase() + sentence.slice(1);
const isOver = ({ state }) => state !== "queued" && state !== "running";

/**
 * @param {import("./feeds.js").Feed} feed
 * @returns {Promise<number>} s to ask for, so that a clip has no more frames than it may; at most KEPT_S
 */
async function lengthOf({ received_fps: fps }) {
  try {
    const { limits } = await getInfo();
    return fps > 0 ? Math.min(KEPT_S, Math.max(MIN_S, limits.max_frames / fps - LONGER_S)) : KEPT_S;
  } catch {
    return KEPT_S; // the service refuses what is too long
  }
}

export class Keeping {
  /**
   * @param {{button: HTMLButtonElement, line: HTMLElement}} parts
   * @param {import("./clock.js").FeedClock} clock
   * @param {(fromS: number, toS: number) => void} onKept
   */
  constructor({ button, line }, clock, onKept) {
    Object.assign(this, { button, line, clock, onKept, visit: 0, times: new TimesLeft() });
    languageEvents.addEventListener("changed", () => this.#say());
    this.forget();
  }

  /** What was kept of another feed is not spoken of here. */
  forget() {
    this.visit += 1;
    this.isCutting = false;
    /** @type {{fromS: number, toS: number, job: import("../base/api.js").Job} | null} */
    this.kept = null;
    /** @type {Error | null} */
    this.problem = null;
    this.#say();
  }

  /** @param {import("./feeds.js").Feed} feed */
  async keep(feed) {
    if (this.isCutting) return;
    const visit = ++this.visit;
    const nowS = this.clock.nowS;
    const pastS = feed.begins_s === null ? KEPT_S : Math.max(MIN_S, nowS - feed.begins_s);
    Object.assign(this, { isCutting: true, kept: null, problem: null });
    this.#say();
    try {
      const lengthS = Math.min(pastS, await lengthOf(feed));
      const job = await cutFeed(feed.id, { from: -Number(lengthS.toFixed(1)), to: "live", label: this.#label(feed, nowS) });
      this.isCutting = false;
      if (visit !== this.visit) return;
      this.kept = { fromS: job.cut.from_s, toS: job.cut.to_s, job };
      this.onKept(job.cut.from_s, job.cut.to_s);
      this.#say();
      await this.#watch(visit);
    } catch (error) {
      if (visit === this.visit) this.problem = error;
    }
    if (visit === this.visit) this.isCutting = false;
    this.#say();
  }

  #label(feed, nowS) {
    return `${feed.label ?? words("live.title")}, ${clockTime(1000 * nowS)}`.slice(0, 80);
  }

  async #watch(visit) {
    while (visit === this.visit && !isOver(this.kept.job)) {
      await pause(LOOK_MS);
      try {
        const job = await getJob(this.kept.job.id);
        if (visit === this.visit) this.kept.job = job;
      } catch (error) {
        if (!error.mayPass) throw error;
      }
      this.#say();
    }
  }

  #say() {
    const { line, kept } = this;
    this.button.disabled = this.isCutting;
    line.classList.toggle("bad", this.problem !== null);
    const text = this.#text();
    line.hidden = text === "";
    const link = line.querySelector("a") ?? element("a");
    if (!line.firstChild) {
      line.append(link, " ", element("span"), element("span", { class: "progress" }), " ", element("span"));
      line.lastChild.lang = "en";
    }
    const [own, progress, said] = line.querySelectorAll("span");
    const isOnItsWay = kept !== null && this.problem === null && failureOf(kept.job) === "";
    setText(own, text);
    setText(progress, isOnItsWay ? ` · ${progressOf(kept.job, this.times)}` : "");
    setText(said, this.#refusal);
    link.hidden = !isOnItsWay;
    if (kept) link.href = `./#/scene/${kept.job.id}`;
    setText(link, words("live.kept_open"));
  }

  /** Why the service refuses a part, and which it would take: its own words, for only they say how long it may be. */
  get #refusal() {
    const { mayPass, document: { detail, remedy } = {} } = this.problem ?? {};
    return mayPass ? "" : [detail, remedy].filter(Boolean).map(capitalised).join(" ");
  }

  #text() {
    if (this.problem) return words("live.kept_failed", { why: this.#refusal ? "" : this.problem.message }).trim();
    if (this.isCutting) return words("live.keeping");
    if (!this.kept) return "";
    const { fromS, toS, job } = this.kept;
    const part = words("live.kept", { s: figure(toS - fromS), to: clockTime(1000 * toS) });
    return [failureOf(job), part].filter(Boolean).join(" · ");
  }
}
