// The list of jobs: where each stands, and what may be done about it.

import { cancelJob, purgeScene, retryJob } from "../base/api.js";
import { closeBanner } from "../base/banners.js";
import { button, element } from "../base/element.js";
import { words } from "../base/messages.js";
import { details, showProblem } from "../base/problem.js";
import { makeCard, nameOf, rename } from "./card.js";
import { progressOf, shareOf } from "./progress.js";
import { Thumbnails } from "./thumbnails.js";
import { TimesLeft } from "./timeleft.js";

/** @typedef {import("../base/api.js").Job} Job */

/** Errors after which the same clip may well succeed; after any other, the clip or the service must change first. */
const MAY_SUCCEED = ["attempts_exhausted", "fault", "out_of_memory", "queue_full", "store_full", "decoder_killed", "unavailable", "unclassified"];

/** @param {import("../base/api.js").Receipt} receipt @returns {string} for whoever keeps books */
function describeReceipt(receipt) {
  const sum = (counts) => Object.values(counts).reduce((total, count) => total + count, 0);
  const others = receipt.clip_kept_by.map((id) => `clip_kept_by ${id}`);
  return [`${receipt.job_id}: ${sum(receipt.files)} files, ${sum(receipt.bytes)} bytes, ${receipt.purged_at}`, ...others].join("; ");
}

/** A click on picture and name opens it, as its button does for keyboards. @param {HTMLElement} item @param {() => void} onOpen */
function openByClick(item, onOpen) {
  const card = item.querySelector(".card");
  card.classList.add("opens");
  card.addEventListener("click", ({ target }) => target.closest("form, details, button") || onOpen());
}

export class JobList {
  /**
   * @param {{list: HTMLElement, nothing: HTMLElement, message: HTMLElement, confirm: HTMLDialogElement}} parts
   * @param {import("../base/scopes.js").Scopes} scopes
   * @param {{onView: (id: string) => void, onCalibrate: (id: string) => void, onChange: () => void, onPurged: (id: string) => void,
   *   onLabelled: (job: Job) => void, onRedraw: () => void, onDownload: (id: string, name: string) => void,
   *   summaryOf: (id: string) => import("../base/api.js").SceneSummary | null}} told
   */
  constructor(parts, scopes, told) {
    Object.assign(this, parts, told);
    this.scopes = scopes;
    this.times = new TimesLeft();
    this.thumbnails = new Thumbnails(this.list.closest(".drawer"));
    /** @type {Map<string, {item: HTMLElement, bar: HTMLProgressElement, words: HTMLElement, key: string}>} */
    this.rows = new Map();
    /** @type {string | null} the job whose name is being changed: its row stays as it is */
    this.renamed = null;
    this.confirm.querySelector("[value=no]").addEventListener("click", () => this.confirm.close());
    this.confirm.querySelector("[value=yes]").addEventListener("click", () => {
      this.confirm.close();
      this.onYes();
    });
  }

  /** @param {Job[]} jobs @param {string | null} chosen the one in view */
  show(jobs, chosen) {
    this.nothing.hidden = jobs.length > 0;
    const here = new Set(jobs.map((job) => job.id));
    this.times.keepOnly(here);
    for (const [id, row] of this.rows) {
      if (!here.has(id)) this.#remove(id, row);
    }
    jobs.forEach((job, place) => {
      const item = this.#row(job, chosen).item;
      if (this.list.children[place] !== item) this.list.insertBefore(item, this.list.children[place] ?? null);
    });
  }

  /** Make every row anew, as in another language. */
  forget() {
    for (const [id, row] of this.rows) this.#remove(id, row);
  }

