// Another scene of the library, seen from the place and at the moment of the scene in view: a picture of it follows each
// picture that is shown. At home it is its own endoscope's view; elsewhere the place in mm holds in each scene's own world.

import { getCameras, getJob, getReport } from "../base/api.js";
import { pause } from "../base/pause.js";
import { isPending } from "../library/trustlight.js";
import { Cameras } from "../player/camera.js";
import { judged } from "./pictures.js";

const CONFIRM_MS = 3000;
const AFTER_TROUBLE_MS = 1000;
/** Nothing more comes of it. */
const FINAL = [401, 403, 404, 409, 422];
/** Layers that scenes without recorded frames do not have, and how the service says so; it says the same of no scene. */
const OF_FRAMES = ["recorded", "error"];
const LACKING = [404, 422];
/** So long playing waits for its picture, so that both halves show the same moment. */
const WAIT_MS = 700;

/** @typedef {import("./viewer.js").Shown} Shown */
/** @typedef {import("./stream.js").Picture} Picture */
/** @typedef {import("./pictures.js").Pictures} Pictures */

export class OtherScene {
  /**
   * @param {string} scene
   * @param {Pictures} pictures where they come from, for nobody else
   * @param {{onChange: () => void, onFail: (error: Error) => void}} handlers onChange: there is more to show or to say;
   *   onFail: nothing of it comes any more
   */
  constructor(scene, pictures, handlers) {
    Object.assign(this, { scene, pictures, handlers, isClosed: false, isAsking: false, isSilent: false, askedAt: 0, confirmedAt: 0 });
    /** Whether it has no recorded frames for the layer in view. */
    this.lacksFrames = false;
    /** @type {import("../base/wire.js").JobView | null} */
    this.job = null;
    /** @type {import("../base/wire.js").Report | null} null: not known */
    this.report = null;
    /** @type {{picture: Picture, view: import("./stream.js").View, image: ImageBitmap} | null} the newest */
    this.shown = null;
    /** @type {{shown: Shown, seconds: number} | null} what is asked for next */
    this.wish = null;
    this.#learn();
    this.#judge();
    this.timer = setInterval(() => this.#confirm(), CONFIRM_MS);
  }

  /** Let go of its picture, and of what is on its way. */
  close() {
    this.isClosed = true;
    clearInterval(this.timer);
    this.pictures.giveUp();
    this.pictures.stream.close();
    this.#take(null);
  }

  #take(shown) {
    this.shown?.image.close();
    this.shown = shown;
    this.lacksFrames = false;
  }

  /** The service has just answered. */
  #hear() {
    this.isSilent = false;
    this.confirmedAt = performance.now();
    this.#change();
  }

  #change() {
    if (!this.isClosed) this.handlers.onChange();
  }

  /** Whether its picture of the view is on its way, and soon there. */
  get isExpected() {
    return this.isAsking && performance.now() - this.askedAt < WAIT_MS;
  }

  /** Whether what is shown is not, or not known to be, of the view. */
  get isLate() {
    return this.isSilent || (this.shown === null && !this.lacksFrames) || (this.isAsking && !this.isExpected);
  }

  /** Whether what is shown is of the view, or it is known that there is nothing. */
  get isCurrent() {
    return !this.isLate && !this.isAsking && this.wish === null;
  }

  /** Whether the clip is over at the moment in view: its last frame stays. */
  get isOver() {
    return this.cameras !== undefined && this.seconds > this.#secondsAt(1) + 1e-3;
  }

  /** Seconds of its clip that are shown; NaN while there is no picture. */
  get shownS() {
    return this.shown && this.cameras ? this.#secondsAt(this.shown.picture.t) : NaN;
  }

  #secondsAt(t) {
    return this.cameras.seconds(t) - this.cameras.seconds(0);
  }

  /** @param {Shown} shown what is in view beside it @param {number} seconds since that clip's first frame */
  follow(shown, seconds) {
    this.seconds = seconds;
    this.wish = { shown, seconds };
    this.#work();
  }

  async #learn() {
    while (!this.isClosed && !this.cameras) {
      try {
        const [job, cameras] = await Promise.all([getJob(this.scene), getCameras(this.scene)]);
        if (this.isClosed) return;
        Object.assign(this, { job, cameras: new Cameras(cameras) });
        this.#change();
        this.#work();
      } catch (error) {
        await this.#trouble(error);
      }
    }
  }

  /** Ask for the verdict until it is final; the pictures stand without it. */
  async #judge() {
    while (!this.isClosed) {
      this.report = await getReport(this.scene).catch(() => this.report);
      this.#change();
      if (this.report && !isPending(this.report)) return;
      await pause(CONFIRM_MS);
    }
  }

  async #work() {
    if (this.isAsking || !this.cameras) return;
    this.isAsking = true;
    while (this.wish && !this.isClosed) {
      const { wish } = this;
      this.askedAt = performance.now();
      const late = setTimeout(() => this.#change(), 1.1 * WAIT_MS);
      try {
        await this.#show(wish).catch((error) => this.#lack(error, wish));
        if (this.wish === wish) this.wish = null;
      } catch (error) {
        await this.#trouble(error);
      }
      clearTimeout(late);
    }
    this.isAsking = false;
    this.#change();
  }

  async #show({ shown, seconds }) {
    const view = this.#view(shown, seconds);
    const how = { isFull: !shown.isMoving, width: this.cameras.intrinsics.width };
    const picture = judged(await this.pictures.ask(view, how), view);
    const image = await createImageBitmap(picture.blob);
    if (this.isClosed) return image.close();
    this.#take({ picture, view, image });
    this.#hear();
  }

  /** Throws the error, unless only recorded frames are lacking. */
  async #lack(error, { shown: { layer } }) {
    if (!OF_FRAMES.includes(layer) || !LACKING.includes(error.status)) throw error;
    await this.pictures.confirm(this.scene);
    if (this.isClosed) return;
    this.#take(null);
    this.lacksFrames = true;
    this.#hear();
  }

  /** @param {Shown} shown @param {number} seconds @returns {import("./stream.js").View} the same view of this scene */
  #view({ pose, eye, layer, unseen, highlights, light, camera, depthRangeMm }, seconds) {
    const t = Number(this.cameras.timeAt(seconds).toFixed(6));
    const view = { scene: this.scene, t, layer, unseen, highlights, format: "jpeg" };
    if (layer === "error") return view; // as recorded, through the left eye
    if (layer === "depth" && depthRangeMm) [view.near_mm, view.far_mm] = depthRangeMm.map(Math.round); // one map for both
    if (pose !== null) view.pose = camera ? camera.world_from_camera.join(",") : pose;
    else if (eye === "right" && this.cameras.rightEyeMm) view.eye = eye;
    if (light === "recorded") Object.assign(view, { light, smoke: "show" });
    return view;
  }

  /** While no picture is asked for: ask whether the scene is still there. */
  async #confirm() {
    if (this.isAsking || performance.now() - this.confirmedAt < CONFIRM_MS) return;
    try {
      await this.pictures.confirm(this.scene);
      this.#hear();
    } catch (error) {
      if (!error.isOvertaken) await this.#trouble(error);
    }
  }

  async #trouble(error) {
    if (this.isClosed) return;
    if (FINAL.includes(error.status)) {
      this.close();
      this.handlers.onFail(error);
      return;
    }
    this.isSilent = true;
    this.#change();
    await pause(AFTER_TROUBLE_MS);
  }
}
