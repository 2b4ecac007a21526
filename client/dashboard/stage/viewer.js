// The view of one scene: at most one picture is under way; the newest wish comes next. The service draws, or this browser
// once it has the scene. Now and then the service is asked: for the newest picture of a job that trains, else only whether
// the scene is still there, which notices a purge and keeps the status true.

import { figure, languageEvents, words } from "../base/messages.js";
import { pause } from "../base/pause.js";
import { Clip } from "./clip.js";
import { DrawnBy } from "./drawnby.js";
import { Memory } from "./memory.js";
import { Orbit } from "./orbit.js";
import { judged, Pictures } from "./pictures.js";
import { Pace } from "./rate.js";
import { Rock } from "./rock.js";
import { Screen } from "./screen.js";
import { Timeline } from "./timeline.js";

const AGAIN_MS = 1500;
/** A finished scene does not change; that it is there costs the service some hundred bytes. */
const CONFIRM_MS = 3000;
const AFTER_TROUBLE_MS = 700;
/** A view that changes again so soon moves; when it rests, it is drawn exactly. */
const REST_MS = 150;
const COARSE = "coarse";
/**
 * What a view shows. t: as shown, within the clip; pose: as the service spells it, null for the endoscope's own, of the eye;
 * camera: null where it is not known, as of recorded frames; way: how the picture came; isMoving: it was drawn at once, perhaps
 * with its Gaussians sorted for the view before, or came smaller over a slow line, and an exact picture follows; hasDetail: this browser added that of recorded frames.
 * @typedef {{scene: string, t: number, pose: string | null, eye: "left"|"right", layer: string, unseen: "mark"|"guess",
 *   highlights: "on"|"off", light: "steady"|"recorded", state: "running"|"done", way: "stream"|"single"|"memory",
 *   camera: import("./stream.js").Camera | null, depthRangeMm?: [number, number] | null, isMoving: boolean, hasDetail: boolean}} Shown
 */
/** Not a layer of the model, but what the endoscope saw. */
const RECORDED = "recorded";
const DEPTH = "depth";
/** The model against what the endoscope saw. */
const ERROR = "error";
/** There is nothing to show, or not to this key; a picture that was there goes. */
const NOTHING_TO_SHOW = [401, 403, 404, 409];

/**
 * Tells "shown" (a CustomEvent whose detail is Shown) of every picture that has come to the screen, "gone" when it goes, "known"
 * when the scene's cameras are, "refused" when nobody may stand where the viewer shall, and "uncompared" (detail: why) when
 * there is no recorded frame to compare with, and colours are shown instead.
 */
