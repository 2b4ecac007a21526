// The model's picture over /stream. A view that moves is asked for again and again, the newest wish alone; one that rests
// at the newest moment is followed: the service sends each newer moment by itself.

import { askForKey, currentKey } from "../base/key.js";
import { Problem, wrongKeyWords } from "../base/problem.js";
import { unpack } from "../stage/stream.js";

/** @typedef {{scene: string, t: string, pose?: string, follow?: true}} Wish of a view */
/**
 * tries: how often the same was asked for before without a good picture. againMs: when to ask once more for one.
 * @typedef {{id: number, wish: Wish, atMs: number, isAnswered: boolean, isRefused: boolean, tries: number, againMs: number}} Asked
 */
/**
 * What came. image: of the view. capturedAtS: the moment of the feed. asked: the wish that it answers.
 * @typedef {{asked: Wish, capturedAtS: number, camera: import("../stage/stream.js").Camera | null, unseen: number,
 *   warnings: import("../base/wire.js").Notice[]}} ModelShown
 */

const RECONNECT_MS = 500;
const AGAIN_MS = 1000;
/** A coarse view is asked for again ever more rarely, up to this: rendering it adds to the load that makes it coarse. */
const MAX_AGAIN_MS = 8000;
/** An answer that has not come after this comes over another connection. */
const SILENCE_MS = 5000;
const BUSY = [429, 503];
const QUALITY = 85;
/** The notice of a picture that will be sharper once there is time. */
const COARSE = "coarse";

/** Tells "shown", "answered" when the service has said anything, and "refused" with a Problem. */
export class ModelPicture extends EventTarget {
  /** @param {HTMLCanvasElement} canvas @param {import("./clock.js").FeedClock} clock */
  constructor(canvas, clock) {
    super();
    Object.assign(this, { canvas, clock, number: 0, drawn: 0, socket: null });
    /** @type {Wish | null} */
    this.wish = null;
    /** @type {Asked | null} what was asked for last */
    this.asked = null;
    /** @type {ModelShown | null} */
    this.shown = null;
    setInterval(() => this.#watch(), AGAIN_MS);
  }

  /** Show none until the next comes. */
  clear() {
    this.shown = null;
    this.drawn = this.number;
    this.canvas.hidden = true;
    this.canvas.width = this.canvas.height = 0;
  }

  /** @param {Wish | null} wish null: nothing, and no connection */
  want(wish) {
    this.wish = wish;
    if (wish === null) {
      this.socket?.close();
      this.socket = this.asked = null;
    } else if (this.socket === null) this.#connect();
    else this.#send();
  }

  #connect() {
    const socket = (this.socket = new WebSocket(new URL("/stream", location.href.replace(/^http/, "ws"))));
    const key = currentKey();
    socket.binaryType = "arraybuffer";
    this.asked = null;
    socket.addEventListener("open", () => {
      if (key) socket.send(JSON.stringify({ authorize: key }));
      this.#send();
    });
    socket.addEventListener("message", (event) => socket === this.socket && this.#take(event.data, key));
    socket.addEventListener("close", () => {
      if (socket !== this.socket) return;
      this.asked = null;
      setTimeout(() => socket === this.socket && this.wish !== null && this.#connect(), RECONNECT_MS);
    });
  }

  /** Ask for what is wished, unless that was asked for already or an answer is under way. */
  #send(tries = 0) {
    const { socket, wish, asked } = this;
    if (wish === null || socket?.readyState !== WebSocket.OPEN) return;
    if (asked && (!asked.isAnswered || JSON.stringify(asked.wish) === JSON.stringify(wish))) return;
    this.asked = { id: ++this.number, wish, atMs: performance.now(), isAnswered: false, isRefused: false, tries, againMs: Infinity };
    socket.send(JSON.stringify({ format: "jpeg", quality: QUALITY, ...wish, id: this.number }));
  }

  #watch() {
    const { asked, socket } = this;
    if (asked && !asked.isAnswered && performance.now() - asked.atMs > SILENCE_MS) socket?.close();
    if (asked && performance.now() >= asked.againMs && this.#isUnfinished(asked)) this.#sendAgain(asked.tries + 1);
  }

  /** Whether a view that rests has lost its picture, or has a coarse one. @param {Asked} asked */
  #isUnfinished({ wish, isAnswered, isRefused }) {
    if (!isAnswered || isRefused || wish.follow) return false;
    return this.shown?.asked !== wish || this.shown.warnings.some(({ code }) => code === COARSE);
  }

  #sendAgain(tries) {
    this.asked = null;
    this.#send(tries);
  }

  #take(data, key) {
    this.dispatchEvent(new Event("answered"));
    if (typeof data === "string") return this.#fail(JSON.parse(data), key);
    const receivedMs = performance.now();
    const [head, blob] = unpack(data);
    const capturedAtS = Date.parse(head.captured_at) / 1000;
    const { asked } = this;
    const isAnswer = asked?.id === head.id && !asked.isAnswered;
    this.clock.note(capturedAtS + head.age_s, receivedMs);
    if (asked?.id !== head.id) return; // of a view that nobody waits for any more
    if (isAnswer) {
      asked.isAnswered = true;
      asked.againMs = receivedMs + Math.min(MAX_AGAIN_MS, AGAIN_MS * 2 ** asked.tries);
    }
    this.#show(blob, { asked: asked.wish, capturedAtS, camera: head.camera, unseen: head.unseen, warnings: head.warnings });
    this.#send();
  }

  #fail(document, key) {
    const problem = new Problem(document.status, document, document.retry_after_s);
    if (problem.status === 401 && key === currentKey()) askForKey(key ? wrongKeyWords(problem) : problem.message);
    const { asked } = this;
    if (!asked || document.id !== asked.id) return;
    asked.isAnswered = asked.isRefused = true;
    this.dispatchEvent(new CustomEvent("refused", { detail: problem }));
    if (JSON.stringify(asked.wish) !== JSON.stringify(this.wish)) this.#send();
    else if (BUSY.includes(problem.status) && !asked.wish.follow) {
      setTimeout(() => this.asked === asked && this.#sendAgain(asked.tries), Math.max(AGAIN_MS, 1000 * problem.turnInS));
    }
  }

  async #show(blob, shown) {
    const number = ++this.number; // also orders pictures that are decoded at once
    const bitmap = await createImageBitmap(blob).catch(() => null);
    if (bitmap === null) return; // damaged: a view that rests is asked for again
    if (number > this.drawn && this.wish?.scene === shown.asked.scene) {
      this.drawn = number;
      const { canvas } = this;
      if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
        [canvas.width, canvas.height] = [bitmap.width, bitmap.height];
      }
      canvas.getContext("2d").drawImage(bitmap, 0, 0);
      canvas.hidden = false;
      this.shown = shown;
      this.dispatchEvent(new CustomEvent("shown", { detail: shown }));
    }
    bitmap.close();
  }
}
