// A finished scene, drawn by this browser at any time and from any pose: the same picture as GET /render.

import { Cameras } from "./camera.js";
import { DamagedError } from "./decode.js";
import { CannotDrawError, Drawing } from "./draw.js";
import { patternsAt } from "./motion.js";
import { readTable } from "./table.js";

/** Of intrasplat/view/render.py. */
const FAR_POSE = 0.35;
const MAX_UNSEEN_SHARE = 0.05;
const MAX_LOW_SHARE = 0.1;
const ROUNDING = 1e-6;
/** What a scene stores of the light and the smoke in which it was recorded, where the model's differ; not drawn here. */
const RECORDED_LIGHT = ["log_gains", "vignetting", "veil"];
const SCENE = "scene.safetensors";
/** The recorded frames from which the service takes detail (intrasplat/names.py). */
const DETAIL = "detail.mkv";

/**
 * What is shown: pose is world_from_camera, rows, in mm. isMoving: draw at once, sorted as the view before, if need be.
 * isTimed: wait for the GPU, and tell what each part of the work takes.
 * @typedef {{t: number, pose: number[][], width: number, height: number, highlights?: boolean, isMarked?: boolean,
 *   isMoving?: boolean, isTimed?: boolean}} View
 */
/** @typedef {{code: string, text: string}} Notice as a render's warnings */
/** @typedef {{t: number, unseen: number, warnings: Notice[]}} Drawn */

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
    this.poseWarnings = manifest.settings?.pose_warnings ?? [];
    /** Whether the service's pictures have more detail than those drawn here. */
    this.hasDetail = manifest.beside?.[DETAIL] !== undefined;
    this.hasRecordedLight = RECORDED_LIGHT.some((name) => manifest.settings?.[name] !== undefined);
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
   * Draw a view; its picture is on the canvas when the promise is kept.
   * @param {View} view
   * @returns {Promise<Drawn>}
   */
  async draw(view) {
    const t = this.cameras.shownTime(view.t);
    const rows = this.cameras.cameraFromWorld(view.pose);
    const key = JSON.stringify([t, rows[2]]);
    if (key !== this.sortedFor) {
      const mayLag = view.isMoving && this.sortedFor !== "";
      if (!mayLag) {
        while (this.sorting) await this.sorting;
        if (key !== this.sortedFor) await this.#sort(key, t, rows[2]);
      } else if (!this.sorting) this.#sort(key, t, rows[2]).catch(() => {}); // the next still picture tells of it
    }
    if (this.isClosed) throw new CannotDrawError("The scene is closed.", "closed");
    this.#deform(t, view.isTimed);
    const began = performance.now();
    const shine = this.cameras.gloss(t, view.pose, view.highlights !== false);
    const lens = this.cameras.resized(view.width, view.height);
    const enlargement = this.cameras.enlargement(t, view.pose, lens);
    this.drawing.draw(rows, lens, shine, enlargement, view.isMarked !== false);
    if (view.isTimed) {
      this.drawing.finish();
      this.times.drawMs = performance.now() - began;
    }
    const { unseen, hardlySeen } = this.drawing.shares(!view.isMoving);
    return { t, unseen, warnings: this.#warnings(view, t, unseen, hardlySeen) };
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
    this.drawing.close();
  }

  #deform(t, isTimed) {
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
    const far = this.cameras.distanceFromTrained(view.pose);
    if (far > FAR_POSE) {
      const text = `This pose is ${far.toFixed(1)} viewing distances from the endoscope's: most of it is a guess.`;
      tell("pose_far", text);
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