export class Viewer extends EventTarget {
  /**
   * @param {Record<string, HTMLElement>} parts by what they are; index.html has them
   * @param {() => boolean} mayDownload whether the key allows to load scenes into the browser
   * @param {(scene: string) => string} whyNothing why nothing will come of a scene's job; empty where that is not known
   */
  constructor(parts, mayDownload, whyNothing) {
    super();
    this.whyNothing = whyNothing;
    this.parts = parts;
    this.scene = null;
    /** @type {Shown | null} what is on the screen */
    this.shown = null;
    this.visit = 0; // counts scenes opened: what was asked for in an earlier one is not shown in this
    this.underWay = 0; // views that are asked for
    this.asked = this.presented = 0; // counts them; the newest that is on the screen
    this.isWanted = false;
    this.isFullWanted = false;
    this.askedAt = 0;
    this.isConfirming = false;
    this.isMoving = false;
    this.wishedAt = 0;
    /** @type {"steady"|"recorded"} recorded: as the moment was recorded, through its smoke, too */
    this.light = "steady";
    /** @type {[number, number] | null} mm between which depth has its colours; null: the clip's own */
    this.range = null;
    this.orbit = new Orbit(() => this.timeline.t);
    this.rock = new Rock(this.orbit, () => this.refresh(), () => this.timeline.playEvents.dispatchEvent(new Event("changed")));
    this.pace = new Pace();
    this.pictures = new Pictures();
    this.memory = new Memory(mayDownload);
    this.drawnBy = new DrawnBy(parts.way, this.memory, () => this.refresh());
    this.screen = new Screen(parts);
    /** Whether something beside the picture is not there yet, for which playing waits. @type {() => boolean} */
    this.awaits = () => false;
    this.timeline = new Timeline(parts, () => this.refresh(), () => this.isWanted || this.#isFull || this.awaits(), () => this.screen.isStale);
    this.clip = new Clip((cameras) => this.#know(cameras));
    this.#listen();
    setInterval(() => this.#again(), AGAIN_MS / 3);
    document.addEventListener("visibilitychange", () => this.refresh());
    this.timeline.playEvents.addEventListener("changed", () => this.refresh()); // what rests is drawn exactly
    this.memory.addEventListener("changed", () => this.#tellWay());
    this.memory.addEventListener("changed", () => this.memory.player && this.refresh());
    languageEvents.addEventListener("changed", () => {
      this.#tellWay();
      this.refresh(); // what is said of the picture
    });
    new ResizeObserver(() => this.#isDrawnHere && this.refresh()).observe(parts.fitted);
    this.#tellWay();
  }

  /**
   * @param {string | null} scene
   * @param {string} [message] to show until its picture is there
   */
  open(scene, message = words(scene ? "screen.rendering" : "page.choose")) {
    this.scene = scene;
    this.visit += 1;
    this.drawnBy.begin();
    this.pictures.giveUp(); // the other scene's
    this.memory.open(scene);
    this.orbit.goHome();
    this.light = "steady";
    this.range = null;
    this.shown = null;
    this.screen.clear(scene, message);
    this.dispatchEvent(new Event("gone")); // what was measured or compared in it goes, too
    this.parts.readout.textContent = "";
    this.clip.open(scene);
    this.#allowPlay();
    this.refresh();
  }

  /** Nothing plays without a picture. */
  #allowPlay() {
    if (this.shown === null) this.timeline.play(false);
    this.parts.play.disabled = this.shown === null;
  }

  /**
   * Look elsewhere; what is left out stays.
   * @param {{t?: number, pose?: string | null, layer?: string, unseen?: "mark"|"guess", highlights?: "on"|"off",
   *   light?: "steady"|"recorded", range?: [number, number] | null}} wish
   */
  look({ t, pose, layer, unseen, highlights, light, range }) {
    const { parts } = this;
    if (range !== undefined) this.range = range;
    if (light !== undefined) this.light = light;
    if (pose !== undefined && !this.orbit.stand(pose)) this.dispatchEvent(new Event("refused"));
    if (layer !== undefined) parts.layer.value = layer;
    if (unseen !== undefined) parts.guess.checked = unseen === "guess";
    if (highlights !== undefined) parts.highlights.checked = highlights === "on";
    if (t !== undefined) this.timeline.set(t); // asks for the picture: all of the wish is set before
    if (layer !== undefined) parts.layer.dispatchEvent(new Event("change"));
    this.refresh();
  }

  /** Rock as soon as it is known where the endoscope was. */
  swing(visit = this.visit) {
    if (visit !== this.visit) return;
    if (!this.timeline.cameras) this.addEventListener("known", () => this.swing(visit), { once: true });
    else if (!this.rock.isOn) this.rock.toggle();
  }

  /** Whether a picture takes so long that only other answers can tell whether the service is there. */
  get isKeptWaiting() {
    return this.isBusy && performance.now() - this.askedAt > AGAIN_MS;
  }

  get isBusy() {
    return this.underWay > 0;
  }

  /** Whether another view would have to wait for one that is under way. */
  get #isFull() {
    const isMany = this.isMoving && this.scene !== null && !this.#isDrawnHere;
    return this.underWay >= (isMany ? this.pictures.depthOf(this.#view(this.scene)) : 1);
  }

  /** @param {boolean} [isFull] however slow the line is */
  refresh(isFull = false) {
    const now = performance.now();
    this.isFullWanted = isFull;
    clearTimeout(this.resting);
    this.isMoving = this.isRunning || now - this.wishedAt < REST_MS;
    this.wishedAt = now;
    this.isWanted = true;
    this.#work();
  }

  #know(cameras) {
    this.timeline.know(cameras);
    if (!this.orbit.know(cameras)) this.dispatchEvent(new Event("refused"));
    this.dispatchEvent(new Event("known"));
    if (cameras) this.refresh();
  }

  get #place() {
    return this.rock.isOn ? words("live.rocking") : this.orbit.words;
  }

  /** Whether something moves by itself. */
  get isRunning() {
    return this.timeline.isPlaying || this.rock.isOn;
  }

  /** Whether this browser draws what is wished for. */
  get #isDrawnHere() {
    return this.scene !== null && this.#whyNot() === null;
  }

  #whyNot() {
    return this.memory.whyNot(this.#view(this.scene), this.shown?.state);
  }

  #tellWay() {
    this.drawnBy.tell(this.#whyNot());
  }

  #again() {
    if (!this.scene) return;
    const { shown, screen } = this;
    if (shown?.state === "done") this.memory.want(this.#view(this.scene));
    const now = performance.now();
    const sinceConfirmedMs = Date.now() - screen.confirmedAt;
    if (this.#isDrawnHere) {
      if (sinceConfirmedMs > CONFIRM_MS) this.#confirm();
    } else if (!this.isBusy && now - this.askedAt > AGAIN_MS) {
      const isServed = shown?.state === "done" && shown.way !== "memory" && shown.layer !== RECORDED;
      const isFinal = isServed && !screen.shown?.codes.includes(COARSE);
      if (!isFinal || screen.trouble || this.pictures.prepare(shown.way)) this.refresh();
      else if (sinceConfirmedMs > CONFIRM_MS) this.#confirm();
    }
  }

  /** Ask whether what is shown is still there. */
  async #confirm() {
    if (this.isConfirming) return;
    const { scene, visit } = this;
    this.isConfirming = true;
    try {
      await this.pictures.confirm(scene);
      if (visit === this.visit) this.screen.confirm();
    } catch (error) {
      if (visit === this.visit && !error.isOvertaken) this.#fail(error);
    }
    this.isConfirming = false;
  }

  async #work() {
    if (!this.isWanted || !this.scene || this.#isFull) return;
    const restMs = this.isBusy ? this.askedAt + this.pictures.line.spacingMs - performance.now() : 0;
    if (restMs > 0) {
      clearTimeout(this.next);
      this.next = setTimeout(() => this.#work(), restMs);
      return;
    }
    this.isWanted = false;
    this.underWay += 1;
    await this.#showOnce(this.scene, this.visit);
    this.underWay -= 1;
    this.#work();
  }

  async #showOnce(scene, visit) {
    const began = (this.askedAt = performance.now());
    const guesses = this.parts.guess.checked ? `, ${words("picture.guesses")}` : "";
    const view = this.#view(scene);
    const highlights = view.highlights === "off" ? `, ${words("picture.no_highlights")}` : "";
    const light = view.light ? `, ${words("picture.recorded_light")}` : "";
    const layer = this.parts.layer.selectedOptions[0].text;
    const name = [RECORDED, ERROR].includes(view.layer) ? layer : `${layer}, ${this.#place}${guesses}${highlights}${light}`;
    const isDrawnHere = this.#isDrawnHere;
    const number = ++this.asked;
    const how = { isFull: this.isFullWanted, width: this.timeline.cameras?.intrinsics.width };
    try {
      const picture = judged(await (isDrawnHere ? this.#draw(view) : this.pictures.ask(view, how)), view);
      const image = picture.image ?? (await createImageBitmap(picture.blob));
      if (visit !== this.visit || number < this.presented) return; // another scene's, or older than what is shown
      this.presented = number;
      this.pace.note();
      if (!picture.isRecorded) this.clip.follow(picture);
      this.#present(picture, image, view, name, began);
      if (picture.isReduced && !this.isWanted) this.#completeAtRest();
      if (isDrawnHere) await this.#refine(view, visit, name, picture.hasDetail);
      else if (picture.state === "done") this.memory.want(view);
    } catch (error) {
      if (visit !== this.visit || error.isOvertaken) return;
      if (isDrawnHere) {
        if (error.code !== "closed") this.memory.giveUp(error);
        this.isWanted = true;
        return;
      }
      if (error.turnInS && this.screen.hasPicture) this.screen.waitFor(error.turnInS);
      else this.#fail(error);
      await pause(Math.max(AFTER_TROUBLE_MS, (error.turnInS ?? 0) * 1000));
    }
  }

  /** Ask for the full picture when the view has not changed for a while. */
  #completeAtRest() {
    clearTimeout(this.resting);
    if (!this.timeline.isPlaying) this.resting = setTimeout(() => this.refresh(true), 2 * REST_MS);
  }

  /** Draw a view here: at once while it moves, and once more, exactly, when it rests. */
  async #draw(view) {
    const { isMoving } = this;
    clearTimeout(this.resting);
    if (isMoving && !this.isRunning) this.resting = setTimeout(() => this.refresh(), 2 * REST_MS);
    return this.memory.draw(view, this.#room, { isMoving, isTimed: this.drawnBy.isOpen });
  }

  /** In pixels of the screen. */
  get #room() {
    const { clientWidth, clientHeight } = this.parts.fitted;
    return { width: clientWidth * devicePixelRatio, height: clientHeight * devicePixelRatio };
  }

  /** Put a view's picture on the screen, and say what it shows. began: when it was asked for. */
  #present(picture, image, view, name, began) {
    const t = [RECORDED, ERROR].includes(view.layer) ? view.t : picture.t; // a frame stands for all moments next to it
    this.screen.show(picture, image, name, this.timeline.momentOf(t));
    this.shown = shownOf(view, picture);
    this.#allowPlay();
    this.dispatchEvent(new CustomEvent("shown", { detail: this.shown }));
    this.#tell(name, picture, performance.now() - began);
  }

