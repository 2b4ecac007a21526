// The form that sends a clip: files by picker or by drop, what speaks against them, progress, and going on after a reload.

import { element } from "../base/element.js";
import { keyEvents } from "../base/key.js";
import { languageEvents, words } from "../base/messages.js";
import { translatePickers } from "../base/pickers.js";
import { showProblem } from "../base/problem.js";
import { findingsOf, showFindings } from "./checks.js";
import { carriedFrom, limit, nameChoices, OPTIONS, optionsOf } from "./options.js";
import { interrupted, isSame, planOf, Sending } from "./sending.js";

const PARTS = ["clip", "right", "calibration", "masks", "poses_file", "fov_mask"];
const CALIBRATION = /\.(json|ya?ml|xml|ini)$/i;
const POSES = /\.(tum|txt|csv)$|(^|[^a-z])poses?[^a-z].*json$/i;
const PICTURE = /\.png$/i;
const SAVED_SCENE = /\.scene( ?\(\d+\))?\.zip$/i;
const UNAUTHORISED = 401;
/** tests/client/draw_example.py draws it. */
const EXAMPLE = ["stereo.webm", "calibration.json", "masks.zip"];

/**
 * Which part of a clip each dropped file is, by its name; the user sees the guess in the pickers.
 * @param {File[]} files
 * @returns {Map<string, File>}
 */
function partsOf(files) {
  const parts = new Map();
  for (const file of files) {
    if (POSES.test(file.name)) parts.set("poses_file", file);
    else if (PICTURE.test(file.name)) parts.set("fov_mask", file);
    else if (CALIBRATION.test(file.name)) parts.set("calibration", file);
    else if (/mask/i.test(file.name)) parts.set("masks", file);
    else if (/right/i.test(file.name)) parts.set("right", file);
    else parts.set(parts.has("clip") ? "right" : "clip", file);
  }
  return parts;
}

