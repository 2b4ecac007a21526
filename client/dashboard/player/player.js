// A finished scene, drawn by this browser at any time and from any pose: the same picture as GET /render.

import { Aside } from "./aside.js";
import { Cameras } from "./camera.js";
import { DamagedError } from "./decode.js";
import { Drawing } from "./draw.js";
import { CannotDrawError } from "./gpu.js";
import { patternsAt } from "./motion.js";
import { readTable } from "./table.js";

/** Of intrasplat/view/render.py. */
const FAR_DEG = 20;
const MAX_ENLARGEMENT = 4;
/** Beyond these, warnings name no figure. */
const MOST_DEG = 60;
const MOST_ENLARGED = 100;
const MAX_UNSEEN_SHARE = 0.05;
const MAX_LOW_SHARE = 0.1;
const ROUNDING = 1e-6;
/** What a scene stores of the light and the smoke in which it was recorded, where the model's differ; not drawn here. */
const RECORDED_LIGHT = ["log_gains", "vignetting", "veil"];
const SCENE = "scene.safetensors";
/** The recorded frames from which views take detail (intrasplat/names.py). */
export const DETAIL = "detail.mkv";
/** A view that moves gets detail if that takes no longer. */
const MAX_DETAIL_MS = 60;

/**
 * What is shown: pose is world_from_camera, rows, in mm. isMoving: draw at once, sorted as the view before, if need be.
 * isTimed: wait for the GPU, and tell what each part of the work takes. isRefined: with detail, however long that takes;
 * else where it is quick and its pictures are there. isOutdated: whether another view is wished for, which ends isRefined.
 * @typedef {{t: number, pose: number[][], width: number, height: number, highlights?: boolean, isMarked?: boolean,
 *   isMoving?: boolean, isTimed?: boolean, isRefined?: boolean, isOutdated?: () => boolean}} View
 */
/** @typedef {import("./detail.js").Detail} Detail */
/** @typedef {{code: string, text: string}} Notice as a render's warnings */
/** @typedef {{t: number, unseen: number, warnings: Notice[], hasDetail: boolean}} Drawn */

export class Player {
  /**
   * @param {{manifest: Record<string, any>, scene: ArrayBuffer}} files
   * @param {HTMLCanvasElement | OffscreenCanvas} canvas to draw on, of this player alone
   * @param {(share: number) => void} [onProgress]
   * @param {AbortSignal} [signal] ends it early, as an error
   * @returns {Promise<Player>}
   * @throws DamagedError, CannotDrawError
   */
  static async of({ manifest, scene }, canvas, onProgress, signal) {
    if (manifest.coding !== "compact" || manifest.deformation !== "shared") {
      throw new CannotDrawError(`Scenes of this kind (${manifest.deformation}) are drawn by the service.`, "kind");
    }
    await checkHash(scene, manifest.files[SCENE]);
    const began = performance.now();
    const table = await readTable(scene, onProgress, signal);
    const decoded = performance.now();
    const worker = new Worker(new URL("./order.worker.js", import.meta.url), { type: "module" });
    try {
      const buffers = table.tables.map((each) => each.buffer);
      const packed = await answered(worker, { table, manifest }, buffers);
      signal?.throwIfAborted();
      const ready = performance.now();
      const drawing = new Drawing(canvas, table, packed);
      const times = { decodeMs: decoded - began, packMs: ready - decoded, uploadMs: performance.now() - ready };
      return new Player(manifest, table, worker, drawing, times);
    } catch (error) {
      worker.terminate();
      canvas.getContext("webgl2")?.getExtension("WEBGL_lose_context")?.loseContext();
      throw error;
    }
  }

  /** Use Player.of(). */
  constructor(manifest, table, worker, drawing, times) {
    Object.assign(this, { table, worker, drawing, times });
    this.canvas = drawing.canvas;
    this.cameras = new Cameras(manifest);
    this.aside = new Aside(this.cameras);
    this.settings = manifest.settings ?? {};
    this.poseWarnings = this.settings.pose_warnings ?? [];
    /** Whether recorded frames are stored, from which views take detail. */
    this.hasDetail = manifest.beside?.[DETAIL] !== undefined;
    this.hasRecordedLight = RECORDED_LIGHT.some((name) => this.settings[name] !== undefined);
    /** @type {Promise<Detail> | null} */
    this.opening = null;
    /** @type {Detail | null} */
    this.detail = null;
    this.detailMs = Infinity; // that a view takes with detail
    this.isClosed = false;
    /** Broken when the scene is let go of: a worker that has ended answers nobody. */
    this.closing = new Promise((_, reject) => (this.reject = reject));
    this.closing.catch(() => {});
    this.deformedAt = null; // the time that the GPU's Gaussians are at
    this.sortedFor = ""; // the view that their order is of
    this.sorting = null; // a promise, while the worker sorts
    this.id = 0;
  }

