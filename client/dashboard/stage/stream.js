// Pictures over one WebSocket: a view is asked for, its picture comes back, then the next.

import { askForKey, currentKey } from "../base/key.js";
import { connectionLost, Problem, wrongKeyWords } from "../base/problem.js";

/**
 * What is asked for; the query of GET /render.
 * @typedef {{scene: string, t: number, pose?: string, eye?: "right", layer: string, unseen: string, highlights: string,
 *   format: string, light?: "recorded", smoke?: "show", near_mm?: number, far_mm?: number}} View
 */
/**
 * What came: a file, or an image that this browser drew. way: how. isExtrapolated: it shows a guess, or a pose or time far
 * from the clip's. isRecorded: it is a frame of the clip, no render. Both are set by judged() of pictures.js.
 * depthRangeMm: of depth in false colours, of the brightest and of the darkest. isMoving: as of Shown in viewer.js.
 * @typedef {{blob?: Blob, image?: HTMLCanvasElement, scene: string, state: "running"|"done", t: number, iteration: number | null,
 *   unseen: number, codes: string[], totalMs: number, way: "stream"|"single"|"memory",
 *   camera: Camera | null, depthRangeMm?: [number, number] | null, isExtrapolated?: boolean, isRecorded?: boolean,
 *   isMoving?: boolean}} Picture
 */
/**
 * Where a picture was taken from, and through which lens: pixels of the picture as it came, and world_from_camera as 12
 * numbers, row by row, in mm.
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number,
 *   world_from_camera: number[]}} Camera
 */

const LENGTH_BYTES = 4;

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
    this.pending = null; // the one view that is under way
  }

  get isOpen() {
    return this.socket?.readyState === WebSocket.OPEN;
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
    socket.addEventListener("close", () => socket === this.socket && this.giveUp());
  }

  /** Wait no more for what was asked; its picture is not taken when it comes. */
  giveUp() {
    this.#fail(connectionLost());
  }

  close() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    this.giveUp();
  }

  /** @param {View} view @returns {Promise<Picture>} */
  ask(view) {
    this.giveUp();
    const id = ++this.number;
    return new Promise((resolve, reject) => {
      this.pending = { id, resolve, reject };
      this.socket.send(JSON.stringify({ ...view, id }));
    });
  }

  #take(data, key) {
    if (typeof data === "string") {
      const document = JSON.parse(data);
      const problem = new Problem(document.status, document, document.retry_after_s);
      if (problem.status === 401 && key === currentKey()) askForKey(key ? wrongKeyWords(problem) : problem.message);
      if (document.id === undefined || document.id === null || document.id === this.pending?.id) this.#fail(problem);
      return;
    }
    const [head, blob] = unpack(data);
    if (head.id !== this.pending?.id) return; // of a view that nobody waits for any more
    const { resolve } = this.pending;
    this.pending = null;
    const { scene, state, t, iteration, unseen, camera, depth_range_mm: depthRangeMm, warnings, total_ms: totalMs } = head;
    const codes = warnings.map(({ code }) => code);
    resolve({ blob, scene, state, t, iteration, unseen, codes, totalMs, camera, depthRangeMm, way: "stream" });
  }

  #fail(problem) {
    const pending = this.pending;
    this.pending = null;
    pending?.reject(problem);
  }
}
