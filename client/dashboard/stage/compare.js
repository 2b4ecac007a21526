// The model's picture beside or under another of the same moment: the recorded frame, or another scene. Recording and model
// show the same only from the endoscope's own pose and in the light of the recording: choosing it goes there, and turning
// away ends it. Another scene follows wherever the viewer goes.

import { element, setText } from "../base/element.js";
import { figure, languageEvents, words } from "../base/messages.js";
import { comparisonOf } from "../base/spelling.js";
import { nameOf } from "../library/card.js";
import { reasonsIn } from "../library/report.js";
import { lightMark, trustOf } from "../library/trustlight.js";
import { OtherScene } from "./otherscene.js";
import { Pictures, warningsOf } from "./pictures.js";
import { RecordedFrames } from "./recordedframes.js";
import { RecordedPicture } from "./recordedpicture.js";
import { MIDDLE, Seam } from "./seam.js";

/** @typedef {import("../base/wire.js").Report} Report */
/** @typedef {import("../base/wire.js").JobView} Job */
/** @typedef {"off"|"wipe"|"side"} Mode wipe: the other picture left of a seam, the model right; side: both whole */

const TOLD_MS = 10_000;

export class Compare {
  /**
   * @param {import("./viewer.js").Viewer} viewer
   * @param {{stage: HTMLElement, box: HTMLElement, canvas: HTMLCanvasElement, seam: HTMLElement,
   *   ofRecorded: HTMLElement, ofModel: HTMLElement, mode: HTMLSelectElement,
   *   beside: HTMLSelectElement, tools: HTMLInputElement, message: HTMLElement}} parts
   * @param {() => void} onChange there is another comparison, or none
   */
  constructor(viewer, parts, onChange) {
    this.viewer = viewer;
    this.parts = parts;
    this.onChange = onChange;
    this.pictures = new Pictures();
    /** @type {Job[]} */
    this.offered = [];
    viewer.awaits = () => this.other?.isExpected === true;
    this.recorded = new RecordedPicture(parts.canvas);
    this.seam = new Seam(parts.seam, parts.box);
    /** @type {Mode} */
    this.mode = "off";
    this.open(null);
    viewer.addEventListener("shown", ({ detail }) => this.#follow(detail));
    viewer.addEventListener("gone", () => this.#end(""));
    languageEvents.addEventListener("changed", () => {
      this.#fill();
      this.labelled = "";
      this.#label();
      this.seam.move(this.seam.percent);
    });
    parts.mode.addEventListener("change", () => this.choose(parts.mode.value));
    parts.beside.addEventListener("change", () => this.choose(this.mode === "off" ? "wipe" : this.mode, parts.beside.value));
    parts.tools.addEventListener("change", () => this.#draw());
  }

  /** @param {string | null} scene that comes into view; what it keeps is not known yet */
  open(scene) {
    this.scene = scene;
    /** @type {Report | null} */
    this.report = null;
    /** @type {Mode | null} of the recording, while it is not known what the scene keeps of it */
    this.wanted = null;
    this.#end("");
    this.parts.mode.disabled = this.parts.beside.disabled = scene === null;
    this.parts.beside.value = "";
    this.#fill();
  }

  /** @param {Job[]} jobs of which the finished ones can be chosen, but not the one in view */
  offer(jobs) {
    this.offered = jobs.sort((a, b) => b.created_at_s - a.created_at_s);
    this.#fill();
    this.#label(); // the scene in view may have another name
  }

  #fill() {
    const { beside } = this.parts;
    const { value } = beside;
    const jobs = this.offered.filter(({ id, state }) => state === "done" && id !== this.scene);
    const { job } = this.other ?? {};
    if (job && !jobs.some(({ id }) => id === job.id)) jobs.push(job);
    const none = words(this.mode === "off" && value === "" ? "compare.with_another" : "compare.with_recording"); // said once
    const options = [["", none], ...jobs.map((each) => [each.id, nameOf(each)])];
    const filled = JSON.stringify(options);
    if (filled === this.filled) return; // an open list would close
    this.filled = filled;
    beside.replaceChildren(...options.map(([id, name]) => Object.assign(element("option", { text: name }), { value: id })));
    beside.value = options.some(([id]) => id === value) ? value : "";
    beside.hidden = options.length === 1;
  }

  /** @param {string} scene @param {Report} report its report, which says what it keeps */
  know(scene, report) {
    if (scene !== this.scene) return;
    this.report = report;
    this.#label();
    if (this.wanted) this.choose(this.wanted, "");
  }

  /** @returns {string | null} what is compared, or shall be, as an address spells it */
  get text() {
    if (this.mode === "off") return this.wanted;
    return this.other ? `${this.mode},${this.other.scene}` : this.mode;
  }

  /** Whether it goes on when the view turns. */
  get mayTurn() {
    return this.text === null || this.other !== null;
  }

  /** @returns {string} the names of what is compared, or that of the scene in view */
  get names() {
    const { name } = this;
    return this.other ? words("compare.names", { name, other: this.#otherName }) : name;
  }

  /** Whether the other picture, if there is one, is of the view. */
  get isCurrent() {
    if (this.mode === "off") return true;
    return this.other ? this.other.isCurrent : this.drawn !== null && this.drawn === this.#frame;
  }

  /** @returns {Record<string, unknown> | null} what the other picture shows; frame: of the recording, from 0 */
  get compared() {
    if (this.mode === "off") return null;
    if (!this.other) return { scene: this.scene, frame: this.drawn };
    const { scene, shown } = this.other;
    if (!shown) return { scene, t: null };
    const { pose = null, eye = "left", layer } = shown.view;
    return { scene, t: shown.picture.t, pose, eye, layer, codes: shown.picture.codes };
  }

  /** In which light the model is compared with the recording: with that of the moment, where it changes. */
  get #light() {
    return this.report.light ? "recorded" : "steady";
  }

  /** The recorded frame that belongs to the view; null: not known. */
  get #frame() {
    return this.t === null ? null : this.frames.frameAt(this.t);
  }

  /** @returns {string} of the scene in view */
  get name() {
    const job = this.offered.find(({ id }) => id === this.scene);
    return job ? nameOf(job) : words("compare.model");
  }

  get #otherName() {
    return this.other.job ? nameOf(this.other.job) : words("compare.other");
  }

  /** Compare as an address says. @param {string | null} text */
  restore(text) {
    if (text === this.text) return;
    const { mode, scene: other } = comparisonOf(text) ?? {};
    if (!mode || other === this.scene) this.#end("");
    else if (other || this.report) this.choose(mode, other);
    else this.wanted = mode; // what the scene keeps is not known yet
  }

  /** The next mode. */
  cycle() {
    const modes = [...this.parts.mode.options].map(({ value }) => value);
    this.choose(modes[(modes.indexOf(this.mode) + 1) % modes.length]);
  }

  /** @param {Mode} mode @param {string} other scene; empty: the recording */
  choose(mode, other = this.other?.scene ?? this.parts.beside.value) {
    if (mode === "off") return this.#end("");
    if (other !== (this.other?.scene ?? "")) this.#end("");
    if (other) return this.#chooseScene(mode, other);
    if (!this.report) return this.#end(words("compare.not_yet"));
    if (!this.report.recorded) return this.#end(words("compare.none"));
    if (this.mode === "off") this.isComing = true; // until the view from home, as recorded, is there
    this.#begin(mode);
    this.parts.tools.closest("label").hidden = !this.report.recorded.masks;
    const { orbit, parts } = this.viewer;
    const wish = { light: this.#light, ...(parts.layer.value === "recorded" ? { layer: "rgb" } : {}) };
    this.viewer.look(orbit.isHome ? wish : { ...wish, pose: null }); // at home either eye may stay
  }

  #begin(mode) {
    this.mode = this.parts.mode.value = mode;
    this.wanted = null;
    this.#say("");
    this.parts.stage.dataset.compare = mode;
    this.parts.box.hidden = false;
    this.seam.move(MIDDLE);
    this.#fill();
    this.#draw();
    this.onChange();
  }

  #chooseScene(mode, scene) {
    const { viewer, parts } = this;
    this.other ??= new OtherScene(scene, this.pictures, {
      onChange: () => {
        this.#fill();
        parts.beside.value = scene;
        this.#draw();
      },
      onFail: (error) => this.#end(words("compare.other_failed", { name: this.#otherName, why: error.message })),
    });
    this.#begin(mode);
    if (viewer.shown) this.#follow(viewer.shown);
  }

