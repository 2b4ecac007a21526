// The form that sends a clip: files by picker or by drop, options, progress, and what was wrong with it.

import { reconstruct } from "./api.js";
import { words } from "./messages.js";
import { insist } from "./pause.js";
import { showProblem } from "./problem.js";
import { Upload } from "./upload.js";
import { LIMITS } from "./wire.js";

const PARTS = ["clip", "right", "calibration", "masks"];
const OPTIONS = [
  ...["preset", "budget_s", "layout", "eyes", "poses", "priority", "mask_source", "mask_polarity", "keep_recorded"],
];
const LABELS = {
  preset: {
    instant: "instant: a scene within seconds",
    fast: "fast",
    quality: "quality: sharper, takes longer",
    small: "small: a small file",
    paper: "paper: the method as published",
    "paper-released": "paper, as its code was released",
    "paper-wide": "paper, with more bases",
    pfs: "baseline: pfs",
    hexplane: "baseline: hexplane",
    without_mapf: "baseline: without mapf",
  },
  mask_source: { given: "as given", auto: "as given, or found", none: "not at all" },
  poses: {
    auto: "may move: to be found out",
    given: "moves as the clip's poses say",
    fixed: "rests",
    estimate: "moves: its path is estimated",
  },
  mask_polarity: { auto: "to be found out", tool: "the instrument", tissue: "the tissue" },
  layout: {
    auto: "to be found out",
    sbs: "side by side",
    tb: "top and bottom",
    frames: "frames",
    endonerf: "EndoNeRF",
    stereomis: "StereoMIS",
  },
  eyes: { both: "both eyes", left: "the left eye; the right one judges" },
  keep_recorded: { on: "kept, to compare the model with", off: "not kept" },
  priority: { standard: "standard", high: "high: before all others" },
};
const CALIBRATION = /\.(json|ya?ml|xml|ini)$/i;

/**
 * Which part of a clip each dropped file is, by its name; the user sees the guess in the pickers.
 * @param {File[]} files
 * @returns {Map<string, File>}
 */
function partsOf(files) {
  const parts = new Map();
  for (const file of files) {
    if (CALIBRATION.test(file.name)) parts.set("calibration", file);
    else if (/mask/i.test(file.name)) parts.set("masks", file);
    else if (/right/i.test(file.name)) parts.set("right", file);
    else parts.set(parts.has("clip") ? "right" : "clip", file);
  }
  return parts;
}

/** An id for one submission; not randomUUID, which browsers keep from pages without HTTPS. */
const newKey = () => [...crypto.getRandomValues(new Uint32Array(4))].map((number) => number.toString(16)).join("-");

/** @param {HTMLFormElement} form */
function optionsOf(form) {
  const given = new FormData(form);
  const options = Object.fromEntries(OPTIONS.filter((name) => given.get(name)).map((name) => [name, given.get(name)]));
  if (options.budget_s) options.budget_s = Number(options.budget_s);
  return options;
}

/** Options that the form has no field for, as the job had them. @param {import("./api.js").Job | null} job */
function carriedFrom(job) {
  const options = Object.entries(job?.options ?? {});
  return Object.fromEntries(options.filter(([name, value]) => value != null && !OPTIONS.includes(name)));
}

/** Give the form's fields the choices and limits of the service's options. @param {HTMLFormElement} form */
function limit(form) {
  for (const name of OPTIONS) {
    const { choices, max, default: chosen } = LIMITS[name];
    const field = form.elements[name];
    if (max !== undefined) field.max = max;
    for (const choice of choices ?? []) {
      field.append(new Option(LABELS[name][choice] ?? choice, choice, choice === chosen, choice === chosen));
    }
  }
}

