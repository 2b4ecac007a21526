// What is under way, told while something else is looked at: in the tab's title, in a line above the picture, and, if the
// user wants it, by a notification of the browser when it is ready.

import { button, element, setText } from "../base/element.js";
import { words } from "../base/messages.js";
import { failureOf } from "../base/problem.js";
import { readChoice, readTabStorage, writeChoice, writeTabStorage } from "../base/storage.js";
import { nameOf } from "./card.js";
import { progressOf, shareOf, shareOfSending } from "./progress.js";
import { TimesLeft } from "./timeleft.js";

const STORED_AS = "intrasplat-sent";
const WANTED_AS = "intrasplat-notify";
const NAME = "intrasplat";

/** @typedef {import("../base/api.js").Job} Job */

const isOver = (job) => job.state === "done" || job.state === "failed" || job.state === "cancelled";

export class Announcer {
  /**
   * @param {{line: HTMLElement, ask: HTMLButtonElement}} parts
   * @param {(id: string) => void} onView
   */
  constructor({ line, ask }, onView) {
    Object.assign(this, { line, ask, onView });
    /** @type {string[]} jobs of this tab that have not ended, the newest last */
    this.pending = readTabStorage(STORED_AS) ?? [];
    /** @type {Job | null} the last one that ended, until somebody looks at it */
    this.ended = null;
    /** @type {number | null} share of a clip that is sent */
    this.share = null;
    this.times = new TimesLeft();
    ask.addEventListener("click", () => this.#wish());
    this.#showWish();
  }

  /** @returns {string | null} the job that was sent last, if it has not ended */
  get awaited() {
    return this.pending.at(-1) ?? null;
  }

  /** @param {string} id of a job that was sent from here */
  await(id) {
    this.#keep([...this.pending.filter((each) => each !== id), id]);
    this.ended = null;
  }

  /** @param {number | null} share of a clip that is sent; null when there is none */
  send(share) {
    this.share = share;
    this.#showTitle(null);
  }

  /** @param {Map<string, Job>} byId @param {Set<string>} gone ids of jobs that are no more @param {string | null} viewed */
  refresh(byId, gone, viewed) {
    if (this.pending.some((id) => gone.has(id))) this.#keep(this.pending.filter((id) => !gone.has(id)));
    for (const id of this.pending) {
      const job = byId.get(id);
      if (job && isOver(job)) this.#end(job);
    }
    const isSeen = this.ended?.id === viewed && !document.hidden;
    if (this.ended && (isSeen || !byId.has(this.ended.id))) this.ended = null;
    const job = byId.get(this.awaited) ?? null;
    this.#showTitle(job);
    this.#showLine(job?.id === viewed ? null : job);
  }

  #end(job) {
    this.#keep(this.pending.filter((each) => each !== job.id));
    if (job.state === "cancelled") return;
    this.ended = job;
    this.#notify(job);
  }

  #keep(pending) {
    this.pending = pending;
    writeTabStorage(STORED_AS, pending.length > 0 ? pending : null);
  }

  #showTitle(job) {
    const share = this.share === null ? job && shareOf(job) : shareOfSending(this.share);
    if (share !== null) document.title = `${Math.round(share * 100)} % · ${NAME}`;
    else document.title = this.ended ? `${words(`state.${this.ended.state}`)} · ${NAME}` : NAME;
  }

  /** @param {Job | null} job under way and not in view */
  #showLine(job) {
    const told = job ?? this.ended;
    const key = told && JSON.stringify([told.id, told.state]);
    if (!told || this.line.dataset.of !== key) this.line.replaceChildren();
    this.line.dataset.of = key ?? "";
    if (!told) return;
    if (!this.line.firstChild) this.line.append(element("p"), ...this.#buttons(told));
    const what = failureOf(told) || progressOf(told, this.times);
    const text = `${nameOf(told)}: ${what}`;
    setText(this.line.firstChild, text);
    this.line.classList.toggle("bad", told.state === "failed");
  }

  #buttons(job) {
    if (!isOver(job)) return [];
    const close = button(words("announce.close"), () => {
      this.ended = null;
      this.#showLine(null);
      this.#showTitle(null);
    });
    return job.state === "done" ? [button(words("job.view"), () => this.onView(job.id)), close] : [close];
  }

  get #isWanted() {
    return readChoice(WANTED_AS) === "on" && window.Notification?.permission === "granted";
  }

  async #wish() {
    const isWanted = !this.#isWanted && (await Notification.requestPermission()) === "granted";
    writeChoice(WANTED_AS, isWanted ? "on" : "off");
    this.#showWish();
  }

  #showWish() {
    this.ask.hidden = !window.Notification;
    this.ask.setAttribute("aria-pressed", String(this.#isWanted));
    this.ask.disabled = window.Notification?.permission === "denied";
  }

  #notify(job) {
    if (!this.#isWanted) return;
    try {
      const shown = new Notification(words(`announce.${job.state}`), { body: nameOf(job), tag: job.id });
      shown.addEventListener("click", () => {
        window.focus();
        if (job.state === "done") this.onView(job.id);
      });
    } catch {
      // some browsers show none of a page; title and line tell it
    }
  }
}