  /** @param {string} why empty where the user knows */
  #end(why) {
    const isNew = this.text !== null;
    const { other } = this;
    this.wanted = null;
    this.mode = this.parts.mode.value = "off";
    this.frames?.close();
    this.frames = this.drawn = this.other = null;
    other?.close();
    this.labelled = this.parts.ofRecorded.title = "";
    this.t = null;
    delete this.parts.stage.dataset.compare;
    this.parts.box.hidden = this.parts.tools.closest("label").hidden = true;
    this.parts.canvas.width = this.parts.canvas.height = 0; // its pixels are gone, not only hidden
    this.#say(why);
    if (this.viewer.light === "recorded") this.viewer.look({ light: "steady" });
    this.#fill();
    if (isNew) this.onChange();
  }

  /** @param {string} text for a while: it lies over the picture */
  #say(text) {
    clearTimeout(this.timer);
    this.parts.message.textContent = text;
    if (text) this.timer = setTimeout(() => this.#say(""), TOLD_MS);
  }

  /** @param {import("./viewer.js").Shown} shown */
  #follow({ scene, t, pose, layer, eye, light }) {
    if (this.mode === "off" || scene !== this.scene) return;
    if (this.other) return this.#followScene(t);
    const isHome = pose === null && layer !== "recorded";
    if (this.isComing && !(isHome && light === this.#light)) return;
    if (!isHome) return this.#end(layer === "recorded" ? "" : words("compare.turned"));
    this.isComing = false;
    const { recorded, frame_count: frameCount } = this.report;
    if (!recorded.eyes.includes(eye)) return this.#end(words("compare.no_eye"));
    if (this.frames?.eye !== eye) {
      this.frames?.close();
      this.drawn = null;
      this.frames = new RecordedFrames(scene, recorded, frameCount, eye, {
        onReady: () => this.#draw(),
        onFail: (error) => this.#end(words("compare.failed", { why: error.message })),
      });
    }
    this.t = t;
    this.#draw();
  }

  #followScene(t) {
    const { cameras } = this.viewer.timeline;
    if (cameras) this.other.follow(this.viewer.shown, cameras.seconds(t) - cameras.seconds(0));
  }

  /** The frame of the moment in view, if it is there; until then the one before stays, under its own number. */
  #draw() {
    if (this.other) return this.#drawScene();
    if (this.t === null) return this.#label();
    const found = this.frames.seek(this.t);
    if (found) {
      this.recorded.draw(found, this.parts.tools.checked);
      this.drawn = found.frame;
    }
    this.#label();
  }

  #drawScene() {
    const { canvas } = this.parts;
    const image = this.other.shown?.image ?? null;
    if (image && image !== this.drawn) {
      Object.assign(canvas, { width: image.width, height: image.height });
      canvas.getContext("2d").drawImage(image, 0, 0);
    }
    if (this.other.lacksFrames) blacken(canvas, this.viewer.parts.canvas);
    this.drawn = image;
    this.#label();
  }

  #label() {
    const { ofRecorded, ofModel, canvas } = this.parts;
    if (this.mode === "off") return;
    if (this.other) return this.#labelScenes();
    const isLate = !this.isCurrent;
    canvas.hidden = this.drawn === null;
    const text = this.drawn === null ? words("compare.loading") : words("compare.recorded", { frame: this.drawn + 1 });
    setText(ofRecorded, isLate && this.drawn !== null ? `${text} · ${words("compare.late")}` : text);
    ofRecorded.toggleAttribute("data-late", isLate);
    ofModel.textContent = words("compare.model");
    canvas.setAttribute("aria-label", text);
  }

  /** Each half has its scene's name, moment and verdict. */
  #labelScenes() {
    const { other, parts, viewer } = this;
    const { shown, report, isOver, isSilent, isLate } = other;
    parts.canvas.hidden = this.drawn === null && !other.lacksFrames;
    parts.ofRecorded.toggleAttribute("data-late", isLate);
    const nothing = words(other.lacksFrames ? "compare.no_frames" : "compare.loading_scene");
    const time = Number.isFinite(other.shownS) ? words("time.moment", { seconds: figure(other.shownS, 2) }) : nothing;
    const guess = (isGuess) => (isGuess ? [words("screen.extrapolated")] : []);
    const late = isSilent ? [words("compare.silent")] : isLate && shown ? [words("compare.late")] : [];
    const over = isOver ? [words("compare.over")] : [];
    const reasons = report ? reasonsIn(report, trustOf(report)) : [];
    const warnings = shown ? warningsOf(shown.picture.codes, shown.view, reasons) : [];
    const left = [this.#otherName, time, ...late, ...over, ...guess(shown?.picture.isExtrapolated), ...warnings.slice(0, 1)];
    const right = [this.name, viewer.timeline.momentOf(viewer.shown?.t ?? 0), ...guess(viewer.screen.shown?.isExtrapolated)];
    const labelled = JSON.stringify([left, right, warnings, report?.scored, this.report?.scored]);
    if (labelled === this.labelled) return;
    this.labelled = labelled;
    fillLabel(parts.ofRecorded, left, report);
    fillLabel(parts.ofModel, right, this.report);
    parts.ofRecorded.title = warnings.join(" ");
    parts.canvas.setAttribute("aria-label", left.join(", "));
  }
}

/** The model's picture would show through. @param {HTMLCanvasElement} canvas @param {HTMLCanvasElement} picture of the model */
function blacken(canvas, { width, height }) {
  Object.assign(canvas, { width, height });
  canvas.getContext("2d").fillRect(0, 0, width, height);
}

/** @param {HTMLElement} label @param {string[]} texts the name first @param {Report | null} report */
function fillLabel(label, [name, ...texts], report) {
  const mark = report ? [" ", lightMark(trustOf(report).light)] : [];
  const said = [report ? "" : words("compare.no_verdict"), ...texts].filter(Boolean);
  label.replaceChildren(element("b", { text: name }), ...mark, ` · ${said.join(" · ")}`);
}