export class ClipForm {
  /**
   * @param {{form: HTMLFormElement, again: HTMLElement, message: HTMLElement, progress: HTMLElement,
   *   stop: HTMLElement, refusal: HTMLElement}} parts
   * @param {{onJob: (id: string, plan: import("./sending.js").Plan) => void, onSend: (clip: File | undefined, isExample: boolean) => void,
   *   onShare: (share: number | null) => void, onAsked: () => void, onScene: (file: File) => void}} told of the job that was made,
   *   and of what; that a clip is being sent; of the share that is sent, null at the end; that something is asked of the user;
   *   of a scene that was saved and is dropped
   */
  constructor(parts, told) {
    Object.assign(this, parts, told);
    /** @type {import("../base/api.js").Job | null} the job whose clip is used again, in place of a file */
    this.earlier = null;
    /** @type {"masks"|"calibration"} the file that is sent with it */
    this.asked = "masks";
    /** @type {{sending: Sending, missing: import("./sending.js").PlannedFile[]} | null} what a reload interrupted */
    this.resumed = null;
    this.isSending = false;
    this.isEdited = false; // there is something in it that was not sent
    this.isAllowed = true;
    this.looks = 0; // counts checks: only the newest is shown
    limit(this.form);
    this.showPickers = translatePickers(this.form);
    this.submit = this.form.querySelector("[type=submit]");
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#send();
    });
    this.form.addEventListener("input", () => (this.isEdited = true));
    this.form.addEventListener("change", () => this.#look());
    this.stop.addEventListener("click", () => this.controller?.abort());
    this.again.querySelector("button").addEventListener("click", () => this.#giveUp());
    languageEvents.addEventListener("changed", () => nameChoices(this.form));
    keyEvents.addEventListener("changed", () => this.#resume());
    this.#takeDrops();
    this.#resume();
  }

  /** Offer what the user's key may do. @param {import("../base/scopes.js").Scopes} scopes */
  allow(scopes) {
    this.isAllowed = scopes.known === null || scopes.has("reconstruct");
    this.refusal.hidden = this.isAllowed;
    this.form.classList.toggle("refused", !this.isAllowed);
    this.#showSubmit();
    const high = [...this.form.elements.priority.options].find((option) => option.value === "high");
    high.disabled = scopes.known !== null && !scopes.has("priority");
  }

  /**
   * Use a job's clip again with another file: its options are chosen, and the file is asked for. Not while one is sent.
   * @param {import("../base/api.js").Job} job
   * @param {"masks"|"calibration"} part
   * @param {File} [painted] the masks, white on instruments
   */
  sendAgain(job, part, painted) {
    this.#startAnew();
    this.earlier = job;
    this.asked = part;
    this.isEdited = true;
    for (const name of OPTIONS) {
      const value = part === "masks" && name === "mask_source" ? "given" : job.options[name];
      if (value != null) this.form.elements[name].value = value;
    }
    this.#showSource();
    this.form.scrollIntoView();
    this.form.elements[part].focus({ preventScroll: true });
    if (!painted) return;
    this.form.elements.mask_polarity.value = "tool";
    this.take([painted]);
  }

  /** Send the clip that comes with the page. @param {string} label its name */
  async sendExample(label) {
    if (this.isSending) return;
    this.#startAnew();
    const files = EXAMPLE.map(async (name) => new File([await (await fetch(`example/${name}`)).blob()], name));
    this.take(await Promise.all(files));
    this.form.elements.label.value = label;
    await this.#send(true);
  }

  #startAnew() {
    this.form.reset();
    this.isEdited = false;
    this.earlier = null;
    this.resumed = null;
    showFindings(this.form, []);
    this.#showSource();
    this.#say("");
  }

  /** Another clip in place of the earlier or the interrupted one. */
  #giveUp() {
    this.resumed?.sending.discard();
    this.#startAnew();
  }

  /** The pickers of the parts that are asked for, and why it is not all of them. */
  #showSource() {
    const { clip, calibration } = this.form.elements;
    const asked = this.#askedFor();
    for (const part of PARTS) {
      const label = this.form.elements[part].closest("label");
      label.hidden = !asked.includes(part);
    }
    const inGroup = PARTS.filter((part) => this.form.elements[part].closest("details"));
    const group = this.form.querySelector("details");
    const isAsked = inGroup.some((part) => asked.includes(part));
    group.classList.toggle("asked", isAsked);
    if (this.resumed && isAsked) group.open = true;
    this.form.classList.toggle("resumed", this.resumed !== null);
    clip.required = asked.includes("clip");
    calibration.required = this.earlier !== null && this.asked === "calibration";
    this.again.hidden = this.earlier === null && this.resumed === null;
    const [text, leave] = this.again.children;
    leave.textContent = words(this.resumed ? "upload.give_up" : "upload.another");
    if (this.resumed) {
      const names = this.resumed.missing.map((planned) => planned.name).join(", ");
      text.textContent = words("upload.choose_again", { names });
    } else if (this.earlier) text.textContent = words(`upload.clip_again_${this.asked}`, { id: this.earlier.label ?? this.earlier.id.slice(0, 8) });
  }

  #askedFor() {
    if (this.resumed) return this.resumed.missing.map(({ part }) => pickerOf(part));
    return this.earlier ? [this.asked] : PARTS;
  }

  /** Files dropped anywhere on the page. */
  #takeDrops() {
    const theatre = this.form.closest("main");
    const hold = (event, isOver) => {
      event.preventDefault(); // else the browser opens the file
      theatre.classList.toggle("dropping", isOver && this.isAllowed);
    };
    document.addEventListener("dragover", (event) => hold(event, true));
    document.addEventListener("dragleave", (event) => hold(event, false));
    document.addEventListener("drop", (event) => {
      hold(event, false);
      if (event.dataTransfer.files.length === 0) return;
      if (!this.isAllowed) return this.#say(words("upload.not_allowed"), "bad");
      const files = [...event.dataTransfer.files];
      if (files.length === 1 && SAVED_SCENE.test(files[0].name)) return this.onScene(files[0]);
      this.onAsked();
      this.take(files);
    });
  }

  /** @param {File[]} files put into the pickers */
  take(files) {
    const parts = partsOf(files);
    if (this.earlier && (parts.has("clip") || parts.has("right"))) this.#startAnew();
    this.isEdited = true;
    for (const [part, file] of parts) {
      const transfer = new DataTransfer();
      transfer.items.add(file);
      this.form.elements[part].files = transfer.files;
    }
    this.showPickers();
    this.#look();
  }

  /** @returns {Map<string, File>} the files that are chosen, by the part of the clip that they are */
  #files() {
    const chosen = PARTS.map((part) => [part, this.form.elements[part].files[0]]).filter(([, file]) => file);
    const isPair = chosen.some(([part]) => part === "right");
    return new Map(chosen.map(([part, file]) => [isPair && part === "clip" ? "left" : part, file]));
  }

  /** What is sent beside the files. */
  #submission() {
    const submission = { options: { ...carriedFrom(this.earlier), ...optionsOf(this.form) } };
    if (this.earlier) submission.clip_of = this.earlier.id;
    const label = this.form.elements.label.value.trim();
    if (label) submission.label = label;
    if (submission.options.budget_s) delete submission.options.iterations; // they exclude each other
    return submission;
  }

  /** Show what speaks against what is chosen, or go on with what was interrupted. @returns {Promise<HTMLElement | null>} */
  async #look() {
    if (this.resumed) return this.#goOn();
    const look = ++this.looks;
    const files = this.#files();
    const findings = files.size > 0 ? await findingsOf(files, this.#submission()) : [];
    return look === this.looks ? showFindings(this.form, findings) : null;
  }

  async #send(isExample = false) {
    if (this.isSending) return;
    this.isSending = true;
    this.#showSubmit();
    const atFault = await this.#look();
    this.isSending = false;
    this.#showSubmit();
    if (atFault) {
      this.#say(words("upload.look"), "bad");
      atFault.focus();
      return;
    }
    const files = this.#files();
    const sending = this.#begin(planOf(files, this.#submission()));
    this.isEdited = false;
    await this.#run(sending, files, isExample);
  }

  /** @param {import("./sending.js").Plan} plan */
  #begin(plan) {
    this.controller = new AbortController();
    return new Sending(plan, this.controller.signal, {
      onShare: (share) => this.#showShare(share),
      onTrouble: (problem) => showProblem(this.message, problem, words("upload.kept")),
    });
  }

  /** @param {Sending} sending @param {Map<string, File>} files @param {boolean} isExample the page's own */
  async #run(sending, files, isExample = false) {
    this.#show(true);
    this.onSend(files.get("clip") ?? files.get("left"), isExample);
    try {
      this.onJob(await sending.run(files), sending.plan);
      if (this.isEdited) this.#goOnWithNext();
      else this.#startAnew();
    } catch (error) {
      this.#tellEnd(sending, error);
    } finally {
      this.#show(false);
      this.onShare(null);
    }
  }

  /** What was put into the form while another clip was sent stays there. */
  #goOnWithNext() {
    this.resumed = null;
    this.#showSource();
    this.#say("");
    this.#look();
  }

  /** It ended without a job. @param {Sending} sending @param {Error} error */
  #tellEnd(sending, error) {
    if (sending.signal.aborted) this.#say(words("upload.stopped"), "bad");
    else showProblem(this.message, error);
    if (error.status === UNAUTHORISED) return; // goes on with the right key
    sending.discard();
    this.resumed = null;
    this.#showSource();
    this.onAsked();
  }

  /** Take up what a reload interrupted: what has not come of its files is asked for again. */
  async #resume() {
    const plan = interrupted();
    if (plan === null || this.isSending) return;
    const sending = this.#begin(plan);
    this.#show(true);
    try {
      this.resumed = { sending, missing: await sending.missing() };
    } catch (error) {
      this.#tellEnd(sending, error);
      return;
    } finally {
      this.#show(false);
    }
    if (this.resumed.missing.length === 0) {
      await this.#run(sending, new Map());
      return;
    }
    this.#showSource();
    this.#say(words("upload.interrupted"), "bad");
    this.onAsked();
    await this.#goOn(); // after another key was asked for, the files are chosen still
  }

  /** Go on as soon as the files that were interrupted are chosen again. */
  async #goOn() {
    const { sending, missing } = this.resumed;
    showFindings(this.form, []);
    const files = new Map();
    for (const planned of missing) {
      const picker = this.form.elements[pickerOf(planned.part)];
      const file = picker.files[0];
      if (file && !isSame(planned, file)) {
        picker.closest("label").after(element("div", { class: "finding bad", text: words("upload.other_file", { name: planned.name }) }));
      } else if (file) files.set(planned.part, file);
    }
    if (files.size < missing.length || this.isSending) return null;
    this.isEdited = false;
    await this.#run(sending, files);
    return null;
  }

  #showShare(share) {
    this.progress.value = share;
    this.#say(words("upload.sending", { share: Math.round(share * 100) }));
    this.onShare(share);
  }

  #say(text, kind = "") {
    this.message.textContent = text;
    this.message.className = `message ${kind}`;
  }

  #show(isSending) {
    this.isSending = isSending;
    this.progress.hidden = this.stop.hidden = !isSending;
    this.#showSubmit();
  }

  #showSubmit() {
    this.submit.disabled = this.isSending || !this.isAllowed;
  }
}

/** @param {string} part of a clip @returns {string} the picker's name */
const pickerOf = (part) => (part === "left" ? "clip" : part);
