// Pictures over one WebSocket: a view is asked for, its picture comes back, then the next.

import { askForKey, currentKey } from "../base/key.js";
import { connectionLost, Problem, wrongKeyWords } from "../base/problem.js";

/**
 * What is asked for; the query of GET /render.
 * @typedef {{scene: string, t: number, pose?: string, eye?: "right", layer: string, unseen: string, highlights: string,
 *   format: string, light?: "recorded", smoke?: "show", near_mm?: number, far_mm?: number, width?: number,
 *   quality?: number}} View
 */
/**
 * What came: a file, or an image that this browser drew. way: how. isExtrapolated: it shows a guess, or a pose or time far
 * from the clip's. isRecorded: it is a frame of the clip, no render. Both are set by judged() of pictures.js.
 * depthRangeMm: of depth in false colours, of the brightest and of the darkest. isMoving: as of Shown in viewer.js.
 * isReduced: it is smaller or coarser than asked for, because the line is slow.
 * @typedef {{blob?: Blob, image?: HTMLCanvasElement, scene: string, state: "running"|"done", t: number, iteration: number | null,
 *   unseen: number, codes: string[], totalMs: number, way: "stream"|"single"|"memory",
 *   camera: Camera | null, depthRangeMm?: [number, number] | null, isExtrapolated?: boolean, isRecorded?: boolean,
 *   isMoving?: boolean, isReduced?: boolean}} Picture
 */
/**
 * Where a picture was taken from, and through which lens: pixels of the picture as it came, and world_from_camera as 12
 * numbers, row by row, in mm.
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number,
 *   world_from_camera: number[]}} Camera
 */

const LENGTH_BYTES = 4;
/** Who waits no more. */
const NOBODY = { resolve() {}, reject() {} };

/** @param {ArrayBuffer} message @returns {[Record<string, any>, Blob]} head and image */
export function unpack(message) {
  const length = new DataView(message).getUint32(0);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(message, LENGTH_BYTES, length)));
  return [head, new Blob([new Uint8Array(message, LENGTH_BYTES + length)], { type: head.media_type })];
}

export class Stream {
  constructor() {
    this.socket = null;
    this.number = 0;
    /** @type {Map<number, {resolve: (answer?: Picture) => void, reject: (error: Error) => void}>} under way, in order */
    this.pending = new Map();
  }

  get isOpen() {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  /** Whether the service works on something, also on what nobody waits for. */
  get isBusy() {
    return this.pending.size > 0;
  }

  get isConnecting() {
    return this.socket?.readyState === WebSocket.CONNECTING;
  }

  connect() {
    this.close();
    const socket = (this.socket = new WebSocket(new URL("/stream", location.href.replace(/^http/, "ws"))));
    const key = currentKey();
    socket.binaryType = "arraybuffer";
    socket.addEventListener("open", () => key && socket.send(JSON.stringify({ authorize: key })));
    socket.addEventListener("message", (event) => socket === this.socket && this.#take(event.data, key));
    socket.addEventListener("close", () => socket === this.socket && this.#fail(connectionLost()));
  }

  /** Wait no more for what was asked; no picture of it is taken when it comes. */
  giveUp() {
    for (const [id, { reject }] of this.pending) {
      this.pending.set(id, NOBODY);
      reject(connectionLost());
    }
  }

  close() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    this.#fail(connectionLost());
  }

  /**
   * Ask for one more view. The service answers in order, and may leave out views that later ones have overtaken.
   * @param {View} view
   * @returns {Promise<Picture>}
   */
  ask(view) {
    return this.#send(view);
  }

  /**
   * Ask whether a scene is there; answered as a view is.
   * @param {string} scene
   * @returns {Promise<void>}
   */
  confirm(scene) {
    return this.#send({ scene, confirm: true });
  }

  /** @param {object} message @returns {Promise<Picture | undefined>} what answers it; undefined: no picture, but it is there */
  #send(message) {
    const id = ++this.number;
    return new Promise((resolve, reject) => {
      this.pending.set(id, { resolve, reject });
      this.socket.send(JSON.stringify({ ...message, id }));
    });
  }

  #take(data, key) {
    if (typeof data === "string") {
      const document = JSON.parse(data);
      if (document.status === undefined) return this.#answered(document.id)?.resolve(); // it is there
      const problem = new Problem(document.status, document, document.retry_after_s);
      if (problem.status === 401 && key === currentKey()) askForKey(key ? wrongKeyWords(problem) : problem.message);
      if (document.id === undefined || document.id === null) this.#fail(problem);
      else this.#answered(document.id)?.reject(problem);
      return;
    }
    const [head, blob] = unpack(data);
    const asked = this.#answered(head.id);
    if (!asked) return;
    const { scene, state, t, iteration, unseen, camera, depth_range_mm: depthRangeMm, warnings, total_ms: totalMs } = head;
    const codes = warnings.map(({ code }) => code);
    asked.resolve({ blob, scene, state, t, iteration, unseen, codes, totalMs, camera, depthRangeMm, way: "stream" });
  }

  /** The view that is answered; those before it, which it has overtaken, get no answer. @param {number} id */
  #answered(id) {
    const asked = this.pending.get(id);
    if (!asked) return undefined;
    for (const [earlier, { reject }] of this.pending) {
      if (earlier > id) break;
      this.pending.delete(earlier);
      if (earlier < id) reject(Object.assign(new Error("overtaken"), { isOvertaken: true }));
    }
    return asked;
  }

  #fail(problem) {
    const pending = [...this.pending.values()];
    this.pending.clear();
    for (const { reject } of pending) reject(problem);
  }
}
