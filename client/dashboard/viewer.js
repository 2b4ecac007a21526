// The view of one scene: at most one picture is under way; the newest wish is asked for next, and now and then the same
// again, which follows training, notices a purge, and keeps CURRENT true.

import { Clip } from "./clip.js";
import { Orbit } from "./orbit.js";
import { Pace } from "./pace.js";
import { pause } from "./pause.js";
import { Pictures } from "./pictures.js";
import { Screen } from "./screen.js";
import { Timeline } from "./timeline.js";

const AGAIN_MS = 1500;
const AFTER_TROUBLE_MS = 700;
const NOT_YET = "Its first picture comes when training begins.";
/**
 * What a view shows. t: as shown, within the clip; pose: as the service spells it, null for the endoscope's own, of the eye;
 * camera: null where it is not known, as of recorded frames; way: how the picture came.
 * @typedef {{scene: string, t: number, pose: string | null, eye: "left"|"right", layer: string, unseen: "mark"|"guess",
 *   highlights: "on"|"off", state: "running"|"done", way: string, camera: import("./stream.js").Camera | null}} Shown
 */
/** There is nothing to show, or not to this key; a picture that was there goes. */
const NOTHING_TO_SHOW = [401, 403, 404, 409];

/**
 * Tells "shown" (a CustomEvent whose detail is Shown) of every picture that has come to the screen, "gone" when it goes, "known"
 * when the scene's cameras are, and "refused" when nobody may stand where the viewer shall.
 */
export class Viewer extends EventTarget {
  /** @param {Record<string, HTMLElement>} parts by what they are; index.html has them */
  constructor(parts) {
    super();
    this.parts = parts;
    this.scene = null;
    /** @type {Shown | null} what is on the screen */
    this.shown = null;
    this.visit = 0; // counts scenes opened: what was asked for in an earlier one is not shown in this
    this.isBusy = false;
    this.isWanted = false;
    this.askedAt = 0;
    this.orbit = new Orbit(() => this.timeline.t);
    this.pace = new Pace();
    this.pictures = new Pictures();
    this.screen = new Screen(parts);
    this.timeline = new Timeline(parts, () => this.refresh(), () => this.isBusy);
    this.clip = new Clip((cameras) => this.#know(cameras));
    this.#listen();
    setInterval(() => this.#again(), AGAIN_MS / 3);
    document.addEventListener("visibilitychange", () => this.refresh());
  }

  /**
   * @param {string | null} scene
   * @param {string} [words] to show until its picture is there
   */
  open(scene, words = scene ? "Rendering." : "Choose a job.") {
    this.scene = scene;
    this.visit += 1;
    this.pictures.giveUp(); // the other scene's
    this.orbit.goHome();
    this.shown = null;
    this.screen.clear(scene, words);
    this.parts.readout.textContent = "";
    this.clip.open(scene);
    if (scene === null) this.timeline.play(false);
    this.refresh();
  }

  /**
   * Look elsewhere; what is left out stays.
   * @param {{t?: number, pose?: string | null, layer?: string, unseen?: "mark"|"guess", highlights?: "on"|"off"}} wish
   */
  look({ t, pose, layer, unseen, highlights }) {
    const { parts } = this;
    if (pose !== undefined && !this.orbit.stand(pose)) this.dispatchEvent(new Event("refused"));
    if (layer !== undefined) parts.layer.value = layer;
    if (unseen !== undefined) parts.guess.checked = unseen === "guess";
    if (highlights !== undefined) parts.highlights.checked = highlights === "on";
    if (t !== undefined) this.timeline.set(t); // asks for the picture: all of the wish is set before
    if (layer !== undefined) parts.layer.dispatchEvent(new Event("change"));
    this.refresh();
  }

  refresh() {
    this.isWanted = true;
    if (!this.isBusy) this.#work();
  }

  #know(cameras) {
    this.timeline.know(cameras);
    if (!this.orbit.know(cameras)) this.dispatchEvent(new Event("refused"));
    this.dispatchEvent(new Event("known"));
    if (cameras) this.refresh();
  }

  #again() {
    if (this.scene && !this.isBusy && performance.now() - this.askedAt > AGAIN_MS) this.refresh();
  }

