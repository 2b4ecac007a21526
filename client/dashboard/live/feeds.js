// The service's routes of live feeds, as this screen uses them. What goes wrong is thrown as a Problem.

import { bodyOf, request } from "../base/api.js";
import { ServerEvents } from "../base/events.js";

/**
 * A feed as the service shows it. Moments are UNIX times, s.
 * @typedef {{id: string, label: string | null, state: string, reason: string | null, text: string, since_s: number,
 *   recording: string | null, received_fps: number, used_fps: number, dropped: number, model_age_s: number | null,
 *   decode_lag_s: number | null, reconnects: number, last_frame_at_s: number | null, stored_bytes: number,
 *   begins_s: number | null, ends_s: number | null, gaussians: number, wish: string,
 *   options: {source: string | null, keep_s: number, layout: string}}} Feed
 */
/**
 * blob: null: it is the one that the caller has.
 * @typedef {{blob: Blob | null, tag: string, capturedAtS: number, ageS: number, sentMs: number,
 *   receivedMs: number}} LiveImage
 */

const RETRY_MS = 500;
/** Numbers come once a second. */
const SILENCE_MS = 4000;
const NOT_MODIFIED = 304;
const GONE = 404;
/** Longer than a picture takes on a slow line. */
const PICTURE_MS = 5000;

const json = async (path, options) => bodyOf(await request(path, options));
const posted = (body, headers = {}) => ({
  method: "POST",
  headers: { "Content-Type": "application/json", ...headers },
  body: JSON.stringify(body),
});

/** @returns {Promise<Feed[]>} the open ones, the newest first */
export const listFeeds = () => json("/feeds");
/** @param {string} id @returns {Promise<Feed>} */
export const pauseFeed = (id) => json(`/feeds/${id}/pause`, { method: "POST" });
/** @param {string} id @returns {Promise<Feed>} */
export const resumeFeed = (id) => json(`/feeds/${id}/resume`, { method: "POST" });
/** @param {string} id @returns {Promise<{bytes: number, record: boolean, verified: boolean}>} */
export const endFeed = (id) => json(`/feeds/${id}`, { method: "DELETE" });

/**
 * @param {Record<string, unknown>} options of POST /feeds
 * @param {File} calibration
 * @returns {Promise<Feed>}
 */
export function openFeed(options, calibration) {
  const body = new FormData();
  body.append("options", JSON.stringify(options));
  body.append("calibration", calibration, `calibration${/\.\w+$/.exec(calibration.name)?.[0] ?? ".json"}`);
  return json("/feeds", { method: "POST", body });
}

/**
 * Make a job of a part of the recording.
 * @param {string} id
 * @param {{from: number | string, to: number | string, label?: string}} part
 * @returns {Promise<import("../base/api.js").Job & {cut: {from_s: number, to_s: number}}>}
 */
export function cutFeed(id, part) {
  const key = [...crypto.getRandomValues(new Uint32Array(4))].map((number) => number.toString(16)).join("-");
  return json(`/feeds/${id}/cut`, posted(part, { "Idempotency-Key": key }));
}

/**
 * The newest picture of the left eye.
 * @param {string} id
 * @param {string | null} tag of the picture that the caller has
 * @returns {Promise<LiveImage>}
 */
export async function getLivePicture(id, tag) {
  const sentMs = performance.now();
  const options = { signal: AbortSignal.timeout(PICTURE_MS), headers: tag ? { "If-None-Match": tag } : {} };
  const response = await request(`/scenes/${id}/recorded?t=live&masks=off`, options);
  const receivedMs = performance.now();
  const [capturedAt, age] = ["Captured-At", "Age-S"].map((name) => response.headers.get(`X-Intrasplat-${name}`));
  const blob = response.status === NOT_MODIFIED ? null : await bodyOf(response, "blob");
  const times = { capturedAtS: Date.parse(capturedAt) / 1000, ageS: Number(age), sentMs, receivedMs };
  return { blob, tag: response.headers.get("ETag"), ...times };
}

/** Follows what a feed says of itself until it has ended; comes again after a lost connection. */
export class FeedEvents extends ServerEvents {
  /**
   * @param {string} id
   * @param {(feed: Feed) => void} onFeed
   * @param {() => void} onGone the feed is no more, or not this key's
   */
  constructor(id, onFeed, onGone) {
    super(`/feeds/${id}/events`, { retryMs: RETRY_MS, silenceMs: SILENCE_MS });
    Object.assign(this, { onFeed, onGone });
    this.start();
  }

  take(events) {
    const last = events.findLast(({ type }) => type === "feed");
    if (last && !this.isOver) this.onFeed(JSON.parse(last.data));
  }

  fail(error) {
    if (error.status !== GONE || this.isOver) return;
    this.stop();
    this.onGone();
  }
}
