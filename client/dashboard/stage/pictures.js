// Where pictures come from: the stream, and one by one from GET /render while there is no stream.

import { bodyOf, request, SILENCE_MS, stillThere } from "../base/api.js";
import { keyEvents } from "../base/key.js";
import { noticeWords, words } from "../base/messages.js";
import { Line } from "./line.js";
import { Stream } from "./stream.js";

/** @typedef {import("./stream.js").View} View */
/** @typedef {import("./stream.js").Picture} Picture */

/** Longer than the service waits for a worker (render_timeout_s). */
const ANSWER_MS = 25000;
const FIRST_RETRY_MS = 1000;
const MAX_RETRY_MS = 15000;

/** Not a layer of the model, but what the endoscope saw, with the masked parts marked. */
const RECORDED = "recorded";

/** A smaller share of a view is no hatch that anybody sees. The service warns from 0.05 on. */
const LEAST_UNSEEN = 0.005;
const GUESSES = ["pose_far", "time_outside_clip"];
/** What a view itself says; all other notices are of its scene. */
const OF_VIEW = [...GUESSES, "unseen", "hardly_seen", "enlarged"];

/** @param {string} path @param {AbortSignal} signal @returns {Promise<Picture>} */
async function askOnce(path, signal) {
  const response = await request(path, { signal });
  const header = (name) => response.headers.get(`X-Intrasplat-${name}`);
  const total = /total;dur=([\d.]+)/.exec(response.headers.get("Server-Timing") ?? "");
  return {
    blob: await bodyOf(response, "blob"),
    scene: header("Scene"),
    state: header("State"),
    t: Number(header("T")),
    iteration: header("Iteration") === null ? null : Number(header("Iteration")),
    unseen: Number(header("Unseen")),
    codes: header("Warning-Codes")?.split(", ") ?? [],
    totalMs: total ? Number(total[1]) : NaN,
    camera: JSON.parse(header("Camera") ?? "null"),
    depthRangeMm: header("Depth-Range-Mm")?.split(" ").map(Number) ?? null,
    way: "single",
  };
}

/**
 * Whether a notice says that a picture shows a guess. What is hatched is none, and at the endoscope's own pose the clip
 * saw what is shown, hardly or well.
 * @param {string} code @param {View} view
 */
function isGuess(code, view) {
  if (code === "unseen") return view.unseen === "guess";
  if (code === "hardly_seen") return view.pose !== undefined;
  return GUESSES.includes(code);
}

const withViewFirst = (codes) => [true, false].flatMap((isOfView) => codes.filter((code) => OF_VIEW.includes(code) === isOfView));

/** What to know of a view, in the page's words. @param {string} code @param {View} view */
function wordsOf(code, view) {
  if (code === "unseen" && view.layer === "error") return words("picture.not_compared");
  return code === "unseen" && view.unseen === "guess" ? words("picture.guessed") : noticeWords({ code, text: "" });
}

/**
 * What to know of a picture: of this view first, then of its scene.
 * @param {string[]} codes of the picture @param {View} view
 * @param {{code: string, text: string}[]} reasons for care with the scene, in words
 * @returns {string[]} sentences, each once
 */
export function warningsOf(codes, view, reasons) {
  const own = codes.filter((code) => !reasons.some((reason) => reason.code === code));
  const sentences = [...withViewFirst(own).map((code) => wordsOf(code, view)), ...reasons.map(({ text }) => text)];
  return [...new Set(sentences)].filter(Boolean);
}

/** Note of a picture of a view what its codes mean. @param {Picture} picture @param {View} view @returns {Picture} */
export function judged(picture, view) {
  const isUnseen = picture.unseen >= LEAST_UNSEEN && !picture.codes.includes("unseen");
  if (isUnseen) picture.codes = [...picture.codes, "unseen"]; // what is hatched, or guessed, is named
  picture.isRecorded = view.layer === RECORDED;
  picture.isExtrapolated = picture.codes.some((code) => isGuess(code, view));
  return picture;
}

/** @param {View} view */
const pathOf = (view) =>
  view.layer === RECORDED ? `/scenes/${view.scene}/recorded?t=${view.t}` : `/render?${new URLSearchParams(view)}`;

export class Pictures {
  constructor() {
    this.stream = new Stream();
    this.line = new Line();
    this.retryMs = FIRST_RETRY_MS;
    this.retryAt = 0;
    this.controller = new AbortController();
    keyEvents.addEventListener("changed", () => {
      this.stream.close();
      this.retryAt = 0;
    });
  }

  /** Wait no more for what was asked. */
  giveUp() {
    this.controller.abort();
    this.stream.giveUp();
  }

  /** @param {View} view @returns {number} how many pictures of such views may be under way at a time, while they change */
  depthOf(view) {
    return this.#isStreamed(view) ? this.line.depth : 1;
  }

  /**
   * The picture of a view; one at a time, or as many as depthOf() says. Where the line is slow it is smaller and coarser.
   * @param {View} view
   * @param {{isFull?: boolean, width?: number}} how isFull: as large as it is; width: of the full picture, if it is known
   * @returns {Promise<Picture>}
   */
  async ask(view, { isFull = true, width } = {}) {
    this.#keepOpen();
    const { line } = this;
    const level = isFull || view.layer === RECORDED ? 0 : line.level;
    const wanted = { ...view, ...line.reduction(level, width) };
    const began = performance.now();
    const picture = this.#isStreamed(view) ? await this.#inTime(this.stream.ask(wanted), ANSWER_MS) : await this.#fromPath(pathOf(wanted));
    if (picture.scene !== view.scene) throw new Error(words("page.other_scene"));
    if (view.layer !== RECORDED) line.note(picture.blob.size, performance.now() - began, picture.totalMs || 0, level);
    picture.isReduced = level > 0;
    return picture;
  }

  /**
   * Return if a finished scene is still there; throws as a picture of it would. Over the stream that costs the line least.
   * @param {string} scene
   */
  async confirm(scene) {
    this.#keepOpen();
    if (!this.stream.isOpen || this.stream.isBusy) return stillThere(scene);
    return this.#inTime(this.stream.confirm(scene), SILENCE_MS);
  }

  /** @param {View} view */
  #isStreamed(view) {
    return this.stream.isOpen && view.layer !== RECORDED;
  }

  /** Have the stream back for the next picture. @returns {boolean} whether it would come another way than the last */
  prepare(way) {
    this.#keepOpen();
    return way === "single" && this.stream.isOpen;
  }

  #keepOpen() {
    if (this.stream.isOpen) this.retryMs = FIRST_RETRY_MS;
    if (this.stream.isOpen || this.stream.isConnecting || performance.now() < this.retryAt) return;
    this.retryAt = performance.now() + this.retryMs;
    this.retryMs = Math.min(MAX_RETRY_MS, this.retryMs * 2);
    this.stream.connect();
  }

  async #fromPath(path) {
    this.controller = new AbortController();
    return askOnce(path, AbortSignal.any([this.controller.signal, AbortSignal.timeout(ANSWER_MS)]));
  }

  /** The stream's answer; a connection that is silent for this long is dead. */
  async #inTime(answer, ms) {
    const timer = setTimeout(() => this.stream.close(), ms);
    try {
      return await answer;
    } finally {
      clearTimeout(timer);
    }
  }
}
