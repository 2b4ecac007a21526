// How the feed does, in words and numbers: what comes in, what the model learns of it, and whether it is recorded.

import { element, setText } from "../base/element.js";
import { figure, hasWords, words } from "../base/messages.js";
import { isBack } from "./headline.js";

/** States in which pairs come in and are recorded, unless `recording` says why not. */
const RECORDED = ["live", "behind"];
const MB = 1e6;

/** @param {string | null} reason @returns {string} */
const reasonWords = (reason) =>
  words(hasWords(`live.reason_${reason}`) ? `live.reason_${reason}` : "live.reason_unclassified");

/** Why the feed is in its state; "" while all is well. @param {import("./feeds.js").Feed} feed */
export const whyOf = ({ reason }) => (reason === null ? "" : reasonWords(reason));

/** @param {import("./feeds.js").Feed} feed @returns {string} whether it is recorded */
function recordingOf({ state, recording }) {
  if (recording !== null) return words("live.not_recorded_why", { why: reasonWords(recording) });
  return words(RECORDED.includes(state) ? "live.recorded" : "live.not_recorded");
}

const secondsWords = (s, digits = 2) => (s == null || Number.isNaN(s) ? "–" : words("live.in_seconds", { s: figure(s, digits) }));

/**
 * @param {import("./feeds.js").Feed} feed
 * @param {number} sentRate pictures a second that this browser sends; NaN: none
 * @returns {[string, string | null][]} name and value; null: the model's age
 */
function rowsOf(feed, sentRate) {
  const rate = (fps) => words("live.per_second", { fps: figure(fps, 1) });
  const rows = [
    [words("live.recording"), recordingOf(feed)],
    [words("live.received"), rate(feed.received_fps)],
    [words("live.used"), rate(feed.used_fps)],
    [words("live.dropped"), figure(feed.dropped)],
    [words("live.lag"), secondsWords(feed.decode_lag_s)],
    [words("live.model_age"), null],
    [words("live.reconnects"), figure(feed.reconnects)],
    [words("live.stored"), words("live.megabytes", { mb: figure(feed.stored_bytes / MB, 1) })],
  ];
  return Number.isNaN(sentRate) ? rows : [[words("live.sent"), rate(sentRate)], ...rows];
}

export class Health {
  /** @param {{summary: HTMLElement, list: HTMLDListElement, why: HTMLElement}} parts */
  constructor(parts) {
    this.parts = parts;
    /** @type {HTMLElement | null} where the model's age stands */
    this.age = null;
    this.modelAgeS = NaN;
  }

  /** @param {number} modelAgeS as the screen has it; NaN: unknown */
  tellAge(modelAgeS) {
    this.modelAgeS = modelAgeS;
    if (this.age) setText(this.age, secondsWords(modelAgeS, 1));
  }

  /**
   * @param {import("./feeds.js").Feed | null} feed
   * @param {number} sentRate
   * @param {number | null} pictureAtS of the endoscope's picture in sight, UNIX time
   */
  refresh(feed, sentRate, pictureAtS) {
    const { summary, list, why } = this.parts;
    setText(why, feed === null || isBack(feed, pictureAtS) ? "" : whyOf(feed));
    setText(summary, feed === null ? words("live.health") : recordingOf(feed));
    const rows = feed === null ? [] : rowsOf(feed, sentRate);
    while (list.children.length > rows.length) list.lastChild.remove();
    while (list.children.length < rows.length) list.append(element("div", {}, element("dt"), element("dd")));
    for (const [i, [name, value]] of rows.entries()) {
      setText(list.children[i].firstChild, name);
      if (value === null) this.age = list.children[i].lastChild;
      else setText(list.children[i].lastChild, value);
    }
    this.tellAge(this.modelAgeS);
  }
}