  /**
   * Add detail to views as soon as it can be computed.
   * @param {() => Promise<Detail>} open from the scene's recorded frames
   */
  takeDetail(open) {
    this.opening = open().then((detail) => {
      if (this.isClosed) detail.close();
      return (this.detail = detail);
    });
    this.opening.catch(() => {}); // draw() tells of it, if it is asked to refine
  }

  /**
   * Draw a view; its picture is on the canvas when the promise is kept.
   * @param {View} view
   * @returns {Promise<Drawn>}
   */
  async draw(view) {
    let began = performance.now();
    const t = this.cameras.shownTime(view.t);
    const hasDetail = await this.#prepareDetail(view, t);
    if (hasDetail && !view.isMoving) {
      await this.settled(); // residuals stay: what they take does not count
      began = performance.now();
    }
    await this.#arrange(t, this.cameras.cameraFromWorld(view.pose), view.isMoving);
    this.#deform(t, view.isTimed);
    const deformed = performance.now();
    const lens = this.cameras.resized(view.width, view.height);
    this.#blend(t, view.pose, lens, view.highlights !== false);
    const added = hasDetail ? this.detail.add(t, view.pose, lens, view.highlights !== false) : null;
    this.drawing.show(view.isMarked !== false, added);
    if (hasDetail) {
      await this.settled();
      const ms = performance.now() - began;
      this.detailMs = view.isMoving ? (this.detailMs + ms) / 2 : ms;
    }
    if (view.isTimed) {
      this.drawing.finish();
      this.times.drawMs = performance.now() - deformed;
    }
    const { unseen, hardlySeen } = this.drawing.shares(!view.isMoving);
    return { t, unseen, warnings: this.#warnings(view, t, unseen, hardlySeen), hasDetail };
  }

  /** Have the residuals of a view. @returns {Promise<boolean>} whether they are there */
  async #prepareDetail(view, t) {
    if (view.isRefined) await this.opening;
    const { detail } = this;
    if (detail === null || !(view.isRefined || this.detailMs < MAX_DETAIL_MS)) return false;
    const { residuals, flows } = detail.wanted(t, view.pose, view.highlights !== false);
    const { pictures } = detail;
    if (view.isMoving) for (const { eye, frame } of residuals) pictures.ahead(eye, frame);
    const missing = residuals.filter((each) => !detail.has(each));
    const found = view.isRefined
      ? await Promise.all(missing.map(({ eye, frame }) => pictures.load(eye, frame)))
      : missing.map(({ eye, frame }) => pictures.at(eye, frame));
    if (found.includes(null)) return false;
    for (const [place, { eye, frame }] of missing.entries()) {
      if (view.isOutdated?.()) throw new CannotDrawError("Another view is wished for.", "outdated");
      const then = frame / this.cameras.frameCount;
      const pose = detail.eyePose(eye, then);
      await this.#arrange(then, this.cameras.cameraFromWorld(pose), false);
      this.#deform(then);
      this.#blend(then, pose, pictures.eyes[eye].lens, true, detail.ownTarget(eye));
      detail.measure({ eye, frame }, found[place]);
    }
    for (const pair of flows) await Promise.race([detail.find(pair), this.closing]);
    return true;
  }

