// Reads the word on top aloud once it rests: not while a hand moves it, nor at every second of a number that runs.

import { setText } from "../base/element.js";
import { language } from "../base/messages.js";

const REST_MS = 700;
/** Kinds whose numbers a hand chooses; the others' run by themselves. */
const BY_HAND = ["frozen", "back"];

export class Aloud {
  /** @param {HTMLElement} line of role status, for readers of the screen */
  constructor(line) {
    Object.assign(this, { line, text: "", sinceMs: 0, place: "", isSaid: false });
  }

  /** @param {import("./headline.js").Headline} top @param {string} text its words */
  note({ kind, place }, text) {
    const nowMs = performance.now();
    const placeNow = `${language()} ${place}`;
    if (placeNow !== this.place) Object.assign(this, { place: placeNow, isSaid: false });
    if (text !== this.text) {
      Object.assign(this, { text, sinceMs: nowMs });
      setText(this.line, ""); // what it said is no longer so
    }
    if (nowMs - this.sinceMs < REST_MS || (this.isSaid && !BY_HAND.includes(kind))) return;
    this.isSaid = true;
    setText(this.line, text);
  }
}
