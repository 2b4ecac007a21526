// The list of jobs: where each stands, and what may be done about it.

import { cancelJob, purgeScene, retryJob } from "./api.js";
import { button, clockTime, element } from "./element.js";

/** @typedef {import("./api.js").Job} Job */

/** What the worker's stages are to somebody who waits. */
const STAGES = {
  fetching: "fetching the clip",
  decode: "reading the clip",
  calibrate: "checking the calibration",
  stereo: "measuring depth",
  compile: "preparing the kernels",
  fusion: "collecting points",
  motion: "following the tissue",
  start: "starting the model",
  train: "training",
  finish: "cleaning up",
  score: "scoring",
  publishing: "publishing",
};

const seconds = (value) => (value < 90 ? `${Math.max(1, Math.round(value))} s` : `${Math.round(value / 60)} min`);

/** @param {Job} job @returns {string} what it is doing, in one line */
function describe(job) {
  if (job.state === "queued") {
    const before = job.position == null ? null : job.position === 0 ? "next" : `${job.position} before it`;
    return ["queued", before, job.eta_s != null && `done in about ${seconds(job.eta_s)}`].filter(Boolean).join(" · ");
  }
  if (job.state !== "running") return job.state;
  const stage = job.cancel_requested ? "cancelling" : (STAGES[job.stage] ?? job.stage ?? "starting");
  const db = job.psnr_db != null && `${job.psnr_db.toFixed(1)} dB`;
  return [stage, db, job.seconds_left != null && `${seconds(job.seconds_left)} left`].filter(Boolean).join(" · ");
}

/** @param {import("./api.js").Receipt} receipt @returns {string} */
function describeReceipt(receipt) {
  const sum = (counts) => Object.values(counts).reduce((total, count) => total + count, 0);
  const megabytes = (sum(receipt.bytes) / 1e6).toFixed(1);
  const proof = receipt.verified ? "It was checked that nothing is left." : "";
  const others = receipt.clip_kept_by.map((id) => id.slice(0, 8)).join(" and ");
  const kept = others && ` The same clip stays with ${others}.`;
  const what = `${sum(receipt.files)} files, ${megabytes} MB, and its record`;
  return `${receipt.job_id.slice(0, 8)} is deleted for good: ${what}. ${proof}${kept}`;
}

export class JobList {
  /**
   * @param {{list: HTMLElement, nothing: HTMLElement, message: HTMLElement, confirm: HTMLDialogElement}} parts
   * @param {{onView: (id: string) => void, onChange: () => void, onPurged: (id: string) => void}} told
   */
  constructor(parts, told) {
    Object.assign(this, parts, told);
    /** @type {Map<string, {item: HTMLElement, bar: HTMLProgressElement, words: HTMLElement, key: string}>} */
    this.rows = new Map();
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
    for (const [id, row] of this.rows) {
      if (here.has(id)) continue;
      row.item.remove();
      this.rows.delete(id);
    }
    jobs.forEach((job, place) => {
      const item = this.#row(job, chosen).item;
      if (this.list.children[place] !== item) this.list.insertBefore(item, this.list.children[place] ?? null);
    });
  }

  /** The job's row, made again only if its actions change, so that focus and half-made clicks stay. */
  #row(job, chosen) {
    const key = JSON.stringify([job.state, job.cancel_requested, job.error]);
    let row = this.rows.get(job.id);
    if (row?.key !== key) {
      const made = this.#make(job, key);
      const hadFocus = row?.item.contains(document.activeElement);
      row?.item.replaceWith(made.item);
      if (hadFocus) made.item.querySelector("button")?.focus();
      row = made;
      this.rows.set(job.id, row);
    }
    row.words.textContent = describe(job);
    row.bar.value = job.fraction ?? 0;
    row.item.classList.toggle("chosen", job.id === chosen);
    if (job.id === chosen) row.item.setAttribute("aria-current", "true");
    else row.item.removeAttribute("aria-current");
    return row;
  }

  #make(job, key) {
    const name = `${clockTime(job.created_at_s * 1000)} · ${job.id.slice(0, 8)}`;
    const words = element("strong");
    const bar = element("progress");
    bar.setAttribute("aria-label", `progress of ${name}`);
    bar.hidden = job.state !== "running";
    const head = element("div", { class: "head" }, element("span", { text: name }), words);
    const item = element("li", { class: `job ${job.state}` }, head, bar);
    item.dataset.job = job.id;
    if (job.error) {
      const { field, problem, remedy } = job.error;
      const text = [field && `${field}:`, problem, remedy].filter(Boolean).join(" ");
      item.append(element("p", { class: "failed", text }));
    }
    item.append(element("div", { class: "actions" }, ...this.#buttons(job, name)));
    return { item, bar, words, key };
  }

  #buttons(job, name) {
    const buttons = [];
    const add = (text, onClick) => buttons.push(button(text, onClick, `${text} ${name}`));
    if (job.state === "running") add("Watch", () => this.onView(job.id));
    if (job.state === "done") add("View", () => this.onView(job.id));
    if (job.state === "failed") add("Try again", () => this.#do(() => retryJob(job.id)));
    if (job.state === "queued" || job.state === "running") {
      add("Cancel", () => this.#ask("Cancel job", `Cancel ${name}? Its clip is removed.`, () => this.#do(() => cancelJob(job.id))));
      buttons.at(-1).disabled = job.cancel_requested;
    } else {
      add("Delete", () => this.#ask("Delete", `Delete the clip and the scene of ${name} for good?`, () => this.#purge(job.id)));
    }
    return buttons;
  }

  /** Ask before what cannot be taken back. @param {string} yes @param {string} question @param {() => void} onYes */
  #ask(yes, question, onYes) {
    this.onYes = onYes;
    this.confirm.querySelector("[value=yes]").textContent = yes;
    this.confirm.querySelector("p").textContent = question;
    this.confirm.showModal();
  }

  #purge(id) {
    this.#do(async () => {
      const receipt = await purgeScene(id);
      this.onPurged(id);
      return describeReceipt(receipt);
    });
  }

  async #do(work) {
    this.message.className = "message";
    try {
      const words = await work();
      this.message.textContent = typeof words === "string" ? words : "";
    } catch (error) {
      this.message.textContent = error.message;
      this.message.classList.add("bad");
    }
    this.onChange();
  }
}