  /** Have the Gaussians sorted for a camera; mayLag: perhaps as they were for the view before. */
  async #arrange(t, rows, mayLag) {
    const key = JSON.stringify([t, rows[2]]);
    if (key !== this.sortedFor) {
      if (!mayLag || this.sortedFor === "") {
        while (this.sorting) await this.sorting;
        if (key !== this.sortedFor) await this.#sort(key, t, rows[2]);
      } else if (!this.sorting) this.#sort(key, t, rows[2]).catch(() => {}); // the next still picture tells of it
    }
    if (this.isClosed) throw new CannotDrawError("The scene is closed.", "closed");
  }

  #blend(t, pose, lens, highlights, into = null) {
    const shine = this.cameras.gloss(t, pose, highlights);
    const enlargement = this.cameras.enlargement(t, pose, lens);
    this.drawing.blend(this.cameras.cameraFromWorld(pose), lens, shine, enlargement, into);
  }

  /** Kept when the GPU has drawn the last picture; to draw the next one sooner would only queue it. */
  settled() {
    return this.drawing.settled();
  }

  /** The picture's pixels as they were drawn, from the top. @returns {Uint8Array} [height, width, 4] */
  pixels() {
    return this.drawing.pixels();
  }

  /** Let the scene go. */
  close() {
    this.isClosed = true;
    this.reject(new CannotDrawError("The scene is closed.", "closed"));
    this.worker.terminate();
    this.detail?.close();
    this.drawing.close();
  }

  #deform(t, isTimed) {
    if (isTimed) this.times.deformMs = 0;
    if (this.deformedAt === t) return;
    const began = performance.now();
    this.drawing.deform(patternsAt(this.table, t));
    this.deformedAt = t;
    if (!isTimed) return;
    this.drawing.finish();
    this.times.deformMs = performance.now() - began;
  }

  async #sort(key, t, row) {
    const message = { id: ++this.id, patterns: patternsAt(this.table, t), row, seconds: this.cameras.seconds(t) };
    this.sorting = Promise.race([answered(this.worker, message), this.closing]).finally(() => (this.sorting = null));
    const { order, values, ms } = await this.sorting;
    if (this.isClosed) return;
    this.times.sortMs = ms;
    this.drawing.arrange(order, values);
    this.sortedFor = key;
  }

  /** As intrasplat/view/render.py warns of a frame. */
  #warnings(view, t, unseen, hardlySeen) {
    const warnings = [...this.poseWarnings];
    const tell = (code, text) => warnings.push({ code, text });
    const last = (this.cameras.frameCount - 1) / this.cameras.frameCount;
    if (!(view.t >= 0 && view.t <= last + ROUNDING)) {
      tell("time_outside_clip", `t = ${view.t} lies outside the clip; t = ${t.toPrecision(4)} is shown.`);
    }
    const { angleDeg, enlargement } = this.aside.of(view.pose);
    if (angleDeg > FAR_DEG) {
      const said = angleDeg <= MOST_DEG ? angleDeg.toFixed(0) : `more than ${MOST_DEG}`;
      tell("pose_far", `This view looks from ${said} degrees beside the endoscope: most of it is a guess.`);
    }
    if (enlargement > MAX_ENLARGEMENT) {
      const said = enlargement <= MOST_ENLARGED ? enlargement.toFixed(1) : `more than ${MOST_ENLARGED}`;
      tell("enlarged", `This view is enlarged ${said} times: it holds no finer detail than the clip.`);
    }
    if (unseen > MAX_UNSEEN_SHARE) {
      const text = `No frame saw ${Math.round(unseen * 100)}% of this view.`;
      tell("unseen", text);
    }
    if (hardlySeen > MAX_LOW_SHARE) {
      tell("hardly_seen", "More than a tenth of this view was hardly seen in the clip; see layer=confidence.");
    }
    if (view.highlights === false && this.cameras.rightEyeMm === null) {
      const text = "This scene was taught by one eye, so its highlights are not known apart: they stay.";
      tell("highlights_unknown", text);
    }
    return warnings;
  }
}

/** The worker's next answer. */
function answered(worker, message, buffers = []) {
  return new Promise((resolve, reject) => {
    worker.onerror = () => reject(new CannotDrawError("A worker of the page could not start.", "no_worker"));
    worker.onmessage = ({ data }) => (data.error ? reject(new DamagedError(data.error)) : resolve(data));
    worker.postMessage(message, buffers);
  });
}

/** @param {ArrayBuffer} file @param {{bytes: number, sha256: string}} expected */
async function checkHash(file, { bytes, sha256 }) {
  if (file.byteLength !== bytes) throw new DamagedError(`The scene has ${file.byteLength} bytes instead of ${bytes}.`);
  if (!crypto.subtle) return; // pages without HTTPS, other than this machine's own, have none
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", file));
  const found = [...digest].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  if (found !== sha256) throw new DamagedError("The scene's file is damaged: it does not match its hash.");
}
