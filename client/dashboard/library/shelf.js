// What the list of scenes shows: the newest jobs, or those that are looked for, page by page, and of each finished one
// what its report says in short.

import { listJobs, listScenes } from "../base/api.js";
import { isKeyMissing, keyEvents } from "../base/key.js";
import { words } from "../base/messages.js";
import { showProblem } from "../base/problem.js";
import { PAGE_SIZE } from "./jobs.js";

const TYPING_MS = 300;
/** Reports that are asked for at once. */
const MAX_ASKED = 50;

/** @typedef {import("../base/api.js").Job} Job */
/** @typedef {import("../base/api.js").SceneSummary} SceneSummary */

export class Shelf {
  /**
   * @param {{search: HTMLInputElement, more: HTMLButtonElement, message: HTMLElement}} parts
   * @param {import("./jobs.js").Jobs} jobs
   * @param {() => void} onChange
   */
  constructor({ search, more, message }, jobs, onChange) {
    Object.assign(this, { search, more, message, jobs, onChange });
    /** @type {string[]} ids of the jobs that were found, or that follow the newest ones */
    this.found = [];
    /** @type {string | null | undefined} the cursor of the next page; undefined before any page was asked for */
    this.next = undefined;
    /** @type {Map<string, SceneSummary | null>} null: the service lists no such scene */
    this.summaries = new Map();
    this.visit = 0; // counts searches: what an earlier one finds is not shown
    this.isAsking = false;
    search.addEventListener("input", () => {
      clearTimeout(this.timer);
      this.timer = setTimeout(() => this.#startAnew(), TYPING_MS);
    });
    more.addEventListener("click", () => this.#addPage());
    keyEvents.addEventListener("missing", onChange);
    keyEvents.addEventListener("changed", () => {
      search.value = "";
      this.summaries.clear();
      this.#startAnew();
    });
  }

  /** @returns {Job[]} newest first */
  get shown() {
    const ids = new Set(this.#isSearch ? this.found : [...this.jobs.newest, ...this.found]);
    return [...ids].map((id) => this.jobs.byId.get(id)).filter(Boolean);
  }

  /** @returns {string} what to say where no job is shown; empty while it is not known yet */
  get nothing() {
    if (isKeyMissing()) return words("label.no_key");
    if (!this.#isSearch) return words("label.none");
    return this.next === undefined ? "" : words("label.none_found");
  }

  /** @param {string} id @returns {SceneSummary | null} of a finished scene, once it is known */
  summaryOf(id) {
    return this.summaries.get(id) ?? null;
  }

  /** Ask for what is not known yet of the scenes that are shown; called after any change of the jobs. */
  refresh() {
    this.more.hidden = this.#cursor === null;
    const shown = this.shown;
    const ids = new Set(shown.map((job) => job.id));
    for (const id of this.summaries.keys()) if (!ids.has(id)) this.summaries.delete(id);
    this.#askForSummaries(shown);
  }

  get #isSearch() {
    return this.search.value.trim() !== "";
  }

  /** Of the page that follows what is shown. */
  get #cursor() {
    return this.next === undefined ? this.jobs.next : this.next;
  }

  #startAnew() {
    this.visit += 1;
    this.found = [];
    this.next = undefined;
    this.jobs.keep([]);
    this.message.replaceChildren();
    this.onChange();
    if (this.#isSearch) this.#addPage();
  }

  async #addPage() {
    const visit = this.visit;
    const isFirst = this.#isSearch && this.next === undefined;
    this.more.disabled = true;
    try {
      const search = { q: this.search.value.trim(), limit: PAGE_SIZE, cursor: isFirst ? undefined : this.#cursor };
      const { jobs, next } = await listJobs(search);
      if (visit !== this.visit) return;
      this.found.push(...jobs.map((job) => job.id));
      this.next = next;
      const before = this.found.map((id) => this.jobs.byId.get(id)).filter(Boolean);
      this.jobs.keep([...before, ...jobs]);
    } catch (error) {
      if (visit === this.visit) showProblem(this.message, error);
    } finally {
      this.more.disabled = false;
      this.onChange();
    }
  }

  /** @param {Job[]} shown */
  async #askForSummaries(shown) {
    const isUnknown = ({ id }) => !this.summaries.has(id) || this.summaries.get(id)?.scored === false;
    const wanted = shown.filter((job) => job.state === "done" && isUnknown(job)).slice(0, MAX_ASKED);
    if (this.isAsking || wanted.length === 0) return;
    this.isAsking = true;
    try {
      const times = wanted.map((job) => job.created_at_s);
      const window = { created_from_s: Math.min(...times), created_until_s: Math.max(...times), q: this.search.value.trim() };
      const scenes = new Map((await listScenes({ ...window, limit: 2 * MAX_ASKED })).map((scene) => [scene.id, scene]));
      for (const { id } of wanted) this.summaries.set(id, scenes.get(id) ?? null);
      this.onChange();
    } catch {
      // asked again with the next look at the jobs
    } finally {
      this.isAsking = false;
    }
  }
}