  async #work() {
    this.isBusy = true;
    while (this.isWanted && this.scene) {
      this.isWanted = false;
      await this.#showOnce(this.scene, this.visit);
    }
    this.isBusy = false;
  }

  async #showOnce(scene, visit) {
    const began = (this.askedAt = performance.now());
    const guesses = this.parts.guess.checked ? ", guesses shown" : "";
    const view = this.#view(scene);
    const highlights = view.highlights === "off" ? ", without highlights" : "";
    const layer = this.parts.layer.selectedOptions[0].text;
    const name = view.layer === "recorded" ? layer : `${layer}, ${this.orbit.words}${guesses}${highlights}`;
    try {
      const picture = await this.pictures.ask(view);
      const bitmap = await createImageBitmap(picture.blob);
      if (visit !== this.visit) return; // another was opened meanwhile: never its neighbour's picture
      this.screen.show(picture, bitmap, `${name}, ${this.timeline.momentOf(picture.t)}`);
      this.pace.note();
      this.shown = shownOf(view, picture);
      this.dispatchEvent(new CustomEvent("shown", { detail: this.shown }));
      this.#tell(name, picture, performance.now() - began);
    } catch (error) {
      if (visit !== this.visit) return;
      if (error.turnInS && this.screen.hasPicture) this.screen.waitFor(error.turnInS);
      else this.#fail(error);
      await pause(Math.max(AFTER_TROUBLE_MS, (error.turnInS ?? 0) * 1000));
    }
  }

  #view(scene) {
    const { checked, disabled } = this.parts.highlights;
    const view = {
      scene,
      t: Number(this.timeline.t.toFixed(6)),
      layer: this.parts.layer.value,
      unseen: this.parts.guess.checked ? "guess" : "mark",
      highlights: checked || disabled ? "on" : "off",
      format: "jpeg",
    };
    if (this.orbit.pose) view.pose = this.orbit.pose;
    else if (this.orbit.eye === "right") view.eye = "right";
    return view;
  }

  #tell(name, picture, tookMs) {
    const server = Number.isFinite(picture.totalMs) ? ` (service ${picture.totalMs.toFixed(0)} ms)` : "";
    const rate = this.pace.rate >= 1 ? ` · ${this.pace.rate.toFixed(0)} pictures/s` : "";
    const unseen = picture.unseen >= 0.005 ? ` · ${(picture.unseen * 100).toFixed(0)} % unseen` : "";
    this.parts.readout.textContent = `${name}${unseen} · ${tookMs.toFixed(0)} ms${server}${rate} · ${picture.way}`;
  }

  #fail(error) {
    const isNotYet = error.status === 503 && error.document.field === "scene" && !this.screen.hasPicture;
    if (NOTHING_TO_SHOW.includes(error.status)) {
      this.shown = null;
      this.screen.clear(this.scene, error.message);
      this.dispatchEvent(new Event("gone"));
    } else this.screen.fail(isNotYet ? NOT_YET : error.message);
  }

  #listen() {
    const { layer, guess, highlights } = this.parts;
    layer.addEventListener("change", () => (highlights.disabled = layer.value !== "rgb"));
    for (const choice of [layer, guess, highlights]) choice.addEventListener("change", () => this.refresh());
  }
}

/** @param {import("./stream.js").View} view @param {import("./stream.js").Picture} picture @returns {Shown} */
function shownOf({ scene, pose = null, eye = "left", layer, unseen, highlights }, { t, state, way, camera }) {
  return { scene, t, pose, eye, layer, unseen, highlights, state, way, camera };
}