  /** Show a view that rests with the detail of recorded frames; the service draws it where this browser cannot. */
  async #refine(view, visit, name, isRefined) {
    await this.memory.player?.settled();
    if (isRefined || this.isMoving || this.isWanted || !this.memory.player?.hasDetail) return;
    const began = performance.now();
    const isOutdated = () => visit !== this.visit || this.isWanted;
    try {
      const picture = judged((await this.#drawRefined(view, isOutdated)) ?? (await this.pictures.ask(view)), view);
      const image = picture.image ?? (await createImageBitmap(picture.blob));
      if (!isOutdated()) this.#present(picture, image, view, name, began);
    } catch {
      // What is drawn here stays; #confirm() says whether the service still has the scene.
    }
  }

  /** @returns {Promise<import("./stream.js").Picture | null>} null: this browser cannot add detail */
  async #drawRefined(view, isOutdated) {
    try {
      const how = { isMoving: false, isTimed: this.drawnBy.isOpen, isRefined: true, isOutdated };
      const picture = await this.memory.draw(view, this.#room, how);
      return picture.hasDetail ? picture : null;
    } catch (error) {
      if (isOutdated()) throw error;
      return null;
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
    if (view.layer === DEPTH && this.range) [view.near_mm, view.far_mm] = this.range;
    if (view.layer === ERROR) return view; // as recorded, through the left eye
    if (this.orbit.pose) view.pose = this.orbit.pose;
    else if (this.orbit.eye === "right") view.eye = "right";
    if (this.light === "recorded") Object.assign(view, { light: "recorded", smoke: "show" });
    return view;
  }

  #tell(name, picture, tookMs) {
    const server = Number.isFinite(picture.totalMs) ? ` (${words("readout.service", { ms: figure(picture.totalMs) })})` : "";
    const { rate } = this.pace;
    const pace = rate >= 1 && this.isRunning ? [words("readout.rate", { rate: figure(rate) })] : [];
    const iteration = picture.iteration === null ? [] : [words("readout.iteration", { iteration: picture.iteration })];
    const unseen = picture.unseen >= 0.005 ? [words("readout.unseen", { share: figure(100 * picture.unseen) })] : [];
    const reduced = picture.isReduced ? [words("readout.reduced")] : [];
    const took = `${figure(tookMs)} ms${server}`;
    this.parts.readout.textContent = [name, ...iteration, ...unseen, took, ...pace, words(`readout.${picture.way}`), ...reduced].join(" · ");
    this.#tellWay();
    this.drawnBy.tellFigures(pace, picture.camera);
  }

  #fail(error) {
    if (this.parts.layer.value === ERROR && error.document?.field === "layer") {
      this.look({ layer: "rgb" });
      this.dispatchEvent(new CustomEvent("uncompared", { detail: error.message }));
      return;
    }
    const isNotYet = error.status === 503 && error.document.field === "scene" && !this.screen.hasPicture;
    if (NOTHING_TO_SHOW.includes(error.status)) {
      this.shown = null;
      this.#allowPlay();
      this.memory.open(this.scene);
      this.screen.clear(this.scene, this.whyNothing(this.scene) || error.message);
      this.dispatchEvent(new Event("gone"));
    } else this.screen.fail(isNotYet ? words("screen.not_yet") : error.message);
  }

  #listen() {
    const { layer, guess, highlights } = this.parts;
    layer.addEventListener("change", () => (highlights.disabled = layer.value !== "rgb"));
    for (const choice of [layer, guess, highlights]) choice.addEventListener("change", () => this.refresh());
  }
}

/** @param {import("./stream.js").View} view @param {import("./stream.js").Picture} picture @returns {Shown} */
function shownOf({ scene, pose = null, eye = "left", layer, unseen, highlights, light = "steady" }, picture) {
  const { t, state, way, camera, depthRangeMm, isMoving = false, hasDetail = false, isReduced = false } = picture;
  return { scene, t, pose, eye, layer, unseen, highlights, light, state, way, camera, depthRangeMm, isMoving: isMoving || isReduced, hasDetail };
}