  #remove(id, row) {
    if (this.renamed === id) this.renamed = null;
    this.thumbnails.letGo(row.item);
    row.item.remove();
    this.rows.delete(id);
  }

  /** The job's row, made again only if its actions change, so that focus and half-made clicks stay. */
  #row(job, chosen) {
    const summary = job.state === "done" ? this.summaryOf(job.id) : null;
    const key = JSON.stringify([job.state, job.cancel_requested, job.error, job.label, this.#actions(job), summary]);
    let row = this.rows.get(job.id);
    if (row?.key !== key && !(row && this.renamed === job.id)) {
      const made = { ...makeCard(job, { summary, buttons: this.#buttons(job, nameOf(job)), thumbnails: this.thumbnails }), key };
      const open = this.#actions(job).find((action) => action === "view" || action === "watch");
      if (open) openByClick(made.item, () => this.onView(job.id));
      const hadFocus = row?.item.contains(document.activeElement);
      if (row) this.thumbnails.letGo(row.item);
      row?.item.replaceWith(made.item);
      if (hadFocus) made.item.querySelector("button")?.focus();
      row = made;
      this.rows.set(job.id, row);
    }
    row.words.textContent = progressOf(job, this.times);
    row.bar.value = shareOf(job);
    row.item.classList.toggle("chosen", job.id === chosen);
    if (job.id === chosen) row.item.setAttribute("aria-current", "true");
    else row.item.removeAttribute("aria-current");
    return row;
  }

  /** @param {Job} job @returns {("watch"|"view"|"save"|"rename"|"retry"|"calibrate"|"cancel"|"delete")[]} what may be done, and would not be refused */
  #actions(job) {
    const isLive = job.state === "queued" || job.state === "running";
    const mayChange = this.scopes.has("reconstruct");
    const may = {
      watch: job.state === "running",
      view: job.state === "done",
      save: job.state === "done" && this.scopes.has("view"),
      rename: mayChange,
      retry: job.state === "failed" && mayChange && MAY_SUCCEED.includes(job.error?.code ?? "unclassified"),
      calibrate: job.state === "failed" && mayChange && job.error?.field === "calibration",
      cancel: isLive && mayChange,
      delete: !isLive && this.scopes.has("purge"),
    };
    return Object.keys(may).filter((action) => may[action]);
  }

  #buttons(job, name) {
    const work = {
      watch: () => this.onView(job.id),
      view: () => this.onView(job.id),
      save: () => this.onDownload(job.id, name),
      rename: () => this.#rename(job),
      retry: () => this.#do(() => retryJob(job.id)),
      calibrate: () => this.onCalibrate(job.id),
      cancel: () => this.#ask("cancel", name, () => this.#do(() => cancelJob(job.id))),
      delete: () => this.#ask("delete", name, () => this.#purge(job.id, name)),
    };
    return this.#actions(job).map((action) => {
      const text = words(`job.${action}`);
      const made = button(text, work[action], `${text} ${name}`);
      made.dataset.action = action;
      made.disabled = action === "cancel" && job.cancel_requested;
      return made;
    });
  }

  #rename(job) {
    closeBanner(this.message);
    this.renamed = job.id;
    rename(this.rows.get(job.id).item, job, (labelled) => {
      const row = this.rows.get(job.id);
      this.renamed = null;
      if (row) row.key = ""; // made again, with its name
      if (labelled) this.onLabelled(labelled);
      this.onRedraw();
      this.rows.get(job.id)?.item.querySelector("[data-action=rename]")?.focus();
    });
  }

  /** Ask before what cannot be taken back. @param {"cancel"|"delete"} action @param {string} name @param {() => void} onYes */
  #ask(action, name, onYes) {
    this.onYes = onYes;
    for (const answer of ["yes", "no"]) this.confirm.querySelector(`[value=${answer}]`).textContent = words(`job.${answer}_${action}`);
    this.confirm.querySelector("p").textContent = words(`job.ask_${action}`, { name });
    this.confirm.showModal();
  }

  #purge(id, name) {
    this.#do(async () => {
      const receipt = await purgeScene(id);
      this.onPurged(id);
      const checked = receipt.verified && words("job.purge_checked");
      const kept = receipt.clip_kept_by.length > 0 && words("job.clip_kept");
      const said = [words("job.purged", { name }), checked, kept].filter(Boolean).join(" ");
      this.message.replaceChildren(element("p", { text: said }), ...details(describeReceipt(receipt)));
    });
  }

  async #do(work) {
    closeBanner(this.message);
    try {
      await work();
    } catch (error) {
      showProblem(this.message, error);
    }
    this.onChange();
  }
}
