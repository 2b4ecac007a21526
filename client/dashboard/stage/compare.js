// The recorded frame beside or over the model's picture of the same moment. Both show the same only from the
// endoscope's own pose and in the light of the recording: choosing it goes there, and turning away ends it.

import { setText } from "../base/element.js";
import { languageEvents, words } from "../base/messages.js";
import { RecordedFrames } from "./recordedframes.js";

/** @typedef {import("../base/wire.js").Report} Report */
/** @typedef {"off"|"wipe"|"side"} Mode wipe: the recorded frame left of a seam, the model right; side: both whole */

const STEPS = { ArrowLeft: -2, ArrowDown: -2, ArrowRight: 2, ArrowUp: 2, PageDown: -10, PageUp: 10 };
const ENDS = { Home: 0, End: 100 };
const MIDDLE = 50;
const TOLD_MS = 10_000;
/** The hatch of what nobody saw (intrasplat/view/unseen.py). */
const GREYS = ["rgb(40 40 40)", "rgb(74 74 74)"];
const STRIPES_A_PICTURE = 96;

export class Compare {
  /**
   * @param {import("./viewer.js").Viewer} viewer
   * @param {{stage: HTMLElement, box: HTMLElement, canvas: HTMLCanvasElement, seam: HTMLElement,
   *   ofRecorded: HTMLElement, ofModel: HTMLElement, mode: HTMLSelectElement, tools: HTMLInputElement,
   *   message: HTMLElement}} parts
   */
  constructor(viewer, parts) {
    this.viewer = viewer;
    this.parts = parts;
    this.hatch = document.createElement("canvas");
    /** @type {Mode} */
    this.mode = "off";
    this.seam = MIDDLE;
    this.open(null);
    viewer.addEventListener("shown", ({ detail }) => this.#follow(detail));
    viewer.addEventListener("gone", () => this.#end(""));
    languageEvents.addEventListener("changed", () => {
      this.#label();
      this.#moveSeam(this.seam);
    });
    parts.mode.addEventListener("change", () => this.choose(parts.mode.value));
    parts.tools.addEventListener("change", () => this.#draw());
    this.#listenToSeam();
  }

  /** @param {string | null} scene that comes into view; what it keeps is not known yet */
  open(scene) {
    this.scene = scene;
    /** @type {Report | null} */
    this.report = null;
    this.#end("");
    this.parts.mode.disabled = scene === null;
  }

  /** @param {string} scene @param {Report} report its report, which says what it keeps */
  know(scene, report) {
    if (scene === this.scene) this.report = report;
  }

  /** The next mode. */
  cycle() {
    const modes = [...this.parts.mode.options].map(({ value }) => value);
    this.choose(modes[(modes.indexOf(this.mode) + 1) % modes.length]);
  }

  /** @param {Mode} mode */
  choose(mode) {
    if (mode === "off") return this.#end("");
    if (!this.report) return this.#end(words("compare.not_yet"));
    if (!this.report.recorded) return this.#end(words("compare.none"));
    if (this.mode === "off") this.isComing = true; // until the view from home, as recorded, is there
    this.mode = this.parts.mode.value = mode;
    this.#say("");
    this.parts.stage.dataset.compare = mode;
    this.parts.box.hidden = false;
    this.parts.tools.closest("label").hidden = !this.report.recorded.masks;
    this.#moveSeam(MIDDLE);
    this.#draw();
    const { orbit, parts } = this.viewer;
    const wish = { light: "recorded", ...(parts.layer.value === "recorded" ? { layer: "rgb" } : {}) };
    this.viewer.look(orbit.isHome ? wish : { ...wish, pose: null }); // at home either eye may stay
  }

  /** @param {string} why empty where the user knows */
  #end(why) {
    this.mode = this.parts.mode.value = "off";
    this.frames?.close();
    this.frames = this.drawn = null;
    this.t = null;
    delete this.parts.stage.dataset.compare;
    this.parts.box.hidden = this.parts.tools.closest("label").hidden = true;
    this.parts.canvas.width = this.parts.canvas.height = 0; // its pixels are gone, not only hidden
    this.#say(why);
    if (this.viewer.light === "recorded") this.viewer.look({ light: "steady" });
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
    const isHome = pose === null && layer !== "recorded";
    if (this.isComing && !(isHome && light === "recorded")) return;
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

  /** The frame of the moment in view, if it is there; until then the one before stays, under its own number. */
  #draw() {
    if (this.t === null) return this.#label();
    const found = this.frames.seek(this.t);
    if (found) {
      const { canvas, tools } = this.parts;
      const { width, height } = found.picture;
      if (canvas.width !== width) canvas.width = width;
      if (canvas.height !== height) canvas.height = height;
      const context = canvas.getContext("2d");
      context.drawImage(found.picture, 0, 0);
      if (found.mask && !tools.checked) context.drawImage(this.#hatched(found.mask), 0, 0);
      this.drawn = found.frame;
    }
    this.#label();
  }

  /** @param {ImageBitmap} mask opaque where the hatch is to be */
  #hatched(mask) {
    const { hatch } = this;
    if (hatch.width !== mask.width || hatch.height !== mask.height) {
      Object.assign(hatch, { width: mask.width, height: mask.height });
      this.stripes = null;
    }
    const context = hatch.getContext("2d");
    this.stripes ??= stripesOn(context, Math.max(2, Math.round(mask.width / STRIPES_A_PICTURE)));
    context.globalCompositeOperation = "copy";
    context.drawImage(mask, 0, 0);
    context.globalCompositeOperation = "source-in";
    context.fillStyle = this.stripes;
    context.fillRect(0, 0, mask.width, mask.height);
    return hatch;
  }

  #label() {
    const { ofRecorded, ofModel, canvas } = this.parts;
    if (this.mode === "off") return;
    const wanted = this.t === null ? null : this.frames.frameAt(this.t);
    const isLate = this.drawn === null || this.drawn !== wanted;
    canvas.hidden = this.drawn === null;
    const text = this.drawn === null ? words("compare.loading") : words("compare.recorded", { frame: this.drawn + 1 });
    setText(ofRecorded, text);
    ofRecorded.toggleAttribute("data-late", isLate);
    ofModel.textContent = words("compare.model");
    canvas.setAttribute("aria-label", text);
  }

  #listenToSeam() {
    const { seam, box } = this.parts;
    const follow = ({ clientX }) => {
      const { left, width } = box.getBoundingClientRect();
      this.#moveSeam(((clientX - left) / width) * 100);
    };
    seam.addEventListener("pointerdown", (event) => {
      event.stopPropagation(); // the stage would turn the model
      seam.setPointerCapture(event.pointerId);
    });
    seam.addEventListener("pointermove", (event) => {
      event.stopPropagation();
      if (seam.hasPointerCapture(event.pointerId)) follow(event);
    });
    seam.addEventListener("dblclick", (event) => event.stopPropagation());
    seam.addEventListener("keydown", (event) => {
      const { key } = event;
      if (key in STEPS) this.#moveSeam(this.seam + STEPS[key]);
      else if (key in ENDS) this.#moveSeam(ENDS[key]);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  /** @param {number} percent of the stage that shows the recorded frame */
  #moveSeam(percent) {
    this.seam = Math.min(100, Math.max(0, percent));
    const { seam, box } = this.parts;
    box.style.setProperty("--seam", `${this.seam}%`);
    seam.setAttribute("aria-valuenow", String(Math.round(this.seam)));
    seam.setAttribute("aria-valuetext", words("compare.seam_at", { percent: Math.round(this.seam) }));
  }
}

/** Diagonal stripes, px wide along a row. @param {CanvasRenderingContext2D} context @param {number} px */
function stripesOn(context, px) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = 2 * px;
  const drawing = tile.getContext("2d");
  for (let y = 0; y < 2 * px; y++) {
    for (let x = 0; x < 2 * px; x++) {
      drawing.fillStyle = GREYS[Math.floor((x + y) / px) % 2];
      drawing.fillRect(x, y, 1, 1);
    }
  }
  return context.createPattern(tile, "repeat");
}