export class ClipForm {
  /**
   * @param {{form: HTMLFormElement, again: HTMLElement, message: HTMLElement, progress: HTMLElement,
   *   stop: HTMLElement}} parts
   * @param {(id: string) => void} onJob told of the job that was made
   */
  constructor(parts, onJob) {
    Object.assign(this, parts);
    this.onJob = onJob;
    /** @type {import("./api.js").Job | null} the job whose clip is used again, in place of a file */
    this.earlier = null;
    limit(this.form);
    this.submit = this.form.querySelector("[type=submit]");
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#send();
    });
    this.stop.addEventListener("click", () => this.controller?.abort());
    this.again.querySelector("button").addEventListener("click", () => this.#startAnew());
    this.#takeDrops();
  }

  /**
   * Use a job's clip again with better masks: its options are chosen, and masks are asked for.
   * @param {import("./api.js").Job} job
   */
  sendMasks(job) {
    this.#startAnew();
    this.earlier = job;
    for (const name of OPTIONS) {
      const value = name === "mask_source" ? "given" : job.options[name];
      if (value != null) this.form.elements[name].value = value;
    }
    this.#showSource();
    this.form.scrollIntoView();
    this.form.elements.masks.focus({ preventScroll: true });
  }

  #startAnew() {
    this.form.reset();
    this.earlier = null;
    this.#showSource();
    this.#say("");
  }

  /** The pickers of clip and calibration, or whose are used again and, beside that, the masks' picker. */
  #showSource() {
    const isAgain = this.earlier !== null;
    const { clip, right, calibration, masks, poses } = this.form.elements;
    if (isAgain) this.again.after(masks.closest("label"));
    else poses.closest("label").before(masks.closest("label"));
    for (const picker of [clip, right, calibration]) picker.closest("label").hidden = isAgain;
    clip.required = !isAgain;
    this.again.hidden = !isAgain;
    this.again.querySelector("p").textContent = isAgain
      ? `The clip of ${this.earlier.id.slice(0, 8)} again, with its calibration.`
      : "";
  }

  #takeDrops() {
    const hold = (event, isOver) => {
      event.preventDefault(); // else the browser opens the file
      this.form.classList.toggle("over", isOver && this.form.contains(event.target));
    };
    document.addEventListener("dragover", (event) => hold(event, true));
    document.addEventListener("dragleave", (event) => hold(event, false));
    document.addEventListener("drop", (event) => {
      hold(event, false);
      if (this.form.contains(event.target)) this.take([...event.dataTransfer.files]);
    });
  }

  /** @param {File[]} files put into the pickers */
  take(files) {
    const parts = partsOf(files);
    if (this.earlier && (parts.has("clip") || parts.has("right"))) this.#startAnew();
    for (const [part, file] of parts) {
      const transfer = new DataTransfer();
      transfer.items.add(file);
      this.form.elements[part].files = transfer.files;
    }
  }

  async #send() {
    this.controller = new AbortController();
    const { signal } = this.controller;
    const uploads = this.#uploads(signal);
    this.#show(true);
    try {
      await this.#sendAll(uploads);
      this.onJob(await this.#submitAll(uploads, signal));
      this.#startAnew();
    } catch (error) {
      if (signal.aborted) this.#say(words("upload.stopped"), "bad");
      else showProblem(this.message, error);
      for (const upload of uploads) upload.discard();
    } finally {
      this.#show(false);
    }
  }

  #uploads(signal) {
    const files = PARTS.map((part) => [part, this.form.elements[part].files[0]]).filter(([, file]) => file);
    const isPair = files.some(([part]) => part === "right");
    return files.map(([part, file]) => new Upload(isPair && part === "clip" ? "left" : part, file, signal));
  }

  async #sendAll(uploads) {
    const total = uploads.reduce((sum, upload) => sum + upload.file.size, 0);
    const showProgress = () => {
      const share = uploads.reduce((sum, upload) => sum + upload.offset, 0) / total;
      this.progress.value = share;
      this.#say(words("upload.sending", { share: Math.round(share * 100) }));
    };
    showProgress();
    for (const upload of uploads) await upload.send(showProgress, (problem) => this.#wait(problem));
  }

  /** @returns {Promise<string>} the job's id */
  async #submitAll(uploads, signal) {
    const submission = { options: { ...carriedFrom(this.earlier), ...optionsOf(this.form) } };
    if (this.earlier) submission.clip_of = this.earlier.id;
    if (submission.options.budget_s) delete submission.options.iterations; // they exclude each other
    for (const upload of uploads) submission[upload.part] = upload.id;
    const key = newKey();
    const submit = async () => {
      try {
        return (await reconstruct(submission, key, signal)).id;
      } catch (error) {
        if (error.status === 503 && error.document.job_id) return error.document.job_id; // safe, and queued later
        throw error;
      }
    };
    return insist(submit, (problem) => this.#wait(problem), signal);
  }

  #wait(problem) {
    showProblem(this.message, problem, words("upload.kept"));
  }

  #say(text, kind = "") {
    this.message.textContent = text;
    this.message.className = `message ${kind}`;
  }

  #show(isSending) {
    this.submit.disabled = isSending;
    this.progress.hidden = this.stop.hidden = !isSending;
  }
}
